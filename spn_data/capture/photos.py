"""Photos: which of a sequence can be read, their pixels upright, and masks."""

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

from spn_data.errors import InputError
from spn_data.telemetry.exif import PhotoMetadata, read_photo

MAX_PHOTO_PIXELS = 500_000_000
_MAX_ASPECT_ERROR = 0.01  # by which a mask's shape may differ from the image's
_FORMATS = ("JPEG", "PNG", "TIFF")  # JPEG opens MPO as well
_ORIENTATION = 0x0112
_DIAGONAL_35MM = 43.267
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
    """What N photos of one sequence say before their pixels are decoded.

    paths : (N,); metadata : (N,), None where unreadable; problem : (N,), why, else "".
    """

    paths: tuple[Path, ...]
    metadata: tuple[PhotoMetadata | None, ...]
    problem: tuple[str, ...]

    @property
    def sizes(self) -> np.ndarray:
        """(N, 2) width and height upright, pixels; 0 where unreadable."""
        return np.array([_upright_size(m) for m in self.metadata], dtype=np.int64).reshape(-1, 2)

    @property
    def lens(self) -> tuple[object, ...]:
        """(N,) equal for photos through one lens at one zoom and size; None where unreadable."""
        return tuple(
            None
            if m is None
            else (m.make, m.model, m.lens, _zoom(m.focal_mm), _zoom(m.focal_35mm), _upright_size(m))
            for m in self.metadata
        )

    def focal_px(self, row: int) -> float | None:
        """Of the upright photo, from the 35-mm equivalent, which compares diagonals (CIPA DCG-001).

        None where it says none.
        """
        metadata = self.metadata[row]
        if metadata is None or not metadata.focal_35mm > 0:
            return None
        return float(metadata.focal_35mm / _DIAGONAL_35MM * np.hypot(*self.sizes[row]))


def read_headers(paths: Sequence[Path]) -> PhotoHeaders:
    """Headers of photos; one that can't be read is noted, and the others go on."""
    metadata: list[PhotoMetadata | None] = []
    problem: list[str] = []
    for path in paths:
        try:
            photo = read_photo(path)
            if photo.width * photo.height > MAX_PHOTO_PIXELS:
                raise InputError(f"{photo.width}x{photo.height} pixels are too many", path=path)
        except InputError as error:
            metadata.append(None)
            problem.append(_reason(error, path))
        else:
            metadata.append(photo)
            problem.append("")
    return PhotoHeaders(tuple(paths), tuple(metadata), tuple(problem))


def decode_photo(path: Path) -> np.ndarray:
    """(H, W, 3) uint8 BGR, upright by its EXIF orientation, 8 bits; InputError where damaged."""
    with _opened(path) as image:
        rgb = _to_8_bits(_upright(image), path).convert("RGB")
        return np.ascontiguousarray(np.asarray(rgb)[:, :, ::-1])


def decode_photo_gray(path: Path, *, max_width: int) -> np.ndarray:
    """(h, w) uint8 grey, upright, at most `max_width` wide; a JPEG is decoded at a reduced size."""
    with _opened(path) as image:
        image.draft("L", (max_width, max_width * image.height // max(image.width, 1)))
        gray = np.asarray(_to_8_bits(_upright(image), path).convert("L"))
    scale = max_width / gray.shape[1]
    if scale < 1:
        size = (max_width, max(1, round(gray.shape[0] * scale)))
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(gray)


def load_mask(path: Path, width: int, height: int) -> np.ndarray:
    """(height, width) bool, True where the image may be used: where the mask is white (at least half).

    A mask of another size but the same shape is resized without blending; another shape is an InputError.
    """
    with _opened(path) as image:
        mask = np.asarray(_to_8_bits(image, path).convert("L"))
    if mask.shape != (height, width):
        found = f"{mask.shape[1]}x{mask.shape[0]}"
        if abs(mask.shape[1] * height / (mask.shape[0] * width) - 1) > _MAX_ASPECT_ERROR:
            raise InputError(
                f"a mask of {found} does not fit images of {width}x{height}", path=path
            )
        mask = cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST)
    usable = mask >= 128
    if not usable.any():
        raise InputError("the mask is black all over: white is what may be used", path=path)
    return usable


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """The photo, with its size checked before pixels take memory; damage becomes an InputError."""
    try:
        with warnings.catch_warnings():
            # Large photos are told by `read_headers` and the limit below, damaged EXIF by `read_photo`.
            warnings.simplefilter("ignore")
            with Image.open(path, formats=_FORMATS) as image:
                if image.width * image.height > MAX_PHOTO_PIXELS:
                    raise InputError(f"{image.width}x{image.height} pixels are too many", path=path)
                yield image
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        reason = str(error) if isinstance(error, Image.DecompressionBombError) else _damage(error)
        raise InputError(f"cannot be read as an image: {reason}", path=path) from error


def _upright(image: Image.Image) -> Image.Image:
    """Turned as EXIF says; as stored where the EXIF is damaged, which `read_photo` tells."""
    image.load()  # Pillow turns a TIFF itself when it is loaded, and then reports no orientation
    try:
        orientation = image.getexif().get(_ORIENTATION, 1)
    except (OSError, SyntaxError, ValueError, KeyError, TypeError, struct.error):
        return image
    turn = _TURNS.get(orientation)
    return image if turn is None else image.transpose(turn)


def _damage(error: Exception) -> str:
    strerror = getattr(error, "strerror", None)
    if strerror:
        return str(strerror)
    return "it is truncated" if "truncated" in str(error) else "it is damaged or no image"


def _to_8_bits(image: Image.Image, path: Path) -> Image.Image:
    """Modes of 16 bits scaled to 8; those without a known range are refused."""
    if image.mode.startswith("I;16"):
        return Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))
    if image.mode in ("I", "F"):
        raise InputError(f"pixels of kind {image.mode!r} (thermal?) have no known range", path=path)
    return image


def _upright_size(photo: PhotoMetadata | None) -> tuple[int, int]:
    if photo is None:
        return 0, 0
    turned = photo.orientation >= 5
    return (photo.height, photo.width) if turned else (photo.width, photo.height)


def _zoom(focal_mm: float) -> float | None:
    return round(focal_mm, 2) if np.isfinite(focal_mm) else None


def _reason(error: InputError, path: Path) -> str:
    return str(error).removeprefix(f"{path}: ")
