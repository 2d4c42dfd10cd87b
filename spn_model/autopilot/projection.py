"""How autopilots project latitude and longitude onto their local plane, which is not exactly metric.

In true metres, a map would disagree with their waypoints and GNSS by up to 0.5 % of the distance.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np

_PX4_RADIUS_M = 6_371_000.0  # CONSTANTS_RADIUS_OF_EARTH
_ARDUPILOT_M_PER_DEGREE = 0.011131884502145034e7  # LATLON_TO_M, per 1e-7 degrees


class Projection(StrEnum):
    """A projection."""

    PX4 = "px4"  # azimuthal equidistant, on a sphere (geo.cpp, MapProjection::project)
    ARDUPILOT = (
        "ardupilot"  # cylindrical, with the mean latitude's cosine (Location::get_distance_NE)
    )


def north_east(
    projection: Projection, lat_lon_deg: tuple[float, float], origin_deg: tuple[float, float]
) -> tuple[float, float]:
    """Return north and east of an origin in an autopilot's own metres, of latitudes and longitudes."""
    (lat, lon), (lat_0, lon_0) = lat_lon_deg, origin_deg
    turn = (lon - lon_0 + 180.0) % 360.0 - 180.0
    if projection == Projection.ARDUPILOT:
        cosine = np.cos(np.deg2rad((lat + lat_0) / 2))
        return (
            float((lat - lat_0) * _ARDUPILOT_M_PER_DEGREE),
            float(turn * _ARDUPILOT_M_PER_DEGREE * cosine),
        )
    sin, cos = np.sin(np.deg2rad([lat, lat_0])), np.cos(np.deg2rad([lat, lat_0]))
    east, north = (
        cos[0] * np.sin(np.deg2rad(turn)),
        cos[1] * sin[0] - sin[1] * cos[0] * np.cos(np.deg2rad(turn)),
    )
    # The angle to the origin: its sine is the length of (east, north), which is exact near zero too.
    sine = np.hypot(east, north)
    angle = np.arctan2(sine, sin[1] * sin[0] + cos[1] * cos[0] * np.cos(np.deg2rad(turn)))
    k = angle / sine if sine > 0 else 1.0
    return float(k * north * _PX4_RADIUS_M), float(k * east * _PX4_RADIUS_M)
