"""Schema of dataset.h5: names, types and attributes (documented in docs/dataset.md for other readers)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_from_json, camera_to_json
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.json_values import parse_json

FORMAT = "squeezeposenet-dataset"
VERSION = 1
OFFSET_VERSION = 2  # of a file with an offset, so that programs that know none refuse it
OFFSET = ("offset_x", "offset_y", "offset_z")  # attributes of such a file
CONVENTIONS = (
    "World: East, North, Up in metres about the origin where units is 'm' and has_origin is 1. "
    "centers: camera centre in the world. quats_wxyz: unit, scalar first, w >= 0, turns world axes into "
    "camera axes (x right, y down, z forward): x_cam = R(q) (x_world - center). covariance: over (centre; "
    "rotation vector v in the camera frame, radians), R_true = exp(v) R, relative to the map. Pixels: x "
    "right, y down, the centre of the upper-left pixel is (0.5, 0.5); so in intrinsics and points. Images "
    "are RGB, without distortion. NaN is unknown."
)
_OFFSET_CONVENTION = (
    " Centers and points/xyz are relative to offset_x, offset_y, offset_z: add these in float64 to obtain "
    "positions in the world."
)
# Texts have a fixed length, padded with zeros. HDF5 reads variable-length texts through a heap, and crashes
# if that is damaged.
UNIT_TOLERANCE = (
    1e-5  # of a quaternion's length; quaternions printed with six decimals are not exactly unit
)


class Role(StrEnum):
    """Purpose of a group of frames."""

    TRAIN = "train"
    VALIDATION = "validation"
    TEST = "test"


@dataclass(frozen=True)
class SchemaColumn:
    """HDF5 dataset of a group, with one row per frame or per point.

    dtype : NumPy type, S256 is UTF-8 of at most 256 bytes; tail : shape of a row; description : text of its
    attribute "description".
    """

    dtype: str
    tail: tuple[int, ...]
    description: str


COLUMNS: dict[str, SchemaColumn] = {
    "names": SchemaColumn("S256", (), "<sequence>/<frame>, unique in the file"),
    "sequences": SchemaColumn("S128", (), "flight that the frame is from"),
    "strata": SchemaColumn(
        "S8", (), "coverage by the mapping frames: high, medium, low; empty: unknown"
    ),
    "time_s": SchemaColumn("<f8", (), "seconds since the sequence's first frame"),
    "dense": SchemaColumn("u1", (), "1: a video frame that was not chosen for the map"),
    "centers": SchemaColumn("<f8", (3,), "camera centre in the world"),
    "quats_wxyz": SchemaColumn("<f8", (4,), "unit quaternion, world to camera, scalar first"),
    "covariance": SchemaColumn(
        "<f8", (6, 6), "of the pose: centre, then rotation vector in radians"
    ),
    "intrinsics": SchemaColumn("<f8", (3, 3), "K in pixels of the image; there is no distortion"),
    "mask_idx": SchemaColumn(
        "<i4", (), "row of masks that holds the frame's valid pixels; -1: all are valid"
    ),
}
POINTS: dict[str, SchemaColumn] = {
    "ids": SchemaColumn("<i8", (), "id of the point in the map's COLMAP model"),
    "pixels": SchemaColumn("<f4", (2,), "where it was measured, moved into this image"),
    "xyz": SchemaColumn("<f8", (3,), "its position in the world"),
}
OFFSETS = SchemaColumn("<i8", (), "points of frame k are rows offsets[k] to offsets[k + 1]")
IMAGES = "height x width x RGB"
MASKS = "1: the pixel shows the scene; 0: outside the camera's view, or masked out"


@dataclass(frozen=True, eq=False, kw_only=True)
class DatasetInfo:
    """Properties of a whole data set.

    Attributes
    ----------
    units : str
        "m", or "model" for a world with an arbitrary unit.
    origin : GeoOrigin or None
        Origin of the East-North-Up world; None if the world is not georeferenced.
    up_is_known : bool
        Whether z points up.
    camera : Camera or None
        Pinhole camera shared by all images; None if frames have their own intrinsics.
    has_images : bool
        Whether the data set contains images.
    optimistic : bool
        Whether test frames come from flights used for training.
    split : mapping of str to Any
        How the frames were split, as plain values.
    fingerprints : mapping of str to str
        Fingerprints of the inputs, by name.
    notes : tuple of str
        Sentences for the user.
    offset : tuple of float
        World position of the zero of the file's arrays `centers` and `points/xyz`; zero unless the world's
        coordinates are too large for float32.
    """

    units: str
    origin: GeoOrigin | None
    up_is_known: bool
    camera: Camera | None
    has_images: bool = True
    optimistic: bool = False
    split: Mapping[str, Any] = field(default_factory=dict)
    fingerprints: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.units not in ("m", "model"):
            raise ValueError(f"units must be 'm' or 'model', got {self.units!r}")
        if len(self.offset) != 3 or not np.isfinite(self.offset).all():
            raise ValueError(f"the offset {self.offset} is not a position")

    def to_attributes(self) -> dict[str, Any]:
        """Return the attributes of the root group."""
        origin = self.origin
        documents = {
            "camera": None if self.camera is None else camera_to_json(self.camera),
            "split": dict(self.split),
            "fingerprints": dict(self.fingerprints),
            "notes": list(self.notes),
        }
        return {
            "format": FORMAT,
            "version": OFFSET_VERSION if any(self.offset) else VERSION,
            "conventions": CONVENTIONS + (_OFFSET_CONVENTION if any(self.offset) else ""),
            "units": self.units,
            "has_origin": int(origin is not None),
            "origin_lat_deg": np.nan if origin is None else origin.lat_deg,
            "origin_lon_deg": np.nan if origin is None else origin.lon_deg,
            "origin_alt_m": np.nan if origin is None else origin.alt_m,
            "height_reference": (
                HeightReference.UNKNOWN if origin is None else origin.height_reference
            ).value,
            "up_is_known": int(self.up_is_known),
            "has_images": int(self.has_images),
            "optimistic": int(self.optimistic),
            **{name: json.dumps(value, sort_keys=True) for name, value in documents.items()},
            **(dict(zip(OFFSET, map(float, self.offset), strict=True)) if any(self.offset) else {}),
        }

    @classmethod
    def from_attributes(cls, attributes: Mapping[str, Any]) -> DatasetInfo:
        """Restore from the attributes of the root group.

        Raises KeyError, TypeError or ValueError if they do not follow the schema.
        """
        camera = _json(attributes["camera"])
        split, prints, notes = (_json(attributes[n]) for n in ("split", "fingerprints", "notes"))
        if not (isinstance(split, dict) and isinstance(prints, dict) and isinstance(notes, list)):
            raise ValueError("split, fingerprints or notes have the wrong type")
        return cls(
            units=_text(attributes["units"]),
            origin=_origin(attributes) if flag(attributes["has_origin"]) else None,
            up_is_known=flag(attributes["up_is_known"]),
            camera=None if camera is None else camera_from_json(camera),
            has_images=flag(attributes["has_images"]),
            optimistic=flag(attributes["optimistic"]),
            split=split,
            fingerprints={str(k): str(v) for k, v in prints.items()},
            notes=tuple(str(note) for note in notes),
            offset=_offset(attributes),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class DatasetFrame:
    """Frame with its label, to be written.

    Attributes
    ----------
    name, sequence : str
        Name of the frame, unique in the file, and of its sequence.
    time_s : float
        Seconds since the first frame of the sequence.
    center : ndarray, shape (3,)
        Camera centre in the world.
    quat_wxyz : ndarray, shape (4,)
        Unit quaternion from world to camera, scalar first, w >= 0.
    intrinsics : ndarray, shape (3, 3)
        Camera matrix in pixels of the image; NaN if unknown.
    covariance : ndarray, shape (6, 6)
        Pose covariance (centre, rotation vector); NaN if unknown.
    tracked : bool
        Whether this is a tracked frame.
    stratum : str
        "high", "medium", "low", or "" if unknown.
    image : ndarray of uint8, shape (H, W, 3), or None
        RGB image; None in a data set without images.
    valid : ndarray of bool, shape (H, W), or None
        Mask of valid pixels; None if all are valid.
    point_ids : ndarray of int, shape (K,)
        Ids of map points seen by the frame.
    point_pixels : ndarray, shape (K, 2)
        Their pixels in this image.
    point_xyz : ndarray, shape (K, 3)
        Their positions in the world.
    """

    name: str
    sequence: str
    time_s: float
    center: np.ndarray
    quat_wxyz: np.ndarray
    intrinsics: np.ndarray
    covariance: np.ndarray = field(default_factory=lambda: np.full((6, 6), np.nan))
    tracked: bool = False
    stratum: str = ""
    image: np.ndarray | None = None
    valid: np.ndarray | None = None
    point_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    point_pixels: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    point_xyz: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"expected text, found {type(value).__name__}")
    return value


def flag(value: Any) -> bool:
    """Convert an attribute to bool; raise ValueError if it is neither 0 nor 1."""
    if int(value) not in (0, 1):
        raise ValueError(f"{value!r} is neither 0 nor 1")
    return bool(int(value))


def _json(value: Any) -> Any:
    return parse_json(_text(value))


def _offset(attributes: Mapping[str, Any]) -> tuple[float, float, float]:
    offset = tuple(float(attributes[name]) for name in OFFSET if name in attributes)
    if int(attributes["version"]) == VERSION and not offset:
        return 0.0, 0.0, 0.0
    if int(attributes["version"]) != OFFSET_VERSION or len(offset) != 3 or not any(offset):
        raise ValueError("its version and its offset contradict each other")
    return offset


def _origin(attributes: Mapping[str, Any]) -> GeoOrigin:
    names = ("origin_lat_deg", "origin_lon_deg", "origin_alt_m")
    lat_deg, lon_deg, alt_m = (float(attributes[name]) for name in names)
    if not (abs(lat_deg) <= 90 and abs(lon_deg) <= 360 and abs(alt_m) < 1e5):
        raise ValueError(f"the origin {lat_deg}, {lon_deg}, {alt_m} is not a valid location")
    reference = HeightReference(_text(attributes["height_reference"]))
    return GeoOrigin(lat_deg, lon_deg, alt_m, reference)
