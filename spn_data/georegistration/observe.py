"""What telemetry says of each frame, in local metres: fixes, their sigma, and the direction of up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spn_data.errors import GeometryError
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.pose import rotations_from_angles
from spn_data.georegistration.georegister_options import (
    RTK_SIGMA_M,
    GeoregisterOptions,
    Heights,
    default_sigma_m,
)
from spn_data.telemetry.track import Telemetry

# Finer than any fix, coarse enough to be read aloud: 6 decimals are 0.1 m.
_ORIGIN_DECIMALS = 6


@dataclass(frozen=True, eq=False)
class Fixes:
    """Observations of N frames in the local frame of `origin`.

    enu_m : (N, 3) NaN where unknown (up apart from east and north); sigma_m : (N, 3); up_cam : (N, 3) unit
    direction of up in camera axes by the gimbal, NaN where unknown; attitude : (N, 3, 3) cam_from_world by
    the gimbal, heading included, NaN where it is not to be used; flight : (N,) index into `flights`;
    time_s : (N,) within the flight; relative : (F,) bool, the flight's heights are above its take-off.
    """

    enu_m: np.ndarray
    sigma_m: np.ndarray
    up_cam: np.ndarray
    attitude: np.ndarray
    flight: np.ndarray
    flights: tuple[str, ...]
    time_s: np.ndarray
    relative: np.ndarray
    origin: GeoOrigin
    has_heights: bool
    free_heights: bool  # each flight's heights may be off by a constant
    notes: tuple[str, ...]

    @property
    def has_fix(self) -> np.ndarray:
        """(N,) bool: east and north are known."""
        return np.isfinite(self.enu_m[:, :2]).all(axis=1)

    @property
    def is_rtk(self) -> np.ndarray:
        """(N,) bool: the fix is one of differential carrier phase."""
        return self.sigma_m[:, :2].max(axis=1) < RTK_SIGMA_M

    def only(self, mask: np.ndarray) -> Fixes:
        """The same frames with observations only where the mask (N,) is set."""
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
    max_gap_s: float = 2.5,
) -> Telemetry:
    """One row per frame from each flight's own telemetry, interpolated at the frames' times (N,).

    Where a source states no sigma, that of its kind is filled in, so that flights of different kinds can be
    fitted together. Frames of a sequence without telemetry have NaN throughout.
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
        values["sigma_m"][mask] = np.where(np.isfinite(sigma), sigma, default_sigma_m(part.kind))
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
    """(N, 3) sigma east, north, up of each fix: the user's, the source's own, or that of its kind."""
    if options.gnss_sigma_m is not None:
        horizontal, vertical = options.gnss_sigma_m
        return np.tile([horizontal, horizontal, vertical], (len(telemetry), 1))
    stated = telemetry.sigma_m
    return np.where(np.isfinite(stated) & (stated > 0), stated, default_sigma_m(telemetry.kind))


def _heights(
    telemetry: Telemetry, flight: np.ndarray, n_flights: int, options: GeoregisterOptions
) -> tuple[np.ndarray, np.ndarray]:
    """Heights (N,) as their source gives them, and which flights' (F,) are above take-off."""
    heights = np.full(len(telemetry), np.nan)
    relative = np.zeros(n_flights, dtype=bool)
    for f in range(n_flights):
        mine = (flight == f) & telemetry.has_fix
        n_relative = int(np.isfinite(telemetry.rel_alt_m[mine]).sum())
        n_absolute = int(np.isfinite(telemetry.abs_alt_m[mine]).sum())
        if options.heights is Heights.AUTO:
            # A few heights above take-off are worth less than a full column of absolute ones.
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
) -> Fixes:
    """Fixes of N frames from their rows of telemetry.

    Raises GeometryError where no frame has a fix, or where heights cannot be brought to a kept origin.
    """
    n = len(telemetry)
    if len(sequence) != n or len(time_s) != n:
        raise ValueError(f"{n} rows of telemetry, {len(sequence)} names and {len(time_s)} times")
    if not telemetry.has_fix.any():
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
    origin = options.origin or _new_origin(telemetry, heights, use_relative, reference, options)
    # Metres between the zero of the heights and the zero of the local frame.
    zero = _zero_of_heights(origin, use_relative, reference, options) if known.any() else 0.0
    up = heights + zero
    if mixed:
        # The other kind starts from the same place and is then left free.
        offset = np.nanmedian(up[known & relative[flight]]) - np.nanmedian(
            heights[known & ~relative[flight]]
        )
        up = np.where(relative[flight], up, heights + offset)
    if not known.any():
        notes.append(
            "No heights are known: the mean camera height is set to 0 and up is not determined."
        )
    elif not use_relative and reference is HeightReference.UNKNOWN:
        notes.append(
            "Heights are absolute of unknown reference: good for shape, the vertical zero is unknown."
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
        notes.append("Frames without a time share their flight's whole GNSS error.")
    # Frames without a time: as if at one instant, so that their errors count as one.
    return Fixes(
        enu,
        _sigma(telemetry, options),
        up_cam,
        np.full((n, 3, 3), np.nan),
        flight,
        flights,
        np.where(np.isfinite(time_s), time_s, 0.0),
        relative,
        origin,
        bool(known.any()),
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
    """The middle of the fixes; zero height at take-off, or at the metre next to the mean absolute height."""
    lat_lon = telemetry.lat_lon_deg[telemetry.has_fix]
    # Longitudes on both sides of 180 degrees are averaged where they do not jump.
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


def _zero_of_heights(
    origin: GeoOrigin,
    use_relative: bool,
    reference: HeightReference,
    options: GeoregisterOptions,
) -> float:
    """Up coordinate in metres of height zero."""
    if not use_relative:
        if origin.height_reference is not reference:
            raise GeometryError(
                f"the area's heights are '{origin.height_reference}', these are '{reference}': "
                "say what absolute heights refer to, or use heights above take-off"
            )
        return -origin.alt_m
    if origin.height_reference is HeightReference.TAKEOFF:
        return 0.0
    if options.takeoff_alt_m is None:
        raise GeometryError(
            f"the area's heights are '{origin.height_reference}' and the flight's are above take-off: "
            "give the height of the take-off point"
        )
    return options.takeoff_alt_m - origin.alt_m
