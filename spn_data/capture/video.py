"""Video files: properties and decoded frames with the container's own timestamps."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from spn_data.capture.video_container import (
    Orientation,
    decoded_frames,
    frame_orientation,
    pixel_aspect_ratio,
    upright_size,
    video_stream,
)
from spn_data.errors import InputError
from spn_data.media.container import open_container

MAX_PIXELS = 200_000_000
_MAX_PACKETS_TO_FIRST_FRAME = 1000
# Plane 0 of these formats is 8-bit luma, so that the grey image needs no conversion.
_LUMA_FIRST = ("yuv4", "yuvj4", "yuva4", "nv12", "nv16", "nv21", "gray8", "gray")


@dataclass(frozen=True)
class VideoInfo:
    """Properties of a video file whose first frame can be decoded.

    Attributes
    ----------
    path : Path
        The file.
    width, height : int
        Size of the upright image with square pixels.
    rotation_deg : int
        Counter-clockwise rotation that makes the stored image upright (0, 90, 180, 270).
    codec, pixel_format : str
        FFmpeg's names.
    duration_s : float
        Duration; NaN if unknown.
    frame_count : int
        As stated by the container, or an estimate.
    fps : float
        Nominal frame rate; use the frames' own times (`decode`) for anything else.
    time_base : Fraction
        Unit of the stream's timestamps, in seconds.
    created_utc : datetime or None
        Creation time stored in the container.
    pixel_aspect : Fraction
        Width over height of a stored pixel.
    has_subtitles : bool
        The file has a subtitle track.
    data_streams : tuple of str
        Names of data tracks such as "GoPro MET" (GPMF) or "DJI meta".
    notes : tuple of str
        What the user should know, one sentence each.
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


@dataclass(frozen=True, eq=False)
class VideoFrame:
    """One decoded frame.

    Attributes
    ----------
    index : int
        Position among the decoded frames.
    time_s : float
        The container's timestamp, 0 at the first frame.
    width, height : int
        Size of the upright full-size image with square pixels.
    damaged : bool
        Packets were lost since the last key frame.
    image : ndarray of uint8 or None
        (H, W, 3) upright BGR from `decode`; (h, w) upright luma, possibly reduced, from `decode_gray`;
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
    """Counts and notes, filled while a file is decoded and complete once its iterator has ended."""

    frames: int = 0
    lost_packets: int = 0
    damaged_frames: int = 0  # predicted from lost reference frames
    out_of_order: int = 0  # dropped because their timestamp was not after that of the frame before
    expected_frames: int = 0  # as stated by the container; 0 if it does not say
    notes: list[str] = field(default_factory=list)

    @property
    def early_end(self) -> str:
        """What is missing, if clearly fewer frames were decoded than the container states; else ""."""
        missing = self.expected_frames - self.frames - self.out_of_order
        # Edit lists often cut a frame or two at the ends.
        if missing <= max(2, 0.01 * self.expected_frames):
            return ""
        return f"only {self.frames} of {self.expected_frames} frames can be decoded: damaged or truncated"


def probe(path: Path) -> VideoInfo:
    """Read the properties of a video and decode its first frame.

    Parameters
    ----------
    path : Path
        The video file.

    Returns
    -------
    VideoInfo
        Its properties.

    Raises
    ------
    InputError
        If the file is not a video, is empty or truncated, has no frame, or its frames are too large.
    """
    with open_container(path) as container:
        stream = video_stream(container, path)
        first = _first_frame(container, stream, path)
        orientation = frame_orientation(first)
        aspect = pixel_aspect_ratio(stream)
        width, height = upright_size(first, orientation, aspect)
        if width * height > MAX_PIXELS:
            raise InputError(
                f"frames of {width}x{height} pixels exceed the limit of {MAX_PIXELS / 1e6:.0f} megapixels",
                path=path,
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
    """Decode frames in order of time as upright 8-bit BGR images.

    Damaged packets are skipped and counted in `report`.

    Parameters
    ----------
    path : Path
        The video file.
    wanted : collection of int or callable, optional
        Indices of the frames whose image is needed (default all); decoding ends after the last of them. Or a
        function that decides from a frame without its image. Other frames are yielded with image None.
    threads : int
        Decoder threads, 0 for one per core.
    report : DecodeReport, optional
        Filled with what was lost.

    Yields
    ------
    VideoFrame
        Every frame up to the last wanted one.

    Raises
    ------
    InputError
        If nothing can be decoded, or frames have no timestamps.
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
        # Conversion and interpolation of chroma are those of OpenCV, which decodes on board.
        image = frame.to_ndarray(format="bgr24", interpolation="BICUBIC")
        image = orientation.apply(image)
        if image.shape[:2] != (item.height, item.width):
            image = cv2.resize(image, (item.width, item.height), interpolation=cv2.INTER_CUBIC)
        yield _with_image(item, np.ascontiguousarray(image))


def decode_gray(
    path: Path, *, max_width: int = 640, threads: int = 0, report: DecodeReport | None = None
) -> Iterator[VideoFrame]:
    """Decode all frames as upright luma at most `max_width` wide (never enlarged); cheap, for measuring."""
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
) -> Iterator[tuple[VideoFrame, Orientation, Any]]:
    """Yield the frames with their times, not yet converted to arrays, and fill the report."""
    with open_container(path) as container:
        stream = video_stream(container, path)
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = threads
        report.expected_frames = int(stream.frames)
        aspect = pixel_aspect_ratio(stream)
        start: float | None = None
        previous = -1.0
        damaged = False
        for frame, lost in decoded_frames(container, stream):
            report.lost_packets += lost
            damaged = damaged or lost > 0
            if frame is None:
                continue
            damaged = (damaged and not frame.key_frame) or bool(frame.is_corrupt)
            stamp = frame.pts if frame.pts is not None else frame.dts
            if stamp is None:
                raise InputError(
                    f"frame {report.frames} has no timestamp; remux it into a container that keeps them",
                    path=path,
                )
            clock_s = float(stamp * (frame.time_base or stream.time_base))
            start = clock_s if start is None else start
            time_s = round(clock_s - start, 6)
            if time_s <= previous:
                report.out_of_order += 1
                continue
            previous = time_s
            orientation = frame_orientation(frame)
            width, height = upright_size(frame, orientation, aspect)
            report.damaged_frames += damaged
            item = VideoFrame(report.frames, time_s, width, height, damaged, None)
            report.frames += 1
            yield item, orientation, frame
    if report.frames == 0:
        raise InputError("no frame can be decoded: the file is damaged or truncated", path=path)
    _add_notes(report)


def _add_notes(report: DecodeReport) -> None:
    if report.lost_packets:
        report.notes.append(f"{report.lost_packets} damaged packets were skipped")
    if report.damaged_frames:
        report.notes.append(f"{report.damaged_frames} frames show traces of damage in the file")
    if report.out_of_order:
        report.notes.append(
            f"{report.out_of_order} frames dropped because their timestamps did not increase"
        )
    if report.early_end:
        report.notes.append(report.early_end)


def _first_frame(container: Any, stream: Any, path: Path) -> Any:
    for tries, (frame, _) in enumerate(decoded_frames(container, stream)):
        if frame is not None:
            return frame
        if tries >= _MAX_PACKETS_TO_FIRST_FRAME:
            break
    raise InputError("no frame can be decoded: the file is damaged or truncated", path=path)


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
            f"non-square pixels ({aspect.numerator}:{aspect.denominator}) are resampled to square ones"
        )
    if int(frame.color_trc) in (16, 18):
        notes.append("high dynamic range (HDR) is converted to 8 bits without tone mapping")
    if frame.interlaced_frame:
        notes.append(
            "interlaced: combing on moving edges degrades features; deinterlace the video first"
        )
    if int(frame.rotation) % 90:
        notes.append(f"rotation of {frame.rotation} degrees is rounded to the nearest right angle")
    return tuple(notes)


def _with_image(item: VideoFrame, image: np.ndarray) -> VideoFrame:
    return VideoFrame(item.index, item.time_s, item.width, item.height, item.damaged, image)
