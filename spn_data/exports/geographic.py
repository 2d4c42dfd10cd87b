"""WGS84 positions and headings of cameras, for GeoJSON and KML."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.exports.exported_frames import ExportedFrames
from spn_data.geometry.geodesy import HeightReference
from spn_data.geometry.rotations import angles_from_rotations


@dataclass(frozen=True, eq=False)
class GeographicPoses:
    """Camera poses of N frames on the globe.

    lat_lon_deg : (N, 2), WGS84. height_m : (N,), above `reference`. heading_pitch_roll_deg : (N, 3).
    """

    lat_lon_deg: np.ndarray
    height_m: np.ndarray
    reference: HeightReference
    heading_pitch_roll_deg: np.ndarray


def geographic_poses(frames: ExportedFrames, what: str) -> GeographicPoses:
    """Convert the poses of frames to WGS84; raise StageError if the map is not georegistered.

    what : name of the format that needs them, for the error message.
    """
    origin = frames.required_origin(what)
    lat_lon_height = origin.wgs84_from_enu(frames.labels.poses.centers)
    return GeographicPoses(
        lat_lon_height[:, :2],
        lat_lon_height[:, 2],
        origin.height_reference,
        angles_from_rotations(frames.labels.poses.rotations),
    )
