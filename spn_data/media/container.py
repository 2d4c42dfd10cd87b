"""Opening of video containers with PyAV: one local file, self-contained, and never a URL."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import av

from spn_data.errors import InputError

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


def _why_unreadable(path: Path) -> str:
    with path.open("rb") as file:
        head = file.read(12)
    if head[4:8] in (b"ftyp", b"mdat", b"wide", b"free", b"moov"):
        return (
            "is truncated: the index (moov) that a camera writes at the end of a recording is missing; "
            "copy it again or let the drone repair it"
        )
    return "is not a video"
