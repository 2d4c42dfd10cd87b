"""Labels of an evaluation flight against its own GNSS, which they were made without."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.geodesy import GeoOrigin, HeightReference
from spn_data.georegister.offset import estimate_time_offset
from spn_data.labels import Labels
from spn_data.telemetry.track import Telemetry

_MIN_FIXES = 5


@dataclass(frozen=True, kw_only=True)
class GnssCheck:
    """Fix minus label, metres; an offset that all frames share is mostly GNSS's own, and the map's.

    fixes : frames with a label and a fix; time_offset_s : added to telemetry's times, 0 where the flight
    cannot tell. offset_e_m, offset_n_m, offset_u_m : medians (None: no comparable height).
    scatter_h_m, scatter_v_m : RMSE about them. max_h_m : the largest horizontal difference from the median.
    """

    fixes: int
    time_offset_s: float
    offset_e_m: float
    offset_n_m: float
    offset_u_m: float | None
    scatter_h_m: float
    scatter_v_m: float | None
    max_h_m: float

    def tell(self) -> str:
        vertical = (
            "; no height to compare"
            if self.offset_u_m is None
            else f", {self.offset_u_m:+.2f} m vertically ({self.scatter_v_m:.2f} m)"
        )
        return (
            f"its own GNSS, not used, lies {np.hypot(self.offset_e_m, self.offset_n_m):.2f} m beside "
            f"the labels in the middle ({self.scatter_h_m:.2f} m RMSE about that, {self.fixes} frames)"
            + vertical
        )


def check_gnss(labels: Labels, track: Telemetry, origin: GeoOrigin) -> GnssCheck | None:
    """Compare registered frames with telemetry; None with fewer than five fixes among them."""
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
    return GnssCheck(
        fixes=int(known.sum()),
        time_offset_s=round(offset_s, 3),
        offset_e_m=round(float(middle[0]), 4),
        offset_n_m=round(float(middle[1]), 4),
        offset_u_m=None if offset_u is None else round(offset_u, 4),
        scatter_h_m=round(float(np.sqrt((horizontal**2).mean())), 4),
        scatter_v_m=None
        if offset_u is None
        else round(float(np.sqrt(((vertical - offset_u) ** 2).mean())), 4),
        max_h_m=round(float(horizontal.max()), 4),
    )


def _height(rows: Telemetry, origin: GeoOrigin) -> np.ndarray:
    """(N,) heights that count from what the origin's does; NaN where none does."""
    if origin.height_reference is HeightReference.TAKEOFF:
        return rows.rel_alt_m + origin.alt_m
    if origin.height_reference == rows.abs_reference:
        return rows.abs_alt_m
    return np.full(len(rows), np.nan)
