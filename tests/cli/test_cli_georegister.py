"""`spn-data georegister` with changed options, their effect on `reconstruct`, and camera files."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from spn_cli.data import main

from spn_data.area.area import Area
from spn_data.area.names import GEO, MODEL
from spn_data.colmap.model import read_scene
from spn_data.errors import FormatError, InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_from_json, camera_to_json, read_camera
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.georegistration.georegister_options import GeoregisterOptions, Heights
from spn_data.pipeline.geo_stage import GeoStageOptions, recorded_options
from spn_data.storage.json_files import read_json
from spn_data.storage.stage_record import StageRecord

FAST = ("--max-features", "800", "--threads", "1", "--fov", "72")


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.fixture
def area(finished_area: Path, tmp_path: Path) -> Path:
    """A copy of the finished area that a test may change."""
    return Path(shutil.copytree(finished_area, tmp_path / "area"))


def test_other_options_need_overwrite_and_move_only_the_third_stage(area: Path) -> None:
    """A new take-off altitude needs --overwrite and changes the origin but not the model."""
    before = Area(area).record(MODEL)
    options = ("--takeoff-alt", "100", "--height-reference", "amsl")
    refused = run("georegister", "--area", area, *options)
    assert refused.exit_code == 1
    assert "--overwrite" in refused.stderr
    result = run("georegister", "--area", area, *options, "--overwrite")
    assert result.exit_code == 0, result.output
    assert Area(area).record(MODEL) == before
    origin = read_json(area / GEO / "geo.json")["origin"]
    assert origin["height_reference"] == "amsl"
    assert origin["alt_m"] == pytest.approx(100.0, abs=1e-6)


def test_reconstruct_keeps_a_georegistration_that_was_made_with_other_options(
    area: Path, flight1: Path
) -> None:
    """`reconstruct` keeps a georegistration made by `georegister`, and takes the first field of view."""
    made = run("georegister", "--area", area, "--gnss-sigma", "0.5", "1", "--overwrite")
    assert made.exit_code == 0, made.output
    again = run("reconstruct", flight1, "--area", area, *FAST[:4])  # without --fov
    assert again.exit_code == 0, again.output
    assert f"{GEO}: unchanged since" in again.stdout
    assert "--fov 72.0, --gnss-sigma 0.5 1.0. Give an option" in " ".join(again.output.split())
    assert recorded_options(Area(area).record(GEO)).fit.gnss_sigma_m == (0.5, 1.0)


def test_the_area_remembers_the_options_that_it_was_georegistered_with(area: Path) -> None:
    """Later commands take them and say so; another value needs --overwrite, and is remembered."""
    options = ("--takeoff-alt", "100", "--height-reference", "amsl", "--gnss-bias", "2")
    assert run("georegister", "--area", area, *options, "--overwrite").exit_code == 0
    again = run("georegister", "--area", area)
    assert again.exit_code == 0, again.output
    said = " ".join(again.output.split())
    assert (
        "--gnss-bias 2.0,5.0, --height-reference amsl, --takeoff-alt 100.0. Give an option" in said
    )
    remembered = Area(area).facts.options
    refused = run("georegister", "--area", area, "--takeoff-alt", "120")
    assert refused.exit_code == 1
    assert "--overwrite" in refused.stderr
    assert Area(area).facts.options == remembered
    changed = run("georegister", "--area", area, "--takeoff-alt", "120", "--overwrite")
    assert changed.exit_code == 0, changed.output
    assert "--takeoff-alt 120.0 replaces 100.0" in " ".join(changed.output.split())
    fit = recorded_options(Area(area).record(GEO)).fit
    assert (fit.takeoff_alt_m, fit.gnss_bias_m) == (120.0, (2.0, 5.0))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            'fovv = ["72"]',
            "options has 'fovv', which is not remembered; it may have fov, gnss-sigma",
        ),
        ('takeoff-alt = ["high"]', "options: --takeoff-alt: 'high' is not a valid float"),
        ('gnss-sigma = ["1"]', "options: --gnss-sigma: "),
        ('heights = ["relative", "absolute"]', "options: --heights is not one text"),
    ],
)
def test_a_wrong_option_in_the_file_of_the_area_is_one_line(
    tmp_path: Path, options: str, words: str
) -> None:
    """An unknown name and a value that the option would refuse are errors that name the file."""
    (tmp_path / "area.toml").write_text(f"version = 1\nsources = []\n[options]\n{options}\n")
    result = run("georegister", "--area", tmp_path)
    assert result.exit_code == 1
    assert f"area.toml: {words}" in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


def test_a_take_off_height_without_its_reference_is_a_usage_error(area: Path) -> None:
    """--takeoff-alt requires --height-reference."""
    result = run("georegister", "--area", area, "--takeoff-alt", "100")
    assert result.exit_code == 2
    assert "--height-reference" in result.stderr


def test_options_come_back_from_the_record_as_they_were() -> None:
    """Options survive the round trip through the JSON stage record."""
    options = GeoStageOptions(
        fit=GeoregisterOptions(
            gnss_sigma_m=(1.0, 2.0),
            heights=Heights.ABSOLUTE,
            height_reference=HeightReference.AMSL,
            origin=GeoOrigin(1.0, 2.0, 3.0, HeightReference.AMSL),
        ),
        time_offset_s={"*": 0.5},
    )
    for given in (options, GeoStageOptions()):
        stored = json.loads(json.dumps(asdict(given)))
        record = StageRecord(stage=GEO, options=stored, inputs={}, upstream={})
        assert recorded_options(record) == given


def test_options_that_cannot_be_read_are_a_format_error() -> None:
    """Invalid options in a stage record raise FormatError."""
    record = StageRecord(stage=GEO, options={"fit": {"heights": "deep"}}, inputs={}, upstream={})
    with pytest.raises(FormatError, match="3-geo: its options cannot be read"):
        recorded_options(record)


def test_a_calibrated_camera_is_started_from(flight1: Path, tmp_path: Path) -> None:
    """The camera from --camera, given at twice the image size, is scaled and used as the initial camera."""
    truth = json.loads((flight1.parent / "truth" / "flight1_camera.json").read_text())
    doubled = camera_from_json(truth).scaled(640, 360)
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(camera_to_json(doubled)))
    options = ("--max-features", "800", "--threads", "1", "--camera", file)
    result = run("reconstruct", flight1, "--area", tmp_path / "area", *options)
    assert result.exit_code == 0, result.output
    started = read_json(tmp_path / "area" / "1-frames" / "cameras.json")["cameras"]["flight1"]
    assert started["model"] == "RADIAL"
    assert started["params"] == pytest.approx(truth["params"])
    (found,) = read_scene(tmp_path / "area" / MODEL).cameras.values()
    assert found.focal_px[0] == pytest.approx(truth["params"][0], rel=0.05)


def test_a_camera_of_another_shape_is_refused(flight1: Path, tmp_path: Path) -> None:
    """A camera with another aspect ratio than the images is rejected."""
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(camera_to_json(Camera.from_horizontal_fov(400, 300, 70))))
    result = run("reconstruct", flight1, "--area", tmp_path / "area", "--camera", file)
    assert result.exit_code == 1
    assert "the given camera is for 400x300 images, these are 320x180" in result.stderr


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        '{"model": "PINHOLE"}',
        '{"model": "FISHEYE", "width": 8, "height": 8, "params": [1]}',
        '{"model": "SIMPLE_PINHOLE", "width": 8, "height": 8, "params": [-1, 4, 4]}',
        '{"model": "SIMPLE_PINHOLE", "width": 8, "height": 8, "params": [1, 4]}',
        '{"model": "SIMPLE_PINHOLE", "width": 1e9, "height": 8, "params": [1, 4, 4]}',
    ],
)
def test_a_file_that_holds_no_camera_is_refused(tmp_path: Path, text: str) -> None:
    """A file without a valid camera raises InputError."""
    (tmp_path / "camera.json").write_text(text)
    with pytest.raises(InputError, match=r"camera\.json: does not contain a camera"):
        read_camera(tmp_path / "camera.json")


def test_a_camera_comes_back_from_its_file(tmp_path: Path) -> None:
    """A camera survives the round trip through its file."""
    camera = Camera.from_horizontal_fov(800, 600, 70, (0.1, -0.2, 0.01, 0.02))
    (tmp_path / "camera.json").write_text(json.dumps(camera_to_json(camera)))
    again = read_camera(tmp_path / "camera.json")
    assert (again.model, again.width, again.height) == ("OPENCV", 800, 600)
    assert np.array_equal(again.params, camera.params)
