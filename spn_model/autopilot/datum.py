"""Geodetic positions of a local world, with heights above the ellipsoid and above sea level kept apart."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_model.autopilot.projection import Projection, north_east

_MAX_GEOID_M = 120.0  # geoid undulations are -107 to +86 m
_MAX_HEIGHT_M = 20_000.0


@dataclass(frozen=True, kw_only=True)
class Geodetic:
    """A position on the Earth; NaN where a height is unknown.

    Attributes
    ----------
    lat_deg, lon_deg : float
        WGS84 latitude and longitude.
    ellipsoid_m, amsl_m : float
        Height above the WGS84 ellipsoid and above mean sea level.
    """

    lat_deg: float
    lon_deg: float
    ellipsoid_m: float
    amsl_m: float


@dataclass(frozen=True, kw_only=True)
class Datum:
    """Where the world is on the Earth.

    Attributes
    ----------
    origin : GeoOrigin
        Origin of the world's East-North-Up frame, with the reference of its height.
    geoid_height_m : float, optional
        Height of the geoid above the ellipsoid at the origin (undulation). No geoid model is built in:
        without it, the height for the other reference is unknown.

    Raises
    ------
    InputError
        If a number is not finite or out of range.
    """

    origin: GeoOrigin
    geoid_height_m: float | None = None

    def __post_init__(self) -> None:
        place = (self.origin.lat_deg, self.origin.lon_deg, self.origin.alt_m)
        limits = (90.0, 180.0, _MAX_HEIGHT_M)
        if not all(
            math.isfinite(v) and abs(v) <= most for v, most in zip(place, limits, strict=True)
        ):
            raise InputError(f"the origin of the world is at {place}: no place on the Earth")
        geoid = self.geoid_height_m
        if geoid is not None and not (math.isfinite(geoid) and abs(geoid) <= _MAX_GEOID_M):
            raise InputError(
                f"the geoid height is {geoid!r} m, not between -{_MAX_GEOID_M:g} and {_MAX_GEOID_M:g}"
            )

    def geodetic(self, enu: np.ndarray) -> Geodetic:
        """Return the position on the Earth of a point (3,) in the world."""
        lat, lon, height = (float(v) for v in self.origin.wgs84_from_enu(enu))
        return Geodetic(
            lat_deg=lat,
            lon_deg=lon,
            ellipsoid_m=self._height(height, HeightReference.ELLIPSOID),
            amsl_m=self._height(height, HeightReference.AMSL),
        )

    def require_amsl(self) -> None:
        """Raise InputError if heights above sea level are unknown, in which autopilots state their origin."""
        if math.isnan(self.geodetic(np.zeros(3)).amsl_m):
            known = self.origin.height_reference.value
            raise InputError(
                f"the height of the world's origin is known above '{known}' only, but an autopilot needs it "
                "above sea level: give the geoid height (--geoid-height) or, where heights count from "
                "take-off, that of the take-off point (--takeoff-height)"
            )

    def local_ned(self, enu: np.ndarray, origin: Geodetic, projection: Projection) -> np.ndarray:
        """Return a point of the world in an autopilot's local frame.

        Parameters
        ----------
        enu : ndarray, shape (3,)
            Point in the world, metres.
        origin : Geodetic
            Origin of the autopilot.
        projection : Projection
            Its own, for north and east.

        Returns
        -------
        ndarray, shape (3,)
            North, east, and down: a difference of heights above sea level.
        """
        place = self.geodetic(enu)
        north, east = north_east(
            projection, (place.lat_deg, place.lon_deg), (origin.lat_deg, origin.lon_deg)
        )
        return np.array([north, east, origin.amsl_m - place.amsl_m])

    def _height(self, height_m: float, wanted: HeightReference) -> float:
        """Convert a height of the origin's reference; NaN if that is impossible."""
        known = self.origin.height_reference
        if known == wanted:
            return height_m
        if self.geoid_height_m is None or known not in (
            HeightReference.ELLIPSOID,
            HeightReference.AMSL,
        ):
            return math.nan
        return height_m + (
            self.geoid_height_m if known == HeightReference.AMSL else -self.geoid_height_m
        )
