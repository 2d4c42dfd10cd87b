"""Telemetry: camera positions, heights and angles over time, with their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from spn_data.geometry.geodesy import METRES_PER_DEGREE, HeightReference

_SHORTEST_GAP_S, _LONGEST_GAP_S = 2.5, 30.0
_USUAL_STEPS = 2.5  # a gap is longer than this many usual intervals
_ACCELERATION_M_S2 = 0.5  # of a drone on average (1 sigma) between two fixes


@dataclass(frozen=True, eq=False)
class Telemetry:
    """Records of one source in order of time; values that a record does not state are NaN, never zero.

    Attributes
    ----------
    time_s : ndarray, shape (N,)
        Seconds on the video's own clock (0 at its first frame), increasing; for photos, seconds after the
        first photo, non-decreasing.
    lat_lon_deg : ndarray, shape (N, 2)
        WGS84 latitude and longitude; NaN if the record has no fix.
    rel_alt_m : ndarray, shape (N,)
        Height above the point of take-off.
    abs_alt_m : ndarray, shape (N,)
        Height above `abs_reference`.
    sigma_m : ndarray, shape (N, 3)
        Standard deviations east, north, up, as stated by the source.
    gimbal_deg : ndarray, shape (N, 3)
        Heading, pitch, roll of the camera (`spn_data.geometry.pose.rotations_from_angles`).
    utc_s : ndarray, shape (N,)
        Seconds since 1970; local time of unknown zone if `utc_is_local`.
    zoom : ndarray, shape (N,)
        Focal length times digital zoom in a source-specific unit: only its changes are meaningful.
    abs_reference : HeightReference
        What `abs_alt_m` is measured from.
    utc_is_local : bool
        Whether `utc_s` is local time.
    kind : str
        Format of the source, such as "dji-srt", "gpx", "csv", "exif", "px4-ulog".
    source : str
        Name of the file.
    notes : tuple of str
        What the user should know about how the source was read, one sentence each.
    """

    time_s: np.ndarray
    lat_lon_deg: np.ndarray
    rel_alt_m: np.ndarray
    abs_alt_m: np.ndarray
    sigma_m: np.ndarray
    gimbal_deg: np.ndarray
    utc_s: np.ndarray
    zoom: np.ndarray
    abs_reference: HeightReference = HeightReference.UNKNOWN
    utc_is_local: bool = False
    kind: str = ""
    source: str = ""
    notes: tuple[str, ...] = ()

    @classmethod
    def from_columns(
        cls,
        time_s: np.ndarray,
        *,
        lat_lon_deg: np.ndarray | None = None,
        rel_alt_m: np.ndarray | None = None,
        abs_alt_m: np.ndarray | None = None,
        sigma_m: np.ndarray | None = None,
        gimbal_deg: np.ndarray | None = None,
        utc_s: np.ndarray | None = None,
        zoom: np.ndarray | None = None,
        abs_reference: HeightReference = HeightReference.UNKNOWN,
        utc_is_local: bool = False,
        kind: str = "",
        source: str = "",
        notes: tuple[str, ...] = (),
    ) -> Telemetry:
        """Create telemetry from the known columns; the others become NaN."""
        time_s = np.asarray(time_s, dtype=np.float64)
        n = len(time_s)

        def column(values: np.ndarray | None, *shape: int) -> np.ndarray:
            if values is None:
                return np.full((n, *shape), np.nan)
            array = np.asarray(values, dtype=np.float64)
            if array.shape != (n, *shape):
                raise ValueError(f"a column has shape {array.shape}, expected {(n, *shape)}")
            return array

        return cls(
            time_s,
            column(lat_lon_deg, 2),
            column(rel_alt_m),
            column(abs_alt_m),
            column(sigma_m, 3),
            column(gimbal_deg, 3),
            column(utc_s),
            column(zoom),
            abs_reference,
            utc_is_local,
            kind,
            source,
            notes,
        )

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def has_fix(self) -> np.ndarray:
        """Records with a horizontal position, (N,) bool."""
        return np.isfinite(self.lat_lon_deg).all(axis=1)

    def select(self, index: np.ndarray) -> Telemetry:
        """Return the records selected by an index or mask (N,)."""
        columns: dict[str, Any] = {name: getattr(self, name)[index] for name in _COLUMNS}
        return replace(self, **columns)

    @classmethod
    def concatenate(cls, parts: Sequence[Telemetry]) -> Telemetry:
        """Join the tracks of the parts of one recording, on one clock; properties are taken from the first.

        A record that is not later than all before it is dropped.
        """
        columns: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS
        }
        notes = tuple(dict.fromkeys(note for part in parts for note in part.notes))
        joined = replace(parts[0], **columns, notes=notes)
        latest = np.maximum.accumulate(joined.time_s)
        return joined.select(np.concatenate([[True], joined.time_s[1:] > latest[:-1]]))

    def shifted(self, offset_s: float) -> Telemetry:
        """Return the same records with `offset_s` added to their times."""
        return replace(self, time_s=self.time_s + offset_s)

    @property
    def max_gap_s(self) -> float:
        """Longest interval between fixes that is no gap: 2.5 usual ones, from 2.5 s to 30 s.

        Within it, positions are interpolated. Between photos, which have a fix each or none, there is no
        upper limit.
        """
        steps_s = np.diff(self.time_s[self.has_fix])
        usual_s = _USUAL_STEPS * float(np.median(steps_s)) if len(steps_s) else 0.0
        if self.kind != "exif":
            usual_s = min(usual_s, _LONGEST_GAP_S)
        return max(_SHORTEST_GAP_S, usual_s)

    def interpolation_sigma_m(self, time_s: np.ndarray) -> np.ndarray:
        """Return the standard deviation (M,) of positions interpolated at times (M,), besides the fixes' own.

        In an interval of T seconds with an unknown constant acceleration a, a straight line is off by up to
        a t (T - t) / 2. It is zero in intervals of up to 2.5 s, where the error of the fixes prevails.
        """
        time_s = np.asarray(time_s, dtype=np.float64)
        fixed_s = self.time_s[self.has_fix]
        if len(fixed_s) < 2:
            return np.zeros(len(time_s))
        right = np.clip(np.searchsorted(fixed_s, time_s), 1, len(fixed_s) - 1)
        before_s = np.clip(time_s - fixed_s[right - 1], 0.0, None)
        after_s = np.clip(fixed_s[right] - time_s, 0.0, None)
        wide = fixed_s[right] - fixed_s[right - 1] > _SHORTEST_GAP_S
        return np.where(wide, 0.5 * _ACCELERATION_M_S2 * before_s * after_s, 0.0)

    def at(self, time_s: np.ndarray, *, max_gap_s: float | None = None) -> Telemetry:
        """Interpolate to times (M,): linearly in position, along the shorter arc in angle.

        Each column is interpolated between its own neighbouring known values. It is NaN if these are further
        apart than `max_gap_s` (default `Telemetry.max_gap_s`), or if the time is outside them by more than
        half the median interval. A source with one record per second, whose value holds for the whole second,
        is thus used at its time stamp. A stated sigma grows by `interpolation_sigma_m`.
        """
        time_s = np.asarray(time_s, dtype=np.float64)
        max_gap_s = self.max_gap_s if max_gap_s is None else max_gap_s
        tables: dict[str, Any] = {
            name: _interpolate(self.time_s, getattr(self, name), time_s, max_gap_s)
            for name in _COLUMNS
            if name not in ("time_s", "gimbal_deg", "lat_lon_deg")
        }
        gimbal = _interpolate(self.time_s, _unwrapped(self.gimbal_deg), time_s, max_gap_s)
        gimbal[:, 0] %= 360.0
        gimbal[:, 1:] = _signed(gimbal[:, 1:])
        lat_lon = self.lat_lon_deg.copy()
        lat_lon[:, 1:] = _unwrapped(lat_lon[:, 1:])
        lat_lon = _interpolate(self.time_s, lat_lon, time_s, max_gap_s)
        lat_lon[:, 1] = _signed(lat_lon[:, 1])
        more_m = self.interpolation_sigma_m(time_s)[:, None]
        tables["sigma_m"] = np.hypot(tables["sigma_m"], more_m)
        return replace(self, time_s=time_s, gimbal_deg=gimbal, lat_lon_deg=lat_lon, **tables)


_COLUMNS = (
    "time_s",
    "lat_lon_deg",
    "rel_alt_m",
    "abs_alt_m",
    "sigma_m",
    "gimbal_deg",
    "utc_s",
    "zoom",
)


def _unwrapped(angles_deg: np.ndarray) -> np.ndarray:
    """Remove jumps of 360 degrees between successive known values of angle columns (N, K)."""
    result = angles_deg.copy()
    for column in result.T:
        known = np.isfinite(column)
        column[known] = np.unwrap(column[known], period=360.0)
    return result


def _signed(angles_deg: np.ndarray) -> np.ndarray:
    """Wrap angles to (-180, 180]."""
    return 180.0 - (180.0 - angles_deg) % 360.0


def _interpolate(
    known_s: np.ndarray, values: np.ndarray, wanted_s: np.ndarray, max_gap_s: float
) -> np.ndarray:
    """Interpolate values (N, ...) at known_s (N,) linearly to wanted_s (M,); NaN across gaps and outside."""
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    result = np.full((len(wanted_s), flat.shape[1]), np.nan)
    margin = 0.5 * float(np.median(np.diff(known_s))) if len(known_s) > 1 else 0.0
    margin = min(margin, max_gap_s / 2)
    for column in range(flat.shape[1]):
        keep = np.isfinite(flat[:, column])
        t, v = known_s[keep], flat[keep, column]
        if len(t) == 0:
            continue
        right = np.clip(np.searchsorted(t, wanted_s), 1, max(len(t) - 1, 1))
        right = np.minimum(right, len(t) - 1)
        left = np.maximum(right - 1, 0)
        inside = (wanted_s >= t[0] - margin) & (wanted_s <= t[-1] + margin)
        exact = np.minimum(np.abs(wanted_s - t[left]), np.abs(wanted_s - t[right])) <= 1e-6
        # Within the margin beyond an end, the value at that end holds.
        beyond = (wanted_s < t[0]) | (wanted_s > t[-1])
        good = inside & ((t[right] - t[left] <= max_gap_s) | exact | beyond)
        result[good, column] = np.interp(wanted_s[good], t, v)
    return result.reshape(len(wanted_s), *values.shape[1:])


def time_order(time_s: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Return the index that sorts records by times (N,), one record per time, and notes on what changed."""
    notes = []
    if np.any(np.diff(time_s) < 0):
        notes.append("the records were not in order of time and were sorted")
    # Of several records with the same time, the first in the file counts.
    index = np.unique(time_s, return_index=True)[1]
    if len(index) < len(time_s):
        notes.append(f"records left out because of a duplicate time: {len(time_s) - len(index)}")
    return index, notes


def coordinate_step_m(lat_lon_deg: np.ndarray) -> float:
    """Return the rounding step of coordinates (N, 2) in degrees, in metres of latitude; NaN if unknown.

    Some drones write 4 decimals, steps of 11 m: an error of step / sqrt(12) that no source states.
    """
    known = lat_lon_deg[np.isfinite(lat_lon_deg).all(axis=1)]
    if len(known) == 0:
        return float("nan")
    for decimals in range(9):
        if np.abs(known - np.round(known, decimals)).max() < 1e-10:
            break
    return float(10.0**-decimals * METRES_PER_DEGREE)


@dataclass(frozen=True)
class TelemetrySummary:
    """Overview of a telemetry source, shown to the user before it is relied on.

    Attributes
    ----------
    kind : str
        Format of the source.
    records, with_fix : int
        Number of records, and of those with a fix.
    rate_hz : float
        Rate of records with a fix; NaN for fewer than two.
    duration_s : float
        Time between the first and the last record.
    gaps : tuple of (float, float)
        (from_s, to_s) of gaps without a fix.
    has_rel_alt, has_abs_alt, has_gimbal : bool
        Whether any record states these values.
    abs_reference : HeightReference
        Reference of the absolute height.
    notes : tuple of str
        As in `Telemetry`.
    """

    kind: str
    records: int
    with_fix: int
    rate_hz: float
    duration_s: float
    gaps: tuple[tuple[float, float], ...]
    has_rel_alt: bool
    has_abs_alt: bool
    abs_reference: HeightReference
    has_gimbal: bool
    notes: tuple[str, ...]


def summarize(telemetry: Telemetry) -> TelemetrySummary:
    """Summarize counts, rate and gaps of a source.

    Parameters
    ----------
    telemetry : Telemetry
        The source. A gap is longer than its `max_gap_s`: there is no position in it.

    Returns
    -------
    TelemetrySummary
        The overview.
    """
    fixed_s = telemetry.time_s[telemetry.has_fix]
    steps = np.diff(fixed_s)
    rate = 1 / float(np.median(steps)) if len(steps) and np.median(steps) > 0 else float("nan")
    # The first and last records bound the gaps before the first fix and after the last.
    bounded_s = np.concatenate([telemetry.time_s[:1], fixed_s, telemetry.time_s[-1:]])
    gaps = tuple(
        (float(bounded_s[i]), float(bounded_s[i + 1]))
        for i in np.flatnonzero(np.diff(bounded_s) > telemetry.max_gap_s)
    )
    duration = float(telemetry.time_s[-1] - telemetry.time_s[0]) if len(telemetry) else 0.0
    return TelemetrySummary(
        telemetry.kind,
        len(telemetry),
        int(telemetry.has_fix.sum()),
        rate,
        duration,
        gaps,
        bool(np.isfinite(telemetry.rel_alt_m).any()),
        bool(np.isfinite(telemetry.abs_alt_m).any()),
        telemetry.abs_reference,
        bool(np.isfinite(telemetry.gimbal_deg[:, 1:]).all(axis=1).any()),
        telemetry.notes,
    )
