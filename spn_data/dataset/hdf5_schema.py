"""dataset.h5: what it holds, under which names (docs/dataset.md, for readers in other languages too)."""

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

FORMAT = "squeezeposenet-dataset"
VERSION = 1
CONVENTIONS = (
    "World: East, North, Up in metres about the origin where units is 'm' and has_origin is 1. "
    "centers: camera centre in the world. quats_wxyz: unit, scalar first, w >= 0, turns world axes into "
    "camera axes (x right, y down, z forward): x_cam = R(q) (x_world - center). covariance: over (centre; "
    "rotation vector v in the camera frame, radians), R_true = exp(v) R, relative to the map. Pixels: x "
    "right, y down, the centre of the upper-left pixel is (0.5, 0.5); so in intrinsics and points. Images "
    "are RGB, without distortion. NaN is unknown."
)
# Texts have a fixed length, padded with zeros: HDF5 reads those of variable length through a heap, whose
# damage it does not survive.
UNIT_TOLERANCE = 1e-5  # of a quaternion: printed with six decimals, it is unit only to this


class Role(StrEnum):
    """What a group of frames is for."""

    TRAIN = "train"
    VALIDATION = "validation"
    TEST = "test"


@dataclass(frozen=True)
class SchemaColumn:
    """A dataset of a group: one row a frame, or a point; tail : shape of a row; says : for its attribute.

    dtype : of NumPy; S256 is UTF-8 of at most 256 bytes.
    """

    dtype: str
    tail: tuple[int, ...]
    says: str


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
    """What holds for a whole data set.

    units : "m", or "model" for a world whose unit means nothing. origin : of the East-North-Up world; None
    where it has no known place. up_is_known : z points up. camera : the one pinhole of all images; None
    where frames have their own. split : how frames were divided, plain values. optimistic : test frames are
    from the flights that train. fingerprints : of what it was made from, by name. notes : for the user.
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

    def __post_init__(self) -> None:
        if self.units not in ("m", "model"):
            raise ValueError(f"units {self.units!r} are neither m nor model")

    def to_attributes(self) -> dict[str, Any]:
        """Values of the root's attributes."""
        place = self.origin
        documents = {
            "camera": None if self.camera is None else camera_to_json(self.camera),
            "split": dict(self.split),
            "fingerprints": dict(self.fingerprints),
            "notes": list(self.notes),
        }
        return {
            "format": FORMAT,
            "version": VERSION,
            "conventions": CONVENTIONS,
            "units": self.units,
            "has_origin": int(place is not None),
            "origin_lat_deg": np.nan if place is None else place.lat_deg,
            "origin_lon_deg": np.nan if place is None else place.lon_deg,
            "origin_alt_m": np.nan if place is None else place.alt_m,
            "height_reference": (
                HeightReference.UNKNOWN if place is None else place.height_reference
            ).value,
            "up_is_known": int(self.up_is_known),
            "has_images": int(self.has_images),
            "optimistic": int(self.optimistic),
            **{name: json.dumps(value, sort_keys=True) for name, value in documents.items()},
        }

    @classmethod
    def from_attributes(cls, attributes: Mapping[str, Any]) -> DatasetInfo:
        """Raises KeyError, TypeError or ValueError where they are not those that are written."""
        camera = _json(attributes["camera"])
        split, prints, notes = (_json(attributes[n]) for n in ("split", "fingerprints", "notes"))
        if not (isinstance(split, dict) and isinstance(prints, dict) and isinstance(notes, list)):
            raise ValueError("split, fingerprints or notes are not what is written there")
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
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class DatasetFrame:
    """One frame with its label, as it is written.

    center (3,), quat_wxyz (4,), covariance (6, 6; NaN where unknown), intrinsics (3, 3; NaN where
    unknown). stratum : "high", "medium", "low" or "". image : (H, W, 3) uint8 RGB, None in a data set
    without images. valid : (H, W) bool, None where all pixels are. point_ids (K,), point_pixels (K, 2) in
    this image, point_xyz (K, 3) in the world: map points that it sees.
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
        raise TypeError(f"{type(value).__name__} where text belongs")
    return value


def flag(value: Any) -> bool:
    """Of an attribute; ValueError for what is neither 0 nor 1."""
    if int(value) not in (0, 1):
        raise ValueError(f"{value!r} is neither 0 nor 1")
    return bool(int(value))


def _json(value: Any) -> Any:
    return json.loads(_text(value))


def _origin(attributes: Mapping[str, Any]) -> GeoOrigin:
    names = ("origin_lat_deg", "origin_lon_deg", "origin_alt_m")
    lat_deg, lon_deg, alt_m = (float(attributes[name]) for name in names)
    if not (abs(lat_deg) <= 90 and abs(lon_deg) <= 360 and abs(alt_m) < 1e5):
        raise ValueError(f"the origin {lat_deg}, {lon_deg}, {alt_m} is no place")
    reference = HeightReference(_text(attributes["height_reference"]))
    return GeoOrigin(lat_deg, lon_deg, alt_m, reference)
