"""Photo headers, upright decoding of photos, and masks."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from spn_data.capture.photo_lens import StatedFocal, stated_focal
from spn_data.errors import InputError
from spn_data.media.photo_file import DAMAGE, develop, is_raw, open_photo
from spn_data.telemetry.exif import PhotoMetadata, read_photo

_MIN_RANGE_16 = 64 * 256  # of 16-bit values: a quarter of the grey levels
_MAX_ASPECT_ERROR = 0.01  # tolerated relative difference between aspect ratios of mask and image
_ORIENTATION = 0x0112
_TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}


@dataclass(frozen=True, eq=False)
class PhotoHeaders:
    """Headers of the N photos of one sequence, read without decoding pixels.

    Attributes
    ----------
    paths : tuple of Path, length N
        The photos.
    metadata : tuple of PhotoMetadata or None, length N
        Their EXIF and XMP; None if unreadable.
    problem : tuple of str, length N
        Why a photo is unreadable, or "".
    """

    paths: tuple[Path, ...]
    metadata: tuple[PhotoMetadata | None, ...]
    problem: tuple[str, ...]

    @property
    def sizes(self) -> np.ndarray:
        """Upright width and height in pixels, (N, 2) int; 0 if unreadable."""
        return np.array([_upright_size(m) for m in self.metadata], dtype=np.int64).reshape(-1, 2)

    @property
    def lens(self) -> tuple[object, ...]:
        """Keys (N,), equal for photos taken through one lens at one zoom and size; None if unreadable."""
        return tuple(
            None
            if m is None
            else (
                m.make,
                m.model,
                m.lens,
                _rounded(m.focal_mm),
                _rounded(m.focal_35mm),
                _upright_size(m),
            )
            for m in self.metadata
        )

    def focal(self, row: int) -> tuple[StatedFocal | None, str]:
        """Return the focal length that the metadata of a photo state, and a note if they contradict."""
        metadata = self.metadata[row]
        return (None, "") if metadata is None else stated_focal(metadata)


def read_headers(paths: Sequence[Path]) -> PhotoHeaders:
    """Read the headers of photos; the reason why one cannot be read is kept in `problem`."""
    metadata: list[PhotoMetadata | None] = []
    problem: list[str] = []
    for path in paths:
        try:
            photo = read_photo(path)
        except InputError as error:
            metadata.append(None)
            problem.append(_message_without_path(error, path))
        else:
            metadata.append(photo)
            problem.append("")
    return PhotoHeaders(tuple(paths), tuple(metadata), tuple(problem))


def decode_photo(path: Path, *, upright: bool = True) -> np.ndarray:
    """Decode a photo, upright by its EXIF orientation.

    Parameters
    ----------
    path : Path
        A JPEG, PNG, TIFF, BMP, WebP, HEIC or DNG.
    upright : bool
        False to leave the pixels as they are stored (not possible for a TIFF or HEIC).

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        BGR; 16-bit photos are scaled to 8 bits.

    Raises
    ------
    InputError
        If the photo is damaged, too large or of a pixel format without a known range, or uses so few of
        its 16 bits that hardly any grey levels would be left.
    """
    if is_raw(path):
        return np.ascontiguousarray(develop(path, upright=upright)[:, :, ::-1])
    with _open_image(path) as image:
        _check_deep_colour(image, path)
        rgb = _to_8_bits(_upright(image) if upright else image, path).convert("RGB")
        return np.ascontiguousarray(np.asarray(rgb)[:, :, ::-1])


def decode_photo_gray(path: Path, *, max_width: int) -> np.ndarray:
    """Decode an upright grey image (h, w) uint8 at most `max_width` wide; JPEGs are decoded reduced."""
    if is_raw(path):
        gray = cv2.cvtColor(develop(path, enough_px=max_width), cv2.COLOR_RGB2GRAY)
    else:
        gray = _decode_gray(path, max_width)
    scale = max_width / gray.shape[1]
    if scale < 1:
        size = (max_width, max(1, round(gray.shape[0] * scale)))
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(gray)


def _decode_gray(path: Path, max_width: int) -> np.ndarray:
    with _open_image(path) as image:
        _check_deep_colour(image, path)
        image.draft("L", (max_width, max_width * image.height // max(image.width, 1)))
        return np.asarray(_to_8_bits(_upright(image), path).convert("L"))


def decode_reduced(path: Path, *, max_width: int) -> np.ndarray:
    """Decode a stored image as it is (h, w, 3) uint8 BGR, at most `max_width` wide; JPEGs decoded reduced."""
    with _open_image(path) as image:
        image.draft("RGB", (max_width, max_width * image.height // max(image.width, 1)))
        bgr = np.ascontiguousarray(np.asarray(_to_8_bits(image, path).convert("RGB"))[:, :, ::-1])
    scale = max_width / bgr.shape[1]
    if scale >= 1:
        return bgr
    size = (max_width, max(1, round(bgr.shape[0] * scale)))
    return cv2.resize(bgr, size, interpolation=cv2.INTER_AREA)


def load_mask(path: Path, width: int, height: int) -> np.ndarray:
    """Load a mask of usable pixels.

    Parameters
    ----------
    path : Path
        An image, white (at least half) where pixels may be used. A mask of the same aspect ratio but another
        size is resized with nearest-neighbour interpolation.
    width, height : int
        Size of the images that it masks.

    Returns
    -------
    ndarray of bool, shape (height, width)
        True at pixels that may be used.

    Raises
    ------
    InputError
        If the mask cannot be read, has another aspect ratio or is all black.
    """
    with _open_image(path) as image:
        mask = np.asarray(_to_8_bits(image, path, mask=True).convert("L"))
    if mask.shape != (height, width):
        found = f"{mask.shape[1]}x{mask.shape[0]}"
        if abs(mask.shape[1] * height / (mask.shape[0] * width) - 1) > _MAX_ASPECT_ERROR:
            raise InputError(
                f"the mask is {found} but the images are {width}x{height}: the aspect ratios differ",
                path=path,
            )
        mask = cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST)
    usable = mask >= 128
    if not usable.any():
        raise InputError("the mask is entirely black; usable pixels must be white", path=path)
    return usable


@contextmanager
def _open_image(path: Path) -> Iterator[Image.Image]:
    """Open a photo after checking its size; damage becomes an InputError."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # `read_photo` reports damaged EXIF
            with open_photo(path) as image:
                yield image
    except DAMAGE as error:
        raise InputError(
            f"cannot be read as an image: {_damage_reason(error)}", path=path
        ) from error


def _upright(image: Image.Image) -> Image.Image:
    """Apply the EXIF orientation, unless the EXIF is damaged, which `read_photo` reports."""
    image.load()  # Pillow turns a TIFF upright on loading and then reports no orientation
    if image.format == "HEIF":  # libheif has turned it
        return image
    try:
        orientation = image.getexif().get(_ORIENTATION, 1)
    except (OSError, SyntaxError, ValueError, KeyError, TypeError, struct.error):
        return image
    turn = _TURNS.get(orientation)
    return image if turn is None else image.transpose(turn)


def _damage_reason(error: Exception) -> str:
    strerror = getattr(error, "strerror", None)
    if strerror:
        return str(strerror)
    return "it is truncated" if "truncated" in str(error) else "it is damaged or not an image"


def _to_8_bits(image: Image.Image, path: Path, *, mask: bool = False) -> Image.Image:
    """Scale 16-bit modes to 8 bits; refuse modes without a known range, and photos that use few values."""
    if image.mode.startswith("I;16"):
        values = np.asarray(image)
        if not mask:
            _check_range(values, path)
        return Image.fromarray((values >> 8).astype(np.uint8))
    if image.mode in ("I", "F"):
        raise InputError(
            f"pixel format {image.mode!r} (thermal?) has no known value range", path=path
        )
    return image


def _check_deep_colour(image: Image.Image, path: Path) -> None:
    """Refuse colour photos of 16 bits that use few values; Pillow drops their lower bytes on loading."""
    modes = [str(argument) for tile in getattr(image, "tile", ()) for argument in tile[3:]]
    if image.mode in ("RGB", "RGBA") and any(";16" in mode for mode in modes):
        values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if values is not None and values.dtype == np.uint16:
            _check_range(values[..., :3], path)


def _check_range(values: np.ndarray, path: Path) -> None:
    """Raise InputError if 16-bit values would keep too few grey levels in 8 bits."""
    low, high = (float(v) for v in np.percentile(values[::4, ::4], (0.1, 99.9)))
    if 0 < high - low < _MIN_RANGE_16:
        raise InputError(
            f"uses only values {low:.0f} to {high:.0f} of 16 bits, of which {(high - low) / 256:.0f} of 256 "
            "grey levels would be left (12 or 14 bits, thermal?): convert all photos of the camera to 8 bits "
            f"with the same range, for example gdal_translate -ot Byte -scale {low:.0f} {high:.0f} 0 255",
            path=path,
        )


def _upright_size(photo: PhotoMetadata | None) -> tuple[int, int]:
    if photo is None:
        return 0, 0
    turned = photo.orientation >= 5
    return (photo.height, photo.width) if turned else (photo.width, photo.height)


def _rounded(focal_mm: float) -> float | None:
    return round(focal_mm, 2) if np.isfinite(focal_mm) else None


def _message_without_path(error: InputError, path: Path) -> str:
    return str(error).removeprefix(f"{path}: ")
