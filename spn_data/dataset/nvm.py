"""Models in VisualSFM's NVM_V3 format: cameras without distortion, and points with their measurements.

One line `name focal qw qx qy qz cx cy cz 0 0` per camera: the centre, and the rotation from world axes to
camera axes (x right, y down, z forward), scalar first. One line per point: `x y z r g b n`, followed by n
times `image feature dx dy`, the measurement in pixels right of and below the principal point, which is the
image centre. See http://ccwu.me/vsfm/doc.html#nvm
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.grouping import rank_within_group
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import canonical_quats
from spn_data.storage.files import atomic_writer

MAX_IMAGES = 1_000_000
MAX_POINTS = 100_000_000
_MAX_LINE_BYTES = 64_000_000  # a point seen in a million images
_UNIT_AT_ALL = 0.01
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm")


@dataclass(frozen=True, eq=False)
class NvmModel:
    """NVM model: images, points, and measurements sorted by point.

    Attributes
    ----------
    names : tuple of str
        N unique image names.
    focal_px : ndarray, shape (N,)
        Focal lengths in pixels.
    distortion : ndarray, shape (N,)
        VisualSFM's radial distortion; always 0 in models written by this program.
    poses : Poses
        N poses.
    xyz : ndarray, shape (P, 3)
        Points.
    colors : ndarray of uint8, shape (P, 3)
        RGB colours of the points.
    point_idx, image_idx : ndarray of int, shape (M,)
        Point and image of each measurement.
    feature_idx : ndarray of int, shape (M,)
        Index of each measurement within its image.
    offsets_px : ndarray, shape (M, 2)
        Measurements in pixels from the image centre.
    """

    names: tuple[str, ...]
    focal_px: np.ndarray
    distortion: np.ndarray
    poses: Poses
    xyz: np.ndarray
    colors: np.ndarray
    point_idx: np.ndarray
    image_idx: np.ndarray
    feature_idx: np.ndarray
    offsets_px: np.ndarray


def build_nvm_model(
    names: tuple[str, ...],
    poses: Poses,
    focal_px: np.ndarray,
    points: tuple[np.ndarray, np.ndarray],
    measurements: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> NvmModel:
    """Build a model without distortion.

    Parameters
    ----------
    names : tuple of str
        N image names.
    poses : Poses
        N poses.
    focal_px : ndarray, shape (N,)
        Focal lengths in pixels.
    points : tuple of ndarray
        Positions (P, 3) and RGB colours (P, 3) of the points.
    measurements : tuple of ndarray
        Point index (M,), image index (M,) and offset from the image centre (M, 2) of each measurement, in any
        order.

    Returns
    -------
    NvmModel
        The model; points without measurements are dropped.
    """
    point_idx, image_idx, offsets_px = measurements
    order = np.lexsort((image_idx, point_idx))
    point_idx, image_idx, offsets_px = point_idx[order], image_idx[order], offsets_px[order]
    used, new_idx = np.unique(point_idx, return_inverse=True)
    return NvmModel(
        names,
        np.asarray(focal_px, dtype=np.float64),
        np.zeros(len(names)),
        poses,
        points[0][used],
        points[1][used],
        new_idx,
        image_idx,
        rank_within_group(image_idx, len(names)),
        offsets_px,
    )


def offsets_from_center(camera: Camera, pixels: np.ndarray, focal_px: float) -> np.ndarray:
    """Undistort pixels and return their offsets from the image centre.

    Parameters
    ----------
    camera : Camera
        Camera of the pixels.
    pixels : ndarray, shape (K, 2)
        Pixels.
    focal_px : float
        Focal length of the undistorted camera, whose principal point is the image centre.

    Returns
    -------
    ndarray, shape (K, 2)
        Offsets in pixels.
    """
    return focal_px * camera.unproject(pixels) if len(pixels) else np.zeros((0, 2))


def write_nvm(path: Path, model: NvmModel) -> None:
    """Write a model atomically, with numbers that are restored bit for bit.

    Raises ValueError if an image name contains whitespace or a number is not finite.
    """
    _check(model)
    with atomic_writer(path, "w") as file:
        file.writelines(_text(model))


def _check(model: NvmModel) -> None:
    for name in model.names:
        if not name or any(c.isspace() or not c.isprintable() for c in name):
            raise ValueError(f"{name!r} is not a valid image name in NVM")
    numbers = (model.focal_px, model.poses.centers, model.poses.quats_wxyz, model.xyz)
    if not all(np.isfinite(n).all() for n in (*numbers, model.offsets_px)):
        raise ValueError("cannot write a number that is not finite to NVM")


def _text(model: NvmModel) -> Iterator[str]:
    yield f"NVM_V3\n\n{len(model.names)}\n"
    for k, name in enumerate(model.names):
        numbers = (*model.poses.quats_wxyz[k], *model.poses.centers[k])
        yield (
            f"{name} {model.focal_px[k]:.17g} {' '.join(f'{v:.17g}' for v in numbers)} "
            f"{model.distortion[k]:.17g} 0\n"
        )
    yield f"\n{len(model.xyz)}\n"
    first = np.searchsorted(model.point_idx, np.arange(len(model.xyz) + 1))
    for k, (xyz, color) in enumerate(zip(model.xyz, model.colors, strict=True)):
        mine = slice(first[k], first[k + 1])
        seen = " ".join(
            f"{image} {feature} {dx:.17g} {dy:.17g}"
            for image, feature, (dx, dy) in zip(
                model.image_idx[mine],
                model.feature_idx[mine],
                model.offsets_px[mine],
                strict=True,
            )
        )
        place = " ".join(f"{v:.17g}" for v in xyz)
        yield f"{place} {' '.join(map(str, color))} {mine.stop - mine.start} {seen}".rstrip() + "\n"
    yield "\n0\n"


def read_nvm(path: Path | str) -> NvmModel:
    """Read the first model of a file; raise InputError, with the line number, if it is malformed."""
    return read_nvm_models(path)[0]


def read_nvm_models(path: Path | str) -> tuple[NvmModel, ...]:
    """Read all models of a file.

    Parameters
    ----------
    path : path-like
        File of VisualSFM, which writes one model after the other, the largest first as a rule, and a last
        one without points of the images that it could not register.

    Returns
    -------
    tuple of NvmModel
        At least one model; a later model without points is left out.

    Raises
    ------
    InputError
        With the line number, if the file is malformed.
    """
    path = Path(path)
    lines = _Lines(path)
    try:
        return tuple(_read_all(lines))
    except ValueError as error:
        raise InputError(str(error), path=path, line=lines.number) from error
    except OSError as error:
        raise InputError(f"can't be read: {error.strerror}", path=path) from error
    finally:
        lines.close()


class _Lines:
    """Reader of non-empty lines of limited length."""

    def __init__(self, path: Path):
        self.number = 0
        try:
            self._file = path.open("rb")
        except OSError as error:
            raise InputError(f"can't be read: {error.strerror}", path=path) from error

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def next(self, what: str) -> str:
        """Return the next line; at the end of the file "", or ValueError if `what` was expected."""
        while raw := self._file.readline(_MAX_LINE_BYTES + 1):
            self.number += 1
            if len(raw) > _MAX_LINE_BYTES:
                raise ValueError(f"the line is longer than {_MAX_LINE_BYTES // 1_000_000} MB")
            try:
                text = raw.decode("utf-8").strip()
            except UnicodeDecodeError as error:
                raise ValueError("the line is not UTF-8 text") from error
            if text:
                return text
        if not what:
            return ""
        raise ValueError(f"the file ends where {what} is expected")


def _read_all(lines: _Lines) -> Iterator[NvmModel]:
    head = lines.next("NVM_V3")
    # A fixed calibration may follow NVM_V3; it is ignored because each image has its own focal length.
    if head.split()[0] != "NVM_V3":
        raise ValueError(f"begins with {head[:40]!r}, not NVM_V3")
    yield _read(lines, _count(lines.next("the number of images"), MAX_IMAGES), is_first=True)
    # Models end with a zero, and after it stand the names of PLY files.
    while (text := lines.next("")) and text[0] != "#" and (images := _count(text, MAX_IMAGES)):
        model = _read(lines, images, is_first=False)
        if len(model.xyz):
            yield model


def _read_camera(lines: _Lines) -> tuple[str, list[float]]:
    """Read one image: its name, which may contain spaces, and ten numbers."""
    text = lines.next("an image")
    cells = text.rsplit(None, 10)
    if len(cells) != 11 or (len(cells[0].split()) > 1 and not has_image_suffix(cells[0])):
        raise ValueError(
            f"{len(text.split())} fields, expected 11: name focal qw qx qy qz cx cy cz r 0"
        )
    try:
        return cells[0], _numbers(cells[1:])
    except ValueError as error:
        raise ValueError(f"{cells[0][:80]}: {error}") from error


def _read(lines: _Lines, images: int, *, is_first: bool) -> NvmModel:
    names: dict[str, None] = {}
    cameras = array("d")
    damaged: tuple[int, str] | None = None
    for _ in range(images):
        name, numbers = _read_camera(lines)
        if name in names:
            raise ValueError(f"{name[:80]!r} is listed twice")
        length = math.sqrt(sum(value * value for value in numbers[1:5]))
        if damaged is None and abs(length - 1) > _UNIT_AT_ALL:
            damaged = (lines.number, f"{name[:80]}: {_bad_length(length)}")
        names[name] = None
        cameras.extend(numbers)
    points = _count(lines.next("the number of points"), MAX_POINTS)
    if damaged is not None and (
        points or is_first
    ):  # images that were not registered may have any pose
        lines.number = damaged[0]
        raise ValueError(damaged[1])
    xyz, colors, owners, offsets = array("d"), array("B"), array("q"), array("d")
    for point in range(points):
        cells = lines.next("a point").split()
        count = _count(cells[6], MAX_IMAGES) if len(cells) > 6 else -1
        if len(cells) != 7 + 4 * count:
            raise ValueError(
                f"{len(cells)} fields, expected x y z r g b n and n times image feature dx dy"
            )
        xyz.extend(_numbers(cells[:3]))
        colors.extend(_count(cell, 255) for cell in cells[3:6])
        for k in range(7, len(cells), 4):
            image = _count(cells[k], MAX_IMAGES)
            if image >= len(names):
                raise ValueError(f"image {image} is out of range, there are {len(names)} images")
            owners.extend((point, image, _count(cells[k + 1], 2**62)))
            offsets.extend(_numbers(cells[k + 2 : k + 4]))
    table = np.array(cameras).reshape(-1, 10)
    quats = table[:, 1:5].copy()
    if not (points or is_first):
        quats[:] = (1, 0, 0, 0)  # of a model that is left out
    index = np.array(owners, dtype=np.int64).reshape(-1, 3)
    return NvmModel(
        tuple(names),
        table[:, 0],
        table[:, 8],
        Poses(table[:, 5:8], canonical_quats(quats)),
        np.array(xyz).reshape(-1, 3),
        np.array(colors, dtype=np.uint8).reshape(-1, 3),
        index[:, 0],
        index[:, 1],
        index[:, 2],
        np.array(offsets).reshape(-1, 2),
    )


def has_image_suffix(name: str) -> bool:
    """Return whether a name ends like that of an image: spaces in it are not separators then."""
    return name.lower().endswith(_IMAGE_SUFFIXES)


def _bad_length(length: float) -> str:
    if length == 0:
        return "its quaternion is zero, so it has no pose: remove the image from the model"
    return f"the quaternion has length {length:.6g} instead of 1: check the order of the columns"


def _count(cell: str, most: int) -> int:
    if not (cell.isascii() and cell.isdigit()) or len(cell) > 19 or int(cell) > most:
        raise ValueError(f"{cell[:40]!r} is not a number from 0 to {most}")
    return int(cell)


def _numbers(cells: list[str]) -> list[float]:
    values = [float(cell) for cell in cells]
    if not all(math.isfinite(v) and abs(v) <= 1e15 for v in values):
        raise ValueError("a number is not finite or exceeds 1e15")
    return values
