"""`spn-data georegister --gcp` and `spn-data check-points` on a small area."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from spn_cli.data import main

from spn_data.area.area import Area
from spn_data.area.names import GEO
from spn_data.colmap.model import read_scene
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.pipeline.geo_stage import recorded_options
from spn_data.storage.json_files import read_json

SHIFT_M = np.array([1.2, -0.7, 31.0])
OPTIONS = ("--time-offset", "0", "--overwrite")


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def area(finished_area: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the finished area, georegistered with the points of `points.csv` beside it."""
    area = Path(shutil.copytree(finished_area, tmp_path_factory.mktemp("surveyed") / "area"))
    write_points(area, area.parent / "points.csv")
    command = ("georegister", "--area", area, "--gcp", area.parent / "points.csv", *OPTIONS)
    result = run(*command, "--check-points", "2")
    assert result.exit_code == 0, result.output
    (area.parent / "output.txt").write_text(result.output, encoding="utf-8")
    return area


def write_points(area: Path, path: Path) -> None:
    """Write six map points, surveyed as if the map were SHIFT_M off, with up to five marks each."""
    scene = read_scene(area / GEO)
    origin = GeoOrigin(
        **{
            **read_json(area / GEO / "geo.json")["origin"],
            "height_reference": HeightReference.ELLIPSOID,
        }
    )
    spread = np.argsort(scene.points[:, 0])
    longest = spread[scene.track_lengths[spread] >= 5]
    chosen = longest[np.linspace(0, len(longest) - 1, 6).astype(int)]
    place = origin.wgs84_from_enu(scene.points[chosen] + SHIFT_M)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["name", "lat", "lon", "height", "epsg", "image", "x", "y"])
        for k, point in enumerate(scene.points[chosen]):
            coordinates = [f"{place[k, 0]:.9f}", f"{place[k, 1]:.9f}", f"{place[k, 2]:.4f}", "4979"]
            marks = 0
            for i in np.random.default_rng(k).permutation(len(scene.names)):
                camera = scene.cameras[int(scene.camera_ids[i])]
                x, y = camera.project(scene.poses.to_camera(point[None], int(i)))[0]
                if 0 < x < camera.width and 0 < y < camera.height and marks < 5:
                    writer.writerow([f"T{k}", *coordinates, scene.names[i], f"{x:.3f}", f"{y:.3f}"])
                    marks += 1


def test_the_map_moves_to_the_surveyed_points(area: Path) -> None:
    """The origin takes the points' height reference, and residuals are told, stored and in the report."""
    geo = read_json(area / GEO / "geo.json")
    assert geo["origin"]["height_reference"] == "ellipsoid"
    roles = [point["role"] for point in geo["control"]]
    assert sorted(roles) == ["check"] * 2 + ["control"] * 4
    for point in geo["control"]:
        assert np.abs(point["residual_m"]).max() < 0.2
        assert point["reprojection_px"] < 20
    assert geo["uncertainty"]["vertical_m"] < 0.2
    output = (area.parent / "output.txt").read_text(encoding="utf-8")
    assert "Ground control: surveyed minus mapped" in output
    assert "2 check points: east RMSE" in output
    page = (area / "report.html").read_text(encoding="utf-8")
    assert "<h2>Ground control</h2>" in page
    assert "<td>T5</td>" in page
    recorded = recorded_options(Area(area).record(GEO)).control
    assert recorded is not None
    assert recorded.check == ("2",)


def test_check_points_changes_nothing(area: Path) -> None:
    """The command tells the residuals of all points of a file and leaves the area as it is."""
    before = Area(area).record(GEO)
    result = run("check-points", area.parent / "points.csv", "--area", area)
    assert result.exit_code == 0, result.output
    assert "6 check points: east RMSE" in result.output
    assert Area(area).record(GEO) == before


def test_heights_above_take_off_are_compared_without_their_offset(
    finished_area: Path, area: Path
) -> None:
    """In an area above take-off, the median difference of 31 m is taken off and told."""
    result = run("check-points", area.parent / "points.csv", "--area", finished_area)
    assert result.exit_code == 0, result.output
    assert "median difference of +31.0" in " ".join(result.output.split())
    assert "east RMSE 1.2" in " ".join(result.output.split())


def test_wrong_points_leave_the_area_as_it_was(area: Path, tmp_path: Path) -> None:
    """Points of another place, images of another flight and a missing --gcp are one line each."""
    before = Area(area).record(GEO)
    text = (area.parent / "points.csv").read_text(encoding="utf-8")
    far = tmp_path / "far.csv"
    far.write_text(text.replace(",49.", ",39."), encoding="utf-8")
    result = run("georegister", "--area", area, "--gcp", far, *OPTIONS)
    assert result.exit_code == 1
    assert "km from the fixes of the telemetry: is WGS 84 its coordinate system?" in result.stderr
    other = tmp_path / "other.csv"
    other.write_text(text.replace("flight1/", "flight7/x"), encoding="utf-8")
    result = run("georegister", "--area", area, "--gcp", other, *OPTIONS)
    assert result.exit_code == 1
    assert "none of its images is in the model" in result.stderr
    every = ("--gcp", area.parent / "points.csv", "--check-points", "T0,T1,T2,T3,T4,T5")
    result = run("georegister", "--area", area, *every, *OPTIONS)
    assert result.exit_code == 1
    assert "all of its 6 points that can be used are check points" in result.stderr
    facts = (area / "area.toml").read_text(encoding="utf-8")
    (area / "area.toml").write_text(facts.partition("[options]")[0], encoding="utf-8")
    result = run("georegister", "--area", area, "--check-points", "2")
    assert result.exit_code == 2
    assert "--check-points needs --gcp" in result.stderr
    assert run("georegister", "--area", area, "--gnss-bias", "1,x").exit_code == 2
    assert Area(area).record(GEO) == before
