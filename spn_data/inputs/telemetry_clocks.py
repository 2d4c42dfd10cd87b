"""Clocks of telemetry and images: time zones that are not stated, and recordings that do not overlap."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spn_data.errors import InputError
from spn_data.telemetry.track import Telemetry

# All time zones in use, in hours.
_ZONES_H = (
    *range(-12, 15),
    *(-9.5, -3.5, -2.5, 3.5, 4.5, 5.5, 5.75, 6.5, 8.75, 9.5, 10.5, 12.75, 13.75),
)
_COVERED_SHARE = 0.5  # of the images: a log that covers less of them is of another time
_FEW = 0.05  # of the images: fixes for fewer are worth no reconstruction
_MOST = 0.9  # of the images: no word if as many have a fix


@dataclass(frozen=True)
class ImageClock:
    """Times of the images of a source, and what is allowed to be wrong with them.

    Attributes
    ----------
    time_s : ndarray, shape (N,)
        Seconds on the clock of the source.
    zero_utc_s : float
        Time of second 0 since 1970, of unknown zone if `zoneless`.
    zoneless : bool
        Whether the camera does not state its time zone.
    what : str
        What has this clock, for messages, such as "the video".
    accept : bool
        Whether the user accepts telemetry that does not fit.
    offset_s : float or None
        Time offset given by the user.
    """

    time_s: np.ndarray
    zero_utc_s: float
    zoneless: bool
    what: str
    accept: bool
    offset_s: float | None

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time."""
        return float(self.time_s.min()), float(self.time_s.max())


def on_image_clock(log: Telemetry, clock: ImageClock, name: str) -> Telemetry:
    """Return a log with dates on the clock of the images.

    Parameters
    ----------
    log : Telemetry
        Its records without a date are left out.
    clock : ImageClock
        Clock of the images.
    name : str
        Name of the log, for messages.

    Returns
    -------
    Telemetry
        If only one of the two clocks states its time zone, the other has the only zone with which the log
        covers the images, and a note says so.

    Raises
    ------
    InputError
        If no zone or several fit, unless the user accepts it or gives the time offset.
    """
    moved = replace(log, time_s=log.utc_s - clock.zero_utc_s)
    moved = moved.select(np.isfinite(moved.time_s))
    if log.utc_is_local == clock.zoneless:
        if not log.utc_is_local:
            return moved
        return _noted(
            moved, f"neither it nor {clock.what} states a time zone: they are taken as equal"
        )
    unstated = name if log.utc_is_local else f"the clock of {clock.what}"
    if clock.offset_s is not None:
        return _noted(
            moved, f"{unstated} states no time zone: it is read as UTC, plus --time-offset"
        )
    sign = -1.0 if log.utc_is_local else 1.0
    fits = [h for h in _ZONES_H if _covered(moved, clock.span_s, sign * h * 3600) >= _COVERED_SHARE]
    if len(fits) == 1:
        note = f"{unstated} states no time zone; it is read as {_zone(fits[0])}, the only one that fits"
        return _noted(moved.shifted(sign * fits[0] * 3600), note)
    if clock.accept:
        return _noted(moved, f"{unstated} states no time zone: it is read as UTC (--any-telemetry)")
    found = (
        f"{len(fits)} zones fit, from {_zone(min(fits))} to {_zone(max(fits))}"
        if fits
        else "none fits"
    )
    write = (
        ""
        if log.utc_is_local
        else " write the zone into the photos (exiftool -OffsetTimeOriginal=+02:00),"
    )
    raise InputError(
        f"cannot be paired with {clock.what}: {unstated} states no time zone, and {found};{write} give the "
        f"offset (--time-offset {sign * 7200:+.0f} for UTC+2), or use --any-telemetry to read it as UTC",
        path=name,
    )


def check_overlap(track: Telemetry, clock: ImageClock, name: str) -> Telemetry:
    """Compare telemetry with the images that it is for.

    Parameters
    ----------
    track : Telemetry
        Telemetry on the clock of the images, without the user's time offset.
    clock : ImageClock
        Clock of the images.
    name : str
        Name of the telemetry, for messages.

    Returns
    -------
    Telemetry
        The same, with a note if a part of the images gets no fix.

    Raises
    ------
    InputError
        If hardly any image gets a fix although the telemetry has fixes, unless the user accepts it.
    """
    shifted = track.shifted(clock.offset_s or 0.0)
    if not track.has_fix.any() or len(clock.time_s) == 0:
        return track
    count, total = int(shifted.at(clock.time_s).has_fix.sum()), len(clock.time_s)
    if count >= _MOST * total:
        return track
    fixed_s = shifted.time_s[shifted.has_fix]
    begin_s, end_s = clock.span_s
    where = (
        f"its fixes last from {_clock(fixed_s[0])} to "
        f"{_clock(fixed_s[-1])} on the clock of {clock.what}, which lasts from {_clock(begin_s)} to "
        f"{_clock(end_s)}"
    )
    if count > _FEW * total:
        return _noted(track, f"{count} of {total} images get a fix: {where}")
    why = _explained(shifted, clock)
    if clock.accept:
        return _noted(track, f"{count} of {total} images get a fix: {where}{why}")
    raise InputError(
        f"{count} of {total} images get a fix: {where}{why}; remove the file, give --time-offset, or use "
        "--any-telemetry to go on",
        path=name,
    )


def _explained(track: Telemetry, clock: ImageClock) -> str:
    """Say how far telemetry and images are apart, and which offset would bring them together."""
    fixed_s = track.time_s[track.has_fix]
    begin_s, end_s = clock.span_s
    before = clock.offset_s or 0.0
    if fixed_s[0] <= begin_s and end_s <= fixed_s[-1]:
        return ", in gaps between the fixes"
    apart_s = max(fixed_s[0] - end_s, begin_s - fixed_s[-1])
    text = f", {_clock(apart_s)} apart" if apart_s > 0 else ""
    if track.kind == "dji-srt":
        offset_s = before + begin_s - float(track.time_s[0])
        return (
            f"{text}; if its first record belongs to the first frame: --time-offset {offset_s:.0f}"
        )
    length_s = end_s - begin_s
    fits = [h for h in _ZONES_H if h and _covered(track, clock.span_s, -h * 3600) >= _COVERED_SHARE]
    if len(fits) == 1:
        offset_s = before - 3600 * fits[0]
        return (
            f"{text}; a shift by {_clock(3600 * abs(fits[0]))}, a time zone, fits: one of the clocks is "
            f"local time; then give --time-offset {offset_s:.0f}"
        )
    if fits:
        return f"{text}; shifts by {len(fits)} time zones fit: one of the clocks may be local time"
    is_video = clock.what == "the video"
    if is_video and _covered(track, clock.span_s, length_s) >= _COVERED_SHARE:
        return (
            f"{text}; if the camera writes the end of the recording as its creation time, give "
            f"--time-offset {before + length_s:.0f}"
        )
    return text


def _covered(track: Telemetry, span_s: tuple[float, float], shift_s: float) -> float:
    """Return the share of a time span that the fixes cover if they are shifted."""
    fixed_s = track.time_s[track.has_fix]
    if len(fixed_s) == 0:
        return 0.0
    begin_s = max(span_s[0], float(fixed_s[0]) + shift_s)
    end_s = min(span_s[1], float(fixed_s[-1]) + shift_s)
    if span_s[1] == span_s[0]:
        return float(end_s >= begin_s)
    return (end_s - begin_s) / (span_s[1] - span_s[0])


def _noted(track: Telemetry, note: str) -> Telemetry:
    return replace(track, notes=(*track.notes, note))


def _zone(hours: float) -> str:
    minutes = round(60 * abs(hours))
    rest = f":{minutes % 60:02d}" if minutes % 60 else ""
    return f"UTC{'-' if hours < 0 else '+'}{minutes // 60}{rest}"


def _clock(seconds: float) -> str:
    """Return a time like 1:23:45, with a sign if it is negative."""
    whole = round(abs(seconds))
    sign = "-" if seconds < 0 and whole else ""
    return f"{sign}{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"
