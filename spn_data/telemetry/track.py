"""Telemetry: where a camera was, when, and how well that is known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spn_data.geodesy import HeightReference


@dataclass(frozen=True, eq=False)
class Telemetry:
    """Records of one source, in the order of time. What a record does not say is NaN, never zero.

    time_s : (N,) on the video's own clock (0 at its first frame), increasing; for photos, seconds after
        the first photo, non-decreasing.
    lat_lon_deg : (N, 2) WGS84; NaN where the record has no fix.
    rel_alt_m : (N,) height above the point of take-off.
    abs_alt_m : (N,) height above what `abs_reference` says.
    sigma_m : (N, 3) standard deviation east, north, up that the source itself states.
    gimbal_deg : (N, 3) heading, pitch, roll of the camera (`spn_data.pose.rotations_from_angles`).
    utc_s : (N,) seconds since 1970; local time of unknown zone where `utc_is_local`.
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
        return replace(self, **{name: getattr(self, name)[index] for name in _COLUMNS})

    def shifted(self, offset_s: float) -> Telemetry:
        """The same records with `offset_s` added to their times."""
        return replace(self, time_s=self.time_s + offset_s)

    def at(self, time_s: np.ndarray, *, max_gap_s: float = 2.5) -> Telemetry:
        """Interpolated to times (M,): linear in position, along the shorter arc in angle.

        Each column is interpolated between its own neighbouring known values; where these lie further
        apart than `max_gap_s`, or a time lies outside them by more than half the median interval, it is NaN.
        A source of one record a second whose value stands for the whole second is thus used at its stamp.
        """
        time_s = np.asarray(time_s, dtype=np.float64)
        tables = {
            name: _interpolate(self.time_s, getattr(self, name), time_s, max_gap_s)
            for name in _COLUMNS
            if name not in ("time_s", "gimbal_deg")
        }
        # Angles go through unit vectors so that 359 and 1 degrees have 0 between them.
        radians = np.deg2rad(self.gimbal_deg)
        cosine = _interpolate(self.time_s, np.cos(radians), time_s, max_gap_s)
        sine = _interpolate(self.time_s, np.sin(radians), time_s, max_gap_s)
        gimbal = np.rad2deg(np.arctan2(sine, cosine))
        gimbal[:, 0] %= 360.0
        return replace(self, time_s=time_s, gimbal_deg=gimbal, **tables)


_COLUMNS = ("time_s", "lat_lon_deg", "rel_alt_m", "abs_alt_m", "sigma_m", "gimbal_deg", "utc_s")


def _interpolate(
    known_s: np.ndarray, values: np.ndarray, wanted_s: np.ndarray, max_gap_s: float
) -> np.ndarray:
    """values (N, ...) at known_s (N,), linearly at wanted_s (M,); NaN across gaps and outside."""
    flat = values.reshape(len(values), -1)
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
        exact = np.isclose(wanted_s, t[left], atol=1e-6) | np.isclose(wanted_s, t[right], atol=1e-6)
        # Beyond an end the nearest end's value holds for the margin.
        beyond = (wanted_s < t[0]) | (wanted_s > t[-1])
        good = inside & ((t[right] - t[left] <= max_gap_s) | exact | beyond)
        result[good, column] = np.interp(wanted_s[good], t, v)
    return result.reshape(len(wanted_s), *values.shape[1:])


@dataclass(frozen=True)
class TelemetrySummary:
    """What a source of telemetry holds, for the user to see before relying on it."""

    kind: str
    records: int
    with_fix: int
    rate_hz: float  # of records with a fix; NaN for fewer than two
    duration_s: float
    gaps: tuple[tuple[float, float], ...]  # (from_s, to_s) without a fix for longer than `max_gap_s`
    has_rel_alt: bool
    has_abs_alt: bool
    abs_reference: HeightReference
    has_gimbal: bool
    has_sigma: bool
    notes: tuple[str, ...]


def summarize(telemetry: Telemetry, *, max_gap_s: float = 2.5) -> TelemetrySummary:
    """Counts, rate and gaps of a source."""
    fixed_s = telemetry.time_s[telemetry.has_fix]
    steps = np.diff(fixed_s)
    rate = 1 / float(np.median(steps)) if len(steps) and np.median(steps) > 0 else float("nan")
    gaps = tuple((float(fixed_s[i]), float(fixed_s[i + 1])) for i in np.flatnonzero(steps > max_gap_s))
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
