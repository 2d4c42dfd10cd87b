"""Tests of video files: properties, times and orientation of frames, and the effects of damage."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from spn_data.capture.video import DecodeReport, decode, decode_gray, probe
from spn_data.errors import InputError

GREEN = (0, 255, 0)


def marked_image(width: int = 64, height: int = 48) -> np.ndarray:
    """Create a dark red image with a green upper-left quarter."""
    image = np.full((height, width, 3), (30, 30, 120), np.uint8)
    image[: height // 2, : width // 2] = GREEN
    return image


def write_video(
    path: Path,
    images: Sequence[np.ndarray],
    *,
    ticks: Sequence[int] | None = None,
    time_base: Fraction = Fraction(1, 10),
    rotation_deg: int = 0,
    mirrored: bool = False,
    pixel_format: str = "yuv420p",
    pixel_aspect: Fraction | None = None,
    bt709: bool = False,
    container_options: dict[str, str] | None = None,
    gop: int = 12,
) -> Path:
    """Encode BGR images as H.264 with presentation times `ticks` of `time_base`."""
    with av.open(str(path), "w", options=container_options or {}) as container:
        stream = container.add_stream("libx264", rate=10)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = pixel_format
        stream.time_base = stream.codec_context.time_base = time_base
        stream.codec_context.options = {"crf": "10", "g": str(gop), "bf": "0", "sc_threshold": "0"}
        if bt709:
            stream.codec_context.colorspace = stream.codec_context.color_range = 1
        if pixel_aspect is not None:
            stream.codec_context.sample_aspect_ratio = pixel_aspect
        if rotation_deg or mirrored:
            stream.set_display_rotation(rotation_deg, hflip=mirrored)
        for i, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            frame = frame.reformat(
                format=pixel_format, dst_colorspace="ITU709" if bt709 else "ITU601"
            )
            frame.pts, frame.time_base = (ticks[i] if ticks is not None else i), time_base
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def noise_images(count: int, width: int = 320, height: int = 240) -> list[np.ndarray]:
    """Create images that compress badly, so that the file is long enough to damage."""
    rng = np.random.default_rng(5)
    return [rng.integers(0, 255, (height, width, 3), dtype=np.uint8) for _ in range(count)]


def test_probe_reads_a_drone_video(shared_data: Path) -> None:
    """Size, rate, clock and tracks of the GoPro Karma clip are those the camera wrote."""
    info = probe(shared_data / "video" / "gopro-karma.mp4")
    assert (info.width, info.height, info.rotation_deg, info.codec) == (854, 480, 0, "h264")
    assert info.frame_count == 362
    assert info.fps == pytest.approx(30000 / 1001)
    assert info.duration_s == pytest.approx(12.0787, abs=1e-3)
    assert info.created_utc == datetime(2017, 4, 17, 19, 27, 57, tzinfo=UTC)
    assert info.data_streams == ("GoPro TCD", "GoPro MET", "GoPro SOS")
    assert not info.has_subtitles
    assert info.pixel_aspect == 1


def test_all_frames_of_a_drone_video_come_at_its_rate(shared_data: Path) -> None:
    """Both decoders agree, and all 362 frames are decoded at 29.97 fps."""
    path = shared_data / "video" / "gopro-karma.mp4"
    report = DecodeReport()
    gray = list(decode_gray(path, max_width=320, report=report))
    assert [f.index for f in gray] == list(range(362))
    np.testing.assert_allclose([f.time_s for f in gray], np.arange(362) * 1001 / 30000, atol=1e-6)
    assert gray[0].image is not None
    assert gray[0].image.shape == (180, 320)
    assert (gray[0].width, gray[0].height) == (854, 480)
    assert not report.notes
    [full] = [f for f in decode(path, wanted={7}) if f.image is not None]
    assert (full.index, full.time_s) == (7, gray[7].time_s)
    assert full.image is not None
    small = cv2.cvtColor(
        cv2.resize(full.image, (320, 180), interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY
    )
    # Both are full-range luma and agree up to rounding in the colour conversion.
    assert np.abs(small.astype(int) - gray[7].image.astype(int)).mean() < 2


def test_a_real_portrait_video_of_variable_rate_keeps_its_timestamps(shared_data: Path) -> None:
    """Variable timestamps are kept; one frame with a decreasing timestamp is dropped and reported."""
    path = shared_data / "video" / "sample-5s_h265.mp4"
    report = DecodeReport()
    times = np.array([f.time_s for f in decode_gray(path, max_width=160, report=report)])
    assert (probe(path).width, probe(path).height) == (1376, 1840)
    assert probe(path).fps == pytest.approx(28.787, abs=1e-3)
    assert (len(times), report.out_of_order) == (145, 1)
    assert np.all(np.diff(times) > 0)
    # Timestamps are multiples of 1001/30000 s with gaps; index / rate would be up to 0.1 s off.
    assert np.diff(times).max() > 2.9 * 1001 / 30000
    assert report.notes == ["1 frames dropped because their timestamps did not increase"]


def test_times_are_the_containers_and_begin_at_zero(tmp_path: Path) -> None:
    """Times follow the container's variable rate, and the first timestamp becomes 0."""
    ticks = [40, 41, 43, 50, 51, 90]
    images = [marked_image()] * 6
    path = write_video(tmp_path / "v.mkv", images, ticks=ticks, time_base=Fraction(1, 1000))
    times = [f.time_s for f in decode(path)]
    np.testing.assert_allclose(times, [0, 0.001, 0.003, 0.010, 0.011, 0.050], atol=1e-9)


@pytest.mark.parametrize(
    ("rotation_deg", "mirrored", "size", "corner"),
    [
        (0, False, (64, 48), (0, 0)),
        (90, False, (48, 64), (0, 1)),  # counter-clockwise: upper left goes to lower left
        (180, False, (64, 48), (1, 1)),
        (-90, False, (48, 64), (1, 0)),
        (0, True, (64, 48), (1, 0)),
        (90, True, (48, 64), None),
    ],
)
def test_frames_stand_upright(
    tmp_path: Path,
    rotation_deg: int,
    mirrored: bool,
    size: tuple[int, int],
    corner: tuple[int, int] | None,
) -> None:
    """The display matrix rotates and mirrors colour and grey images; corner is (right, lower)."""
    path = write_video(
        tmp_path / "v.mp4", [marked_image()] * 2, rotation_deg=rotation_deg, mirrored=mirrored
    )
    info = probe(path)
    assert (info.width, info.height) == size
    frame, gray = next(decode(path)), next(decode_gray(path))
    assert frame.image is not None
    assert gray.image is not None
    assert frame.image.shape == (size[1], size[0], 3)
    assert gray.image.shape == (size[1], size[0])
    found = _bright_corner(frame.image[:, :, 1])
    assert found == _bright_corner(gray.image)
    assert corner is None or found == corner


def _bright_corner(image: np.ndarray) -> tuple[int, int]:
    height, width = image.shape
    corners = [(x, y) for x in (0, 1) for y in (0, 1)]
    level = [image[5 + y * (height - 11), 5 + x * (width - 11)] for x, y in corners]
    return corners[int(np.argmax(level))]


@pytest.mark.parametrize("pixel_format", ["yuv420p", "yuv422p10le", "yuv444p"])
def test_other_pixel_formats_give_8_bits(tmp_path: Path, pixel_format: str) -> None:
    """10-bit and other chroma formats give the same 8-bit colours, and grey at reduced size."""
    path = write_video(tmp_path / "v.mkv", [marked_image()] * 2, pixel_format=pixel_format)
    frame = next(decode(path))
    gray = next(decode_gray(path, max_width=32))
    assert frame.image is not None
    assert frame.image.dtype == np.uint8
    np.testing.assert_allclose(frame.image[10, 10], GREEN, atol=6)
    assert gray.image is not None
    assert (gray.image.dtype, gray.image.shape) == (np.uint8, (24, 32))
    assert int(gray.image[4, 4]) > int(gray.image[20, 28]) + 60


def test_colours_of_bt709_are_kept(tmp_path: Path) -> None:
    """HD video is decoded as BT.709; decoding it as BT.601 would change red by 20 levels."""
    image = np.full((720, 64, 3), (20, 40, 200), np.uint8)
    path = write_video(tmp_path / "v.mp4", [image] * 2, bt709=True)
    frame = next(decode(path))
    assert frame.image is not None
    np.testing.assert_allclose(frame.image[300, 30], (20, 40, 200), atol=4)


def test_pixels_that_are_not_square_are_stretched(tmp_path: Path) -> None:
    """48 pixels of aspect 4:3 are resampled to 64, and a note says so."""
    image = marked_image(48, 48)
    path = write_video(tmp_path / "v.mp4", [image] * 2, pixel_aspect=Fraction(4, 3))
    info = probe(path)
    assert (info.width, info.height, info.pixel_aspect) == (64, 48, Fraction(4, 3))
    assert info.notes == ("non-square pixels (4:3) are resampled to square ones",)
    frame, gray = next(decode(path)), next(decode_gray(path))
    assert frame.image is not None
    assert gray.image is not None
    assert frame.image.shape == (48, 64, 3)
    assert gray.image.shape == (48, 64)
    assert frame.image[10, 28, 1] > 200 > frame.image[10, 36, 1]


def test_a_change_of_size_within_a_file_shows_in_the_frames(tmp_path: Path) -> None:
    """Frames of concatenated transport streams, as some recorders write, keep their own sizes."""
    first = write_video(tmp_path / "a.ts", [marked_image(64, 48)] * 5)
    second = write_video(tmp_path / "b.ts", [marked_image(96, 48)] * 5, ticks=list(range(5, 10)))
    path = tmp_path / "both.ts"
    path.write_bytes(first.read_bytes() + second.read_bytes())
    widths = [f.width for f in decode_gray(path)]
    shapes = [f.image.shape for f in decode(path) if f.image is not None]
    assert widths == [64] * 5 + [96] * 5
    assert shapes == [(48, w, 3) for w in widths]


def test_only_wanted_frames_are_converted(tmp_path: Path) -> None:
    """Only wanted frames have an image, and decoding stops after the last of them."""
    path = write_video(tmp_path / "v.mp4", [marked_image()] * 8)
    frames = list(decode(path, wanted={2, 4}))
    assert [f.index for f in frames] == [0, 1, 2, 3, 4]
    assert [f.index for f in frames if f.image is not None] == [2, 4]


def test_damaged_packets_are_passed_over_and_told(tmp_path: Path) -> None:
    """Zeroed bytes cost some frames; those up to the next key frame are marked as damaged."""
    path = write_video(tmp_path / "v.mp4", noise_images(40), gop=10)
    data = bytearray(path.read_bytes())
    begin = data.find(b"mdat") + (len(data) * 2) // 5
    data[begin : begin + len(data) // 20] = bytes(len(data) // 20)
    path.write_bytes(data)
    report = DecodeReport()
    frames = list(decode_gray(path, report=report, threads=1))
    damaged = [f.index for f in frames if f.damaged]
    assert report.lost_packets > 0
    assert 20 < len(frames) < 40
    assert len(damaged) == report.damaged_frames < 12
    assert not frames[0].damaged
    assert not frames[-1].damaged
    assert report.notes[:2] == [
        f"{report.lost_packets} damaged packets were skipped",
        f"{len(damaged)} frames show traces of damage in the file",
    ]


def test_a_video_that_breaks_off_gives_what_it_has(tmp_path: Path) -> None:
    """A file cut in half gives its remaining frames and reports how many are missing."""
    options = {"movflags": "faststart"}
    path = write_video(tmp_path / "v.mp4", noise_images(40), container_options=options)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    report = DecodeReport()
    count = len(list(decode_gray(path, report=report)))
    assert 15 <= count <= 25
    assert report.expected_frames == 40
    assert f"only {count} of 40 frames can be decoded: damaged or truncated" in report.notes


def _audio_only(path: Path) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=8000)
        frame = av.AudioFrame.from_ndarray(
            np.zeros((1, 4096), np.float32), format="fltp", layout="mono"
        )
        frame.sample_rate, frame.pts = 8000, 0
        container.mux(stream.encode(frame))
        container.mux(stream.encode())


def test_what_is_no_video_is_refused_in_one_line(tmp_path: Path) -> None:
    """Each kind of unusable file (empty, text, truncated, audio only, ...) gets its own one-line message."""
    real = write_video(tmp_path / "real.mp4", noise_images(3))
    content = real.read_bytes()
    (tmp_path / "empty.mp4").touch()
    (tmp_path / "text.mp4").write_text("This is not a video.\n" * 30)
    playlist = f"#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\n{real}\n#EXT-X-ENDLIST\n"
    (tmp_path / "playlist.mp4").write_text(playlist)
    (tmp_path / "script.mp4").write_text(f"ffconcat version 1.0\nfile '{real}'\n")
    (tmp_path / "truncated.mp4").write_bytes(content[: content.find(b"moov") - 100])
    _audio_only(tmp_path / "sound.mp4")
    (tmp_path / "folder.mp4").mkdir()
    expected = {
        "empty.mp4": "is empty (0 bytes)",
        "text.mp4": "is not a video",
        "playlist.mp4": "is not a video",
        "script.mp4": "is not a video",
        "truncated.mp4": "is truncated: the index (moov) that a camera writes at the end",
        "sound.mp4": "contains no video stream",
        "folder.mp4": "is a folder, not a video",
        "missing.mp4": "can't be read: No such file or directory",
    }
    for name, message in expected.items():
        for use in (probe, lambda path: list(decode(path))):
            with pytest.raises(InputError) as caught:
                use(tmp_path / name)
            assert str(caught.value).startswith(f"{tmp_path / name}: {message}")
            assert "\n" not in str(caught.value)
