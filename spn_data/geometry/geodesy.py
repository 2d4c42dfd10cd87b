"""WGS84 and local East-North-Up coordinates, and height references."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

# WGS84 (NIMA TR8350.2, 2000).
SEMI_MAJOR_M = 6378137.0
FLATTENING = 1 / 298.257223563
ECCENTRICITY_2 = FLATTENING * (2 - FLATTENING)

# A sphere is enough for distances within one flight.
MEAN_RADIUS_M = 6_371_000.0
METRES_PER_DEGREE = 111_195.0  # of latitude on that sphere, rounded


class HeightReference(StrEnum):
    """The reference surface of a height."""

    ELLIPSOID = "ellipsoid"  # WGS84 ellipsoid
    AMSL = "amsl"  # mean sea level (a geoid model)
    TAKEOFF = "takeoff"  # the point of take-off
    UNKNOWN = "unknown"  # the source does not say


def metres_from_first_fix(lat_lon_deg: np.ndarray) -> np.ndarray:
    """Return approximate east and north offsets from the first known position.

    Equirectangular projection on a sphere: accurate enough for distances within one flight, not for
    georegistration (use `GeoOrigin` there).

    Parameters
    ----------
    lat_lon_deg : ndarray, shape (N, 2)
        WGS84 latitude and longitude in degrees; NaN if unknown.

    Returns
    -------
    ndarray, shape (N, 2)
        Metres east and north; NaN in rows without a position.
    """
    known = np.isfinite(lat_lon_deg).all(axis=1)
    if not known.any():
        return np.full((len(lat_lon_deg), 2), np.nan)
    lat, lon = np.deg2rad(lat_lon_deg).T
    lat_0, lon_0 = lat[known][0], lon[known][0]
    east, north = MEAN_RADIUS_M * (lon - lon_0) * np.cos(lat_0), MEAN_RADIUS_M * (lat - lat_0)
    return np.column_stack([east, north])


def ecef_from_wgs84(lat_lon_alt: np.ndarray) -> np.ndarray:
    """Convert geodetic WGS84 coordinates to Earth-centred, Earth-fixed coordinates.

    Parameters
    ----------
    lat_lon_alt : ndarray, shape (N, 3)
        Latitude (deg), longitude (deg), ellipsoidal height (m).

    Returns
    -------
    ndarray, shape (N, 3)
        ECEF coordinates in metres.
    """
    lat, lon = np.deg2rad(lat_lon_alt[..., 0]), np.deg2rad(lat_lon_alt[..., 1])
    alt = lat_lon_alt[..., 2]
    n = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY_2 * np.sin(lat) ** 2)
    return np.stack(
        [
            (n + alt) * np.cos(lat) * np.cos(lon),
            (n + alt) * np.cos(lat) * np.sin(lon),
            (n * (1 - ECCENTRICITY_2) + alt) * np.sin(lat),
        ],
        axis=-1,
    )


def wgs84_from_ecef(ecef: np.ndarray) -> np.ndarray:
    """Convert Earth-centred, Earth-fixed coordinates to geodetic WGS84 coordinates.

    Parameters
    ----------
    ecef : ndarray, shape (N, 3)
        ECEF coordinates in metres.

    Returns
    -------
    ndarray, shape (N, 3)
        Latitude (deg), longitude (deg), ellipsoidal height (m).

    Notes
    -----
    Fixed-point iteration on the latitude; six iterations converge to below a nanometre near the surface.
    """
    x, y, z = np.moveaxis(np.asarray(ecef, dtype=np.float64), -1, 0)
    p = np.hypot(x, y)
    lat = np.arctan2(z, p * (1 - ECCENTRICITY_2))
    for _ in range(6):
        n = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY_2 * np.sin(lat) ** 2)
        lat = np.arctan2(z + ECCENTRICITY_2 * n * np.sin(lat), p)
    n = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY_2 * np.sin(lat) ** 2)
    # This form of the height is also valid at the poles.
    alt = p * np.cos(lat) + z * np.sin(lat) - SEMI_MAJOR_M**2 / n
    return np.stack([np.rad2deg(lat), np.rad2deg(np.arctan2(y, x)), alt], axis=-1)


@dataclass(frozen=True)
class GeoOrigin:
    """Origin of a local East-North-Up frame.

    Attributes
    ----------
    lat_deg, lon_deg : float
        WGS84 latitude and longitude.
    alt_m : float
        Height of the origin above `height_reference`.
    height_reference : HeightReference
        What `alt_m` refers to.

    Notes
    -----
    If the reference is not the ellipsoid, `alt_m` is used as if it were an ellipsoidal height. This neither
    tilts nor scales the frame; horizontal coordinates are off by at most 8 ppm per 50 m of undulation. The
    reference is stored and no correction is applied.
    """

    lat_deg: float
    lon_deg: float
    alt_m: float
    height_reference: HeightReference = HeightReference.ELLIPSOID

    def plain(self) -> dict[str, float | str]:
        """Return the origin as plain values for JSON."""
        return {
            "lat_deg": self.lat_deg,
            "lon_deg": self.lon_deg,
            "alt_m": self.alt_m,
            "height_reference": self.height_reference.value,
        }

    def _ecef_and_axes(self) -> tuple[np.ndarray, np.ndarray]:
        lat, lon = np.deg2rad(self.lat_deg), np.deg2rad(self.lon_deg)
        origin = ecef_from_wgs84(np.array([self.lat_deg, self.lon_deg, self.alt_m]))
        enu_from_ecef = np.array(
            [
                [-np.sin(lon), np.cos(lon), 0.0],
                [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
                [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
            ]
        )
        return origin, enu_from_ecef

    def enu_from_wgs84(self, lat_lon_alt: np.ndarray) -> np.ndarray:
        """Convert geodetic coordinates to East-North-Up coordinates.

        Parameters
        ----------
        lat_lon_alt : ndarray, shape (N, 3)
            Latitude (deg), longitude (deg), height (m).

        Returns
        -------
        ndarray, shape (N, 3)
            East, north, up in metres.
        """
        origin, enu_from_ecef = self._ecef_and_axes()
        return (
            ecef_from_wgs84(np.asarray(lat_lon_alt, dtype=np.float64)) - origin
        ) @ enu_from_ecef.T

    def wgs84_from_enu(self, enu: np.ndarray) -> np.ndarray:
        """Convert East-North-Up coordinates to geodetic coordinates.

        Parameters
        ----------
        enu : ndarray, shape (N, 3)
            East, north, up in metres.

        Returns
        -------
        ndarray, shape (N, 3)
            Latitude (deg), longitude (deg), height (m).
        """
        origin, enu_from_ecef = self._ecef_and_axes()
        return wgs84_from_ecef(np.asarray(enu, dtype=np.float64) @ enu_from_ecef + origin)
