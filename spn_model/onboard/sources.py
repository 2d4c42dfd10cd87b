"""Images and video frames as OpenCV reads them."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np

from spn_data.errors import InputError
from spn_model.onboard.movie_boxes import is_iso_media, is_mirrored

_IMAGES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
_WITH_PACKAGE = (".heic", ".heif", ".dng")
_MIN_RANGE_16 = 64 * 256  # a quarter of the grey levels, as in `spn_data.capture.photos`
_MAX_IMAGE_BYTES = 500_000_000
_MISSING_FRAMES, _MISSING_SHARE = 2, 0.01
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
    if source.suffix.lower() in (*_IMAGES, *_WITH_PACKAGE):
        yield 0, math.nan, read_image(source)
        return
    _check_file(source)
    if is_mirrored(source):
        raise InputError(
            "is a video whose display matrix mirrors it, which OpenCV does not: "
            "encode it again (ffmpeg -i FILE UPRIGHT.mp4)",
            path=source,
        )
    video = _open_video(source)
    try:
        yield from _video_frames(video, source)
    finally:
        video.release()


def _video_frames(video: cv2.VideoCapture, source: Path) -> Iterator[tuple[int, float, np.ndarray]]:
    """Yield the frames whose time increases, with square pixels, as `spn_data.capture.video` does."""
    number = dropped = 0
    start_s, previous_s = 0.0, -1.0
    while True:
        read, image = video.read()
        if not read:
            break
        clock_s = video.get(cv2.CAP_PROP_POS_MSEC) / 1000
        if not number:
            start_s = clock_s
        time_s = round(clock_s - start_s, 6)
        if time_s <= previous_s:
            dropped += 1
            continue
        previous_s = time_s
        yield number, time_s, _with_square_pixels(image, video)
        number += 1
    if not number:
        raise InputError(
            "cannot be decoded as a video; playlists, URLs and streams are not read", path=source
        )
    if number == 1 and dropped:
        raise InputError(
            "its frames have no timestamps; remux it into a container that keeps them", path=source
        )
    # Other containers state no number of frames, and OpenCV's estimate is wrong for variable rates.
    expected = round(video.get(cv2.CAP_PROP_FRAME_COUNT)) if is_iso_media(source) else 0
    if expected - number - dropped > max(_MISSING_FRAMES, _MISSING_SHARE * expected):
        raise InputError(
            f"only {number} of {expected} frames can be decoded: damaged or truncated", path=source
        )


def _with_square_pixels(image: np.ndarray, video: cv2.VideoCapture) -> np.ndarray:
    """Stretch an upright frame along the axis that is horizontal in the file."""
    above, below = (round(video.get(p)) for p in (cv2.CAP_PROP_SAR_NUM, cv2.CAP_PROP_SAR_DEN))
    aspect = Fraction(above, below) if above > 0 and below > 0 else Fraction(1)
    if aspect == 1 or not Fraction(1, 4) <= aspect <= 4:
        return image
    height, width = image.shape[:2]
    if round(video.get(cv2.CAP_PROP_ORIENTATION_META)) % 180:
        height = round(height * aspect)
    else:
        width = round(width * aspect)
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC)


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
    if path.suffix.lower() in _WITH_PACKAGE:
        return _read_with_package(path)
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
        image = cv2.imdecode(content, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    except cv2.error as error:
        raise InputError(f"cannot be read as an image ({error.err})", path=path) from error
    if image is None:
        raise InputError("cannot be read as an image", path=path)
    return image if image.dtype == np.uint8 else _to_8_bits(image, path)


def _read_with_package(path: Path) -> np.ndarray:
    """Read a HEIC or DNG with the packages of the extras `heic` and `raw`, as `spn-model predict` does."""
    try:
        from spn_data.capture.photos import decode_photo
    except ImportError as error:
        raise InputError(
            f"reading {path.suffix[1:].upper()} photos needs another package: "
            "pip install 'squeezeposenet-toolkit[heic,raw]', or convert them to JPEG",
            path=path,
        ) from error
    return decode_photo(path)


def _to_8_bits(values: np.ndarray, path: Path) -> np.ndarray:
    """Refuse images of which few grey levels are left: the network has seen none like them."""
    if values.dtype != np.uint16:
        raise InputError(
            f"its pixels are {values.dtype} (thermal?), whose range is not known", path=path
        )
    low, high = np.percentile(values[::4, ::4], (0.1, 99.9))
    if 0 < high - low < _MIN_RANGE_16:
        raise InputError(
            f"uses only values {low:.0f} to {high:.0f} of 16 bits: convert all images of the camera to 8 "
            "bits with the same range",
            path=path,
        )
    return (values >> 8).astype(np.uint8)


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
