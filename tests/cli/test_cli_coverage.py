"""`spn-data coverage`: printed output, written files and rejected input."""

from __future__ import annotations

import csv
import json
import re
import shutil
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner
from spn_cli.data import main

from spn_data.area.area import Area
from spn_data.area.names import EVALUATION, FRAMES, GEO, PLANNED_COVERAGE
from spn_data.coverage.nearest_frame import CoverageOptions, coverage_strata
from spn_data.coverage.sequence_table import COLUMNS
from spn_data.coverage.waypoints import WaypointFrame, read_waypoints
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_to_json
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import angles_from_rotations
from spn_data.inputs.area_labels import (
    LabelledArea,
    read_labelled_area,
    read_world_from_model,
)
from spn_data.labels.labels import LabelObservations, Labels, write_label_observations, write_labels
from spn_data.pipeline.area_coverage import read_coverage, stale_because
from spn_data.storage.json_files import read_json, write_json

ROOT = Path(__file__).resolve().parents[2]


def register(area: Area, name: str, poses: Poses, status: list[str]) -> None:
    """Write an evaluation sequence as a stage of the area; failed frames get no pose."""
    n = len(poses)
    centers, quats = poses.centers.copy(), poses.quats_wxyz.copy()
    failed = np.array(status) == "failed"
    centers[failed], quats[failed] = np.nan, np.nan
    labels = Labels(
        names=np.array([f"{name}/{k:06d}.jpg" for k in range(n)]),
        sequences=np.full(n, name),
        cameras=np.full(n, name),
        sources=np.full(n, f"{name}.mp4"),
        video_frame=np.arange(n),
        tracked=np.zeros(n, bool),
        time_s=np.arange(n) / 2,
        status=np.array(status),
        reason=np.where(failed, "ambiguous", ""),
        poses=Poses(centers, quats),
        covariance=np.full((n, 6, 6), np.nan),
        inliers=np.zeros(n, np.int64),
        coverage=np.zeros(n),
        error_px=np.full(n, np.nan),
    )
    work = area.begin(f"{EVALUATION}/{name}", {"n": n}, {}, overwrite=True)
    write_labels(work.path / "poses.csv", labels)
    nothing = np.zeros(0, np.int64)
    write_label_observations(
        work.path / "observations.npz", LabelObservations(nothing, nothing, np.zeros((0, 2)))
    )
    camera = next(iter(read_json(area.folder("1-frames") / "cameras.json")["cameras"].values()))
    write_json(work.path / "camera.json", {"version": 1, **camera})
    transform = read_world_from_model(area).to_json()
    write_json(work.path / "registration.json", {"version": 1, "world_from_model": transform})
    work.finish(counts={"frames": n}, seconds={}, cpu_seconds={})


@pytest.fixture(scope="module")
def labelled(finished_area: Path) -> LabelledArea:
    """The labels of the finished area."""
    return read_labelled_area(Area(finished_area))


@pytest.fixture
def area(finished_area: Path, labelled: LabelledArea, tmp_path: Path) -> Path:
    """A copy of the finished area with a sequence `near` 1 m above mapping frames, one of them failed."""
    folder = tmp_path / "area"
    shutil.copytree(finished_area, folder)
    poses = labelled.mapping.poses[labelled.mapping.registered][:6]
    lifted = Poses(poses.centers + np.array([0.0, 0.0, 1.0]), poses.quats_wxyz)
    register(Area(folder), "near", lifted, ["registered"] * 5 + ["failed"])
    return folder


def run(*words: str | Path, exit_code: int = 0) -> str:
    """Return the output of `spn-data coverage` with whitespace collapsed."""
    result = CliRunner().invoke(main, ["coverage", *map(str, words)])
    assert result.exit_code == exit_code, result.output
    return " ".join(result.output.split())


def rows_of(path: Path) -> list[dict[str, str]]:
    """Read the rows of a CSV file."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_evaluation_sequences_are_told_and_written(area):
    """Output and files show high coverage for five frames 1 m above mapping frames, and one failed frame."""
    shown = run("--area", area)
    assert "frames 6, 1 of them failed" in shown
    assert "high coverage 5 (100%); <= 2 m and <= 15 deg" in shown
    assert "Every frame with a pose has high coverage." in shown
    assert "near: 1 of 6 frames failed" in shown
    rows = rows_of(area / "coverage" / "near.csv")
    assert tuple(rows[0]) == COLUMNS
    assert [row["status"] for row in rows] == ["registered"] * 5 + ["failed"]
    assert [row["stratum"] for row in rows] == ["high"] * 5 + [""]
    assert rows[5]["reason"] == "ambiguous"
    for row in rows[:5]:
        assert 0 < float(row["distance"]) <= 1.0001
        assert 0.5 < float(row["view_share"]) <= 1
    found = read_coverage(Area(area))
    assert found["units"] == "m"
    assert found["sequences"]["near"]["failed"] == 1
    assert found["fly_again"] == []
    assert sorted(found["made_of"]) == ["2-model", "3-geo", "4-eval/near"]


def test_places_to_fly_again_close_the_gaps(area, labelled, tmp_path):
    """With the waypoints written by --fly-again as mapping frames, every frame has high coverage."""
    base = labelled.mapping.poses[labelled.mapping.registered][:6]
    away = Poses(base.centers + np.array([0.0, 0.0, 12.0]), base.quats_wxyz)
    register(Area(area), "away", away, ["registered"] * 6)
    shown = run("--area", area, "--fly-again", tmp_path / "again.csv")
    assert "away: 6 of 6 are above the highest mapping frame" in shown
    assert "would bring 6 frames to high coverage" in shown
    stops = read_waypoints(tmp_path / "again.csv", WaypointFrame(labelled.origin, 0.0))
    assert 1 <= len(stops) < 6
    assert set(coverage_strata(away, labelled.mapping.poses).tolist()) == {"low"}
    assert set(coverage_strata(away, stops.poses).tolist()) == {"high"}
    serves = [int(row["serves"]) for row in rows_of(tmp_path / "again.csv")]
    assert sum(serves) == 6
    listed = read_coverage(Area(area))["fly_again"]
    assert [stop["serves"] for stop in listed] == serves
    assert [stop["stop"] for stop in listed] == list(range(1, len(serves) + 1))


def test_a_plan_is_covered_instead(area, tmp_path):
    """Planned waypoints are named by their line numbers; the coverage of the sequences is unchanged."""
    run("--area", area)
    before = (area / "coverage" / "coverage.json").read_bytes()
    plan = tmp_path / "plan.csv"
    plan.write_text("x,y,z,heading_deg,pitch_deg,camera\n0,0,4,0,0,\n500,0,4,0,0,near\n")
    shown = run("--area", area, "--waypoints", plan, "--fov", "60")
    assert "frames 2" in shown
    rows = rows_of(area / PLANNED_COVERAGE / "waypoints.csv")
    assert [row["name"] for row in rows] == ["line 2", "line 3"]
    assert rows[1]["stratum"] == "low"
    assert float(rows[1]["view_share"]) == 0
    found = read_coverage(Area(area), PLANNED_COVERAGE)
    assert found["waypoints"] == "plan.csv"
    assert sorted(found["made_of"]) == ["2-model", "3-geo"]
    assert (area / "coverage" / "coverage.json").read_bytes() == before


def test_a_camera_of_waypoints_may_be_given(area, labelled, tmp_path):
    """Waypoints without a camera use the one from --camera or --fov; both give the same view shares."""
    pose = labelled.mapping.poses[labelled.mapping.registered][:1]
    x, y, z = pose.centers[0]
    plan = tmp_path / "plan.csv"
    heading, pitch, roll = angles_from_rotations(pose.rotations)[0]
    row = f"{x},{y},{z},{heading},{pitch},{roll}"
    plan.write_text(f"x,y,z,heading,pitch,roll,camera\n{row},\n{row},near\n")
    narrow = camera_to_json(Camera.from_horizontal_fov(320, 180, 8.0))
    (tmp_path / "c.json").write_text(json.dumps(narrow))
    shares = []
    for words in ((), ("--camera", tmp_path / "c.json"), ("--fov", "8")):
        run("--area", area, "--waypoints", plan, *words)
        rows = rows_of(area / PLANNED_COVERAGE / "waypoints.csv")
        shares.append([float(row["view_share"]) for row in rows])
    assert shares[1] == shares[2]
    assert shares[0][0] > shares[1][0] > 0
    assert shares[0][1] == shares[1][1] > shares[1][0]


def test_limits_are_options(area):
    """Stricter limits lower the strata and are recorded in coverage.json."""
    shown = run("--area", area, "--high", "0.2", "5", "--medium", "1.5", "6")
    assert "medium coverage 5 (100%); <= 1.5 m and <= 6 deg" in shown
    options = read_coverage(Area(area))["options"]
    assert (options["high_m"], options["medium_deg"]) == (0.2, 6.0)


def test_another_map_or_sequence_makes_it_stale(area, labelled):
    """Stored coverage is stale once an evaluation sequence is added or redone."""
    run("--area", area)
    found = read_coverage(Area(area))
    assert stale_because(Area(area), found) is None
    poses = labelled.mapping.poses[labelled.mapping.registered][:3]
    register(Area(area), "second", poses, ["registered"] * 3)
    assert stale_because(Area(area), found) == "4-eval/second was added since"
    shutil.rmtree(area / EVALUATION / "second")
    register(Area(area), "near", poses, ["registered"] * 3)
    assert stale_because(Area(area), found) == "4-eval/near was redone since"


def test_without_metres_there_are_units_of_the_model(area):
    """Without 3-geo, lengths are in model units, and there are no strata, heights or waypoints."""
    shutil.rmtree(area / GEO)
    shown = run("--area", area, "--fly-again", area / "again.csv")
    assert "model units" in shown
    assert "high coverage" not in shown
    assert "is not written" in shown
    assert not (area / "again.csv").exists()
    found = read_coverage(Area(area))
    assert (found["units"], found["options"], found["fly_again"]) == ("model", None, None)
    assert found["sequences"]["near"]["heights"] is None
    shown = run("--area", area, "--high", "1", "15")
    assert "model units and <= 15 deg" in shown


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--fov", "60"), "--camera and --fov need --waypoints"),
        (
            ("--waypoints", "plan.csv", "--fov", "60", "--camera", "c.json"),
            "give either --camera or --fov",
        ),
        (("--high", "6", "15"), "within those of medium"),
        (("--high", "nan", "15"), "is not a finite number"),
    ],
)
def test_options_that_do_not_fit_are_refused(area, words, message):
    """Inconsistent options are usage errors (exit code 2)."""
    assert message in run("--area", area, *words, exit_code=2)


def test_what_can_not_be_done_is_one_line(area, finished_area, tmp_path):
    """Missing input, an unknown camera and an existing or protected output file are reported as errors."""
    shown = run("--area", finished_area, exit_code=1)
    assert "no evaluation sequence is registered; add one with spn-data register VIDEO" in shown
    assert "1-frames is missing" in run("--area", tmp_path / "none", exit_code=1)
    assert "cannot be read" in run("--area", area, "--waypoints", tmp_path / "no.csv", exit_code=1)
    plan = tmp_path / "plan.csv"
    plan.write_text("x,y,z,heading_deg,pitch_deg,camera\n0,0,4,0,0,wide\n")
    shown = run("--area", area, "--waypoints", plan, exit_code=1)
    assert "plan.csv:2: the area has no camera 'wide'; cameras are" in shown
    for own in (area / "area.toml", area / FRAMES / "frames.csv"):
        before = own.read_bytes()
        shown = run("--area", area, "--fly-again", own, "--overwrite", exit_code=1)
        assert "is not the name of a CSV file" in shown or "is inside a stage of an area" in shown
        assert own.read_bytes() == before
    shown = run("--area", area, "--fly-again", plan, exit_code=1)
    assert "already exists; use --overwrite to replace it" in shown
    assert plan.read_text().startswith("x,y,z")
    run("--area", area, "--fly-again", plan, "--overwrite")
    assert plan.read_text().startswith("stop,lat_deg")
    shutil.rmtree(area / GEO)
    shown = run("--area", area, "--waypoints", plan, exit_code=1)
    assert "--waypoints needs a georegistered map" in shown


def test_every_option_is_documented():
    """docs/coverage.md lists exactly the options of the command, with their defaults."""
    text = (ROOT / "docs" / "coverage.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(--[a-z-]+)` \|([^|]*)\|", text, re.MULTILINE))
    given = [p for p in main.commands["coverage"].params if isinstance(p, click.Option)]
    flags = {p.opts[-1]: p for p in given if p.expose_value}
    assert rows.keys() == flags.keys()
    for flag, parameter in flags.items():
        if parameter.show_default is True:
            assert rows[flag].strip("` ") == str(parameter.default), flag
    options = CoverageOptions()
    assert rows["--high"].strip("` ") == f"{options.high_m:g} {options.high_deg:g}"
    assert rows["--medium"].strip("` ") == f"{options.medium_m:g} {options.medium_deg:g}"


def test_columns_and_fields_are_documented(area):
    """docs/coverage.md names every CSV column and every field of coverage.json."""
    run("--area", area)
    text = (ROOT / "docs" / "coverage.md").read_text(encoding="utf-8").split("## Files")[1]
    listed = re.findall(r"`([a-z_0-9]+)`", text)
    assert set(COLUMNS) <= set(listed)
    found = read_coverage(Area(area))
    assert {*found, *found["sequences"]["near"], *found["sequences"]["near"]["heights"]} <= {
        *listed
    }
