"""Writer of dataset.h5: frame by frame, with constant memory, and atomic."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np

from spn_data.dataset.hdf5_disk import DeferredErrorFile
from spn_data.dataset.hdf5_schema import (
    COLUMNS,
    IMAGES,
    MASKS,
    OFFSETS,
    POINTS,
    UNIT_TOLERANCE,
    DatasetFrame,
    DatasetInfo,
    Role,
    SchemaColumn,
)
from spn_data.errors import InputError, StageError

_FRAMES_A_BLOCK = 64  # buffered in memory without their images
_POINTS_A_CHUNK = 16_384
_MAX_ATTRIBUTE_BYTES = 60_000  # HDF5's own limit is 64 KiB
_GROUP_NAME = re.compile(r"\w[\w.\- ]{0,99}")


class DatasetWriter:
    """Writer of frames into the groups of dataset.h5, in any order of the groups.

    The file appears at the end of the `with` block, or not at all after an error. A killed run leaves
    `<name>.part`, which the next run replaces.

    Parameters
    ----------
    path : Path
        File to write.
    info : DatasetInfo
        Properties of the whole data set.
    groups : mapping of str to Role
        Groups to create and their roles.

    Raises
    ------
    InputError
        If a group name is invalid.
    StageError
        If the file cannot be created.

    Examples
    --------
    ::

        with DatasetWriter(path, info, {"train": Role.TRAIN, "medium": Role.TEST}) as writer:
            writer.append("train", frame)
    """

    def __init__(self, path: Path, info: DatasetInfo, groups: Mapping[str, Role]):
        self._path = path
        self._part = path.with_name(path.name + ".part")
        self._info: DatasetInfo = info
        self._names: set[str] = set()
        for name in groups:
            if not _GROUP_NAME.fullmatch(name):
                raise InputError(
                    f"{name!r} is not a valid name for a group of a data set", path=path
                )
        try:
            self._disk = DeferredErrorFile(self._part)
        except OSError as error:
            raise _unwritable(path, error) from error
        self._file = h5py.File(self._disk, "w")
        try:
            for key, value in info.to_attributes().items():
                _set_attribute(self._file, key, value)
            self._groups = {
                name: _Group(self._file.create_group(name), Role(role), info.offset)
                for name, role in groups.items()
            }
        except BaseException:
            self._abandon()
            raise

    def append(self, group: str, frame: DatasetFrame) -> None:
        """Append a frame to a group.

        Raises StageError if it cannot be written to the disk, InputError if the name is not unique or too
        long or if the image differs in size from others of the group.
        """
        if frame.name in self._names:
            raise InputError(f"two frames are named {frame.name}", path=self._path)
        for text, column in ((frame.name, "names"), (frame.sequence, "sequences")):
            longest = int(COLUMNS[column].dtype[1:])
            if len(text.encode()) > longest:
                raise InputError(f"the name {text} is longer than {longest} bytes", path=self._path)
        _check(frame, has_image=self._info.has_images)
        try:
            self._groups[group].append(frame)
        except _SizeMismatch as error:
            raise InputError(
                f"{frame.name} is {error.now}, but the images before it in group {group} are "
                f"{error.before}: all images of a group must have the same size",
                path=self._path,
            ) from error
        if self._disk.error is not None:
            raise _unwritable(self._path, self._disk.error)
        self._names.add(frame.name)

    def add_notes(self, notes: Sequence[str]) -> None:
        """Append to the notes of the data set what was found while its images were read."""
        self._info = replace(self._info, notes=(*self._info.notes, *notes))
        _set_attribute(self._file, "notes", self._info.to_attributes()["notes"])

    def __enter__(self) -> DatasetWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is not None:
            self._abandon()
            return
        try:
            for group in self._groups.values():
                group.finish()
            self._file.close()
            self._disk.sync()
            self._disk.close()
            self._part.replace(self._path)
        except OSError as failure:
            self._abandon()
            raise _unwritable(self._path, failure) from failure
        except BaseException:
            self._abandon()
            raise

    def _abandon(self) -> None:
        self._file.close()
        self._disk.close()
        self._part.unlink(missing_ok=True)


class _SizeMismatch(Exception):
    def __init__(self, before: tuple[int, ...], now: tuple[int, ...]):
        self.before, self.now = f"{before[1]}x{before[0]}", f"{now[1]}x{now[0]}"


class _Group:
    """Group being written: images immediately, everything else in blocks of frames."""

    def __init__(self, group: h5py.Group, role: Role, offset: tuple[float, float, float]):
        self._group, self._offset = group, offset
        self._frames: list[DatasetFrame] = []
        self._mask_idx: list[int] = []
        self._masks: dict[bytes, int] = {}
        self._images: h5py.Dataset | None = None
        self._count = 0
        _set_attribute(group, "role", role.value)
        relative = ", relative to the offset of the file" if any(offset) else ""
        for name, column in COLUMNS.items():
            note = relative if name == "centers" else ""
            _create(group, name, column, _FRAMES_A_BLOCK, note)
        points = group.create_group("points")
        points.attrs["for_training"] = int(role is Role.TRAIN)
        for name, column in POINTS.items():
            _create(points, name, column, _POINTS_A_CHUNK, relative if name == "xyz" else "")
        offsets = _create(points, "offsets", OFFSETS, _FRAMES_A_BLOCK)
        _extend(offsets, np.zeros(1, np.int64))

    def append(self, frame: DatasetFrame) -> None:
        """Write the image and buffer the rest."""
        if frame.image is not None:
            if self._images is None:
                self._images = _create_images(self._group, frame.image.shape)
            if self._images.shape[1:] != frame.image.shape:
                raise _SizeMismatch(self._images.shape[1:], frame.image.shape)
            self._images.resize(self._count + 1, axis=0)
            self._images[self._count] = frame.image
        frame = _relative(frame, self._offset)
        self._mask_idx.append(self._mask_row(frame.valid))
        self._frames.append(replace(frame, image=None, valid=None))  # keeps the buffer small
        self._count += 1
        if len(self._frames) == _FRAMES_A_BLOCK:
            self._flush()

    def _mask_row(self, valid: np.ndarray | None) -> int:
        """Return the row of a mask, or -1 if all pixels are valid; identical masks are stored once."""
        if valid is None or valid.all():
            return -1
        packed = np.packbits(valid).tobytes()
        if packed not in self._masks:
            if "masks" not in self._group:
                _create_masks(self._group, valid.shape)
            _extend(self._group["masks"], valid[None].astype(np.uint8))
            self._masks[packed] = len(self._masks)
        return self._masks[packed]

    def _flush(self) -> None:
        frames = self._frames
        if not frames:
            return
        rows: dict[str, Any] = {
            "names": [f.name.encode() for f in frames],
            "sequences": [f.sequence.encode() for f in frames],
            "strata": [f.stratum.encode() for f in frames],
            "time_s": [f.time_s for f in frames],
            "dense": [int(f.tracked) for f in frames],
            "centers": [f.center for f in frames],
            "quats_wxyz": [f.quat_wxyz for f in frames],
            "covariance": [f.covariance for f in frames],
            "intrinsics": [f.intrinsics for f in frames],
            "mask_idx": self._mask_idx,
        }
        for name, values in rows.items():
            _extend(self._group[name], np.array(values, dtype=self._group[name].dtype))
        points = self._group["points"]
        _extend(points["ids"], np.concatenate([f.point_ids for f in frames]))
        _extend(points["pixels"], np.concatenate([f.point_pixels for f in frames]))
        _extend(points["xyz"], np.concatenate([f.point_xyz for f in frames]))
        counts = np.array([len(f.point_ids) for f in frames], dtype=np.int64)
        _extend(points["offsets"], points["offsets"][-1] + np.cumsum(counts))
        self._frames, self._mask_idx = [], []

    def finish(self) -> None:
        """Write the remaining frames."""
        self._flush()
        self._group.attrs["all_valid"] = int(not self._masks)


def _relative(frame: DatasetFrame, offset: tuple[float, float, float]) -> DatasetFrame:
    """Return a frame whose centre and points are relative to the offset of the file."""
    if not any(offset):
        return frame
    return replace(
        frame, center=frame.center - np.array(offset), point_xyz=frame.point_xyz - np.array(offset)
    )


def _check(frame: DatasetFrame, *, has_image: bool) -> None:
    """Raise ValueError if a frame violates the format, which is an error of the caller, not the user."""
    numbers = np.concatenate([frame.center, frame.quat_wxyz])
    if numbers.shape != (7,) or not np.isfinite(numbers).all():
        raise ValueError(f"{frame.name}: has no pose")
    if abs(np.linalg.norm(frame.quat_wxyz) - 1) > UNIT_TOLERANCE or frame.quat_wxyz[0] < 0:
        raise ValueError(f"{frame.name}: the quaternion is not canonical")
    if frame.covariance.shape != (6, 6) or frame.intrinsics.shape != (3, 3):
        raise ValueError(f"{frame.name}: covariance must be (6, 6) and intrinsics (3, 3)")
    if frame.stratum not in ("high", "medium", "low", ""):
        raise ValueError(f"{frame.name}: {frame.stratum!r} is not a stratum")
    k = len(frame.point_ids)
    if frame.point_pixels.shape != (k, 2) or frame.point_xyz.shape != (k, 3):
        raise ValueError(f"{frame.name}: ids, pixels and xyz of the points differ in length")
    if (frame.image is None) == has_image:
        raise ValueError(
            f"{frame.name}: "
            + ("has no image" if has_image else "has an image, but the data set has none")
        )
    if frame.image is None:
        return
    if frame.image.dtype != np.uint8 or frame.image.ndim != 3 or frame.image.shape[2] != 3:
        raise ValueError(f"{frame.name}: the image must be (H, W, 3) uint8")
    shape = frame.image.shape[:2]
    if frame.valid is not None and frame.valid.shape != shape:
        raise ValueError(f"{frame.name}: mask and image differ in shape")
    if k and not np.all((frame.point_pixels >= 0) & (frame.point_pixels < shape[::-1])):
        raise ValueError(f"{frame.name}: a point is outside the image")


def _create(
    group: h5py.Group, name: str, column: SchemaColumn, rows_a_chunk: int, note: str = ""
) -> h5py.Dataset:
    dataset = group.create_dataset(
        name,
        shape=(0, *column.tail),
        maxshape=(None, *column.tail),
        chunks=(rows_a_chunk, *column.tail),
        dtype=_type_of(column.dtype),
        compression="gzip" if column.dtype.startswith("S") else None,
    )
    _set_attribute(dataset, "description", column.description + note)
    return dataset


def _create_images(group: h5py.Group, shape: tuple[int, ...]) -> h5py.Dataset:
    """Create the images, one uncompressed chunk each; gzip would save a sixth but read 30 times slower."""
    images = group.create_dataset(
        "images", (0, *shape), np.uint8, maxshape=(None, *shape), chunks=(1, *shape)
    )
    _set_attribute(images, "description", IMAGES)
    return images


def _create_masks(group: h5py.Group, shape: tuple[int, ...]) -> None:
    masks = group.create_dataset(
        "masks",
        (0, *shape),
        np.uint8,
        maxshape=(None, *shape),
        chunks=(1, *shape),
        compression="gzip",
    )
    _set_attribute(masks, "description", MASKS)


def _type_of(dtype: str) -> np.dtype[Any]:
    return h5py.string_dtype("utf-8", int(dtype[1:])) if dtype[0] == "S" else np.dtype(dtype)


def _set_attribute(of: h5py.Group | h5py.Dataset, name: str, value: Any) -> None:
    if isinstance(value, str):
        text = value.encode()
        if len(text) > _MAX_ATTRIBUTE_BYTES:
            raise ValueError(f"{name} is longer than {_MAX_ATTRIBUTE_BYTES} bytes")
        value = np.array(text, dtype=_type_of(f"S{max(1, len(text))}"))
    of.attrs[name] = value


def _extend(dataset: h5py.Dataset, rows: np.ndarray) -> None:
    if len(rows):
        before = len(dataset)
        dataset.resize(before + len(rows), axis=0)
        dataset[before:] = rows


def _unwritable(path: Path, error: OSError) -> StageError:
    return StageError(f"{path} cannot be written: {error.strerror}")
