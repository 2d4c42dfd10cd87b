"""Labels of an evaluation flight against its own GNSS, which they were made without."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.georegistration.georegister_options import default_sigma_m
from spn_data.georegistration.offset import estimate_time_offset
from spn_data.georegistration.result import GeoFit
from spn_data.labels.labels import Labels
from spn_data.telemetry.track import Telemetry

_MIN_FIXES = 5
_CONTRADICTION = 3.0  # standard deviations of what GNSS and the map's place account for


@dataclass(frozen=True, kw_only=True)
class GnssCheck:
    """Fix minus label, metres; an offset that all frames share is mostly GNSS's own, and the map's.

    fixes : frames with a label and a fix; time_offset_s : added to telemetry's times, 0 where the flight
    cannot tell. offset_e_m, offset_n_m, offset_u_m : medians (None: no comparable height).
    scatter_h_m, scatter_v_m : within which half of the frames lie about them; max_h_m : the largest.
    sigma_h_m, sigma_v_m : of the offset, by the map's uncertainty and that of such fixes.
    contradicts : whether the offset is more than three times that.
    """

    fixes: int
    time_offset_s: float
    offset_e_m: float
    offset_n_m: float
    offset_u_m: float | None
    scatter_h_m: float
    scatter_v_m: float | None
    max_h_m: float
    sigma_h_m: float
    sigma_v_m: float | None
    contradicts: bool

    @property
    def offset_h_m(self) -> float:
        return float(np.hypot(self.offset_e_m, self.offset_n_m))

    def tell(self) -> str:
        vertical = (
            "; no height to compare"
            if self.offset_u_m is None
            else f", {self.offset_u_m:+.2f} m vertically (half within {self.scatter_v_m:.2f} m)"
        )
        text = (
            f"its own GNSS, not used, lies {self.offset_h_m:.2f} m beside the labels in the middle (half of "
            f"{self.fixes} frames within {self.scatter_h_m:.2f} m of that)" + vertical
        )
        if self.contradicts:
            text += (
                f". That is more than the map's place and GNSS account for ({self.sigma_h_m:.2f} m"
                + ("" if self.sigma_v_m is None else f", {self.sigma_v_m:.2f} m vertically")
                + "; 1 sigma): the map, its lens or this one is wrong, or the heights count from elsewhere"
            )
        return text


def check_gnss(labels: Labels, track: Telemetry, geo: GeoFit) -> GnssCheck | None:
    """Compare registered frames with telemetry; None with fewer than five fixes among them.

    geo : how the map was put into the world.
    """
    origin = geo.origin
    registered = labels.select(labels.registered)
    if len(registered) < _MIN_FIXES:
        return None
    offset_s = 0.0
    if track.kind != "exif":
        estimated = estimate_time_offset(registered.poses, registered.time_s, track)
        offset_s = estimated.applied_s
    rows = track.shifted(offset_s).at(registered.time_s)
    known = rows.has_fix
    if known.sum() < _MIN_FIXES:
        return None
    height = _height(rows, origin)
    lat_lon_alt = np.column_stack([rows.lat_lon_deg, np.nan_to_num(height, nan=origin.alt_m)])
    difference = origin.enu_from_wgs84(lat_lon_alt[known]) - registered.poses.centers[known]
    middle = np.median(difference, axis=0)
    away = difference - middle
    horizontal = np.hypot(away[:, 0], away[:, 1])
    has_height = np.isfinite(height[known])
    vertical = difference[has_height, 2]
    tells_height = len(vertical) >= _MIN_FIXES
    offset_u = float(np.median(vertical)) if tells_height else None
    of_kind = default_sigma_m(track.kind)
    # Fixes of one flight share their error: many are hardly better than one.
    sigma_h = float(np.hypot(geo.uncertainty.horizontal_m, np.hypot(*of_kind[:2])))
    sigma_v = float(np.hypot(geo.uncertainty.vertical_m, of_kind[2])) if tells_height else None
    too_far = float(np.hypot(*middle[:2])) > _CONTRADICTION * sigma_h
    if offset_u is not None and sigma_v is not None:
        too_far |= abs(offset_u) > _CONTRADICTION * sigma_v
    return GnssCheck(
        fixes=int(known.sum()),
        time_offset_s=round(offset_s, 3),
        offset_e_m=round(float(middle[0]), 4),
        offset_n_m=round(float(middle[1]), 4),
        offset_u_m=None if offset_u is None else round(offset_u, 4),
        scatter_h_m=round(float(np.median(horizontal)), 4),
        scatter_v_m=None
        if offset_u is None
        else round(float(np.median(np.abs(vertical - offset_u))), 4),
        max_h_m=round(float(horizontal.max()), 4),
        sigma_h_m=round(sigma_h, 4),
        sigma_v_m=None if sigma_v is None else round(sigma_v, 4),
        contradicts=bool(too_far),
    )


def _height(rows: Telemetry, origin: GeoOrigin) -> np.ndarray:
    """(N,) heights that count from what the origin's does; NaN where none does."""
    if origin.height_reference is HeightReference.TAKEOFF:
        return rows.rel_alt_m + origin.alt_m
    if origin.height_reference == rows.abs_reference:
        return rows.abs_alt_m
    return np.full(len(rows), np.nan)
