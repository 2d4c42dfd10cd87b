"""Telemetry: where a camera was, when, and how well that is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from spn_data.geometry.geodesy import METRES_PER_DEGREE, HeightReference


@dataclass(frozen=True, eq=False)
class Telemetry:
    """Records of one source, in the order of time. What a record does not say is NaN, never zero.

    time_s : (N,) on the video's own clock (0 at its first frame), increasing; for photos, seconds
        after the first photo, non-decreasing.
    lat_lon_deg : (N, 2) WGS84; NaN where the record has no fix.
    rel_alt_m : (N,) height above the point of take-off.
    abs_alt_m : (N,) height above what `abs_reference` says.
    sigma_m : (N, 3) standard deviation east, north, up that the source itself states.
    gimbal_deg : (N, 3) heading, pitch, roll of the camera (`spn_data.geometry.pose.rotations_from_angles`).
    utc_s : (N,) seconds since 1970; local time of unknown zone where `utc_is_local`.
    zoom : (N,) focal length times digital zoom in a unit of the source's own: only its changes count.
    kind : what wrote it, such as "dji-srt", "gpx", "csv", "exif"; source : the file's name.
    notes : what the user should know of how the source was read, one sentence each.
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
        """From the columns that are known; the others are NaN."""
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
        """(N,) bool: the record has a horizontal position."""
        return np.isfinite(self.lat_lon_deg).all(axis=1)

    def select(self, index: np.ndarray) -> Telemetry:
        """The records of an index or mask (N,)."""
        columns: dict[str, Any] = {name: getattr(self, name)[index] for name in _COLUMNS}
        return replace(self, **columns)

    @classmethod
    def concatenate(cls, parts: Sequence[Telemetry]) -> Telemetry:
        """Tracks of the parts of one recording, on one clock; what is said of all is the first's.

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
        """The same records with `offset_s` added to their times."""
        return replace(self, time_s=self.time_s + offset_s)

    def at(self, time_s: np.ndarray, *, max_gap_s: float = 2.5) -> Telemetry:
        """Interpolated to times (M,): linear in position, along the shorter arc in angle.

        Each column is interpolated between its own neighbouring known values; where these lie
        further apart than `max_gap_s`, or a time lies outside them by more than half the median
        interval, it is NaN. A source of one record a second whose value stands for the whole second
        is thus used at its stamp.
        """
        time_s = np.asarray(time_s, dtype=np.float64)
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
    """Columns of angles (N, K) without jumps of 360 degrees between successive known ones."""
    result = angles_deg.copy()
    for column in result.T:
        known = np.isfinite(column)
        column[known] = np.unwrap(column[known], period=360.0)
    return result


def _signed(angles_deg: np.ndarray) -> np.ndarray:
    """Angles in (-180, 180]."""
    return 180.0 - (180.0 - angles_deg) % 360.0


def _interpolate(
    known_s: np.ndarray, values: np.ndarray, wanted_s: np.ndarray, max_gap_s: float
) -> np.ndarray:
    """values (N, ...) at known_s (N,), linearly at wanted_s (M,); NaN across gaps and outside."""
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
        # Beyond an end the nearest end's value holds for the margin.
        beyond = (wanted_s < t[0]) | (wanted_s > t[-1])
        good = inside & ((t[right] - t[left] <= max_gap_s) | exact | beyond)
        result[good, column] = np.interp(wanted_s[good], t, v)
    return result.reshape(len(wanted_s), *values.shape[1:])


def increasing(time_s: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """The index that puts records of times (N,) in order, one record a time, and what was done."""
    notes = []
    if np.any(np.diff(time_s) < 0):
        notes.append("its records were not in the order of time and were sorted")
    # Of records with one time the first in the file counts.
    index = np.unique(time_s, return_index=True)[1]
    if len(index) < len(time_s):
        notes.append(f"records with the time of another, left out: {len(time_s) - len(index)}")
    return index, notes


def coordinate_step_m(lat_lon_deg: np.ndarray) -> float:
    """The step in metres of latitude to which coordinates (N, 2) in degrees are rounded; or NaN.

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
    """What a source of telemetry holds, for the user to see before relying on it."""

    kind: str
    records: int
    with_fix: int
    rate_hz: float  # of records with a fix; NaN for fewer than two
    duration_s: float
    gaps: tuple[tuple[float, float], ...]  # (from_s, to_s) without a fix
    has_rel_alt: bool
    has_abs_alt: bool
    abs_reference: HeightReference
    has_gimbal: bool
    has_sigma: bool
    notes: tuple[str, ...]


def summarize(telemetry: Telemetry, *, max_gap_s: float = 2.5) -> TelemetrySummary:
    """Counts, rate and gaps of a source.

    A gap is longer than `max_gap_s` and than 2.5 usual intervals: photos are seconds apart.
    """
    fixed_s = telemetry.time_s[telemetry.has_fix]
    steps = np.diff(fixed_s)
    rate = 1 / float(np.median(steps)) if len(steps) and np.median(steps) > 0 else float("nan")
    # The first and the last record bound the gaps before the first and after the last fix.
    bounded_s = np.concatenate([telemetry.time_s[:1], fixed_s, telemetry.time_s[-1:]])
    usual_s = 2.5 * float(np.median(steps)) if len(steps) else 0.0
    gaps = tuple(
        (float(bounded_s[i]), float(bounded_s[i + 1]))
        for i in np.flatnonzero(np.diff(bounded_s) > max(max_gap_s, usual_s))
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
        bool(np.isfinite(telemetry.sigma_m).all(axis=1).any()),
        telemetry.notes,
    )
