"""Photo files of all formats, opened the same safe way for headers and for pixels."""

from __future__ import annotations

import importlib
import struct
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from spn_data.errors import InputError
from spn_data.media.extras import import_extra

JPEG_SUFFIXES = (".jpg", ".jpeg")
TWIN_SUFFIXES = (".heic", ".heif", ".dng")  # cameras write a JPEG of the same name too
# In order of preference among several files of one image.
PHOTO_SUFFIXES = (".png", *JPEG_SUFFIXES, ".bmp", ".webp", ".tif", ".tiff", *TWIN_SUFFIXES)
RAW_SUFFIXES = (".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw")
RAW_REMEDY = "RAW photo that is not read: convert it to DNG (Adobe DNG Converter) or JPEG"
MAX_PHOTO_PIXELS = 300_000_000
MAX_PHOTO_BYTES = 1_000_000_000
# What Pillow and its plugins raise if a file is damaged.
DAMAGE = (OSError, SyntaxError, ValueError, RuntimeError, EOFError, struct.error)

_FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "WEBP")  # JPEG includes MPO
_EXTRAS = {
    ".heic": ("pillow_heif", "heic"),
    ".heif": ("pillow_heif", "heic"),
    ".dng": ("rawpy", "raw"),
}
_SWAPS_SIDES = 4  # bit of LibRaw's `flip`


def is_raw(path: Path) -> bool:
    """Return whether a photo is to be developed (DNG)."""
    return path.suffix.lower() == ".dng"


def check_readers(photos: Iterable[Path]) -> None:
    """Raise InputError if the package that reads one of the photos is not installed."""
    first: dict[str, Path] = {}
    for path in photos:
        first.setdefault(path.suffix.lower(), path)
    for suffix, path in first.items():
        if suffix in _EXTRAS:
            _reader(path, suffix)


@contextmanager
def open_photo(path: Path) -> Iterator[Image.Image]:
    """Open a photo that is not RAW; its pixels are not decoded yet.

    HEIF images are upright: libheif applies their rotation, and pillow-heif sets their EXIF orientation to 1.

    Raises
    ------
    InputError
        If the file is too large, its header claims too many pixels, or the package for HEIC is missing.
    OSError, SyntaxError, ValueError, RuntimeError, EOFError, struct.error
        If it is damaged (`DAMAGE`).
    """
    check_bytes(path)
    with path.open("rb") as file:
        is_heif = file.read(8)[4:] == b"ftyp"
    if is_heif:
        heif = _reader(path, ".heic")
        heif.register_heif_opener(thumbnails=False, depth_images=False, aux_images=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        before = Image.MAX_IMAGE_PIXELS
        # Pillow refuses twice this number, and real mapping cameras have more than its own limit.
        Image.MAX_IMAGE_PIXELS = MAX_PHOTO_PIXELS // 2
        try:
            image = Image.open(path, formats=("HEIF",) if is_heif else _FORMATS)
        except Image.DecompressionBombError as error:
            raise _too_many_pixels(path) from error
        finally:
            Image.MAX_IMAGE_PIXELS = before
    with image:
        check_pixels(image.width, image.height, path)
        yield image


def check_bytes(path: Path) -> None:
    """Raise InputError for a file that is larger than any photo, OSError if there is none."""
    if path.stat().st_size > MAX_PHOTO_BYTES:
        raise InputError(
            f"is larger than {MAX_PHOTO_BYTES / 1e9:.0f} GB, the limit for a photo", path=path
        )


def check_pixels(width: int, height: int, path: Path) -> None:
    """Raise InputError if a header claims more pixels than any camera has."""
    if width * height > MAX_PHOTO_PIXELS:
        raise _too_many_pixels(path)


def raw_size(path: Path) -> tuple[int, int]:
    """Return the upright width and height of a DNG; raise InputError if it is none."""
    with _open_raw(path) as raw:
        sizes = raw.sizes
        swapped = bool(sizes.flip & _SWAPS_SIDES)
        return (sizes.iheight, sizes.iwidth) if swapped else (sizes.iwidth, sizes.iheight)


def develop(path: Path, *, upright: bool = True, enough_px: int | None = None) -> np.ndarray:
    """Develop a DNG, with the same parameters for all photos.

    Parameters
    ----------
    path : Path
        The DNG.
    upright : bool
        Whether to apply its orientation.
    enough_px : int or None
        If half the shorter side is at least this long, one pixel is made of each 2 x 2 of the sensor, which
        is several times faster.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        RGB in sRGB with the white balance that the camera recorded and LibRaw's standard gamma. Brightness is
        not adjusted to the content, and the lens is not corrected.
    """
    with _open_raw(path) as raw:
        rawpy = importlib.import_module("rawpy")
        shorter = min(raw.sizes.iheight, raw.sizes.iwidth)
        try:
            raw.unpack()
            return np.asarray(
                raw.postprocess(
                    no_auto_bright=True,
                    adjust_maximum_thr=0.0,  # LibRaw else takes the brightest pixel for white
                    use_camera_wb=True,
                    output_color=rawpy.ColorSpace.sRGB,
                    output_bps=8,
                    half_size=enough_px is not None and shorter >= 2 * enough_px,
                    user_flip=None if upright else 0,
                )
            )
        except (rawpy.LibRawError, *DAMAGE) as error:
            raise InputError(f"cannot be developed: {_reason(error)}", path=path) from error


@contextmanager
def _open_raw(path: Path) -> Iterator[Any]:
    """Open a DNG and check its size before any pixel is read."""
    rawpy = _reader(path, ".dng")
    try:
        check_bytes(path)
        raw = rawpy.RawPy()
        raw.open_file(str(path.resolve()))
    except (rawpy.LibRawError, *DAMAGE) as error:
        raise InputError(f"cannot be read as a DNG photo: {_reason(error)}", path=path) from error
    try:
        check_pixels(raw.sizes.raw_width, raw.sizes.raw_height, path)
        yield raw
    finally:
        raw.close()


def _reader(path: Path, suffix: str) -> Any:
    """Import the package that reads photos of a suffix."""
    package, extra = _EXTRAS[suffix]
    return import_extra(package, extra, f"{suffix[1:].upper()} photos", path)


def _too_many_pixels(path: Path) -> InputError:
    return InputError(
        f"its header claims more than {MAX_PHOTO_PIXELS // 1_000_000} megapixels, the limit for a photo",
        path=path,
    )


def _reason(error: Exception) -> str:
    text = error.args[0] if error.args else ""
    if isinstance(text, bytes):
        text = text.decode("ascii", errors="replace")
    return str(getattr(error, "strerror", None) or text or "it is damaged")
