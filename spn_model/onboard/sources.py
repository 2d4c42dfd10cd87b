"""Images and frames of videos as OpenCV reads them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from spn_data.errors import InputError

_IMAGES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
_MAX_IMAGE_BYTES = 500_000_000


def frames(source: Path) -> Iterator[tuple[int, float, np.ndarray]]:
    """Number, seconds since the video's start (NaN for an image), and BGR, upright, of each frame.

    Raises InputError where the file is neither image nor video.
    """
    if source.suffix.lower() in _IMAGES:
        yield 0, math.nan, read_image(source)
        return
    _check_file(source)
    # Resolved: OpenCV takes some names for a device, a pattern or an address.
    video = cv2.VideoCapture(str(source.resolve()), cv2.CAP_FFMPEG)
    try:
        number = 0
        while True:
            read, image = video.read()
            if not read:
                break
            yield number, video.get(cv2.CAP_PROP_POS_MSEC) / 1000, image
            number += 1
        if not number:
            raise InputError("is no video that can be decoded", path=source)
    finally:
        video.release()


def read_image(path: Path) -> np.ndarray:
    """(H, W, 3) BGR uint8, turned as its metadata say. Raises InputError where it is none."""
    _check_file(path)
    if path.stat().st_size > _MAX_IMAGE_BYTES:
        raise InputError("is too large for an image", path=path)
    try:
        image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise InputError(f"cannot be read as an image ({error.err})", path=path) from error
    if image is None:
        raise InputError("cannot be read as an image", path=path)
    return image


def _check_file(path: Path) -> None:
    if not path.is_file():
        raise InputError("does not exist" if not path.exists() else "is no file", path=path)
