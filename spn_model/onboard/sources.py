"""Images and video frames as OpenCV reads them."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from spn_data.errors import InputError

_IMAGES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
_DEEP = (".png", ".tif", ".tiff")
_MIN_RANGE_16 = 64 * 256  # a quarter of the grey levels, as in `spn_data.capture.photos`
_MAX_IMAGE_BYTES = 500_000_000
_MISSING_FRAMES, _MISSING_SHARE = 2, 0.05
_START, _END = 0xD8, 0xD9  # markers of a JPEG
_MARKER = re.compile(rb"\xff+[^\x00\xff\xd0-\xd7]")  # neither a stuffed byte nor a restart
# Only self-contained formats: a playlist or script could refer to other files or hosts.
_DEMUXERS = "mov,matroska,webm,mpegts,mpeg,avi,asf,flv,h264,hevc,mpegvideo,ogg,mxf"
_LOCAL_ONLY = f"protocol_whitelist;file|format_whitelist;{_DEMUXERS}"
_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"  # OpenCV has no argument for them


def frames(source: Path) -> Iterator[tuple[int, float, np.ndarray]]:
    """Yield number, time in seconds and upright BGR image of each frame of an image file or video.

    The time counts from the start of the video and is NaN for an image. Raises InputError if the file is
    neither an image nor a video, or after the last frame if many frames are missing.
    """
    if source.suffix.lower() in _IMAGES:
        yield 0, math.nan, read_image(source)
        return
    _check_file(source)
    video = _open_video(source)
    try:
        number = 0
        while True:
            read, image = video.read()
            if not read:
                break
            yield number, video.get(cv2.CAP_PROP_POS_MSEC) / 1000, image
            number += 1
        if not number:
            raise InputError(
                "cannot be decoded as a video; playlists, URLs and streams are not read",
                path=source,
            )
        expected = round(video.get(cv2.CAP_PROP_FRAME_COUNT))  # estimated in some containers
        if expected - number > max(_MISSING_FRAMES, _MISSING_SHARE * expected):
            raise InputError(
                f"only {number} of about {expected} frames can be decoded: the rest of the video is damaged",
                path=source,
            )
    finally:
        video.release()


def _open_video(source: Path) -> cv2.VideoCapture:
    """Open one local file that refers to no other file or host."""
    before = os.environ.get(_OPTIONS)
    # FFmpeg uses the last of several values of an option.
    os.environ[_OPTIONS] = _LOCAL_ONLY if before is None else f"{before}|{_LOCAL_ONLY}"
    try:
        # Resolved, because OpenCV interprets some names as a device, a pattern or a URL.
        return cv2.VideoCapture(str(source.resolve()), cv2.CAP_FFMPEG)
    finally:
        if before is None:
            del os.environ[_OPTIONS]
        else:
            os.environ[_OPTIONS] = before


def check_sources(sources: Sequence[Path]) -> None:
    """Raise InputError if one of the files does not exist, before anything is computed."""
    for source in sources:
        _check_file(source)


def read_image(path: Path) -> np.ndarray:
    """Return an image (H, W, 3) BGR uint8, rotated according to its metadata.

    Raises InputError if the file is not an image, or not all of it is there: OpenCV fills the missing part of
    a JPEG with grey and returns it as if nothing was wrong.
    """
    _check_file(path)
    if path.stat().st_size > _MAX_IMAGE_BYTES:
        raise InputError(
            f"is larger than {_MAX_IMAGE_BYTES // 1_000_000} MB, too large for an image", path=path
        )
    try:
        content = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(f"cannot be read as an image ({error.strerror})", path=path) from error
    if _is_truncated_jpeg(content.tobytes()):
        raise InputError("cannot be read as an image: it is truncated", path=path)
    try:
        image = cv2.imdecode(content, cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise InputError(f"cannot be read as an image ({error.err})", path=path) from error
    if image is None:
        raise InputError("cannot be read as an image", path=path)
    if path.suffix.lower() in _DEEP:
        _check_depth(content, path)
    return image


def _check_depth(content: np.ndarray, path: Path) -> None:
    """Refuse 16-bit images of which few grey levels are left: the network has seen none like them."""
    values = cv2.imdecode(content, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR)
    if values is None or values.dtype != np.uint16:
        return
    low, high = np.percentile(values[::4, ::4], (0.1, 99.9))
    if 0 < high - low < _MIN_RANGE_16:
        raise InputError(
            f"uses only values {low:.0f} to {high:.0f} of 16 bits: convert all images of the camera to 8 "
            "bits with the same range",
            path=path,
        )


def _is_truncated_jpeg(content: bytes) -> bool:
    """Return whether a file begins as a JPEG, and ends before the end marker of its first image."""
    if content[:3] != b"\xff\xd8\xff":
        return False
    at = 2
    while (found := _MARKER.search(content, at)) is not None:
        marker, at = content[found.end() - 1], found.end()
        if marker == _END:
            return False
        if marker == _START:
            continue
        if at + 2 > len(content):
            return True
        at += int.from_bytes(content[at : at + 2], "big")  # a segment; the data of a scan follow it
    return True


def _check_file(path: Path) -> None:
    if not path.is_file():
        raise InputError("does not exist" if not path.exists() else "is not a file", path=path)
