"""Video files through PyAV: what they hold, and their frames with the container's own timestamps."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from spn_data.errors import InputError

# Only containers of one file: a playlist or script could name other files, or hosts, to be read.
_DEMUXERS = "mov,matroska,webm,mpegts,mpeg,avi,asf,flv,h264,hevc,mpegvideo,ogg,mxf"
MAX_PIXELS = 200_000_000
_MAX_PACKETS_TO_FIRST_FRAME = 1000
# Plane 0 of these is 8-bit luma, so that the grey image costs no conversion.
_LUMA_FIRST = ("yuv4", "yuvj4", "yuva4", "nv12", "nv16", "nv21", "gray8", "gray")


@dataclass(frozen=True)
class VideoInfo:
    """What a video file says of itself, with its first frame decoded.

    width, height : of the upright image with square pixels. rotation_deg : how far the stored image is turned
    counter-clockwise to stand upright (0, 90, 180, 270). frame_count : the container's, or an estimate.
    fps : nominal; the frames' own times hold (`decode`). created_utc : the container's creation time.
    data_streams : names of data tracks such as "GoPro MET" (GPMF) or "DJI meta". notes : one sentence each.
    """

    path: Path
    width: int
    height: int
    rotation_deg: int
    codec: str
    pixel_format: str
    duration_s: float
    frame_count: int
    fps: float
    time_base: Fraction
    created_utc: datetime | None
    pixel_aspect: Fraction
    has_subtitles: bool
    data_streams: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def has_gpmf(self) -> bool:
        """A GoPro metadata track lies inside."""
        return any("GoPro MET" in name for name in self.data_streams)


@dataclass(frozen=True, eq=False)
class VideoFrame:
    """One decoded frame.

    index : position among the frames that were decoded. time_s : the container's timestamp, 0 at the
    first frame. width, height : of the upright full-size image with square pixels. damaged : packets were
    lost since the last key frame.
    image : (H, W, 3) uint8 BGR upright from `decode`, (h, w) uint8 luma, maybe smaller, from `decode_gray`;
    None for a frame that was not wanted.
    """

    index: int
    time_s: float
    width: int
    height: int
    damaged: bool
    image: np.ndarray | None


@dataclass
class DecodeReport:
    """Filled while a file is decoded; complete once its iterator has ended."""

    frames: int = 0
    lost_packets: int = 0
    damaged_frames: int = 0  # shown from references that were lost
    out_of_order: int = 0  # dropped: their timestamp was not after the frame before
    expected_frames: int = 0  # as the container counts them; 0 where it does not
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Orientation:
    """How a stored image becomes upright: transposed first, then flipped."""

    transpose: bool = False
    flip_x: bool = False
    flip_y: bool = False

    def apply(self, image: np.ndarray) -> np.ndarray:
        if self.transpose:
            image = cv2.transpose(image)
        if self.flip_x or self.flip_y:
            image = cv2.flip(image, -1 if self.flip_x and self.flip_y else int(self.flip_x))
        return image


def probe(path: Path) -> VideoInfo:
    """What the file holds; InputError where it is not a video, is empty, truncated, or has no frame."""
    with _open(path) as container:
        stream = _video_stream(container, path)
        first = _first_frame(container, stream, path)
        orientation = _orientation(first)
        aspect = _pixel_aspect(stream)
        width, height = _upright_size(first, orientation, aspect)
        if width * height > MAX_PIXELS:
            raise InputError(
                f"{width}x{height} pixels a frame are more than can be handled", path=path
            )
        rate = stream.average_rate or stream.guessed_rate
        fps = float(rate) if rate else float("nan")
        if stream.duration:
            duration_s = float(stream.duration * stream.time_base)
        else:
            duration_s = container.duration / 1e6 if container.duration else float("nan")
        estimate = duration_s * fps
        others = [s for s in container.streams if s.type not in ("video", "audio", "subtitle")]
        return VideoInfo(
            path=path,
            width=width,
            height=height,
            rotation_deg=int(first.rotation) % 360,
            codec=str(stream.codec_context.name),
            pixel_format=str(first.format.name),
            duration_s=duration_s,
            frame_count=int(stream.frames or (round(estimate) if np.isfinite(estimate) else 0)),
            fps=fps,
            time_base=Fraction(stream.time_base),
            created_utc=_creation_time(stream.metadata) or _creation_time(container.metadata),
            pixel_aspect=aspect,
            has_subtitles=bool(container.streams.subtitles),
            data_streams=tuple(_stream_name(s) for s in others),
            notes=_notes(first, aspect),
        )


def decode(
    path: Path,
    *,
    wanted: Collection[int] | Callable[[VideoFrame], bool] | None = None,
    threads: int = 0,
    report: DecodeReport | None = None,
) -> Iterator[VideoFrame]:
    """The frames in the order of time, upright, 8-bit BGR.

    wanted : indices whose image is converted (default all), after the last of which decoding ends; or what
    tells of a frame without its image whether it is wanted. The others pass with image None. threads : of
    the decoder, 0 for one a core. Damaged packets are passed over and counted in `report`. InputError where
    nothing can be decoded or where frames carry no timestamps.
    """
    last = max(wanted, default=-1) if isinstance(wanted, Collection) else None
    for item, orientation, frame in _frames(path, threads, report or DecodeReport()):
        if last is not None and item.index > last:
            return
        is_wanted = wanted is None or (
            item.index in wanted if isinstance(wanted, Collection) else wanted(item)
        )
        if not is_wanted:
            yield item
            continue
        # Untagged video of 720 lines and more is BT.709 by custom; swscale would take BT.601.
        tagged = int(frame.colorspace) != 2
        source = None if tagged or frame.height < 720 else "ITU709"
        image = frame.to_ndarray(format="bgr24", src_colorspace=source)
        image = orientation.apply(image)
        if image.shape[:2] != (item.height, item.width):
            image = cv2.resize(image, (item.width, item.height), interpolation=cv2.INTER_CUBIC)
        yield _with_image(item, np.ascontiguousarray(image))


def decode_gray(
    path: Path, *, max_width: int = 640, threads: int = 0, report: DecodeReport | None = None
) -> Iterator[VideoFrame]:
    """All frames as upright luma of at most `max_width` columns (never enlarged), cheaply, for measuring."""
    for item, orientation, frame in _frames(path, threads, report or DecodeReport()):
        scale = min(1.0, max_width / item.width)
        size = (max(1, round(item.width * scale)), max(1, round(item.height * scale)))
        stored = size[::-1] if orientation.transpose else size
        if frame.format.name.startswith(_LUMA_FIRST) and frame.format.components[0].bits == 8:
            plane = frame.planes[0]
            luma = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
            luma = luma[: frame.height, : frame.width]
            gray = cv2.resize(luma, stored, interpolation=cv2.INTER_AREA)
        else:
            gray = frame.reformat(
                width=stored[0], height=stored[1], format="gray", interpolation="AREA"
            ).to_ndarray()
        yield _with_image(item, np.ascontiguousarray(orientation.apply(gray)))


def _frames(
    path: Path, threads: int, report: DecodeReport
) -> Iterator[tuple[VideoFrame, _Orientation, Any]]:
    """The frames with their times, undecoded to arrays yet; fills the report."""
    with _open(path) as container:
        stream = _video_stream(container, path)
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = threads
        report.expected_frames = int(stream.frames)
        aspect = _pixel_aspect(stream)
        start: float | None = None
        previous = -1.0
        damaged = False
        for frame, lost in _decoded(container, stream):
            report.lost_packets += lost
            damaged = damaged or lost > 0
            if frame is None:
                continue
            damaged = (damaged and not frame.key_frame) or bool(frame.is_corrupt)
            stamp = frame.pts if frame.pts is not None else frame.dts
            if stamp is None:
                raise InputError(
                    f"frame {report.frames} has no timestamp; rewrite it in a container that keeps them",
                    path=path,
                )
            clock_s = float(stamp * (frame.time_base or stream.time_base))
            start = clock_s if start is None else start
            time_s = round(clock_s - start, 6)
            if time_s <= previous:
                report.out_of_order += 1
                continue
            previous = time_s
            orientation = _orientation(frame)
            width, height = _upright_size(frame, orientation, aspect)
            report.damaged_frames += damaged
            item = VideoFrame(report.frames, time_s, width, height, damaged, None)
            report.frames += 1
            yield item, orientation, frame
    if report.frames == 0:
        raise InputError("no frame of it can be decoded: it is damaged or truncated", path=path)
    _conclude(report)


def _decoded(container: Any, stream: Any) -> Iterator[tuple[Any, int]]:
    """(frame, 0) for each decoded frame and (None, 1) for each packet that can't be decoded."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except av.error.FFmpegError:  # the container breaks off here
            yield None, 1
            return
        try:
            frames = packet.decode()
        except av.error.EOFError:
            return
        except av.error.FFmpegError:
            yield None, 1
            continue
        for frame in frames:
            yield frame, 0


def _conclude(report: DecodeReport) -> None:
    if report.lost_packets:
        report.notes.append(f"{report.lost_packets} damaged packets were passed over")
    if report.damaged_frames:
        report.notes.append(f"{report.damaged_frames} frames show traces of damage in the file")
    if report.out_of_order:
        report.notes.append(f"{report.out_of_order} frames dropped whose timestamps did not rise")
    missing = report.expected_frames - report.frames - report.out_of_order
    # A frame or two at the ends are often cut by an edit list.
    if missing > max(2, 0.01 * report.expected_frames):
        report.notes.append(
            f"only {report.frames} of {report.expected_frames} frames can be decoded: damaged or truncated"
        )


def _open(path: Path) -> Any:
    """The container, opened for reading one local file and nothing else."""
    if path.is_dir():
        raise InputError("is a folder, not a video", path=path)
    try:
        size = path.stat().st_size
    except OSError as error:
        raise InputError(f"can't be read: {error.strerror}", path=path) from error
    if size == 0:
        raise InputError("is empty (0 bytes)", path=path)
    try:
        return av.open(
            f"file:{path.resolve()}",
            options={"format_whitelist": _DEMUXERS, "protocol_whitelist": "file"},
            metadata_errors="replace",
        )
    except av.error.FFmpegError as error:
        raise InputError(_why_unreadable(path), path=path) from error
    except OSError as error:
        raise InputError(f"can't be read: {error.strerror}", path=path) from error


def _why_unreadable(path: Path) -> str:
    with path.open("rb") as file:
        head = file.read(12)
    if head[4:8] in (b"ftyp", b"mdat", b"wide", b"free", b"moov"):
        return (
            "is truncated: the index (moov) that a camera writes at the end of a recording is missing; "
            "copy it again, or let the drone repair it"
        )
    return "is not a video"


def _video_stream(container: Any, path: Path) -> Any:
    stream = container.streams.best("video")
    if stream is None:
        raise InputError("holds no video stream", path=path)
    return stream


def _first_frame(container: Any, stream: Any, path: Path) -> Any:
    for tries, (frame, _) in enumerate(_decoded(container, stream)):
        if frame is not None:
            return frame
        if tries >= _MAX_PACKETS_TO_FIRST_FRAME:
            break
    raise InputError("no frame of it can be decoded: it is damaged or truncated", path=path)


def _orientation(frame: Any) -> _Orientation:
    """From the display matrix (a, b, u, c, d, v, x, y, w): x' = a x + c y, y' = b x + d y (ISO 14496-12)."""
    for data in frame.side_data:
        if data.type.name == "DISPLAYMATRIX":
            a, b, _, c, d = np.frombuffer(data, np.int32)[:5].tolist()
            if abs(b) + abs(c) > abs(a) + abs(d):
                return _Orientation(True, flip_x=c < 0, flip_y=b < 0)
            return _Orientation(False, flip_x=a < 0, flip_y=d < 0)
    return _Orientation()


def _pixel_aspect(stream: Any) -> Fraction:
    """Width of a stored pixel over its height; 1 where the file does not say."""
    ratio = stream.sample_aspect_ratio
    return Fraction(ratio) if ratio and Fraction(1, 4) <= ratio <= 4 else Fraction(1)


def _upright_size(frame: Any, orientation: _Orientation, aspect: Fraction) -> tuple[int, int]:
    """(width, height) upright and with square pixels."""
    width, height = round(frame.width * aspect), int(frame.height)
    return (height, width) if orientation.transpose else (width, height)


def _creation_time(metadata: dict[str, str]) -> datetime | None:
    try:
        created = datetime.fromisoformat(metadata["creation_time"])
    except (KeyError, ValueError):
        return None
    created = created.replace(tzinfo=UTC) if created.tzinfo is None else created.astimezone(UTC)
    return created if created.year >= 2000 else None  # cameras without a clock write 1904 or 1970


def _stream_name(stream: Any) -> str:
    return str(stream.metadata.get("handler_name", "")).strip() or str(stream.type)


def _notes(frame: Any, aspect: Fraction) -> tuple[str, ...]:
    notes = []
    if aspect != 1:
        notes.append(
            f"pixels of {aspect.numerator}:{aspect.denominator} are stretched to square ones"
        )
    if int(frame.color_trc) in (16, 18):
        notes.append("high dynamic range (HDR) is converted to 8 bits without tone mapping")
    if frame.interlaced_frame:
        notes.append(
            "interlaced: moving edges are combed, which spoils features; deinterlace it first"
        )
    if int(frame.rotation) % 90:
        notes.append(f"rotation of {frame.rotation} degrees is taken to the nearest right angle")
    return tuple(notes)


def _with_image(item: VideoFrame, image: np.ndarray) -> VideoFrame:
    return VideoFrame(item.index, item.time_s, item.width, item.height, item.damaged, image)
