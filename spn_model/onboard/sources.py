"""Images and video frames as OpenCV reads them."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from spn_data.errors import InputError

_IMAGES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
_MAX_IMAGE_BYTES = 500_000_000
# Only self-contained formats: a playlist or script could refer to other files or hosts.
_DEMUXERS = "mov,matroska,webm,mpegts,mpeg,avi,asf,flv,h264,hevc,mpegvideo,ogg,mxf"
_LOCAL_ONLY = f"protocol_whitelist;file|format_whitelist;{_DEMUXERS}"
_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"  # OpenCV has no argument for them


def frames(source: Path) -> Iterator[tuple[int, float, np.ndarray]]:
    """Yield number, time in seconds and upright BGR image of each frame of an image file or video.

    The time counts from the start of the video and is NaN for an image. Raises InputError if the file is
    neither an image nor a video.
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


def read_image(path: Path) -> np.ndarray:
    """Return an image (H, W, 3) BGR uint8, rotated according to its metadata.

    Raises InputError if the file is not an image.
    """
    _check_file(path)
    if path.stat().st_size > _MAX_IMAGE_BYTES:
        raise InputError(
            f"is larger than {_MAX_IMAGE_BYTES // 1_000_000} MB, too large for an image", path=path
        )
    try:
        image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise InputError(f"cannot be read as an image ({error.err})", path=path) from error
    if image is None:
        raise InputError("cannot be read as an image", path=path)
    return image


def _check_file(path: Path) -> None:
    if not path.is_file():
        raise InputError("does not exist" if not path.exists() else "is not a file", path=path)
