"""COLMAP's binary model files, read by NumPy: a Python object for each measurement would take seconds."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spn_data.geometry.pose import Poses

IMAGES, POINTS = "images.bin", "points3D.bin"
CAMERAS, RIGS, FRAMES = "cameras.bin", "rigs.bin", "frames.bin"
_POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
_TRACK_ELEMENT_BYTES = 8
_KEYPOINT = np.dtype([("xy", "<f8", 2), ("point_id", "<i8")])
_POSE_BYTES = 64  # image id, quaternion, translation, camera id
# Number of parameters by COLMAP's number of the camera model.
_PARAMETERS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)
_MAX_SIDE_PX = 1_000_000
_SENSOR_POSE_BYTES = 56


@dataclass(frozen=True, eq=False)
class PointTable:
    """All P points of a model, sorted by id.

    Attributes
    ----------
    ids : ndarray, shape (P,), int64
    xyz : ndarray, shape (P, 3)
        In the model's frame.
    colors : ndarray, shape (P, 3), uint8
        RGB.
    track_lengths : ndarray, shape (P,), int64
    """

    ids: np.ndarray
    xyz: np.ndarray
    colors: np.ndarray
    track_lengths: np.ndarray


def read_points(folder: Path) -> PointTable:
    """Read points3D.bin. Raises ValueError if the file is cut short or damaged, OSError if it is missing."""
    data = (folder / POINTS).read_bytes()
    offsets = np.array(_point_offsets(data), np.int64)
    raw = np.frombuffer(data, np.uint8)
    records = raw[offsets[:, None] + np.arange(_POINT.itemsize)].reshape(-1).view(_POINT)
    records = records[np.argsort(records["id"], kind="stable")]
    return PointTable(
        records["id"].astype(np.int64),
        records["xyz"].copy(),
        records["color"].copy(),
        records["length"].astype(np.int64),
    )


def read_keypoints(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Read the keypoints of images.bin.

    Returns
    -------
    dict of str to tuple of ndarray
        By image name, pixels (K, 2) and point ids (K,), -1 for a keypoint without a point.

    Raises
    ------
    ValueError
        If the file is cut short or damaged.
    OSError
        If it is missing.
    """
    data = (folder / IMAGES).read_bytes()
    keypoints = {}
    for name, start, count in _image_blocks(data):
        block = np.frombuffer(data, _KEYPOINT, count, start)
        keypoints[name] = (block["xy"].copy(), block["point_id"].copy())
    return keypoints


def read_centers(folder: Path) -> np.ndarray:
    """Read the camera centres of images.bin in the model's frame, (N, 3); raises as `read_keypoints` does."""
    data = (folder / IMAGES).read_bytes()
    names_at = [start - 9 - len(name.encode()) for name, start, _ in _image_blocks(data)]
    poses = [np.frombuffer(data, "<f8", 7, at - _POSE_BYTES + 4) for at in names_at]
    values = np.array(poses).reshape(-1, 7)
    return Poses.from_cam_from_world(values[:, [1, 2, 3, 0]], values[:, 4:]).centers


def count_images(folder: Path) -> int:
    """Read the number of registered images from the header of images.bin.

    Raises ValueError if the file has no header, OSError if it is missing.
    """
    with (folder / IMAGES).open("rb") as file:
        return _count(file.read(8), IMAGES)


def check_whole(folder: Path) -> None:
    """Raise ValueError unless each file holds just the number of records that its header says.

    COLMAP itself ignores a file that is cut short, and reads records that are not there for as long as a
    damaged header says.
    """
    _image_blocks((folder / IMAGES).read_bytes())
    _point_offsets((folder / POINTS).read_bytes())
    _check_records(folder / CAMERAS, _end_of_camera)
    for name, end_of in ((RIGS, _end_of_rig), (FRAMES, _end_of_frame)):
        if (folder / name).exists():  # models of COLMAP before 3.12 have neither
            _check_records(folder / name, end_of)


def _check_records(path: Path, end_of: Callable[[bytes, int], int]) -> None:
    data, offset = path.read_bytes(), 8
    try:
        for _ in range(_count(data, path.name)):
            offset = end_of(data, offset)
            if offset > len(data):
                break
    except (struct.error, OverflowError):
        offset = -1
    if offset != len(data):
        raise ValueError(f"{path.name} is cut short or damaged")


def _end_of_camera(data: bytes, offset: int) -> int:
    _, model, width, height = struct.unpack_from("<IiQQ", data, offset)
    if not (0 <= model < len(_PARAMETERS) and max(width, height) <= _MAX_SIDE_PX):
        return len(data) + 1
    return offset + 24 + 8 * _PARAMETERS[model]


def _end_of_rig(data: bytes, offset: int) -> int:
    _, sensors = struct.unpack_from("<II", data, offset)
    offset += 8 + (8 if sensors else 0)  # the reference sensor has no pose
    for _ in range(sensors - 1):
        _, _, has_pose = struct.unpack_from("<iIB", data, offset)
        offset += 9 + (_SENSOR_POSE_BYTES if has_pose else 0)
    return offset


def _end_of_frame(data: bytes, offset: int) -> int:
    (count,) = struct.unpack_from("<I", data, offset + 64)
    return offset + 68 + 16 * count


def _count(data: bytes, name: str) -> int:
    try:
        return int(struct.unpack_from("<Q", data)[0])
    except struct.error as error:
        raise ValueError(f"{name} is cut short or damaged") from error


def _image_blocks(data: bytes) -> list[tuple[str, int, int]]:
    """Return name, offset of the keypoints and their number for each image."""
    blocks, offset = [], 8
    try:
        for _ in range(_count(data, IMAGES)):
            end_of_name = data.index(b"\0", offset + _POSE_BYTES)
            (count,) = struct.unpack_from("<Q", data, end_of_name + 1)
            start = end_of_name + 9
            blocks.append((data[offset + _POSE_BYTES : end_of_name].decode(), start, count))
            offset = start + _KEYPOINT.itemsize * count
    except (struct.error, ValueError, OverflowError):
        offset = -1
    if offset != len(data):
        raise ValueError(f"{IMAGES} is cut short or damaged")
    return blocks


def _point_offsets(data: bytes) -> list[int]:
    """Return the offset of each point."""
    offsets, offset = [], 8
    length_of = struct.Struct("<Q").unpack_from
    head = _POINT.itemsize
    try:
        for _ in range(_count(data, POINTS)):
            offsets.append(offset)
            offset += head + _TRACK_ELEMENT_BYTES * length_of(data, offset + head - 8)[0]
    except (struct.error, OverflowError):
        offset = -1
    if offset != len(data):
        raise ValueError(f"{POINTS} is cut short or damaged")
    return offsets
