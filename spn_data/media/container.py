"""Opening and demuxing of video containers with PyAV: one local file, self-contained, and never a URL."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import av

from spn_data.errors import InputError

_DISCARD_ALL = 48  # AVDISCARD_ALL
# Only self-contained formats: a playlist or script could refer to other files or hosts.
_DEMUXERS = "mov,matroska,webm,mpegts,mpeg,avi,asf,flv,h264,hevc,mpegvideo,ogg,mxf"


def open_container(path: Path) -> Any:
    """Open one local file for reading; refuse anything that refers to other files."""
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


@contextmanager
def open_tracks(path: Path, what: str) -> Iterator[Any]:
    """Open a container for its subtitles or data tracks; damage is an InputError that names `what`."""
    try:
        with open_container(path) as container:
            yield container
    except (av.error.FFmpegError, OSError) as error:
        raise InputError(f"its {what} cannot be read: {error.strerror}", path=path) from error


def packets(container: Any, streams: Sequence[Any]) -> Iterator[Any]:
    """Yield the packets of streams in the order of the file, and at its end an empty one for each.

    Other streams are skipped, where the format allows without reading them. Tracks that appear while the file
    is read are left out: PyAV does not know them, and fails at the end of the file, after the packets of all
    others.
    """
    for stream in container.streams:
        if stream not in streams and hasattr(stream, "discard"):  # since PyAV 18
            stream.discard = _DISCARD_ALL
    demuxed = container.demux(streams)
    while True:
        try:
            packet = next(demuxed)
        except (StopIteration, IndexError):
            return
        yield packet


def packet_time_s(packet: Any) -> float:
    """Return the presentation time of a packet in seconds; NaN if it is not stated."""
    if packet.pts is None or packet.time_base is None:
        return math.nan
    return float(packet.pts * packet.time_base)


def first_picture_s(container: Any) -> float:
    """Return the time of the first picture in seconds, 0 if it is not stated."""
    video = container.streams.video[0] if container.streams.video else None
    if video is None or video.start_time is None or video.time_base is None:
        return 0.0
    return float(video.start_time * video.time_base)


def _why_unreadable(path: Path) -> str:
    with path.open("rb") as file:
        head = file.read(12)
    if head[4:8] in (b"ftyp", b"mdat", b"wide", b"free", b"moov"):
        return (
            "is truncated: the index (moov) that a camera writes at the end of a recording is missing; "
            "copy it again or let the drone repair it"
        )
    return "is not a video"
