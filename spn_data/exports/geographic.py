"""Positions on the globe with headings, for GeoJSON and KML."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.exports.exported_frames import ExportedFrames
from spn_data.geometry.geodesy import HeightReference
from spn_data.geometry.pose import angles_from_rotations


@dataclass(frozen=True, eq=False)
class Places:
    """lat_lon_deg : (N, 2) WGS84; height_m : (N,) above `reference`; heading_pitch_roll_deg : (N, 3)."""

    lat_lon_deg: np.ndarray
    height_m: np.ndarray
    reference: HeightReference
    heading_pitch_roll_deg: np.ndarray


def places_of(frames: ExportedFrames, what: str) -> Places:
    """Raises StageError where the area has no place in the world."""
    origin = frames.required_origin(what)
    lat_lon_height = origin.wgs84_from_enu(frames.labels.poses.centers)
    return Places(
        lat_lon_height[:, :2],
        lat_lon_height[:, 2],
        origin.height_reference,
        angles_from_rotations(frames.labels.poses.rotations),
    )
