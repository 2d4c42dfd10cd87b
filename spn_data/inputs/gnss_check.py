"""Comparison of the labels of an evaluation flight with its own GNSS fixes, which they do not use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.grouping import runs_of
from spn_data.georegistration.georegister_options import (
    RELATIVE_HEIGHT_BIAS_M,
    default_bias_m,
    default_sigma_m,
)
from spn_data.georegistration.offset import estimate_time_offset
from spn_data.georegistration.result import GeoFit
from spn_data.labels.labels import Labels
from spn_data.telemetry.track import Telemetry

_MIN_FIXES = 5
_DOUBTFUL_FOCAL = 0.01  # relative error of the map's focal length, from which a witness is of use
_FAR_FIX, _FAR_SCATTER = 5.0, 10.0  # standard deviations of a fix; median distances
_FAR_RUN = 3  # frames in a row
_CONTRADICTION = 3.0  # standard deviations of the offset, from GNSS and georegistration


@dataclass(frozen=True, kw_only=True)
class GnssCheck:
    """Difference between fixes and labels, in metres.

    An offset common to all frames is mostly due to GNSS and georegistration.

    Attributes
    ----------
    fixes : int
        Number of frames with a label and a fix.
    time_offset_s : float
        Added to the times of the telemetry; 0 if the flight does not determine it.
    offset_e_m, offset_n_m, offset_u_m : float
        Median of fix minus label; `offset_u_m` is None if there is no comparable height.
    scatter_h_m, scatter_v_m : float
        Median distance of the frames from these medians; `scatter_v_m` may be None.
    max_h_m : float
        Largest horizontal distance.
    far : int
        Number of frames farther than `far_limit_m` from the median offset, horizontally, without those that
        are fewer than three in a row: such are the outliers of a receiver.
    far_limit_m : float
        Five standard deviations of a fix about the error that all fixes of a flight share, or ten of the
        distances found.
    sigma_h_m, sigma_v_m : float
        Standard deviation of the offset, from the uncertainties of the map and of such fixes; `sigma_v_m`
        may be None.
    contradicts : bool
        Whether the offset exceeds three times that.
    """

    fixes: int
    time_offset_s: float
    offset_e_m: float
    offset_n_m: float
    offset_u_m: float | None
    scatter_h_m: float
    scatter_v_m: float | None
    max_h_m: float
    far: int
    far_limit_m: float
    sigma_h_m: float
    sigma_v_m: float | None
    contradicts: bool

    @property
    def offset_h_m(self) -> float:
        """Horizontal offset."""
        return float(np.hypot(self.offset_e_m, self.offset_n_m))

    def describe(self) -> str:
        """Return a note for the user, with a warning if fixes and labels contradict each other."""
        vertical = (
            "; no height to compare"
            if self.offset_u_m is None
            else f", vertically {self.offset_u_m:+.2f} m (half within {self.scatter_v_m:.2f} m)"
        )
        text = (
            f"its own GNSS fixes (not used) differ from the labels by {self.offset_h_m:.2f} m horizontally "
            f"(median; half of {self.fixes} frames within {self.scatter_h_m:.2f} m of it)"
            + vertical
        )
        if self.far:
            text += (
                f". {self.far} of its frames are more than {self.far_limit_m:.0f} m off, up to "
                f"{self.max_h_m:.0f} m: their labels show a place that looks alike, or these fixes are wrong"
            )
        if self.contradicts:
            text += (
                ". This exceeds the uncertainty of georegistration and GNSS "
                f"({self.sigma_h_m:.2f} m horizontally"
                + ("" if self.sigma_v_m is None else f", {self.sigma_v_m:.2f} m vertically")
                + "; 1 sigma): the map, a lens or the height reference is wrong"
            )
        return text


def check_gnss(
    labels: Labels, track: Telemetry, geo: GeoFit, *, time_is_known: bool = False
) -> GnssCheck | None:
    """Compare registered frames with the fixes of their telemetry.

    Parameters
    ----------
    labels : Labels
        Frames of one sequence, in the world frame.
    track : Telemetry
    geo : GeoFit
        Georegistration of the map.
    time_is_known : bool, optional
        Whether the telemetry is on the clock of the video; otherwise its time offset is estimated.

    Returns
    -------
    GnssCheck or None
        None if fewer than five registered frames have a fix.
    """
    origin = geo.origin
    registered = labels.select(labels.registered)
    if len(registered) < _MIN_FIXES:
        return None
    offset_s = 0.0
    if track.kind != "exif" and not time_is_known:
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
    far_limit_m = max(
        _FAR_FIX * float(np.hypot(*default_sigma_m(track.kind)[:2])),
        _FAR_SCATTER * float(np.median(horizontal)),
    )
    vertical = difference[has_height, 2]
    compares_height = len(vertical) >= _MIN_FIXES
    offset_u = float(np.median(vertical)) if compares_height else None
    # Fixes of one flight share their error: many are hardly better than one.
    bias = default_bias_m(track.kind)
    if origin.height_reference is HeightReference.TAKEOFF:
        bias[2] = RELATIVE_HEIGHT_BIAS_M
    fix_sigma = np.hypot(default_sigma_m(track.kind), bias)
    sigma_h = float(np.hypot(geo.uncertainty.horizontal_m, np.hypot(*fix_sigma[:2])))
    sigma_v = float(np.hypot(geo.uncertainty.vertical_m, fix_sigma[2])) if compares_height else None
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
        far=_count_in_runs(horizontal > far_limit_m),
        far_limit_m=round(far_limit_m, 4),
        sigma_h_m=round(sigma_h, 4),
        sigma_v_m=None if sigma_v is None else round(sigma_v, 4),
        contradicts=bool(too_far),
    )


def _count_in_runs(mask: np.ndarray) -> int:
    """Return the number of true elements (N,) that are at least three in a row."""
    starts, ends = runs_of(mask)
    lengths = ends - starts
    return int(lengths[lengths >= _FAR_RUN].sum())


def focal_witness_notes(
    check: GnssCheck, distance_m: float, lens_error: float, map_error: float
) -> list[str]:
    """Return what the heights of a flight say about the focal length of the map, if that is in doubt.

    If the map's focal length is too short, what it shows is too near to its cameras, by the same share of the
    viewing distance, and a flight whose own focal length is right is placed too high by as much.

    Parameters
    ----------
    check : GnssCheck
        Comparison of the flight's labels with its own fixes.
    distance_m : float
        Viewing distance of the map.
    lens_error : float
        Relative standard deviation of the flight's own focal length.
    map_error : float
        That of the map's.

    Returns
    -------
    list of str
        At most one sentence.
    """
    if check.offset_u_m is None or check.sigma_v_m is None or map_error < _DOUBTFUL_FOCAL:
        return []
    share = check.offset_u_m / distance_m
    sigma = float(np.hypot(check.sigma_v_m / distance_m, lens_error))
    verdict = (
        "which contradicts that"
        if abs(share) > 2 * np.hypot(sigma, map_error)
        else "which agrees with that"
    )
    return [
        f"a second witness of the map's focal length, which the map knows to {map_error:.1%}: this flight's "
        f"GNSS heights, {check.offset_u_m:+.1f} m off at a viewing distance of {distance_m:.0f} m, make it "
        f"{abs(share):.1%} too {'short' if share < 0 else 'long'} (sigma {sigma:.1%}), {verdict}. "
        "Mapping both flights together (reconstruct --add) determines it better"
    ]


def _height(rows: Telemetry, origin: GeoOrigin) -> np.ndarray:
    """Return (N,) heights with the height reference of the origin; NaN if there are none."""
    if origin.height_reference is HeightReference.TAKEOFF:
        return rows.rel_alt_m + origin.alt_m
    if origin.height_reference == rows.abs_reference:
        return rows.abs_alt_m
    return np.full(len(rows), np.nan)
