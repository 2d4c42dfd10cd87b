"""`spn-data report` on a real area: the page shows the stored results and leaves out stale stages."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from spn_cli.data import main

from spn_data.colmap.model import read_scene
from tests.worlds.report_data import unpack


def run(area: Path, *options: str) -> Result:
    """Run `spn-data report` on an area."""
    return CliRunner().invoke(main, ["report", "--area", str(area), *options])


def given(page: Path) -> dict:
    """Return the data embedded in the page for its script."""
    (text,) = re.findall(
        r'<script type="application/json" id="data">(.*?)</script>', page.read_text("ascii")
    )
    return json.loads(text)


@pytest.fixture
def area(finished_area: Path, tmp_path: Path) -> Path:
    """A copy of the area that a test may change, without database and images."""
    copy = tmp_path / "area"
    shutil.copytree(finished_area, copy, ignore=shutil.ignore_patterns("*.jpg", "*.db"))
    return copy


def test_the_page_holds_what_the_area_holds(area):
    """The page has all candidates of frames.csv, the poses of the model and the residuals of geo.json."""
    before = sorted(path for path in area.rglob("*") if path.is_file())
    ran = run(area)
    assert ran.exit_code == 0, ran.output
    after = sorted(path for path in area.rglob("*") if path.is_file())
    assert after == before

    frames = given(area / "report.html")["frames"]
    with (area / "1-frames" / "frames.csv").open(newline="") as file:
        assert sorted(frames["name"]) == sorted(row["name"] for row in csv.DictReader(file))
    scene = read_scene(area / "3-geo")
    centers = dict(zip(frames["name"], unpack(frames["center"]).reshape(-1, 3), strict=True))
    found = np.array([centers[name] for name in scene.names])
    np.testing.assert_allclose(found, scene.poses.centers, atol=1e-5)
    assert np.isfinite(found).all()
    assert np.isfinite(list(centers.values())).all(axis=1).sum() == len(scene.names)

    geo = json.loads((area / "3-geo" / "geo.json").read_text())
    residuals = dict(zip(frames["name"], unpack(frames["gnss_m"]).reshape(-1, 3), strict=True))
    np.testing.assert_allclose(
        [residuals[name] for name in geo["frames"]], geo["residuals_m"], atol=1e-5
    )


def test_the_page_holds_the_stored_images(finished_area, tmp_path):
    """Each frame that was tried has an image in the page, and a link to the full one."""
    area = tmp_path / "area"
    shutil.copytree(finished_area, area, ignore=shutil.ignore_patterns("*.db"))
    ran = run(area)
    assert ran.exit_code == 0, ran.output
    data = given(area / "report.html")
    rows = sorted(map(int, data["images"]))
    names = [data["frames"]["name"][row] for row in rows]
    stored = {
        path.relative_to(area / "1-frames").as_posix() for path in area.glob("1-frames/*/*.jpg")
    }
    assert set(names) == stored
    assert all((area / data["files"][str(row)]).is_file() for row in rows)
    assert (area / ".thumbnails.json").is_file()


def test_the_head_has_the_time_of_the_last_change(area):
    """An evaluation after the last stage counts; writing the page again does not."""
    run(area)
    told = re.compile(r"last change ([-:\d ]+) UTC")
    (before,) = told.findall((area / "report.html").read_text("ascii"))
    finished = [json.loads(path.read_text())["finished"] for path in area.glob("*/stage.json")]
    assert before == max(finished)[:16].replace("T", " ")
    metrics = area / "runs" / "first" / "metrics.json"
    metrics.parent.mkdir(parents=True)
    metrics.write_text("{}")
    os.utime(metrics, (1_900_000_000, 1_900_000_000))
    run(area)
    assert told.findall((area / "report.html").read_text("ascii")) == ["2030-03-17 17:46"]


def test_the_command_tells_the_verdict(area):
    """The verdict of the page and the next step are also printed."""
    ran = run(area)
    assert "Data: Not ready to train: 1 thing to do first: see" in ran.output
    assert "Network: Not measured: no network is trained." in ran.output
    assert "Flight: Not measured: no bundle is exported." in ran.output
    assert ran.output.endswith(f"Next: Split the frames: spn-data split --area {area}\n")


def test_the_status_ends_with_the_next_step_for_the_current_folder(area, monkeypatch):
    """The status ends with a command that can be typed where it was run: in the area, and above it."""
    for here, option in ((area, ""), (area.parent, f" --area {area.name}")):
        monkeypatch.chdir(here)
        ran = CliRunner().invoke(main, ["status", "--area", str(area)])
        assert ran.exit_code == 0, ran.output
        assert ran.output.endswith(f"Next: Split the frames: spn-data split{option}\n")


def test_a_stale_stage_is_named_and_left_out(area):
    """After the model has been redone, the stale georegistration is named and not shown."""
    path = area / "2-model" / "stage.json"
    record = json.loads(path.read_text())
    record["counts"]["points"] += 1
    path.write_text(json.dumps(record))
    ran = run(area)
    assert ran.exit_code == 0, ran.output
    assert "Not ready to train: 2 things to do first: see" in ran.output
    page = (area / "report.html").read_text("ascii")
    assert "3-geo is out of date: 2-model was redone since." in page
    assert given(area / "report.html")["units"] == "model"


@pytest.mark.parametrize("is_there", [True, False])
def test_the_next_step_names_the_sources_that_are_where_they_were(area, tmp_path, is_there):
    """A stale model is redone from the sources in area.toml, or from VIDEO where they are gone."""
    path = area / "1-frames" / "stage.json"
    record = json.loads(path.read_text())
    record["counts"]["candidates"] += 1
    path.write_text(json.dumps(record))
    video = tmp_path / "my flight.mp4"
    (area / "area.toml").write_text(f'version = 1\nsources = ["{video}"]\n')
    if is_there:
        video.write_bytes(b"")
    source = f"'{video}'" if is_there else "VIDEO"
    assert run(area).output.endswith(f"spn-data reconstruct {source} --overwrite --area {area}\n")


def test_an_area_without_a_model_has_a_report(area):
    """An area with frames only still has a report, which names the next step."""
    shutil.rmtree(area / "3-geo")
    shutil.rmtree(area / "2-model")
    ran = run(area)
    assert ran.exit_code == 0, ran.output
    assert "Next: Reconstruct the model: spn-data reconstruct" in ran.output
    assert given(area / "report.html")["points"] is None


def test_a_folder_that_is_no_area_is_refused(tmp_path):
    """A folder without frames is rejected in one line that names the command to run."""
    folder = tmp_path / "area"
    ran = run(folder)
    assert ran.exit_code == 1
    assert ran.output.splitlines() == [
        f"Error: {folder} contains no frames; run spn-data reconstruct first"
    ]
    assert not folder.exists()


def test_damaged_residuals_are_an_error(area):
    """Residuals that do not match the frames are an error."""
    path = area / "3-geo" / "geo.json"
    value = json.loads(path.read_text())
    value["frames"] = value["frames"][1:]
    path.write_text(json.dumps(value))
    ran = run(area)
    assert ran.exit_code == 1
    assert "the numbers of residuals and frames differ" in ran.output
