"""Telemetry observations of each frame in local metres: fixes, their sigma, and the direction of up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spn_data.errors import GeometryError
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.georegistration.georegister_options import (
    LEAST_GNSS_BIAS_M,
    RELATIVE_HEIGHT_BIAS_M,
    RTK_SIGMA_M,
    GeoregisterOptions,
    Heights,
    default_bias_m,
    default_sigma_m,
)
from spn_data.telemetry.track import Telemetry

# Decimals of the origin's latitude and longitude in degrees; 6 decimals correspond to 0.1 m.
_ORIGIN_DECIMALS = 6


@dataclass(frozen=True, eq=False)
class Fixes:
    """Observations of N frames in the local frame of `origin`.

    enu_m : (N, 3), NaN if unknown (up independently of east and north); sigma_m : (N, 3); up_cam : (N, 3)
    unit direction of up in camera axes according to the gimbal, NaN if unknown; attitude : (N, 3, 3)
    cam_from_world according to the gimbal, including heading, NaN if not used; flight : (N,) index into
    `flights`; time_s : (N,) within the flight; bias_m : (N, 3) sigma of the error that all fixes of a bias
    group share; day : (F,) index of each flight's day, the same for all if a day is unknown; relative : (F,)
    bool, whether the flight's heights are above its take-off.
    """

    enu_m: np.ndarray
    sigma_m: np.ndarray
    up_cam: np.ndarray
    attitude: np.ndarray
    flight: np.ndarray
    flights: tuple[str, ...]
    time_s: np.ndarray
    bias_m: np.ndarray
    day: np.ndarray
    relative: np.ndarray
    origin: GeoOrigin
    has_heights: bool
    free_zero: bool  # nothing relates the zero of the heights to the origin's
    free_heights: bool  # each flight's heights may have a constant offset
    notes: tuple[str, ...]

    @property
    def has_fix(self) -> np.ndarray:
        """Mask (N,) of frames whose east and north are known."""
        return np.isfinite(self.enu_m[:, :2]).all(axis=1)

    @property
    def is_rtk(self) -> np.ndarray:
        """Mask (N,) of carrier-phase differential fixes (RTK, PPK)."""
        return self.sigma_m[:, :2].max(axis=1) < RTK_SIGMA_M

    @property
    def bias_group(self) -> np.ndarray:
        """Index (N,) of the set of fixes with a common bias: those of one day, differential ones apart."""
        group = self.day[self.flight] * 2 + self.is_rtk
        return np.unique(group, return_inverse=True)[1].ravel()

    def only(self, mask: np.ndarray) -> Fixes:
        """Return the same frames without the observations of frames outside the mask (N,)."""
        return replace(
            self,
            enu_m=np.where(mask[:, None], self.enu_m, np.nan),
            up_cam=np.where(mask[:, None], self.up_cam, np.nan),
            attitude=np.where(mask[:, None, None], self.attitude, np.nan),
        )


def align_telemetry(
    telemetry: Mapping[str, Telemetry],
    sequence: Sequence[str],
    time_s: np.ndarray,
    *,
    max_gap_s: float | None = None,
) -> Telemetry:
    """Interpolate each flight's telemetry at the times of its frames.

    Parameters
    ----------
    telemetry : mapping of str to Telemetry
        Telemetry by flight.
    sequence : sequence of str
        Flight of each of the N frames.
    time_s : ndarray, shape (N,)
        Time of each frame within its flight, in seconds.
    max_gap_s : float, optional
        Longest gap between records, in seconds, that is interpolated across, by default
        `Telemetry.max_gap_s` of each flight.

    Returns
    -------
    Telemetry
        One row per frame. If a source states no sigma, the default of its kind is filled in, so that flights
        with different kinds of telemetry can be fitted together. Rows of a flight without telemetry are NaN.
    """
    time_s = np.asarray(time_s, dtype=np.float64)
    names = np.asarray(sequence)
    rows = Telemetry.from_columns(time_s)
    columns = ("lat_lon_deg", "rel_alt_m", "abs_alt_m", "sigma_m", "gimbal_deg", "utc_s")
    values = {name: getattr(rows, name).copy() for name in columns}
    used = [name for name in dict.fromkeys(sequence) if name in telemetry]
    for name in used:
        mask = names == name
        part = telemetry[name].at(time_s[mask], max_gap_s=max_gap_s)
        for column in columns:
            values[column][mask] = getattr(part, column)
        sigma = values["sigma_m"][mask]
        more_m = telemetry[name].interpolation_sigma_m(time_s[mask])[:, None]
        default_m = np.hypot(default_sigma_m(part.kind), more_m)
        values["sigma_m"][mask] = np.where(np.isfinite(sigma), sigma, default_m)
    kinds = {telemetry[name].kind for name in used}
    references = {
        telemetry[name].abs_reference
        for name in used
        if np.isfinite(telemetry[name].abs_alt_m).any()
    }
    return replace(
        rows,
        **values,
        kind=kinds.pop() if len(kinds) == 1 else "",
        abs_reference=references.pop() if len(references) == 1 else HeightReference.UNKNOWN,
        source=", ".join(telemetry[name].source for name in used),
    )


def _sigma(telemetry: Telemetry, options: GeoregisterOptions) -> np.ndarray:
    """Return sigma (N, 3) east, north, up of each fix: the user's, the source's, or its kind's default."""
    if options.gnss_sigma_m is not None:
        horizontal, vertical = options.gnss_sigma_m
        return np.tile([horizontal, horizontal, vertical], (len(telemetry), 1))
    stated = telemetry.sigma_m
    return np.where(np.isfinite(stated) & (stated > 0), stated, default_sigma_m(telemetry.kind))


def _bias(
    telemetry: Telemetry, sigma_m: np.ndarray, is_relative: np.ndarray, options: GeoregisterOptions
) -> np.ndarray:
    """Return the bias sigma (N, 3) of each fix: the user's, or its kind's, less for a small sigma."""
    if options.gnss_bias_m is not None:
        horizontal, vertical = options.gnss_bias_m
        return np.tile([horizontal, horizontal, vertical], (len(telemetry), 1))
    usual = np.tile(default_bias_m(telemetry.kind), (len(telemetry), 1))
    usual[is_relative, 2] = RELATIVE_HEIGHT_BIAS_M
    horizontal, vertical = LEAST_GNSS_BIAS_M
    stated = np.minimum(sigma_m / default_sigma_m(telemetry.kind), 1.0)
    return np.maximum(usual * stated, [horizontal, horizontal, vertical])


def _days(telemetry: Telemetry, flight: np.ndarray, n_flights: int) -> np.ndarray:
    """Return the index (F,) of each flight's day; zeros if any flight with fixes does not state its date."""
    utc_s = np.full(n_flights, np.nan)
    for f in range(n_flights):
        mine = telemetry.utc_s[(flight == f) & telemetry.has_fix]
        known = mine[np.isfinite(mine)]
        if len(known):
            utc_s[f] = known[0]
        elif len(mine):
            return np.zeros(n_flights, dtype=np.int64)
    day = np.nan_to_num(np.floor(utc_s / 86400.0), nan=-1.0)
    return np.unique(day, return_inverse=True)[1].ravel()


def _heights(
    telemetry: Telemetry, flight: np.ndarray, n_flights: int, options: GeoregisterOptions
) -> tuple[np.ndarray, np.ndarray]:
    """Return the source's heights (N,) and a mask (F,) of flights whose heights are above take-off."""
    heights = np.full(len(telemetry), np.nan)
    relative = np.zeros(n_flights, dtype=bool)
    for f in range(n_flights):
        mine = (flight == f) & telemetry.has_fix
        n_relative = int(np.isfinite(telemetry.rel_alt_m[mine]).sum())
        n_absolute = int(np.isfinite(telemetry.abs_alt_m[mine]).sum())
        if options.heights is Heights.AUTO:
            # Prefer a full column of absolute heights to a few heights above take-off.
            relative[f] = n_relative > 0 and 2 * n_relative >= n_absolute
        else:
            relative[f] = options.heights is Heights.RELATIVE
        column = telemetry.rel_alt_m if relative[f] else telemetry.abs_alt_m
        heights[mine] = column[mine]
    return heights, relative


def observe(
    telemetry: Telemetry,
    sequence: Sequence[str],
    time_s: np.ndarray,
    options: GeoregisterOptions,
    control_origin: GeoOrigin | None = None,
) -> Fixes:
    """Convert the telemetry rows of N frames to observations in a local frame.

    With an origin of surveyed points, frames need no fix, and heights may have another zero than the origin.

    Raises GeometryError if no frame has a fix, or if the heights cannot be converted to the origin to keep.
    """
    n = len(telemetry)
    if len(sequence) != n or len(time_s) != n:
        raise ValueError(
            f"{n} telemetry rows, {len(sequence)} names and {len(time_s)} times must be equal in number"
        )
    if control_origin is None and not telemetry.has_fix.any():
        raise GeometryError(
            f"none of {n} frames has a fix: georegistration needs telemetry with positions"
        )
    flights = tuple(dict.fromkeys(sequence))
    flight = np.array([flights.index(name) for name in sequence], dtype=np.int64)
    heights, relative = _heights(telemetry, flight, len(flights), options)
    known = np.isfinite(heights)
    with_height = np.bincount(flight[known], minlength=len(flights)) > 0
    notes: list[str] = []
    mixed = len(set(relative[with_height].tolist())) > 1
    if mixed:
        notes.append("Heights are above take-off in some flights and absolute in others.")
    use_relative = bool(relative[with_height].any())
    reference = options.height_reference or telemetry.abs_reference
    origin = (
        control_origin
        or options.origin
        or _new_origin(telemetry, heights, use_relative, reference, options)
    )
    free_zero = control_origin is not None and not _is_comparable(
        origin, use_relative, reference, options
    )
    # Metres from the zero of the local frame to the zero of the heights.
    zero = 0.0
    if known.any() and not free_zero:
        zero = _zero_of_heights(origin, use_relative, reference, options)
    up = heights + zero
    if mixed:
        # Start the other kind at the same median height; its offset is a free parameter afterwards.
        offset = np.nanmedian(up[known & relative[flight]]) - np.nanmedian(
            heights[known & ~relative[flight]]
        )
        up = np.where(relative[flight], up, heights + offset)
    if not known.any() and control_origin is None:
        notes.append(
            "No heights are known: the mean camera height is set to 0 and the vertical position is "
            "undetermined."
        )
    elif not use_relative and reference is HeightReference.UNKNOWN and not free_zero:
        notes.append(
            "Heights are absolute with an unknown reference: they constrain the shape, but the "
            "vertical zero is unknown."
        )
    flat = np.where(known, up, 0.0)
    enu = origin.enu_from_wgs84(np.column_stack([telemetry.lat_lon_deg, origin.alt_m + flat]))
    enu[~known, 2] = np.nan
    angles = np.column_stack([np.zeros(n), telemetry.gimbal_deg[:, 1:]])
    up_cam = rotations_from_angles(angles)[:, :, 2]
    if not options.use_gimbal:
        up_cam = np.full_like(up_cam, np.nan)
    time_s = np.asarray(time_s, dtype=np.float64)
    if not np.isfinite(time_s).all():
        notes.append("Frames without a time are assumed to share one GNSS error per flight.")
    sigma_m = _sigma(telemetry, options)
    # Frames without a time are placed at one instant, so their errors are fully correlated.
    return Fixes(
        enu,
        sigma_m,
        up_cam,
        np.full((n, 3, 3), np.nan),
        flight,
        flights,
        np.where(np.isfinite(time_s), time_s, 0.0),
        _bias(telemetry, sigma_m, relative[flight], options),
        _days(telemetry, flight, len(flights)),
        relative,
        origin,
        bool(known.any()),
        free_zero,
        use_relative or reference is HeightReference.UNKNOWN,
        tuple(notes),
    )


def _new_origin(
    telemetry: Telemetry,
    heights: np.ndarray,
    use_relative: bool,
    reference: HeightReference,
    options: GeoregisterOptions,
) -> GeoOrigin:
    """Return an origin at the median of the fixes, at take-off or the rounded median absolute height."""
    lat_lon = telemetry.lat_lon_deg[telemetry.has_fix]
    # Longitudes are averaged relative to the first one, to avoid the jump at 180 degrees.
    lon_0 = lat_lon[0, 1]
    lon = lon_0 + np.median((lat_lon[:, 1] - lon_0 + 180) % 360 - 180)
    lat = round(float(np.median(lat_lon[:, 0])), _ORIGIN_DECIMALS)
    lon = round(float((lon + 180) % 360 - 180), _ORIGIN_DECIMALS)
    known = np.isfinite(heights)
    if use_relative and options.takeoff_alt_m is not None:
        return GeoOrigin(lat, lon, options.takeoff_alt_m, reference)
    if use_relative or not known.any():
        return GeoOrigin(
            lat, lon, 0.0, HeightReference.TAKEOFF if known.any() else HeightReference.UNKNOWN
        )
    return GeoOrigin(lat, lon, float(np.round(np.median(heights[known]))), reference)


def _is_comparable(
    origin: GeoOrigin,
    use_relative: bool,
    reference: HeightReference,
    options: GeoregisterOptions,
) -> bool:
    """Return whether the heights of the telemetry can be converted to the origin's reference."""
    if (
        origin.height_reference is HeightReference.UNKNOWN
        or reference is not origin.height_reference
    ):
        return False
    return not use_relative or options.takeoff_alt_m is not None


def _zero_of_heights(
    origin: GeoOrigin,
    use_relative: bool,
    reference: HeightReference,
    options: GeoregisterOptions,
) -> float:
    """Return the up coordinate in metres of height zero."""
    if not use_relative:
        if origin.height_reference is not reference:
            raise GeometryError(
                f"the area's height reference is '{origin.height_reference}', that of the telemetry is "
                f"'{reference}': specify the reference of absolute heights, or use heights above take-off"
            )
        return -origin.alt_m
    if origin.height_reference is HeightReference.TAKEOFF:
        return 0.0
    if options.takeoff_alt_m is None:
        raise GeometryError(
            f"the area's height reference is '{origin.height_reference}', but the flight's heights are "
            "above take-off: specify the height of the take-off point"
        )
    return options.takeoff_alt_m - origin.alt_m
