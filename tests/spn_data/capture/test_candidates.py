"""Tests of measuring, choosing and extracting frames, including interruptions and full disks."""

from __future__ import annotations

import os
import shutil
from dataclasses import fields
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from spn_data.capture.candidates import analyse, build_frames
from spn_data.capture.extraction import (
    BYTES_PER_PIXEL,
    check_space,
    estimate_cost,
    extract_chosen,
)
from spn_data.capture.frames import Frames, read_frames, write_frames
from spn_data.capture.measurement import Measurements
from spn_data.capture.photo_selection import choose_photos
from spn_data.capture.selection import SelectionOptions, choose
from spn_data.capture.sources import Source, SourceKind, discover
from spn_data.capture.video import decode
from spn_data.errors import InputError

OPTIONS = SelectionOptions()


def texture(width: int, height: int) -> np.ndarray:
    """Create BGR noise of several scales."""
    rng = np.random.default_rng(3)
    total = np.zeros((height, width, 3))
    for cell, weight in ((3, 20), (8, 40), (25, 60)):
        coarse = rng.normal(size=(height // cell + 2, width // cell + 2, 3))
        total += weight * cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + total / 2, 0, 255).astype(np.uint8)


def write_flight(
    path: Path, frames: int, *, first: int = 0, size: tuple[int, int] = (320, 240)
) -> None:
    """Write a video that pans by 6 px per frame at 10 fps; every seventh frame is blurred along x."""
    width, height = size
    wide = texture(width + 6 * 50, height)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.codec_context.options = {"crf": "12", "preset": "veryfast"}
        for i in range(frames):
            left = 6 * (first + i)
            image = wide[:, left : left + width]
            image = cv2.blur(image, (9, 1)) if i % 7 == 3 else np.ascontiguousarray(image)
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            frame.pts, frame.time_base = i, Fraction(1, 10)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Source:
    """Create a recording of two GoPro chapters of 30 and 20 frames."""
    folder = tmp_path_factory.mktemp("flight")
    write_flight(folder / "GX010001.MP4", 30)
    write_flight(folder / "GX020001.MP4", 20, first=30)
    [source] = discover(folder).sources
    return source


def frames_from(source: Source, options: SelectionOptions = OPTIONS) -> Frames:
    candidates = analyse(source)
    rule = choose_photos if source.kind is SourceKind.PHOTOS else choose
    return build_frames(candidates, rule(candidates.measured, options))


def test_chapters_are_one_sequence_on_one_clock(flight: Source) -> None:
    """Names and times continue across chapters, while the frame index of each file restarts."""
    candidates = analyse(flight)
    assert candidates.part_start_s == (0.0, 3.0)
    frames = build_frames(candidates, choose(candidates.measured, OPTIONS))
    np.testing.assert_allclose(frames.time_s, np.arange(50) / 10, atol=1e-6)
    assert frames.names[30] == "GX010001/000030.jpg"
    assert (frames.sources[30], frames.video_frame[30]) == ("GX020001.MP4", 0)
    assert set(frames.cameras) == {"GX010001"}
    assert not np.isin(np.flatnonzero(frames.chosen[:30]) % 7, 3).any()  # the blurred ones
    # At 6 px of 320 per frame, the image moves by about 0.1 of the width in 5 frames.
    assert 50 / 8 <= frames.chosen.sum() <= 50 / 4
    chosen = np.flatnonzero(frames.chosen)
    np.testing.assert_allclose(frames.motion_px[chosen][1:], 6 * np.diff(chosen), atol=0.7)


def test_chosen_frames_are_the_videos_own(flight: Source, tmp_path: Path) -> None:
    """Each extracted JPEG matches its frame at full size within 5 grey levels RMS; others are not written."""
    frames = frames_from(flight)
    heard: list[int] = []
    count = extract_chosen(flight, frames, tmp_path / "out", progress=heard.append)
    files = sorted(p.name for p in (tmp_path / "out").iterdir())
    assert files == [n.split("/")[1] for n in frames.names[frames.chosen]]
    assert heard == list(range(count + 1))
    true = [f.image for part in flight.parts for f in decode(part)]
    for row in np.flatnonzero(frames.chosen):
        saved = cv2.imread(str(tmp_path / "out" / frames.names[row].split("/")[1]))
        assert saved is not None
        assert saved.shape == (240, 320, 3)
        difference = saved.astype(float) - true[row]
        assert np.sqrt(np.mean(difference**2)) < 5


def test_an_interrupted_extraction_goes_on(flight: Source, tmp_path: Path) -> None:
    """A resumed extraction keeps existing files, ignores partial ones and writes the missing ones."""
    frames = frames_from(flight)
    total = extract_chosen(flight, frames, tmp_path)
    names = sorted(p.name for p in tmp_path.iterdir())
    kept = (tmp_path / names[0]).stat().st_mtime_ns
    (tmp_path / names[1]).unlink()
    (tmp_path / names[-1]).unlink()
    (tmp_path / f".{names[1]}.part").write_bytes(b"half")
    heard: list[int] = []
    assert extract_chosen(flight, frames, tmp_path, progress=heard.append) == 2
    assert heard == [total - 2, total - 1, total]
    assert sorted(p.name for p in tmp_path.iterdir()) == names
    assert (tmp_path / names[0]).stat().st_mtime_ns == kept
    assert extract_chosen(flight, frames, tmp_path) == 0


def test_measurements_are_kept_until_the_video_changes(flight: Source, tmp_path: Path) -> None:
    """Cached measurements are reused until the video is touched or the cache is damaged."""
    for part in flight.parts:
        shutil.copy(part, tmp_path)
    [source] = discover(tmp_path).sources
    cache = tmp_path / "measured.npz"
    first = analyse(source, cache=cache)
    heard: list[int] = []
    again = analyse(source, cache=cache, progress=heard.append)
    assert heard == [50]
    for column in fields(Measurements):
        np.testing.assert_array_equal(
            getattr(first.measured, column.name), getattr(again.measured, column.name)
        )
    assert (again.part_start_s, again.notes) == (first.part_start_s, first.notes)
    os.utime(source.parts[0], ns=(1, 1))
    analyse(source, cache=cache, progress=heard.append)
    cache.write_bytes(cache.read_bytes()[:500])
    analyse(source, cache=cache, progress=heard.append)
    assert len(heard) == 101


def test_a_video_that_was_replaced_is_told(flight: Source, tmp_path: Path) -> None:
    """A video that became shorter or changed size since it was measured is refused."""
    frames = frames_from(flight)
    for size, count in (((320, 240), 12), ((160, 120), 30)):
        folder = tmp_path / f"{size[0]}"
        folder.mkdir()
        write_flight(folder / "GX010001.MP4", count, size=size)
        shutil.copy(flight.parts[1], folder)
        [other] = discover(folder).sources
        with pytest.raises(
            InputError, match=r"GX010001\.MP4: frame \d+ is missing: the video has changed"
        ):
            extract_chosen(other, frames, folder / "out")


def test_zoom_and_size_make_other_cameras(flight: Source, tmp_path: Path) -> None:
    """Zooming from 24 to 48 mm and back gives two cameras; a chapter of another size, one more."""
    candidates = analyse(flight)
    choice = choose(candidates.measured, OPTIONS)
    focal = np.full(50, 24.0)
    focal[10:20], focal[25], focal[40:] = 48.0, np.nan, 24.2
    cameras = build_frames(candidates, choice, focal=focal).cameras.tolist()
    assert cameras == ["GX010001"] * 10 + ["GX010001-2"] * 10 + ["GX010001"] * 30
    shutil.copy(flight.parts[0], tmp_path)
    write_flight(tmp_path / "GX020001.MP4", 20, size=(320, 180))
    [other] = discover(tmp_path).sources
    frames = frames_from(other)
    assert frames.cameras.tolist() == ["GX010001"] * 30 + ["GX010001-2"] * 20
    assert extract_chosen(other, frames, tmp_path / "out") == frames.chosen.sum()


def test_photos_become_frames(shared_data: Path, tmp_path: Path) -> None:
    """Photos are copied, rotated or converted to JPEG as needed; unreadable ones are reported."""
    folder = tmp_path / "survey"
    folder.mkdir()
    real = sorted((shared_data / "photos-two-passes").glob("*.JPG"))[:3]
    for path in real:
        shutil.copyfile(path, folder / path.name)
    data = real[0].read_bytes()
    (folder / "DJI_0000.JPG").write_bytes(data[: len(data) // 2])
    exif = Image.Exif()
    exif[0x0112] = 6
    with Image.open(real[1]) as image:
        image.save(folder / "X turned.jpg", exif=exif)
        image.save(folder / "x_turned.png")
    [source] = discover(folder).sources
    candidates = analyse(source)
    frames = build_frames(candidates, choose_photos(candidates.measured, OPTIONS))
    assert frames.names.tolist() == [
        "survey/DJI_0000.jpg",
        *(f"survey/{p.stem}.jpg" for p in real),
        "survey/X-turned.jpg",
        "survey/x_turned.jpg",
    ]
    assert frames.status[0] == "unreadable"
    assert frames.reason[0] == "cannot be read as an image: it is truncated"
    assert frames.chosen[1:].all()
    assert set(frames.cameras[:4]) == {"survey"}
    assert (frames.cameras[4], frames.width[4], frames.height[4]) == ("survey-2", 600, 800)
    assert candidates.photo_telemetry is not None
    assert len(candidates.photo_telemetry) == 6
    with_fix = frames.with_telemetry(candidates.photo_telemetry)
    assert with_fix.has_fix.tolist() == [True, True, True, True, False, False]
    assert extract_chosen(source, frames, tmp_path / "out") == 5
    assert (tmp_path / "out" / real[0].with_suffix(".jpg").name).read_bytes() == data
    # Read it as a program would that ignores EXIF.
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    turned = cv2.imread(str(tmp_path / "out" / "X-turned.jpg"), flags)
    assert turned is not None
    assert turned.shape == (800, 600, 3)
    write_frames(tmp_path / "frames.csv", with_fix)
    assert read_frames(tmp_path / "frames.csv").names.tolist() == frames.names.tolist()


def test_photos_of_which_none_is_readable_are_rows_too(tmp_path: Path) -> None:
    """Photos that are all unreadable still give rows, with time zero."""
    for name in ("a.jpg", "b.jpg"):
        (tmp_path / name).write_text("no photo")
    [source] = discover(tmp_path).sources
    frames = frames_from(source)
    assert frames.status.tolist() == ["unreadable", "unreadable"]
    assert frames.time_s.tolist() == [0, 0]


def test_costs_are_estimated_before(flight: Source, tmp_path: Path) -> None:
    """The disk estimate is within a factor of three of the files written and scales with the target."""
    cost = estimate_cost([flight])
    assert cost.candidates == 50
    assert cost.chosen == round(5 * 1.3)
    assert cost.disk_bytes == pytest.approx(5 * 1.3 * 320 * 240 * BYTES_PER_PIXEL, rel=0.01)
    extract_chosen(flight, frames_from(flight), tmp_path)
    each = np.mean([p.stat().st_size for p in tmp_path.iterdir()])
    assert 1 / 3 < each / (cost.disk_bytes / cost.chosen) < 3
    double = estimate_cost([flight], target_count=13)
    assert double.disk_bytes == pytest.approx(2 * cost.disk_bytes, rel=0.01)


def test_a_full_disk_is_told_before_starting(tmp_path: Path) -> None:
    """Too little disk space is refused in advance, even if the folder does not exist yet."""
    with pytest.raises(
        InputError, match=r"the frames need about 1000000000\.00 GB but only .* GB are free"
    ):
        check_space(tmp_path / "not" / "there", 10**18)
    check_space(tmp_path / "not" / "there", 1000)


def test_the_blur_of_a_real_flight_video_is_relative(shared_data: Path) -> None:
    """The 12 s GoPro Karma clip gives about one frame per second, without gaps above 4 s."""
    found = discover(shared_data / "video").sources
    frames = frames_from(next(s for s in found if s.sequence == "gopro-karma"))
    times = frames.time_s[frames.chosen]
    assert 6 <= len(times) <= 14
    assert np.diff(times).max() <= 4
    assert len(frames) == 362
