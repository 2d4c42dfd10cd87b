"""Lazy reader of dataset.h5, which validates every shape and bound before use."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import h5py
import numpy as np

from spn_data.dataset.hdf5_schema import (
    COLUMNS,
    FORMAT,
    OFFSET_VERSION,
    OFFSETS,
    POINTS,
    UNIT_TOLERANCE,
    VERSION,
    DatasetInfo,
    Role,
    SchemaColumn,
    flag,
)
from spn_data.errors import FormatError, InputError
from spn_data.geometry.pose import Poses

_MAX_GROUPS = 10_000
_MAX_SIDE_PX = 65_536
_MAX_DEFLATION = 1100  # upper bound of the compression ratio; deflate compresses zeros by 1032
# Other filters are rejected, because HDF5 would load them as plug-ins from the disk.
_FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_LZF}
_DAMAGE = (OSError, RuntimeError, KeyError, TypeError, ValueError, OverflowError, MemoryError)
_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class FramePoints:
    """Map points seen by one frame.

    Attributes
    ----------
    ids : ndarray of int, shape (K,)
        Ids of the points in the map.
    pixels : ndarray of float32, shape (K, 2)
        Pixels in the frame's image, in COLMAP's pixel convention.
    xyz : ndarray, shape (K, 3)
        Positions in the world.
    """

    ids: np.ndarray
    pixels: np.ndarray
    xyz: np.ndarray


class Dataset:
    """Open dataset.h5, to be closed or used as a context manager. Images and points are read on demand.

    Parameters
    ----------
    path : str or path-like
        File to open.

    Attributes
    ----------
    path : Path
        The file.
    info : DatasetInfo
        Properties of the whole data set.
    groups : dict of str to DatasetGroup
        Groups by name.

    Raises
    ------
    InputError
        If the file does not exist.
    FormatError
        If it is not a data set, has another format version, or is damaged. Damage may also be detected later,
        when the affected part is read.
    """

    def __init__(self, path: str | PathLike[str]):
        self.path = path = Path(path)
        if not path.is_file():
            raise InputError("does not exist" if not path.exists() else "is not a file", path=path)
        try:
            self._file = h5py.File(path, "r", locking="best-effort")
        except OSError as error:
            raise FormatError(f"{path}: is not a data set of this program ({error})") from error
        try:
            self.info = self._read_info()
            self.groups = self._read_groups()
        except BaseException:
            self._file.close()
            raise

    def _read_info(self) -> DatasetInfo:
        attributes = _guarded(self.path, "its attributes", lambda: _attributes(self._file))
        if attributes.get("format") != FORMAT:
            raise FormatError(f"{self.path}: is not a data set of this program")
        version = _guarded(self.path, "its version", lambda: int(attributes["version"]))
        if version not in (VERSION, OFFSET_VERSION):
            raise FormatError(
                f"{self.path}: has format version {version}, this program reads {VERSION} and "
                f"{OFFSET_VERSION}; create it again, or update the program"
            )
        return _guarded(
            self.path, "its attributes", lambda: DatasetInfo.from_attributes(attributes)
        )

    def _read_groups(self) -> dict[str, DatasetGroup]:
        names = _guarded(self.path, "its groups", lambda: list(self._file))
        if len(names) > _MAX_GROUPS:
            raise FormatError(f"{self.path}: is damaged: {len(names)} groups")
        return {name: self._read_group(name) for name in names}

    def _read_group(self, name: str) -> DatasetGroup:
        def read() -> DatasetGroup:
            return DatasetGroup(self.path, name, _child(self._file, name, h5py.Group), self.info)

        return _guarded(self.path, f"group {name}", read)

    def __getitem__(self, name: str) -> DatasetGroup:
        if name not in self.groups:
            raise KeyError(f"{name!r} is not a group; the data set has: {', '.join(self.groups)}")
        return self.groups[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.groups)

    def __len__(self) -> int:
        return len(self.groups)

    def of_role(self, role: Role) -> list[DatasetGroup]:
        """Return the groups with a role, sorted by name."""
        return [group for group in self.groups.values() if group.role is role]

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Dataset:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class DatasetGroup:
    """Frames of one group. Columns are read on first use and cached; images and points are not cached.

    Attributes
    ----------
    name : str
        Name of the group.
    role : Role
        Purpose of the group.
    image_size : tuple of int or None
        Width and height of the images; None without images.
    all_valid : bool
        Whether all pixels of all frames are valid.
    points_for_training : bool
        Whether the group's points may be used for training.
    offset : tuple of float
        `DatasetInfo.offset`: subtract it from world positions before they become float32.
    """

    def __init__(self, path: Path, name: str, group: h5py.Group, info: DatasetInfo):
        self._path, self.name, self.offset = path, name, info.offset
        attributes = _attributes(group)
        self.role = Role(attributes["role"])
        self.all_valid = flag(attributes["all_valid"])
        points = _child(group, "points", h5py.Group)
        self.points_for_training = flag(_attributes(points)["for_training"])
        if self.points_for_training and self.role is not Role.TRAIN:
            raise ValueError(f"its points are marked for training, but its role is {self.role}")
        rows = len(_child(group, "names", h5py.Dataset))
        self._length = rows
        self._columns = {n: _table(group, n, column, rows) for n, column in COLUMNS.items()}
        self._offsets = _table(points, "offsets", OFFSETS, rows + 1)
        seen = len(_child(points, "ids", h5py.Dataset))
        self._points = {n: _table(points, n, column, seen) for n, column in POINTS.items()}
        self.image_size: tuple[int, int] | None = None
        self._images, self._masks = None, None
        if info.has_images and rows:
            self._images = _pictures(group, "images", rows, (3,))
            self.image_size = (self._images.shape[2], self._images.shape[1])
        if not self.all_valid:
            masks = len(_child(group, "masks", h5py.Dataset))
            self._masks = _pictures(group, "masks", masks, ())
            if self._images is None or self._masks.shape[1:] != self._images.shape[1:3]:
                raise ValueError("masks and images differ in size")

    def __len__(self) -> int:
        return self._length

    @cached_property
    def names(self) -> np.ndarray:
        """Names of the frames, shape (N,)."""
        return self._texts("names")

    @cached_property
    def sequences(self) -> np.ndarray:
        """Sequences of the frames, shape (N,)."""
        return self._texts("sequences")

    @cached_property
    def strata(self) -> np.ndarray:
        """Coverage strata, shape (N,): "high", "medium", "low" or ""."""
        return self._texts("strata")

    @cached_property
    def time_s(self) -> np.ndarray:
        """Seconds since the sequence's first frame, shape (N,)."""
        return self._column("time_s")

    @cached_property
    def tracked(self) -> np.ndarray:
        """Mask of tracked frames, shape (N,)."""
        return self._column("dense") != 0

    @cached_property
    def poses(self) -> Poses:
        """Poses of the N frames in the world; all finite, quaternions unit to 1e-5."""
        centers, quats = self._column("centers"), self._column("quats_wxyz")
        length = np.linalg.norm(quats, axis=1)
        if not (np.isfinite(centers).all() and np.all(np.abs(length - 1) <= UNIT_TOLERANCE * 1.01)):
            raise FormatError(f"{self._path}: group {self.name} contains an invalid pose")
        return Poses(centers, quats).moved_by(self.offset)

    @cached_property
    def covariance(self) -> np.ndarray:
        """Pose covariances, shape (N, 6, 6); NaN if unknown."""
        return self._column("covariance")

    @cached_property
    def intrinsics(self) -> np.ndarray:
        """Camera matrices, shape (N, 3, 3), in COLMAP's pixel convention; NaN if unknown."""
        return self._column("intrinsics")

    @cached_property
    def _mask_idx(self) -> np.ndarray:
        index = self._column("mask_idx")
        count = 0 if self._masks is None else len(self._masks)
        if len(index) and not (index.min() >= -1 and index.max() < count):
            raise FormatError(f"{self._path}: group {self.name} refers to masks that do not exist")
        return index

    @cached_property
    def _ends(self) -> np.ndarray:
        offsets = self._read("points", lambda: self._offsets[:])
        total = len(self._points["ids"])
        if offsets[0] != 0 or offsets[-1] != total or np.any(np.diff(offsets) < 0):
            raise FormatError(f"{self._path}: the point offsets of group {self.name} are damaged")
        return offsets

    def image(self, row: int, out: np.ndarray | None = None) -> np.ndarray:
        """Read the image of a frame.

        Parameters
        ----------
        row : int
            The frame.
        out : ndarray, shape (H, W, 3), uint8, optional
            Array to read into.

        Returns
        -------
        ndarray, shape (H, W, 3)
            uint8 RGB; `out` if given.

        Raises
        ------
        InputError
            If the data set contains no images.
        FormatError
            If the image is damaged.
        """
        images = self._images
        if images is None:
            raise InputError("contains no images, only poses", path=self._path)
        target = np.empty(images.shape[1:], np.uint8) if out is None else out
        row = range(len(self))[row]
        self._read(f"image {row}", lambda: images.read_direct(target, np.s_[row]))
        return target

    def valid(self, row: int) -> np.ndarray | None:
        """Return the mask (H, W) of pixels that show the scene, or None if all do."""
        masks, index = self._masks, int(self._mask_idx[row])
        if index < 0 or masks is None:
            return None
        return self._read(f"mask {index}", lambda: masks[index]) != 0

    def points(self, row: int) -> FramePoints:
        """Return the map points seen by a frame."""
        row = range(len(self))[row]
        part = slice(int(self._ends[row]), int(self._ends[row + 1]))
        read = self._read("points", lambda: {n: d[part] for n, d in self._points.items()})
        xyz = read["xyz"] + self.offset if any(self.offset) else read["xyz"]
        return FramePoints(read["ids"], read["pixels"], xyz)

    def point_ids(self) -> list[np.ndarray]:
        """Return the ids (K,) of the map points seen by each frame, with a single read."""
        ids = self._read("points", lambda: self._points["ids"][:])
        return np.split(ids, self._ends[1:-1]) if len(self) else []

    def training_points(self, row: int) -> FramePoints:
        """Return `points` if they may be used for training; raise InputError for any other group."""
        if not self.points_for_training:
            raise InputError(
                f"the points of group {self.name} are not for training", path=self._path
            )
        return self.points(row)

    def _column(self, name: str) -> np.ndarray:
        return self._read(name, lambda: self._columns[name][:])

    def _texts(self, name: str) -> np.ndarray:
        return self._read(name, lambda: np.strings.decode(self._columns[name][:], "utf-8"))

    def _read(self, what: str, read: Callable[[], _T]) -> _T:
        return _guarded(self._path, f"{what} of {self.name}", read)


def _guarded(path: Path, what: str, read: Callable[[], _T]) -> _T:
    """Call `read`, and convert any error that a damaged file can cause to FormatError."""
    try:
        return read()
    except _DAMAGE as error:
        raise FormatError(f"{path}: {what} cannot be read: {error}") from error


def _child(group: h5py.Group, name: str, kind: type[Any]) -> Any:
    """Return a member of a group; ValueError for soft and external links, KeyError if it is missing."""
    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"{name} is a link")
    child = group[name]
    if not isinstance(child, kind):
        raise ValueError(f"{name} is not a {kind.__name__}")
    return child


def _stored(group: h5py.Group, name: str) -> h5py.Dataset:
    """Return a dataset after checking that all its values are in this file and need only known filters."""
    dataset = _child(group, name, h5py.Dataset)
    plist = dataset.id.get_create_plist()
    filters = {plist.get_filter(k)[0] for k in range(plist.get_nfilters())}
    if dataset.is_virtual or dataset.external or not filters <= _FILTERS:
        raise ValueError(f"{name} uses an unsupported storage layout or filter")
    if dataset.shape is None or dataset.chunks is None:
        raise ValueError(f"{name} is not a chunked table")
    stored = min(dataset.id.get_storage_size(), group.file.id.get_filesize())
    if dataset.nbytes > stored * (_MAX_DEFLATION if filters else 1):
        raise ValueError(f"{name} is truncated")
    return dataset


def _table(group: h5py.Group, name: str, column: SchemaColumn, rows: int) -> h5py.Dataset:
    dataset = _stored(group, name)
    if dataset.dtype != np.dtype(column.dtype) or dataset.shape != (rows, *column.tail):
        raise ValueError(f"{name} has unexpected shape {dataset.shape} or type {dataset.dtype}")
    return dataset


def _pictures(group: h5py.Group, name: str, rows: int, tail: tuple[int, ...]) -> h5py.Dataset:
    dataset = _stored(group, name)
    height, width = dataset.shape[1:3] if len(dataset.shape) == 3 + len(tail) else (0, 0)
    if (
        dataset.dtype != np.uint8
        or dataset.shape != (rows, height, width, *tail)
        or not (0 < height <= _MAX_SIDE_PX and 0 < width <= _MAX_SIDE_PX)
        or dataset.chunks != (1, height, width, *tail)
    ):
        raise ValueError(f"{name} has unexpected shape {dataset.shape} or type {dataset.dtype}")
    return dataset


def _attributes(of: h5py.Group) -> dict[str, Any]:
    """Read scalar numbers and texts; ValueError for other types, on which HDF5 may crash."""
    values: dict[str, Any] = {}
    for name in of.attrs:
        attribute = of.attrs.get_id(name)
        if attribute.shape != () or attribute.dtype.kind not in "ifS":
            raise ValueError(f"attribute {name} is not a single number or text")
        value = of.attrs[name]
        values[name] = value.decode() if isinstance(value, bytes) else value
    return values
