"""`spn-onboard fly`: fixes of a recorded flight with a bundle that has landmarks."""

from __future__ import annotations

import json
import shutil
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from spn_cli.data import main as data_main
from spn_cli.model import main as model_main

import spn_data
from spn_data.geometry.camera_file import camera_to_json, read_camera
from spn_data.storage.json_files import write_json
from spn_model.integrity.fix import Fix, FixSource, NoFix
from spn_model.onboard.__main__ import main
from spn_model.onboard.bundle import read_bundle
from spn_model.onboard.pilot import Pilot, PilotOptions
from spn_model.onboard.sources import frames

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def flown_area(finished_area, tmp_path_factory) -> Path:
    """The area of the short flight, with a network of a few steps and its bundle."""
    area = tmp_path_factory.mktemp("flown") / "area"
    shutil.copytree(finished_area, area)
    before = torch.get_num_threads()
    for command, words in (
        (data_main, ["split"]),
        (
            model_main,
            ["train", "--images", "32", "--validations", "1", "--threads", "1", "--device", "cpu"],
        ),
        (model_main, ["export", "--run", "default", "--map-mb", "1", "--calibration-images", "2"]),
    ):
        result = CliRunner().invoke(command, [*words, "--area", str(area)])
        assert result.exit_code == 0, result.output
    torch.set_num_threads(before)
    return area


@pytest.fixture(scope="module")
def camera_file(flown_area, tmp_path_factory) -> Path:
    """The camera of the flight."""
    path = tmp_path_factory.mktemp("camera") / "camera.json"
    write_json(path, camera_to_json(spn_data.open_area(flown_area).map.cameras["flight1"]))
    return path


def test_a_recorded_flight_gets_fixes(flown_area, camera_file, flight1, tmp_path, capsys):
    """Most images of the mapping flight get a fix; those of chosen frames are protected from the error."""
    bundle, out = flown_area / "runs" / "default" / "bundle", tmp_path / "fixes.jsonl"
    words = ["fly", str(bundle), str(flight1 / "flight1.mp4"), "--camera", str(camera_file)]
    assert main([*words, "--to", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "Usable fixes: " in printed
    assert "Protection level (median)" in printed
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    usable = [k for k, line in enumerate(lines) if line["usable"]]
    assert len(usable) > 0.7 * len(lines)
    labels = spn_data.open_area(flown_area).labels()
    compared = 0
    for row in np.flatnonzero(labels.registered):
        line = lines[int(labels.video_frame[row])]
        if line["usable"]:
            compared += 1
            off = np.array(line["center"]) - labels.poses.centers[row]
            assert np.hypot(*off[:2]) < line["horizontal_protection_m"]
            assert abs(off[2]) < line["vertical_protection_m"]
    assert compared > 5


def test_an_attitude_is_compared_with_each_fix(flown_area, camera_file, flight1, tmp_path, capsys):
    """The flight's own gimbal angles change no fix; angles that are 10 degrees off leave none."""
    bundle = flown_area / "runs" / "default" / "bundle"
    # The flight has too few frames for the bundle to know its gimbal.
    assert json.loads((bundle / "bundle.json").read_text())["gimbal"] is None
    words = ["fly", str(bundle), str(flight1 / "flight1.mp4"), "--camera", str(camera_file)]
    table = flown_area / "1-frames" / "telemetry" / "flight1.csv"
    wrong = tmp_path / "wrong.csv"
    first, header, *rows = table.read_text().splitlines()
    column = header.split(",").index("pitch_deg")
    cells = [row.split(",") for row in rows]
    for row in cells:
        row[column] = str(float(row[column]) + 10)
    wrong.write_text("\n".join([first, header, *(",".join(row) for row in cells)]))
    usable = {}
    for path in (None, table, wrong):
        given = [] if path is None else ["--attitude", str(path), "--attitude-sigma", "1"]
        assert main([*words, "--no-network", *given]) == 0
        printed = capsys.readouterr().out
        usable[path] = int(printed.split("Usable fixes: ")[1].split()[0])
        assert (" images, to 1 deg." in printed) == (path is not None)
    assert usable[None] == usable[table] > 0
    assert usable[wrong] == 0
    assert "the images contradict the stated attitude by # standard deviations" in printed


def test_a_height_is_compared_with_each_fix(flown_area, camera_file, flight1, capsys):
    """The flight's own heights change no fix, and their zero is learnt; a zero 40 m off leaves no fix."""
    bundle = flown_area / "runs" / "default" / "bundle"
    table = flown_area / "1-frames" / "telemetry" / "flight1.csv"
    words = ["fly", str(bundle), str(flight1 / "flight1.mp4"), "--camera", str(camera_file)]
    usable = []
    for given in ([], ["--height", str(table)], ["--height", str(table), "--height-zero", "40"]):
        assert main([*words, "--no-network", *given]) == 0
        printed = capsys.readouterr().out
        usable.append(int(printed.split("Usable fixes: ")[1].split()[0]))
        assert ("Height: known for" in printed) == bool(given)
    assert usable[0] == usable[1] > 0
    assert usable[2] == 0
    assert "the images contradict the stated height by # standard deviations" in printed
    assert "its zero is +0.00 m from the stated one, known to 3.00 m" in printed


def test_the_self_test_compares_the_first_fix(flown_area, camera_file, flight1, capsys):
    """At the labelled place of the first images the drone is ready; 50 m away it is not, nor at no place."""
    labels = spn_data.open_area(flown_area).labels()
    first = labels.poses.centers[np.flatnonzero(labels.registered)[0]]
    bundle = flown_area / "runs" / "default" / "bundle"
    origin = read_bundle(bundle).view.origin
    words = ["fly", str(bundle), str(flight1 / "flight1.mp4"), "--camera", str(camera_file)]
    for north_m, code in ((0.0, 0), (50.0, 1)):
        lat, lon, _ = origin.wgs84_from_enu(first[None] + [0.0, north_m, 0.0])[0].tolist()
        at = ["--at", repr(lat), repr(lon)]
        assert main([*words, "--no-network", "--pre-arm", *at]) == code
        printed = capsys.readouterr()
        assert printed.out.endswith("Ready.\n") == (code == 0)
        assert ("m from the stated position, 9.0 m is allowed" in printed.err) == (code == 1)
    assert main([*words, "--pre-arm", "--at", "91", "8"]) == 1
    assert "the stated position 91, 8 with 3 m is none" in capsys.readouterr().err


def test_images_that_show_nothing_of_the_map_have_no_fix(flown_area, camera_file):
    """Black images and noise have a NoFix with a reason."""
    area = spn_data.open_area(flown_area)
    camera = area.map.cameras["flight1"]
    pilot = Pilot(
        flown_area / "runs" / "default" / "bundle",
        camera,
        PilotOptions(sequence=False, network=False),
    )
    rng = np.random.default_rng(0)
    shape = (camera.height, camera.width, 3)
    for image in (np.zeros(shape, np.uint8), rng.integers(0, 255, shape).astype(np.uint8)):
        found = pilot.fix(image, 1)
        assert isinstance(found, NoFix)
        assert found.reason


def test_a_bundle_without_landmarks_is_refused(flown_area, camera_file, flight1, tmp_path, capsys):
    """A bundle without landmarks, and one whose landmarks were changed, give one line and exit code 1."""
    bundle = tmp_path / "bundle"
    shutil.copytree(flown_area / "runs" / "default" / "bundle", bundle)
    words = ["fly", str(bundle), str(flight1 / "flight1.mp4"), "--camera", str(camera_file)]
    with (bundle / "landmarks.npz").open("r+b") as handle:
        handle.seek(500)
        handle.write(b"\0" * 64)
    assert main(words) == 1
    assert "its SHA-256 differs from bundle.json" in capsys.readouterr().err
    document = json.loads((bundle / "bundle.json").read_text())
    del document["landmarks"]
    (bundle / "bundle.json").write_text(json.dumps(document))
    assert main(words) == 1
    assert "has no landmarks, which a fix needs" in capsys.readouterr().err


def test_a_followed_pose_on_which_few_landmarks_agree_is_searched_for_anew(
    flown_area, camera_file, flight1
):
    """Where a followed pose needs more agreeing landmarks than there can be, each pose is searched for."""
    bundle = flown_area / "runs" / "default" / "bundle"
    sources = {}
    for share in (0.0, 1.01):
        pilot = Pilot(bundle, read_camera(camera_file), PilotOptions(sure_share=share))
        items = [
            pilot.fix(image, 1_000_000 + round(1e6 * time_s))
            for _, time_s, image in islice(frames(flight1 / "flight1.mp4"), 8)
        ]
        sources[share] = [item.source for item in items if isinstance(item, Fix)]
    assert sources[0.0].count(FixSource.TRACK) > 3
    assert len(sources[1.01]) > 3
    assert FixSource.TRACK not in sources[1.01]


def test_images_so_far_bound_the_lens_of_the_next(flown_area, camera_file, flight1):
    """In a flight, the bound of the focal length only shrinks; images that stand alone have none."""
    bundle = flown_area / "runs" / "default" / "bundle"
    for sequence in (True, False):
        pilot = Pilot(bundle, read_camera(camera_file), PilotOptions(sequence=sequence))
        bounds = [pilot.focal_bound]
        for _, time_s, image in islice(frames(flight1 / "flight1.mp4"), 8):
            pilot.fix(image, 1_000_000 + round(1e6 * time_s))
            bounds.append(pilot.focal_bound)
        assert bounds[0] == np.inf
        assert bounds == sorted(bounds, reverse=True)
        assert (bounds[-1] < 0.05) == sequence
