"""Tests of prediction: poses are the network's own for the given images, and failures are reported."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import cv2
import numpy as np
import piexif
import pytest
from click.testing import CliRunner, Result
from PIL import Image
from spn_cli.model import main

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.errors import InputError, StageError
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_to_json
from spn_data.geometry.image_texture import missing_texture
from spn_data.geometry.pose import Poses, pose_errors
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.simulate.video_out import write_video
from spn_data.storage.files import read_csv
from spn_data.storage.json_files import write_json
from spn_model.models.checkpoint import Checkpoint
from spn_model.onboard.attitude import read_attitude
from spn_model.prediction.flights import FrameFilter, ViewRenderers, find_flights, frames
from spn_model.prediction.predict import Predicted, PredictionStopped, PredictOptions, predict
from spn_model.prediction.predicted_files import COLUMNS, ESTIMATED, FAILED, UNREADABLE
from spn_model.runs.run_files import RunFiles
from spn_model.runs.run_prediction import AttitudeFile, prepare_prediction
from tests.worlds.judged_world import write_judged, write_network
from tests.worlds.training_world import CAMERA, frame

pytestmark = pytest.mark.usefixtures("tiny_kind")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_judged(tmp_path_factory.mktemp("world") / "dataset.h5")


@pytest.fixture
def network(dataset: Path, tmp_path: Path) -> Checkpoint:
    return write_network(tmp_path / "runs" / "first" / "checkpoint.safetensors", dataset)


def textured(image: np.ndarray) -> np.ndarray:
    """Return a copy with 16 squares along its width, bright and dark: the coloured field has no texture."""
    height, width = image.shape[:2]
    y, x = np.mgrid[0:height, 0:width] * 16 // width
    return np.clip(image + 24.0 * ((x + y) % 2)[..., None] - 12, 0, 255).astype(np.uint8)


@pytest.fixture
def photos(dataset: Path, tmp_path: Path) -> Path:
    """Save the images of the sequence medium, textured, as PNG, with the data set's own camera."""
    folder = tmp_path / "flight"
    folder.mkdir()
    with Dataset(dataset) as data:
        group = data.groups["medium"]
        for k in range(len(group)):
            Image.fromarray(textured(group.image(k))).save(folder / f"{k:03d}.png")
    return folder


@pytest.mark.parametrize("suffix", ["bmp", "webp", "heic"])
def test_other_photo_formats_get_the_same_poses(network, photos, tmp_path, suffix):
    """BMP, lossless WebP and HEIC of the same images get the poses of the PNG."""
    if suffix == "heic":
        heif = pytest.importorskip("pillow_heif", reason="needs the extra heic")
        heif.register_heif_opener()
    folder = tmp_path / "other"
    folder.mkdir()
    for path in sorted(photos.glob("*.png"))[:3]:
        with Image.open(path) as image:
            lossless = {"quality": -1, "chroma": 444, "matrix_coefficients": 0}
            options = {"bmp": {}, "webp": {"lossless": True}, "heic": lossless}[suffix]
            image.save(folder / f"{path.stem}.{suffix}", **options)
    predicted(network, photos, tmp_path / "png")
    predicted(network, folder, tmp_path / "out")
    want, found = poses_of(rows_of(tmp_path / "png")[:3]), poses_of(rows_of(tmp_path / "out"))
    np.testing.assert_allclose(found.centers, want.centers, atol=1e-3)
    np.testing.assert_allclose(found.quats_wxyz, want.quats_wxyz, atol=1e-3)


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a video of ten frames at 5 per second, four times the size of the network's view."""
    path = tmp_path_factory.mktemp("video") / "over the field.mp4"
    images = [textured(cv2.resize(frame("video", k).image, (256, 192))) for k in range(10)]  # type: ignore[call-overload]
    write_video(path, images, width=256, height=192, fps=5, crf=18)
    return path


def silent(step: str, done: int, total: int) -> None:
    assert 0 < done <= total


def predicted(
    network: Checkpoint, source: Path, to: Path, given: Camera | None = CAMERA, **options: Any
) -> Predicted:
    flights, _ = find_flights([source], given)
    return predict(network, flights, to, silent, PredictOptions(**options), facts={})


def rows_of(folder: Path) -> list[dict[str, str]]:
    return [row for _, row in read_csv(folder / "poses.csv", COLUMNS)]


def poses_of(rows: list[dict[str, str]]) -> Poses:
    values = [[float(row[c]) for c in ("x", "y", "z", "qw", "qx", "qy", "qz")] for row in rows]
    return Poses(np.array(values)[:, :3], np.array(values)[:, 3:])


def test_poses_are_what_the_network_says_of_the_same_images(network, photos, dataset, tmp_path):
    """Photos from the data set's own camera get the poses and covariances of evaluation."""
    found = predicted(network, photos, tmp_path / "out")
    rows = rows_of(tmp_path / "out")
    assert [row["name"] for row in rows] == [f"flight/{k:03d}.jpg" for k in range(7)]
    assert [row["source"] for row in rows] == [f"{k:03d}.png" for k in range(7)]
    assert found.counts == {ESTIMATED: 7, FAILED: 0, UNREADABLE: 0}
    with Dataset(dataset) as data:
        group = data.groups["medium"]
        images = np.stack([textured(group.image(k)) for k in range(7)])
        expected = network.model.estimate(images, group.intrinsics)
    away, turned = pose_errors(poses_of(rows), expected.poses)
    assert away.max() < 1e-9
    assert turned.max() < 1e-6
    assert float(rows[0]["cov_00"]) == expected.covariance[0, 0, 0]
    assert float(rows[0]["cov_55"]) == expected.covariance[0, 5, 5]
    record = json.loads((tmp_path / "out" / "predict.json").read_text())
    assert record["complete"] is True
    assert record["units"] == "m"
    assert record["origin"]["height_reference"] == "takeoff"


def test_images_are_rendered_into_the_view_of_the_training(network, tmp_path):
    """Images of another lens and size are rendered into the training camera's view."""
    lens = Camera("SIMPLE_RADIAL", 512, 384, np.array([200.0, 250.0, 200.0, -0.02]))
    (flight,), _ = find_flights([_gradient(tmp_path, lens)], lens)
    (seen,) = frames(flight, ViewRenderers(network.view), FrameFilter())
    assert seen.image is not None
    assert seen.image.shape == (48, 64, 3)
    np.testing.assert_allclose(seen.matrix, CAMERA.matrix)
    # The image holds the tangent of each pixel's ray: 100 + 60 x/z in red, 100 + 60 y/z in green.
    x, y = np.meshgrid((np.arange(64) + 0.5 - 32) / 40, (np.arange(48) + 0.5 - 24) / 40)
    inner = np.s_[2:-2, 2:-2]
    np.testing.assert_allclose(seen.image[..., 0][inner], (100 + 60 * x)[inner], atol=1.5)
    np.testing.assert_allclose(seen.image[..., 1][inner], (100 + 60 * y)[inner], atol=1.5)


def _gradient(folder: Path, lens: Camera) -> Path:
    pixels = np.stack(np.meshgrid(np.arange(512) + 0.5, np.arange(384) + 0.5), -1).reshape(-1, 2)
    rays = np.clip(100 + 60 * lens.unproject(pixels), 0, 255).reshape(384, 512, 2)
    image = np.where(textured(np.full((384, 512, 3), 99)) > 99, 255, 0).astype(np.uint8)
    image[..., :2] = np.rint(rays)
    Image.fromarray(image).save(folder / "lens.png")
    return folder / "lens.png"


def test_frames_of_a_video_have_its_own_times(network, video, tmp_path):
    """Frame filters (all, every third, two per second) keep the video's frame numbers and times."""
    for name, options, indices in (
        ("all", {}, range(10)),
        ("third", {"choice": FrameFilter(every=3)}, (0, 3, 6, 9)),
        ("two", {"choice": FrameFilter(fps=2)}, (0, 3, 5, 8)),
    ):
        predicted(network, video, tmp_path / name, **options)
        rows = rows_of(tmp_path / name)
        assert [int(row["video_frame"]) for row in rows] == list(indices), name
        assert [row["name"] for row in rows] == [f"over-the-field/{k:06d}.jpg" for k in indices]
        np.testing.assert_allclose([float(row["time_s"]) for row in rows], np.array(indices) / 5)
        assert {row["source"] for row in rows} == {"over the field.mp4"}


def test_progress_counts_the_frames_that_are_used(video, photos):
    """The expected number of frames is that of the frames that a choice leaves; photos are all used."""
    (flight, images), _ = find_flights([video, photos], CAMERA)
    choices = (
        FrameFilter(),
        FrameFilter(every=3),
        FrameFilter(fps=2),
        FrameFilter(every=2, fps=100),
    )
    assert [flight.expected_of(choice) for choice in choices] == [10, 4, 4, 5]
    assert {images.expected_of(choice) for choice in choices} == {7}


def test_without_a_camera_there_is_no_pose(network, video, photos, tmp_path):
    """A video or photos without a known camera are rejected, and the message names the remedy."""
    for source in (video, photos):
        with pytest.raises(InputError, match=r"camera is unknown.*--camera FILE.*camera\.json"):
            find_flights([source], None)


def test_a_camera_of_another_shape_is_refused(photos, video):
    """A camera with another aspect ratio is rejected; one of another size is scaled."""
    wide = Camera("SIMPLE_PINHOLE", 128, 72, np.array([80.0, 64.0, 36.0]))
    for source in (photos, video):
        with pytest.raises(InputError, match="the given camera is for 128x72 images, these are"):
            find_flights([source], wide)
    (flight,), _ = find_flights([photos], CAMERA.scaled(640, 480))
    camera = flight.cameras[0]
    assert camera is not None
    np.testing.assert_allclose(camera.params, CAMERA.params)


def test_photos_may_tell_their_own_focal_length(network, tmp_path):
    """The 35 mm equivalent focal length in the metadata serves as the camera, with a note.

    A photo without it fails.
    """
    folder = tmp_path / "exif"
    folder.mkdir()
    exif = piexif.dump({"Exif": {piexif.ExifIFD.FocalLengthIn35mmFilm: 28}})
    image = Image.fromarray(textured(np.full((48, 64, 3), 99, np.uint8)))
    image.save(folder / "a.jpg", exif=exif)
    image.save(folder / "b.jpg")
    flights, notes = find_flights([folder], None)
    assert "using focal lengths from the photo metadata" in notes[0]
    camera = flights[0].cameras[0]
    assert camera is not None
    assert camera.focal_px[0] == pytest.approx(28 / 43.267 * 80)
    found = predict(network, flights, tmp_path / "out", silent, facts={})
    assert found.counts == {ESTIMATED: 1, FAILED: 0, UNREADABLE: 1}
    assert found.reasons == [("the camera is unknown: no focal length in the photo metadata", 1)]


def test_a_frame_without_a_pose_has_a_reason_and_no_numbers(network, photos, tmp_path, monkeypatch):
    """Damaged photos and failed estimates have a row with a reason and empty pose cells."""
    (photos / "003.png").write_bytes((photos / "003.png").read_bytes()[:60])
    real = network.model.estimate

    def lost(images, intrinsics, verticals=None):
        found = real(images, intrinsics)
        found.poses.centers[0] = found.poses.quats_wxyz[5] = np.nan
        found.poses.quats_wxyz[1:] *= -1  # the same rotations
        reasons = found.reasons.astype(object)
        reasons[0] = "12 cells agree, need 20"
        return replace(found, reasons=reasons)

    monkeypatch.setattr(network.model, "estimate", lost)
    found = predicted(network, photos, tmp_path / "out", formats=("csv", "tum", "wgs84"))
    assert found.counts == {ESTIMATED: 4, FAILED: 2, UNREADABLE: 1}
    rows = rows_of(tmp_path / "out")
    assert all(float(row["qw"]) >= 0 for row in rows if row["status"] == ESTIMATED)
    assert rows[0]["status"] == FAILED
    assert rows[0]["reason"] == "12 cells agree, need 20"
    assert rows[3]["status"] == UNREADABLE
    for row in (rows[0], rows[3], rows[6]):
        assert row["reason"]
        assert {row[c] for c in COLUMNS if c in "xyz" or c[:2] == "qw" or c[:3] == "cov"} == {""}
    assert len((tmp_path / "out" / "tum" / "flight.txt").read_text().splitlines()) == 3 + 4
    places = (tmp_path / "out" / "wgs84.csv").read_text().splitlines()
    assert places[1].startswith('flight/000.jpg,0.0,failed,"12 cells agree, need 20",,,,takeoff')


def test_tum_and_wgs84_hold_the_same_poses(network, photos, tmp_path):
    """TUM and WGS84 files, read by their own conventions, give the poses of the CSV."""
    predicted(network, photos, tmp_path / "out", formats=("csv", "tum", "wgs84"))
    poses = poses_of(rows_of(tmp_path / "out"))
    table = np.loadtxt(tmp_path / "out" / "tum" / "flight.txt")
    np.testing.assert_allclose(table[:, 1:4], poses.centers, atol=1e-8)
    conjugate = np.column_stack([table[:, 7], -table[:, 4:7]])  # world to camera, scalar first
    _, turned = pose_errors(Poses(table[:, 1:4], conjugate), poses)
    assert turned.max() < 1e-4
    lines = [line.split(",") for line in (tmp_path / "out" / "wgs84.csv").read_text().splitlines()]
    columns = dict(zip(lines[0], np.array(lines[1:]).T, strict=True))
    places = np.column_stack([columns[c].astype(float) for c in ("lat_deg", "lon_deg", "height_m")])
    assert network.view.origin is not None
    np.testing.assert_allclose(network.view.origin.enu_from_wgs84(places), poses.centers, atol=1e-3)
    angles = np.column_stack(
        [columns[f"{a}_deg"].astype(float) for a in ("heading", "pitch", "roll")]
    )
    np.testing.assert_allclose(rotations_from_angles(angles), poses.rotations, atol=1e-4)
    assert set(columns["height_reference"]) == {"takeoff"}
    assert columns["sigma_up_m"].astype(float) == pytest.approx(1)


def test_wgs84_needs_a_place_in_the_world(network, photos, tmp_path):
    """WGS84 output without a georegistered map is rejected, and nothing is written."""
    lost = replace(network, view=replace(network.view, origin=None))
    with pytest.raises(StageError, match="wgs84 needs a georegistered map"):
        predicted(lost, photos, tmp_path / "out", formats=("csv", "wgs84"))
    assert not (tmp_path / "out").exists()


def test_stopped_work_keeps_whole_rows_and_says_so(network, photos, tmp_path):
    """After Ctrl-C, complete rows and a record marked incomplete remain, but no partial files."""
    flights, _ = find_flights([photos], CAMERA)

    def stop(step: str, done: int, total: int) -> None:
        if done > 2:
            # The interrupt leaves a partially written row.
            (half,) = tmp_path.glob(".out.partial/poses.csv")
            with half.open("a") as file:
                file.write("flight/002.jpg,2.0,estim")
            raise KeyboardInterrupt

    with pytest.raises(PredictionStopped) as stopped:
        predict(network, flights, tmp_path / "out", stop, PredictOptions(batch=1), facts={})
    assert stopped.value.predicted.counts[ESTIMATED] == 2
    assert len(rows_of(tmp_path / "out")) == 2
    assert json.loads((tmp_path / "out" / "predict.json").read_text())["complete"] is False
    assert not list(tmp_path.glob(".out*"))


def test_a_failure_leaves_nothing(network, photos, tmp_path, monkeypatch):
    """An error while predicting leaves neither the output folder nor a partial one."""

    def broken(images, intrinsics, verticals=None):
        raise StageError("poses.csv cannot be written: No space left on device")

    monkeypatch.setattr(network.model, "estimate", broken)
    with pytest.raises(StageError, match="No space left"):
        predicted(network, photos, tmp_path / "out")
    assert not list(tmp_path.glob("*out*"))


def test_what_stands_is_not_lost(network, photos, tmp_path):
    """Folders with other files are never changed, and earlier poses only with overwrite."""
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("years")
    with pytest.raises(StageError, match="holds files other than predicted poses"):
        predicted(network, photos, mine)
    predicted(network, photos, tmp_path / "out")
    with pytest.raises(StageError, match="use --overwrite to replace them"):
        predicted(network, photos, tmp_path / "out")
    flights, _ = find_flights([photos], CAMERA)
    predict(network, flights, tmp_path / "out", silent, facts={}, overwrite=True)
    with pytest.raises(StageError, match="is not a folder"):
        predicted(network, photos, mine / "thesis.txt")


@pytest.mark.parametrize("name", ["=cmd.png", "a\nb.png", 'q"uo,te.png', "<b>.png", "\udcff.png"])
def test_no_name_of_a_file_breaks_the_table(network, photos, tmp_path, name):
    """Any valid file name gives one row with a safe name."""
    odd = tmp_path / name
    try:
        os.replace(photos / "000.png", odd)
    except (OSError, UnicodeError):
        pytest.skip("this disk takes no such name")
    predicted(network, odd, tmp_path / "out")
    (row,) = rows_of(tmp_path / "out")
    assert row["status"] == ESTIMATED
    assert all(letter.isalnum() or letter in "._-/" for letter in row["name"])
    assert row["source"].isprintable()


def test_flights_of_one_name_stay_apart(network, photos, tmp_path):
    """Two folders with the same name are separate sequences; the second gets a number."""
    other = tmp_path / "b" / "flight"
    other.mkdir(parents=True)
    os.replace(photos / "000.png", other / "000.png")
    flights, _ = find_flights([photos, other], CAMERA)
    assert [flight.source.sequence for flight in flights] == ["flight", "flight-2"]


def commanded(area: Path, *words: object) -> Result:
    fixed = ["--area", str(area), "--run", "first", "--device", "cpu", "--threads", "1"]
    return CliRunner().invoke(main, ["predict", *fixed, *map(str, words)], env={"COLUMNS": "200"})


def test_the_command_writes_and_tells(network, photos, tmp_path):
    """The command reads a camera file from registration and prints pose counts and height reference."""
    camera = tmp_path / "camera.json"
    write_json(camera, {**camera_to_json(CAMERA), "version": 1, "estimated": ["f"]})
    out = tmp_path / "out"
    ran = commanded(tmp_path, photos, "--camera", camera, "--to", out, "--format", "wgs84")
    assert ran.exit_code == 0, ran.output
    assert "7 of 7 frames have a pose" in ran.output
    assert "Heights in wgs84.csv are above: takeoff." in ran.output
    record = json.loads((out / "predict.json").read_text())
    assert record["run"] == "first"
    assert record["camera"]["params"] == CAMERA.params.tolist()
    assert sorted(path.name for path in out.iterdir()) == ["poses.csv", "predict.json", "wgs84.csv"]


def test_a_narrow_camera_is_told(network, photos, tmp_path):
    """If the camera covers only part of the network's view, the covered share is printed."""
    camera = tmp_path / "camera.json"
    write_json(camera, camera_to_json(replace(CAMERA, params=CAMERA.params * [2.0, 1, 1])))
    ran = commanded(tmp_path, photos, "--camera", camera, "--to", tmp_path / "out")
    assert ran.exit_code == 0, ran.output
    assert "the flying camera fills 25% of the view" in ran.output


def test_errors_of_the_command_are_one_line(network, photos, video, tmp_path):
    """A missing run, an unknown camera and an invalid camera file give an error and no traceback."""
    out = ("--to", tmp_path / "out")
    missing = commanded(tmp_path / "elsewhere", photos, *out)
    assert "holds no trained network; run spn-model train --run first first" in missing.output
    unknown = commanded(tmp_path, video, *out)
    assert "give it as --camera FILE" in unknown.output
    wrong = commanded(tmp_path, video, "--camera", photos / "000.png", *out)
    assert "does not contain a camera" in wrong.output
    for ran in (missing, unknown, wrong):
        assert ran.exit_code == 1
        assert "Traceback" not in ran.output
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["evaluate", "predict"])
def test_options_are_documented_with_their_defaults(name):
    """The command's page lists exactly its options and arguments, with numeric defaults."""
    page = {"evaluate": "evaluation", "predict": "predict"}[name]
    text = (Path(__file__).resolve().parents[3] / "docs" / f"{page}.md").read_text("utf-8")
    table = text[text.index("| option | default |") :]
    rows = re.findall(r"^\| `([^|]+)` \|([^|]*)\|", table[: table.index("\n\n")], re.MULTILINE)
    listed = {first.split("`")[0]: default.strip("` ") for first, default in rows}
    command = main.commands[name]
    wanted = {
        p.opts[0] if isinstance(p, click.Option) else (p.metavar or p.name or "").strip(".").upper()
        for p in command.params
        if p.expose_value
    }
    assert set(listed) == wanted
    for parameter in command.params:
        if isinstance(parameter.default, int) and not isinstance(parameter.default, bool):
            assert listed[parameter.opts[0]] == str(parameter.default)


def test_images_without_texture_get_no_pose(network, photos, tmp_path):
    """Black, white and fogged images have a row with the same reason as on board."""
    steps = np.random.default_rng(0).integers(40, 200, (12, 16, 3), dtype=np.uint8)
    shape = np.asarray(Image.open(photos / "000.png")).shape
    good = cv2.resize(steps, shape[1::-1], interpolation=cv2.INTER_NEAREST)
    Image.fromarray(good).save(photos / "000.png")
    images = {"900": good * 0, "901": good * 0 + 250, "902": (good * 0.03 + 180).astype(np.uint8)}
    for stem, image in images.items():
        Image.fromarray(image).save(photos / f"{stem}.png")
    done = predicted(network, photos, tmp_path / "poses")
    rows = read_csv(tmp_path / "poses" / "poses.csv", list(COLUMNS))
    found = {row["source"]: (row["status"], row["reason"]) for _, row in rows}
    assert found["000.png"] == (ESTIMATED, "")
    for stem, told in (("900", "nearly black"), ("901", "nearly white"), ("902", "fogged")):
        status, reason = found[f"{stem}.png"]
        assert status == FAILED
        assert told in reason
        assert reason == missing_texture(images[stem])
    assert done.counts == {ESTIMATED: 7, FAILED: 3, UNREADABLE: 0}


def test_a_damaged_photo_beside_a_good_one_ends_nothing(network, photos, tmp_path):
    """A damaged photo given with a good one gets a row, but raises an error if given alone."""
    bad = tmp_path / "bad.jpg"
    bad.write_bytes(b"no image")
    flights, _ = find_flights([bad, photos / "000.png"], CAMERA)
    done = predict(network, flights, tmp_path / "poses", silent, facts={})
    assert done.counts == {ESTIMATED: 1, FAILED: 0, UNREADABLE: 1}
    with pytest.raises(InputError, match="none of its photos can be read"):
        find_flights([bad], CAMERA)


def test_each_frame_is_estimated_with_its_own_attitude(network, video, tmp_path, monkeypatch):
    """The network gets up at the time of each frame, none where the file ends; predict.json counts them."""
    asked: list[Any] = []
    estimate = type(network.model).estimate

    def noted(model, images, intrinsics, verticals):
        asked.extend(verticals)
        return estimate(model, images, intrinsics)

    monkeypatch.setattr(type(network.model), "estimate", noted)
    table = tmp_path / "a.csv"
    table.write_text("time_s,pitch_deg,roll_deg,sigma_deg\n0,-10,0,1\n1,-30,0,1\n")
    body = np.eye(3)
    attitude = read_attitude(table, of="camera", mounting=None, body_from_camera=body)
    found = predicted(network, video, tmp_path / "out", attitude=attitude)
    assert found.with_attitude == 6  # 0 to 1 s, five a second
    assert [one is not None for one in asked] == [True] * 6 + [False] * 4
    down = [np.rad2deg(np.arcsin(one.up[2])) for one in asked[:6]]
    assert down == pytest.approx([-10, -14, -18, -22, -26, -30], abs=0.2)
    assert json.loads((tmp_path / "out" / "predict.json").read_text())["with_attitude"] == 6


def test_whose_attitude_it_is_has_to_be_clear(network, photos, video, tmp_path):
    """Several sources and a gimbal with an unknown mounting are told; the camera's own angles need none."""
    table = tmp_path / "a.csv"
    table.write_text("time_s,pitch_deg,roll_deg\n0,-10,0\n1,-30,0\n")
    run = RunFiles(tmp_path / "runs" / "first")
    camera = tmp_path / "camera.json"
    write_json(camera, camera_to_json(CAMERA))

    def prepared(*sources: Path, **given: Any):
        file = AttitudeFile(path=table, **given)
        return prepare_prediction(run, sources, camera, tmp_path / "out", attitude=file)

    with pytest.raises(InputError, match=r"belongs to one video, and there are 2 sequences"):
        prepared(photos, video, sigma_deg=1.0)
    with pytest.raises(InputError, match="states no sigma_deg"):
        prepared(video)
    noted = prepared(video, sigma_deg=1.0).notes
    assert "its angles count as they are" in " ".join(noted)
    assert "there is no bundle" in " ".join(noted)
    assert not prepared(video, sigma_deg=1.0, of="camera").notes
