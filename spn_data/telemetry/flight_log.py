"""One track from the messages of a flight log: fixes, heights and camera angles with times of their own."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.geometry.rotations import angles_from_rotations, rotations_from_quats
from spn_data.telemetry.placeholders import without_placeholders
from spn_data.telemetry.track import Telemetry, time_order

MAX_LOG_BYTES = 4_000_000_000
MAX_FIXES = 1_000_000
_LONGEST_S = 86_400.0  # from the middle of a log: records further away have a damaged time
_YEARS_S = (946_684_800.0, 4_102_444_800.0)  # seconds since 1970 of the years 2000 to 2100
_CLOCK_JUMP_S = 1.0
_NEAR_S = 2.5  # between a fix and a height or an angle that is used for it
_NEAR_POLE = 0.002  # sine of the angle from straight down within which heading and roll are one
_SAME_HEIGHT_M = 0.002
_GPS_EPOCH_S = 315_964_800.0  # 6 January 1980, in seconds since 1970
_WEEK_S = 604_800.0
# Seconds of GPS time since its epoch at which the n-th second was added to UTC (IERS bulletin C).
_LEAPS_S = np.array(
    [
        *(46828800, 78364801, 109900802, 173059203, 252028804, 315187205, 346723206, 393984007),
        *(425520008, 457056009, 504489610, 551750411, 599184012, 820108813, 914803214, 1025136015),
        *(1119744016, 1167264017),
    ],
    dtype=np.float64,
)


@dataclass(frozen=True, eq=False)
class Series:
    """Values of one kind of message: times (N,) on the clock of the log, values (N,) or (N, 3)."""

    time_s: np.ndarray
    values: np.ndarray

    def near(self, time_s: np.ndarray) -> np.ndarray:
        """Return the values nearest in time, numbers interpolated; NaN if there is none within 2.5 s."""
        finite = np.isfinite(self.values)
        known = finite if finite.ndim == 1 else finite.any(axis=1)
        index, _ = time_order(self.time_s[known])
        known_s, values = self.time_s[known][index], self.values[known][index].astype(np.float64)
        if len(known_s) == 0:
            return np.full((len(time_s), *self.values.shape[1:]), np.nan)
        right = np.clip(np.searchsorted(known_s, time_s), 1, max(len(known_s) - 1, 1))
        right = np.minimum(right, len(known_s) - 1)
        left = np.maximum(right - 1, 0)
        nearest = np.where(time_s - known_s[left] < known_s[right] - time_s, left, right)
        result = np.interp(time_s, known_s, values) if values.ndim == 1 else values[nearest]
        result[np.abs(known_s[nearest] - time_s) > _NEAR_S] = np.nan
        return result


@dataclass(frozen=True, eq=False)
class LoggedFixes:
    """The N position records of a log in the order of the file; NaN is not stated.

    `time_s` (N,) is on the clock of the log and `utc_s` (N,) the receiver's time; `lat_lon_deg` (N, 2) is
    NaN without a lock; `abs_alt_m` (N,) is above `reference`, `sigma_m` (N, 3) is east, north, up.
    """

    time_s: np.ndarray
    utc_s: np.ndarray
    lat_lon_deg: np.ndarray
    abs_alt_m: np.ndarray
    sigma_m: np.ndarray
    reference: HeightReference


def log_track(
    path: Path,
    kind: str,
    fixes: LoggedFixes,
    *,
    rel_alt: Series | None = None,
    gimbal: Series | None = None,
    notes: tuple[str, ...] = (),
) -> Telemetry:
    """Return the track of a log.

    Parameters
    ----------
    path : Path
        The log.
    kind : str
        Its format, as in `Telemetry.kind`.
    fixes : LoggedFixes
        Its position records, at least one.
    rel_alt, gimbal : Series or None
        Heights above take-off, and headings, pitches and rolls of the camera.
    notes : tuple of str
        What was noticed so far.

    Returns
    -------
    Telemetry
        `time_s` counts from its first record. Records with damaged times are left out. `utc_s` follows the
        clock of the log at the offset that most records state, so that a jump of the receiver's time does
        not move a record.

    Raises
    ------
    InputError
        If there are too many records, or none has a time.
    """
    check_count(len(fixes.time_s), path)
    found = [*notes]
    time_s = fixes.time_s
    near = np.isfinite(time_s)
    if not near.any():
        raise InputError(
            "contains no positions: none of its position records has a time", path=path
        )
    middle_s = np.sort(time_s[near])[(near.sum() - 1) // 2]
    near[near] = np.abs(time_s[near] - middle_s) <= _LONGEST_S
    if not near.all():
        found.append(f"records left out because their time is more than a day off: {np.sum(~near)}")
    rows = np.flatnonzero(near)
    order, order_notes = time_order(time_s[rows])
    rows = rows[order]
    found += order_notes
    lat_lon = fixes.lat_lon_deg[rows].copy()
    on_earth = (np.abs(lat_lon) <= (90.0, 180.0)).all(axis=1) & (lat_lon != 0).any(axis=1)
    lat_lon[~on_earth] = np.nan
    if not on_earth.any():
        found.append(f"none of its {len(rows)} position records has a fix")
    height_m = np.where(
        on_earth & np.isfinite(fixes.abs_alt_m[rows]), fixes.abs_alt_m[rows], np.nan
    )
    sigma_m = np.where(
        (fixes.sigma_m[rows] > 0) & (fixes.sigma_m[rows] < 1e4), fixes.sigma_m[rows], np.nan
    )
    utc_s, utc_notes = _steady_utc(time_s[rows], fixes.utc_s[rows])
    found += utc_notes
    found.append(
        "its times count from its first record: the time offset to the video must be given, taken from the "
        "video's creation time, or estimated"
    )
    track = Telemetry.from_columns(
        time_s[rows] - time_s[rows[0]],
        lat_lon_deg=lat_lon,
        rel_alt_m=None if rel_alt is None else rel_alt.near(time_s[rows]),
        abs_alt_m=height_m,
        sigma_m=sigma_m,
        gimbal_deg=None if gimbal is None else gimbal.near(time_s[rows]),
        utc_s=utc_s,
        abs_reference=fixes.reference,
        kind=kind,
        source=str(path),
        notes=tuple(found),
    )
    return without_placeholders(track)


def absolute_heights(
    amsl_m: np.ndarray, ellipsoid_m: np.ndarray
) -> tuple[np.ndarray, HeightReference, list[str]]:
    """Choose between the heights (N,) above sea level and above the ellipsoid that a receiver states.

    Returns the heights, their reference, and notes. The ellipsoid counts if all records with a height state
    it; if both are the same, one of them is none, and the reference is unknown.
    """
    known = np.isfinite(amsl_m) | np.isfinite(ellipsoid_m)
    both = np.isfinite(amsl_m) & np.isfinite(ellipsoid_m)
    if known.any() and np.isfinite(ellipsoid_m[known]).all():
        if both.any() and np.abs(amsl_m[both] - ellipsoid_m[both]).max() < _SAME_HEIGHT_M:
            note = (
                "its heights above sea level and above the ellipsoid are the same: their reference is "
                "unknown (give --height-reference)"
            )
            return ellipsoid_m, HeightReference.UNKNOWN, [note]
        return ellipsoid_m, HeightReference.ELLIPSOID, []
    return amsl_m, HeightReference.AMSL, []


def utc_from_gps(week: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return seconds since 1970 in UTC of GPS weeks (N,) and seconds of the week (N,); NaN for week 0."""
    gps_s = np.asarray(week, dtype=np.float64) * _WEEK_S + np.asarray(second, dtype=np.float64)
    leaps = np.searchsorted(_LEAPS_S, gps_s, side="right")
    return np.where(np.asarray(week) > 0, _GPS_EPOCH_S + gps_s - leaps, np.nan)


def camera_angles(quats_wxyz: np.ndarray) -> np.ndarray:
    """Return heading, pitch, roll (N, 3) of quaternions (N, 4) from the camera to north, east, down.

    Quaternions that are none become NaN. Within 0.1 degrees of straight down or up, heading is the direction
    of the image's top and roll is 0.
    """
    quats = np.asarray(quats_wxyz, dtype=np.float64)
    angles = np.full((len(quats), 3), np.nan)
    lengths = np.linalg.norm(np.nan_to_num(quats, posinf=0.0, neginf=0.0), axis=1)
    good: np.ndarray = np.isfinite(quats).all(axis=1) & (np.abs(lengths - 1) < 0.05)
    if not good.any():
        return angles
    ned = rotations_from_quats(quats[good] / lengths[good, None])
    axes = np.swapaxes(ned, 1, 2)  # rows: forward, right, down, in north, east, down
    enu = np.stack([axes[..., 1], axes[..., 0], -axes[..., 2]], axis=-1)
    forward, right, down = enu[:, 0], enu[:, 1], enu[:, 2]
    found = angles_from_rotations(np.stack([right, down, forward], axis=1))
    pole = np.hypot(forward[:, 0], forward[:, 1]) < _NEAR_POLE
    top = -down * np.where(forward[:, 2:] < 0, 1.0, -1.0)
    found[pole, 0] = (np.degrees(np.arctan2(top[:, 0], top[:, 1])) % 360.0)[pole]
    found[pole, 2] = 0.0
    angles[good] = found
    return angles


def gimbal_angles(
    time_s: np.ndarray, quats_wxyz: np.ndarray, flags: np.ndarray, attitude: Series | None
) -> tuple[Series, list[str]]:
    """Return camera angles from gimbal quaternions (N, 4) and MAVLink's gimbal flags (N,), and notes.

    A yaw in the frame of the vehicle is added to the vehicle's heading, the first of `attitude`'s angles.
    """
    yaw_lock, in_vehicle, in_earth = 16, 32, 64
    flags = np.nan_to_num(flags).astype(np.int64)
    stated = (flags & (in_vehicle | in_earth)) != 0
    turns_with_vehicle = np.where(stated, (flags & in_vehicle) != 0, (flags & yaw_lock) == 0)
    angles = camera_angles(quats_wxyz)
    notes = []
    if turns_with_vehicle.any():
        if attitude is None:
            angles[turns_with_vehicle, 0] = np.nan
            notes.append(
                "headings of the gimbal are left out: they are relative to the vehicle, whose attitude is "
                "missing"
            )
        else:
            heading = attitude.near(np.asarray(time_s))[:, 0]
            turned = (angles[:, 0] + heading) % 360.0
            angles[:, 0] = np.where(turns_with_vehicle, turned, angles[:, 0])
    return Series(np.asarray(time_s, dtype=np.float64), angles), notes


def check_size(path: Path, max_bytes: int = MAX_LOG_BYTES) -> int:
    """Return the size of a log; raise InputError if it is empty, too large or no file."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=path) from error
    if not path.is_file():
        raise InputError("not a file", path=path)
    if size == 0:
        raise InputError("the file is empty: it contains no telemetry", path=path)
    if size > max_bytes:
        raise InputError(
            f"has {size / 1e6:.0f} MB; logs of this kind of up to {max_bytes / 1e6:.0f} MB are supported",
            path=path,
        )
    return size


def check_count(fixes: int, path: Path) -> None:
    """Raise InputError if there are too many position records."""
    if fixes > MAX_FIXES:
        raise InputError(f"contains more than {MAX_FIXES:,} position records", path=path)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Discard what a library prints about damage, which is reported as notes."""
    sink = io.StringIO()
    with contextlib.redirect_stdout(sink), contextlib.redirect_stderr(sink):
        yield


def _steady_utc(time_s: np.ndarray, utc_s: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Return the UTC of records by the offset to the clock of the log that most of them state, and notes."""
    known = (utc_s >= _YEARS_S[0]) & (utc_s <= _YEARS_S[1])
    if not known.any():
        return np.full(len(time_s), np.nan), ["it states no date: its UTC is unknown"]
    offset_s = utc_s[known] - time_s[known]
    usual_s = float(np.median(offset_s))
    jumped = int((np.abs(offset_s - usual_s) > _CLOCK_JUMP_S).sum())
    notes = []
    if jumped:
        notes.append(
            f"the GNSS time of {jumped} records differs by more than {_CLOCK_JUMP_S:.0f} s from that of the "
            "others: the clock of the log decides"
        )
    return time_s + usual_s, notes
