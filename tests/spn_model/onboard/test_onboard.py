"""Tests of the onboard program, which runs without torch, pycolmap, h5py or scipy on untrusted bundles."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
import torch
from click.testing import CliRunner
from onnx import TensorProto, helper
from spn_cli.model import main

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.errors import FormatError, InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_to_json
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.pose import Poses, pose_errors
from spn_data.geometry.rendering import PinholeRenderer, RenderingOptions, canonical_camera
from spn_data.storage.json_files import write_json
from spn_model.export.bundle_checks import BundleOptions
from spn_model.export.bundle_export import export
from spn_model.onboard import lines
from spn_model.onboard.bundle import read_bundle, sha256_of
from spn_model.onboard.localizer import SAMPLE_STEP_PX, Localizer, Located
from spn_model.onboard.sources import frames, read_image
from tests.worlds.box_world import seen_by, write_box
from tests.worlds.bundle_world import LENS, learnt

ROOT = Path(__file__).resolve().parents[3]
# An import finder, inserted first, blocks packages that are not available on board.
BLOCKED = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {absent}:
            raise ImportError("not on board: " + name)
sys.meta_path.insert(0, Absent())
from spn_model.onboard.__main__ import main
code = main(sys.argv[1:])
sys.stderr.write("LOADED " + " ".join(sorted({{n.partition(".")[0] for n in sys.modules}})))
sys.exit(code)
"""
ABSENT = ("torch", "pycolmap", "h5py", "scipy", "av", "onnx", "click", "rich", "safetensors", "PIL")


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_box(tmp_path_factory.mktemp("hall") / "dataset.h5", train=4)


@pytest.fixture(scope="module")
def bundle(hall: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("run") / "bundle"
    export(learnt(hall), hall, folder, {}, lambda *_: None, BundleOptions(calibration_images=4))
    torch.set_num_threads(before)
    return folder


@pytest.fixture(scope="module")
def truth(hall: Path) -> Poses:
    with Dataset(hall) as data:
        return data.groups["train"].poses


@pytest.fixture(scope="module")
def flown(truth: Poses) -> list[np.ndarray]:
    """Return BGR images from a camera with lens distortion at the training poses."""
    return [seen_by(truth[k : k + 1], LENS)[0][..., ::-1].copy() for k in range(len(truth))]


@pytest.fixture
def camera_file(tmp_path: Path) -> Path:
    write_json(tmp_path / "cam.json", camera_to_json(LENS))
    return tmp_path / "cam.json"


def test_a_flying_cameras_image_is_located(bundle, flown, truth):
    """An image from an unseen, distorted lens is located at both precisions, as BGR and RGB."""
    for int8, limit_m in ((False, 0.3), (True, 0.5)):
        localizer = Localizer(bundle, int8=int8)
        for k, image in enumerate(flown):
            found = localizer.localize(image, LENS)
            apart, turned = pose_errors(found.poses, truth[k : k + 1])
            assert apart[0] < limit_m
            assert turned[0] < 2
            assert found.reason == ""
            assert np.linalg.eigvalsh(found.covariance).min() > 0
            same = localizer.localize(image[..., ::-1].copy(), LENS, rgb=True)
            assert np.array_equal(same.poses.centers, found.poses.centers)


def test_an_image_without_a_pose_has_a_reason(bundle, flown, tmp_path):
    """If too few cells agree, pose and covariance are NaN and the reason is stated."""
    folder = tmp_path / "bundle"
    shutil.copytree(bundle, folder)
    edited(lambda d: d["decoding"]["options"].update(min_inliers=500))(folder)
    found = Localizer(folder).localize(flown[0], LENS)
    assert np.isnan(found.poses.centers).all()
    assert np.isnan(found.covariance).all()
    assert "need 500" in found.reason


def test_the_offset_of_the_view_is_added_in_float64(bundle, flown, tmp_path):
    """Poses of a bundle with an offset are those without it plus the offset, to 1e-8."""
    offset, folder = [500_000.25, 5_400_000.5, 300.0], tmp_path / "bundle"
    shutil.copytree(bundle, folder)
    edited(lambda d: d["view"].update(offset=offset))(folder)
    with pytest.raises(FormatError, match="its version and its offset contradict each other"):
        Localizer(folder)
    edited(lambda d: d.update(version=2))(folder)
    near, far = (Localizer(each).localize(flown[0], LENS) for each in (bundle, folder))
    np.testing.assert_allclose(far.poses.centers - offset, near.poses.centers, rtol=0, atol=1e-8)
    assert np.array_equal(far.poses.quats_wxyz, near.poses.quats_wxyz)
    assert np.array_equal(far.covariance, near.covariance)
    line = json.loads(lines.json_line("a.png", 0, 0.0, far, None))
    assert line["center"] == far.poses.centers[0].tolist()


def test_the_view_on_board_is_that_of_the_data_set(flown):
    """Onboard rendering from 1280 x 720 to 480 x 270 matches the data set's to about one grey level."""
    lens = Camera("OPENCV", 1280, 720, np.array([820, 822, 645, 355, -0.11, 0.06, 1e-3, -5e-4]))
    view = canonical_camera([lens], RenderingOptions())
    assert (view.width, view.height) == (480, 270)
    image = cv2.resize(flown[0], (1280, 720), interpolation=cv2.INTER_CUBIC)
    noise = np.random.default_rng(0).normal(0, 12, image.shape)
    image = np.clip(image + noise, 0, 255).astype(np.uint8)  # pixel-level detail
    wanted = PinholeRenderer(lens, view).render(image).astype(float)
    found = PinholeRenderer(lens, view, sample_step_px=SAMPLE_STEP_PX).render(image).astype(float)
    assert 0 < np.abs(found - wanted).mean() < 1.5
    assert np.percentile(np.abs(found - wanted), 99) < 6
    # No brightness bias beyond OpenCV's rounding: it rounds halves up in 2 x 2 means, which adds 1/8.
    assert abs((found - wanted).mean()) < 0.15
    smooth = [cv2.GaussianBlur(part, (0, 0), 2) for part in (found, wanted)]
    shift, _ = cv2.phaseCorrelate(smooth[0][..., 1], smooth[1][..., 1])
    assert np.hypot(*shift) < 0.02


def test_images_are_rendered_with_the_coarser_step(bundle, flown):
    """The localizer renders with the coarser sampling step, not the data set's slower one."""
    lens, localizer = LENS.scaled(896, 504), Localizer(bundle)
    image = cv2.resize(flown[0], (896, 504), interpolation=cv2.INTER_CUBIC)
    found = localizer.view(image, lens)[0][..., ::-1]
    coarse = PinholeRenderer(lens, localizer.camera, sample_step_px=SAMPLE_STEP_PX).render(image)
    assert np.array_equal(found, coarse)
    assert not np.array_equal(found, PinholeRenderer(lens, localizer.camera).render(image))


def test_another_size_of_the_same_shape_is_scaled(bundle, flown, truth):
    """A camera file is scaled to images of the same aspect ratio; other ratios are rejected."""
    localizer = Localizer(bundle)
    found = localizer.localize(flown[1], LENS.scaled(1280, 720))
    assert pose_errors(found.poses, truth[1:2])[0] < 0.3
    with pytest.raises(InputError, match="the image is 640x480, but the camera is 640x360"):
        localizer.localize(np.zeros((480, 640, 3), np.uint8), LENS)
    beside = Camera("PINHOLE", 640, 360, np.array([425.0, 425.0, 9000.0, 180.0]))
    with pytest.raises(InputError, match="sees nothing of the view"):
        localizer.localize(flown[0], beside)


def run_blocked(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", BLOCKED.format(absent=ABSENT), *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.fixture
def sources(flown: list[np.ndarray], tmp_path: Path) -> tuple[Path, Path]:
    """Return a photo at the first pose and a video of all four at 2 frames per second."""
    photo, video = tmp_path / "photo one,1.png", tmp_path / "flight.avi"
    photo.write_bytes(cv2.imencode(".png", flown[0])[1].tobytes())
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 2.0, (640, 360))
    for image in flown:
        writer.write(image)
    writer.release()
    return photo, video


def test_the_program_needs_three_packages(bundle, sources, camera_file, truth):
    """Images and videos become CSV rows without torch, pycolmap, h5py, scipy and PyAV installed."""
    done = run_blocked(str(bundle), *map(str, sources), "--camera", str(camera_file), "--int8")
    assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader(io.StringIO(done.stdout)))
    assert tuple(rows[0]) == lines.COLUMNS
    assert [row["source"] for row in rows] == [str(sources[0])] + 4 * [str(sources[1])]
    assert [row["frame"] for row in rows] == ["0", "0", "1", "2", "3"]
    assert [row["time_s"] for row in rows] == ["", "0.000000", "0.500000", "1.000000", "1.500000"]
    for row, k in zip(rows, [0, 0, 1, 2, 3], strict=True):
        found = Poses(
            np.array([[float(row[n]) for n in "xyz"]]),
            np.array([[float(row[n]) for n in ("qw", "qx", "qy", "qz")]]),
        )
        assert pose_errors(found, truth[k : k + 1])[0] < 0.5
        assert float(row["cov_00"]) > 0
        assert row["lat_deg"] == ""  # the hall is not georeferenced
        assert row["reason"] == ""
    loaded = done.stderr.rpartition("LOADED ")[2].split()
    assert {"numpy", "cv2", "onnxruntime"} <= set(loaded)
    assert not set(ABSENT) & set(loaded)


def test_json_lines_hold_the_same(bundle, sources, camera_file):
    """JSON lines hold the poses of the CSV and the full covariance matrix."""
    arguments = (str(bundle), str(sources[1]), "--camera", str(camera_file))
    done = run_blocked(*arguments, "--format", "jsonl")
    assert done.returncode == 0, done.stderr
    found = [json.loads(line) for line in done.stdout.splitlines()]
    rows = list(csv.DictReader(io.StringIO(run_blocked(*arguments).stdout)))
    assert len(found) == len(rows) == 4
    for one, row in zip(found, rows, strict=True):
        assert one["center"] == pytest.approx([float(row[n]) for n in "xyz"], abs=1e-6)
        covariance = np.array(one["covariance"])
        assert covariance.shape == (6, 6)
        assert covariance[1, 4] == pytest.approx(float(row["cov_14"]), rel=1e-6)
        assert one["lat_deg"] is None


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("none.jpg", None, "none.jpg: does not exist"),
        ("bad.jpg", b"no image", "bad.jpg: cannot be read as an image"),
        (
            "bad.mp4",
            b"no video",
            "bad.mp4: cannot be decoded as a video; playlists, URLs and streams are not read",
        ),
    ],
)
def test_a_source_that_is_none_is_told_in_one_line(
    bundle, camera_file, tmp_path, name, content, told
):
    """A missing or unreadable source gives exit code 1, a one-line error and no traceback."""
    if content is not None:
        (tmp_path / name).write_bytes(content)
    done = run_blocked(str(bundle), str(tmp_path / name), "--camera", str(camera_file))
    assert done.returncode == 1
    assert told in done.stderr
    assert "Traceback" not in done.stderr
    rows = list(csv.DictReader(io.StringIO(done.stdout)))
    assert [row["reason"] for row in rows] == ([] if content is None else [told.split(": ")[1]])


def test_a_damaged_image_has_a_row_and_the_next_follows(bundle, flown, camera_file, tmp_path):
    """A damaged image gets a row with a reason and does not affect the rows of others."""
    jpeg = cv2.imencode(".jpg", flown[0])[1].tobytes()
    png = cv2.imencode(".png", flown[0])[1].tobytes()
    square = cv2.imencode(".png", np.ascontiguousarray(flown[0][:, :360]))[1].tobytes()
    content = {
        "a.png": png,
        "text.jpg": b"no image",
        "cut.png": png[: len(png) // 2],
        "cut.jpg": jpeg[: len(jpeg) // 2],
        "square.png": square,
        "b.jpg": jpeg,
    }
    for name, data in content.items():
        (tmp_path / name).write_bytes(data)
    sources = [str(tmp_path / name) for name in content]
    done = run_blocked(str(bundle), *sources, "--camera", str(camera_file))
    assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader(io.StringIO(done.stdout)))
    assert [row["source"] for row in rows] == sources
    reasons = [row["reason"] for row in rows]
    assert (reasons[0], reasons[5]) == ("", "")
    assert reasons[1] == reasons[2] == "cannot be read as an image"
    assert reasons[3] == "cannot be read as an image: it is truncated"
    assert reasons[4].startswith("the image is 360x360, but the camera is 640x360")
    assert [row["x"] == "" for row in rows] == [False, True, True, True, True, False]
    assert f"Note: {tmp_path / 'cut.jpg'}: cannot be read" in done.stderr


@pytest.mark.parametrize("tail", [b"", b"\0" * 40, b"\xff\xda\x00"])
def test_a_whole_jpeg_is_not_taken_for_a_cut_one(flown, tmp_path, tail):
    """Complete JPEG files are read: progressive, with a thumbnail, or with trailing bytes."""
    for options in ([], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 4]):
        jpeg = cv2.imencode(".jpg", flown[0], options)[1].tobytes()
        thumbnail = cv2.imencode(".jpg", flown[0][::8, ::8])[1].tobytes()
        segment = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
        (tmp_path / "a.jpg").write_bytes(jpeg[:2] + segment + jpeg[2:] + tail)
        assert read_image(tmp_path / "a.jpg").shape == (360, 640, 3)
        (tmp_path / "a.jpg").write_bytes((jpeg[:2] + segment + jpeg[2:])[:-400])
        with pytest.raises(InputError, match="it is truncated"):
            read_image(tmp_path / "a.jpg")


def test_an_image_without_texture_gets_no_pose_on_board(bundle, flown):
    """Black, white, fogged and blurred images get a reason instead of a pose."""
    localizer = Localizer(bundle)
    noise = np.random.default_rng(0).normal(10, 4, flown[0].shape)
    for image, told in (
        (np.zeros_like(flown[0]), "nearly black"),
        (np.clip(noise, 0, 255).astype(np.uint8), "nearly black"),
        (np.full_like(flown[0], 250), "nearly white"),
        ((flown[0] * 0.05 + 180).astype(np.uint8), "fogged or covered"),
        (cv2.GaussianBlur(flown[0], (0, 0), 60), "fogged or covered"),
    ):
        found = localizer.localize(image, LENS)
        assert told in found.reason
        assert np.isnan(found.poses.centers).all()
        assert np.isnan(found.covariance).all()


def test_a_place_on_the_globe_is_told():
    """If the world has an origin, a line has latitude, longitude and height, except without a pose."""
    origin = GeoOrigin(-33.86, 151.2, 12.5, HeightReference.TAKEOFF)
    poses = Poses(np.array([[100.0, -50.0, 20.0]]), np.array([[1.0, 0, 0, 0]]))
    located = Located(poses, np.diag([1.0, 2, 3, 4, 5, 6]))
    told = json.loads(lines.json_line("a", 0, 1.5, located, origin))
    assert told["lat_deg"] == pytest.approx(-33.86 - 50 / 110_922, abs=1e-6)
    assert told["lon_deg"] == pytest.approx(151.2 + 100 / 92_500, abs=1e-5)
    assert told["alt_m"] == pytest.approx(32.5, abs=0.01)
    row = next(csv.reader([lines.csv_line('x,"y"', 3, np.nan, located, origin)]))
    cells = dict(zip(lines.COLUMNS, row, strict=True))
    assert (cells["source"], cells["frame"], cells["time_s"]) == ('x,"y"', "3", "")
    assert (cells["cov_00"], cells["cov_55"], cells["cov_01"]) == ("1", "6", "0")
    nowhere = Located.failed("too few cells, or none")
    row = next(csv.reader([lines.csv_line("x", 0, 0.0, nowhere, origin)]))
    assert row[3] == "too few cells, or none"
    assert set(row[4:]) == {""}
    assert json.loads(lines.json_line("x", 0, 0.0, nowhere, origin))["center"] is None


def test_the_columns_are_documented():
    """docs/export.md has a row for each CSV column."""
    text = (ROOT / "docs" / "export.md").read_text(encoding="utf-8")
    table = text.split("| column | meaning |")[1].split("\n\n")[0]
    names = re.findall(r"`(\w+)`", "\n".join(line.split(" | ")[0] for line in table.splitlines()))
    assert [n for n in names if not n.startswith("cov")] == [
        n for n in lines.COLUMNS if not n.startswith("cov")
    ]


def edited(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        document = json.loads((folder / "bundle.json").read_text(encoding="utf-8"))
        change(document)
        (folder / "bundle.json").write_text(json.dumps(document), encoding="utf-8")

    return apply


def with_graph(model: onnx.ModelProto | bytes) -> Callable[[Path], None]:
    """Replace the graph and update its hash in bundle.json."""

    def apply(folder: Path) -> None:
        path = folder / "model.onnx"
        path.write_bytes(model if isinstance(model, bytes) else model.SerializeToString())

        def vouch(document: dict[str, Any]) -> None:
            document["graphs"]["float32"] |= {
                "bytes": path.stat().st_size,
                "sha256": sha256_of(path),
            }

        edited(vouch)(folder)

    return apply


def reading(location: str = "") -> onnx.ModelProto:
    """Return a graph that keeps its weight in another file, if a location is given."""
    weight = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[4])
    if location:
        weight.data_location = TensorProto.EXTERNAL
        for key, value in (("location", location), ("offset", "0"), ("length", "16")):
            weight.external_data.add(key=key, value=value)
    else:
        weight.raw_data = bytes(16)
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [4]) for name in ("x", "y")]
    node = helper.make_node("Add", ["x", "w"], ["y"])
    graph = helper.make_graph([node], "g", values[:1], values[1:], [weight])
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


def within(model: onnx.ModelProto) -> onnx.ModelProto:
    """Return a graph that contains another one in a branch of an If node."""
    node = helper.make_node("If", ["c"], ["y"], then_branch=model.graph, else_branch=model.graph)
    graph = helper.make_graph([node], "outer", [], list(model.graph.output))
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


def cut(folder: Path) -> None:
    path = folder / "model.onnx"
    path.write_bytes(path.read_bytes()[:-1])


def flipped(folder: Path) -> None:
    content = bytearray((folder / "model.onnx").read_bytes())
    content[len(content) // 2] ^= 1
    (folder / "model.onnx").write_bytes(content)


def linked(folder: Path) -> None:
    shutil.copy(folder / "model.onnx", folder.parent / "elsewhere.onnx")
    (folder / "model.onnx").unlink()
    (folder / "model.onnx").symlink_to(folder.parent / "elsewhere.onnx")


HOSTILE: dict[str, tuple[Callable[[Path], None], str]] = {
    "not JSON": (lambda f: (f / "bundle.json").write_text("{"), "not a valid bundle description"),
    "deep": (
        lambda f: (f / "bundle.json").write_text("[" * 99_999),
        "not a valid bundle description",
    ),
    "large": (lambda f: (f / "bundle.json").write_text(" " * 1_000_001), "larger than 1 MB"),
    "a list": (lambda f: (f / "bundle.json").write_text("[]"), "its format is not"),
    "newer": (
        edited(lambda d: d.update(version=3)),
        "has format 3, but this program reads 1 and 2",
    ),
    "version without offset": (edited(lambda d: d.update(version=2)), "contradict each other"),
    "no version": (
        edited(lambda d: d.update(version=float("inf"))),
        "not a valid bundle description",
    ),
    "no view": (edited(lambda d: d.pop("view")), "is damaged"),
    "infinite": (edited(lambda d: d["decoding"].update(stride_px=float("inf"))), "is damaged"),
    "no number": (edited(lambda d: d["decoding"].update(first_px="7")), "is damaged"),
    "many cells": (edited(lambda d: d["decoding"]["options"].update(cells=10**9)), "is damaged"),
    "beyond floats": (
        edited(lambda d: d["input"].update(params=[10**400] * 3)),
        "a number of 401 digits",
    ),
    "no graphs": (edited(lambda d: d.update(graphs=[1])), "is damaged"),
    "other decoding": (edited(lambda d: d["decoding"].update(kind="magic")), "is damaged"),
    "huge input": (edited(lambda d: d["input"].update(width=60_000)), "is damaged"),
    "a lens": (
        edited(lambda d: d.update(input=camera_to_json(LENS))),
        "is not a pinhole",
    ),
    "path": (edited(lambda d: d["graphs"]["float32"].update(file="../m.onnx")), "is damaged"),
    "precision": (edited(lambda d: d["graphs"].update(int4=d["graphs"]["int8"])), "is damaged"),
    "other input": (edited(lambda d: d["input"].update(width=322)), "its input is"),
    "other cells": (edited(lambda d: d["decoding"].update(stride_px=64.0)), "its outputs are"),
    "cut": (cut, "copy it again"),
    "flipped": (flipped, r"SHA-256 differs from bundle\.json"),
    "gone": (lambda f: (f / "model.onnx").unlink(), "copy the whole bundle folder"),
    "link": (linked, "copy the whole bundle folder"),
    "weights outside": (with_graph(reading("../secret.bin")), "keeps a weight in another file"),
    "weights anywhere": (with_graph(reading("/etc/hostname")), "keeps a weight in another file"),
    "weights beside": (with_graph(reading("near.bin")), "keeps a weight in another file"),
    "weights in a branch": (with_graph(within(reading("near.bin"))), "keeps a weight in another"),
    "no graph": (with_graph(b"\x3a\x7fnothing"), "is not an ONNX file"),
    "other graph": (with_graph(reading()), "its input is"),
}


@pytest.mark.parametrize("name", list(HOSTILE))
def test_a_bundle_that_is_wrong_is_refused(bundle, tmp_path, name):
    """Damage, false metadata and links raise FormatError before any computation."""
    damage, told = HOSTILE[name]
    (tmp_path / "secret.bin").write_bytes(bytes(16))
    folder = tmp_path / "bundle"
    shutil.copytree(bundle, folder)
    (folder / "near.bin").write_bytes(bytes(16))
    damage(folder)
    with pytest.raises(FormatError, match=told):
        Localizer(folder)


def test_what_is_no_bundle_is_told(bundle, tmp_path):
    """An empty folder and a bundle without the requested graph raise InputError."""
    with pytest.raises(InputError, match=r"it has no bundle\.json"):
        read_bundle(tmp_path)
    folder = tmp_path / "bundle"
    shutil.copytree(bundle, folder)
    edited(lambda d: d["graphs"].pop("int8"))(folder)
    assert Localizer(folder).camera.width == 320
    with pytest.raises(InputError, match="has no int8 graph"):
        Localizer(folder, int8=True)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        (
            "b.m3u8",
            "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nflight.avi\n#EXT-X-ENDLIST\n",
        ),
        ("b.mp4", "ffconcat version 1.0\nfile flight.avi\n"),
    ],
)
def test_a_playlist_is_not_followed(sources, name, text):
    """A playlist, which refers to other files or hosts, is rejected whatever its name."""
    _, video = sources
    assert len(list(frames(video))) == 4
    playlist = video.parent / name
    playlist.write_text(text)
    before = dict(os.environ)
    with pytest.raises(InputError, match=rf"{name}: cannot be decoded as a video; playlists"):
        list(frames(playlist))
    assert dict(os.environ) == before


def test_frames_are_read_upright_and_bounded(tmp_path, flown, monkeypatch):
    """A photo yields one frame, equal to the image; an oversized file is rejected."""
    path = tmp_path / "a.png"
    path.write_bytes(cv2.imencode(".png", flown[0])[1].tobytes())
    [(number, time_s, image)] = frames(path)
    assert (number, np.isnan(time_s)) == (0, True)
    assert np.array_equal(image, flown[0])
    monkeypatch.setattr("spn_model.onboard.sources._MAX_IMAGE_BYTES", 100)
    with pytest.raises(InputError, match="too large for an image"):
        read_image(path)


def test_benchmark_times_both_graphs(bundle, hall, tmp_path):
    """`benchmark` reports time per step, file size and memory of both graphs on data set frames."""
    area = tmp_path / "area"
    (area / "5-split").mkdir(parents=True)
    shutil.copy(hall, area / "5-split" / "dataset.h5")
    shutil.copytree(bundle, area / "runs" / "first" / "bundle")
    arguments = ["benchmark", "--area", str(area), "--run", "first", "--poses", "8"]
    shown = CliRunner().invoke(main, [*arguments, "--json"])
    assert shown.exit_code == 0, shown.output
    told = json.loads(shown.stdout)["graphs"]
    assert set(told) == {"float32", "int8"}
    for one in told.values():
        assert one["frame"] == [1280, 720]
        assert one["located"] > 0.7  # upsampled training images
        assert one["threads"] == 1
        spent = one["milliseconds"]
        assert 0 < spent["graph"]["p50"] <= spent["graph"]["p95"]
        assert set(spent) == set(one["cpu_milliseconds"])
        assert spent["total"]["p50"] > spent["preprocessing"]["p50"] + spent["decoding"]["p50"]
        assert 0.7 < one["overhead"] < 1.4  # measured on few poses
        assert 40 < one["memory_mb"] < 400
    assert told["int8"]["file_mb"] < told["float32"]["file_mb"]


def test_benchmark_of_given_frames(bundle, flown, camera_file, tmp_path):
    """Given frames need a camera, and the onboard program's error is passed on."""
    frame = tmp_path / "f.png"
    frame.write_bytes(cv2.imencode(".png", flown[0])[1].tobytes())
    arguments = ["benchmark", str(bundle), "--frame", str(frame), "--poses", "2"]
    alone = CliRunner().invoke(main, arguments)
    assert alone.exit_code == 2
    assert "--frame and --camera go together" in alone.output
    shown = CliRunner().invoke(main, [*arguments, "--camera", str(camera_file)])
    assert shown.exit_code == 0, shown.output
    assert "A pose from a frame of 640x360, 1 thread" in shown.output
    frame.write_bytes(b"no image")
    broken = CliRunner().invoke(main, [*arguments, "--camera", str(camera_file)])
    assert broken.exit_code == 1
    assert "the onboard program failed" in broken.output
    assert "cannot be read as an image" in broken.output


def test_images_with_few_of_16_bits_are_refused(tmp_path):
    """A 12-bit image stored in 16 bits is rejected; a full 16-bit image is read."""
    values = np.linspace(0, 65535, 64 * 48).astype(np.uint16).reshape(48, 64)
    cv2.imwrite(str(tmp_path / "whole.png"), values)
    cv2.imwrite(str(tmp_path / "few.png"), values >> 4)
    assert read_image(tmp_path / "whole.png").max() == 255
    with pytest.raises(InputError, match=r"few.png: uses only values \d+ to 3\d\d\d of 16 bits"):
        read_image(tmp_path / "few.png")
