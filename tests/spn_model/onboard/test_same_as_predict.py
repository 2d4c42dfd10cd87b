"""`spn-model predict` and the onboard program read the same frames, times and poses from the same files."""

from __future__ import annotations

import csv
import io
import itertools
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from spn_data.capture import video
from spn_data.capture.photos import decode_photo
from spn_data.dataset.hdf5_reader import Dataset
from spn_data.errors import InputError
from spn_data.geometry import rendering
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_from_focal_length, camera_to_json
from spn_data.storage.files import read_csv
from spn_data.storage.json_files import write_json
from spn_model.examples.dataset_view import view_of
from spn_model.examples.training_set import TrainingSet
from spn_model.export.bundle_checks import BundleOptions
from spn_model.export.bundle_export import export
from spn_model.models.checkpoint import Checkpoint
from spn_model.models.registry import make
from spn_model.onboard import __main__ as program
from spn_model.onboard import localizer, sources
from spn_model.prediction.flights import find_flights
from spn_model.prediction.predict import predict
from spn_model.prediction.predicted_files import COLUMNS
from tests.worlds.box_world import write_box

CLIPS = ("sample-5s.mp4", "sample-5s_h265.mp4", "gopro-karma.mp4")
UNEVEN = (0, 50, 250, 300, 420, 900, 950, 1000)


def scene(k: int, width: int = 320, height: int = 180) -> np.ndarray:
    """Draw coloured patches with sharp edges, which move from image to image."""
    patches = np.random.default_rng(5).integers(0, 255, (18, 32, 3), dtype=np.uint8)
    image = cv2.resize(patches, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.roll(image, 8 * k, axis=1)


def write_clip(
    path: Path,
    size: tuple[int, int] = (320, 180),
    *,
    pixels: str = "yuv420p",
    ticks: tuple[int, ...] = tuple(range(0, 800, 100)),
    rotation_deg: int = 0,
    mirrored: bool = False,
    aspect: Fraction | None = None,
    codec: str = "libx264",
    gop: int = 12,
    black: tuple[int, ...] = (),
) -> Path:
    """Encode the scene without a note on its colours, the index before the frames; some may be black."""
    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = *size, pixels
        if codec == "libx264":
            stream.codec_context.options = {"g": str(gop)}
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        if aspect is not None:
            stream.codec_context.sample_aspect_ratio = aspect
        if rotation_deg or mirrored:
            stream.set_display_rotation(rotation_deg, hflip=mirrored)
        for k, tick in enumerate(ticks):
            image = scene(k, *size) * (k not in black)
            frame = av.VideoFrame.from_ndarray(image.astype(np.uint8), format="bgr24")
            frame.pts, frame.time_base = tick, Fraction(1, 1000)
            container.mux(stream.encode(frame.reformat(format=pixels)))
        container.mux(stream.encode())
    return path


MADE: dict[str, Callable[[Path], Path]] = {
    "turned": lambda to: write_clip(to / "a.mp4", rotation_deg=90),
    "upside-down": lambda to: write_clip(to / "a.mov", rotation_deg=180),
    "uneven": lambda to: write_clip(to / "a.mp4", ticks=UNEVEN),
    "uneven-late-matroska": lambda to: write_clip(
        to / "a.mkv", ticks=tuple(700 + tick for tick in UNEVEN)
    ),
    "hd-untagged": lambda to: write_clip(to / "a.mp4", (64, 720)),
    "ten-bits": lambda to: write_clip(to / "a.mp4", pixels="yuv420p10le"),
    "not-square": lambda to: write_clip(to / "a.mp4", aspect=Fraction(4, 3)),
    "not-square-turned": lambda to: write_clip(
        to / "a.mp4", aspect=Fraction(4, 3), rotation_deg=270
    ),
    "transport-stream": lambda to: write_clip(to / "a.ts"),
    "vp9": lambda to: write_clip(to / "a.webm", codec="libvpx-vp9"),
}


@pytest.mark.parametrize("kind", [*CLIPS, *MADE])
def test_frames_of_a_video_are_the_same(kind, request, tmp_path):
    """Both decoders give the same number of frames, times to the microsecond, and every pixel."""
    real = kind in CLIPS
    path = request.getfixturevalue("shared_data") / "video" / kind if real else MADE[kind](tmp_path)
    first = 8 if real else None  # of one, the seventh has a timestamp that does not increase
    both = zip(
        itertools.islice(video.decode(path), first),
        itertools.islice(sources.frames(path), first),
        strict=True,
    )
    for expected, (number, time_s, image) in both:
        assert (number, time_s) == (expected.index, expected.time_s)
        np.testing.assert_array_equal(image, expected.image)
    assert number >= 7


def test_a_mirrored_video_is_refused_on_board(tmp_path):
    """OpenCV would turn a mirrored video by 180 degrees instead."""
    path = write_clip(tmp_path / "a.mp4", mirrored=True)
    assert len(list(video.decode(path))) == 8
    with pytest.raises(InputError, match=r"a\.mp4: is a video whose display matrix mirrors it"):
        next(sources.frames(path))


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.bmp", "a.webp", "a.tif", "a.heic"])
@pytest.mark.parametrize("mode", ["RGB", "L", "RGBA", "P", "I;16", "turned"])
def test_photos_are_the_same(name, mode, tmp_path):
    """A photo has the same pixels on board, whatever its format, depth and EXIF orientation."""
    image = Image.fromarray(np.ascontiguousarray(scene(0)[..., ::-1]))
    options = {}
    if name == "a.heic":
        pytest.importorskip("pillow_heif", reason="needs the extra heic").register_heif_opener()
    if mode == "turned":
        options["exif"] = Image.Exif()
        options["exif"][0x0112] = 6
    elif mode == "I;16":
        values = np.asarray(image.convert("L")).astype(np.uint16) * 257 - 100
        image = Image.fromarray(values)
    else:
        image = image.convert(mode)
    path = tmp_path / name
    try:
        image.save(path, **options)
    except (OSError, ValueError):
        pytest.skip(f"{path.suffix} has no {mode}")
    found, expected = sources.read_image(path).astype(int), decode_photo(path).astype(int)
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() <= (2 if name in ("a.jpg", "a.webp") else 0)


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_box(tmp_path_factory.mktemp("hall") / "dataset.h5", train=4)


@pytest.fixture(scope="module")
def network(hall: Path) -> Checkpoint:
    model = make("regression", {"network": "squeezeposenet", "width": 80}, seed=0)
    with Dataset(hall) as data:
        model.fit(TrainingSet(data.groups["train"]))
        return Checkpoint(model, view_of(data), {})


@pytest.fixture(scope="module")
def bundle(network: Checkpoint, hall: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "bundle"
    export(network, hall, folder, {}, lambda *_: None, BundleOptions(int8=False))
    return folder


def compared(
    path: Path, network: Checkpoint, bundle: Path, to: Path, capsys: pytest.CaptureFixture[str]
) -> tuple[list[dict[str, str]], list[dict[str, str]]]:
    """Run both programs on one file, and return the rows of both."""
    info = video.probe(path)
    camera: Camera = camera_from_focal_length(info.width, info.width, info.height)
    write_json(to / "camera.json", camera_to_json(camera))
    flights, _ = find_flights([path], camera)
    predict(network, flights, to / "poses", lambda *_: None, facts={})
    expected = [row for _, row in read_csv(to / "poses" / "poses.csv", COLUMNS)]
    capsys.readouterr()
    code = program.main([str(bundle), str(path), "--camera", str(to / "camera.json")])
    assert code == 0
    return expected, list(csv.DictReader(io.StringIO(capsys.readouterr().out)))


@pytest.fixture(autouse=True)
def same_sampling(monkeypatch: pytest.MonkeyPatch) -> None:
    """Render on board with as many samples as elsewhere; otherwise grey levels differ by about one."""
    monkeypatch.setattr(localizer, "SAMPLE_STEP_PX", rendering.SAMPLE_STEP_PX)


@pytest.mark.parametrize(
    "kind", [*(pytest.param(clip, marks=pytest.mark.slow) for clip in CLIPS), "turned", "cut"]
)
def test_poses_are_the_same(kind, request, network, bundle, tmp_path, capsys):
    """Both programs give the same frames, times, reasons and, to float accuracy, poses."""
    if kind in CLIPS:
        path = request.getfixturevalue("shared_data") / "video" / kind
    elif kind == "cut":
        path = write_clip(tmp_path / "a.mp4", gop=1)
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    else:
        path = write_clip(tmp_path / "a.mp4", rotation_deg=90, ticks=UNEVEN, black=(2, 5))
    expected, found = compared(path, network, bundle, tmp_path, capsys)
    assert [row["frame"] for row in found] == [row["video_frame"] for row in expected]
    reasons = [row["reason"] for row in expected]
    assert [row["reason"] for row in found] == reasons
    if kind == "turned":
        assert [k for k, reason in enumerate(reasons) if "nearly black" in reason] == [2, 5]
    elif kind == "cut":
        assert reasons[:-1] == [""] * (len(reasons) - 1)
        assert (
            reasons[-1]
            == f"only {len(reasons) - 1} of 8 frames can be decoded: damaged or truncated"
        )
    for mine, theirs in zip(found, expected, strict=True):
        assert mine["time_s"] == (theirs["time_s"] and f"{float(theirs['time_s']):.6f}")
        for name in ("x", "y", "z", "qw", "qx", "qy", "qz"):
            known = float(theirs[name] or np.nan)
            assert float(mine[name] or np.nan) == pytest.approx(known, abs=2e-4, nan_ok=True)
