"""Subtitle files (.SRT) in which drones record position, height and gimbal angles.

The dialect is detected from the records, not from the drone's model; `docs/telemetry.md` lists them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from spn_data.errors import InputError
from spn_data.telemetry.placeholders import without_placeholders
from spn_data.telemetry.srt_positions import positions
from spn_data.telemetry.srt_record import NAN, SrtRecord, parse_record
from spn_data.telemetry.textfile import MAX_RECORDS, read_text
from spn_data.telemetry.track import Telemetry, coordinate_step_m

_TIMES = re.compile(r"(\d{1,3}):(\d{1,2}):(\d{1,2})[,.](\d{1,6})\s*-->")
_INDEX = re.compile(r"\s*\d{1,9}\s*")

Skipped = list[tuple[int, str]]  # (line, reason) of records left out


def read_dji_srt(path: Path | str) -> Telemetry:
    """Read telemetry from a subtitle file; raise InputError naming file and line if it has none."""
    return parse_dji_srt(read_text(path), source=str(path))


def parse_dji_srt(text: str, *, source: str) -> Telemetry:
    """Parse the text of a subtitle file; `source` names it in messages.

    time_s is the start of each record in the video; utc_s is the drone's clock, which is local time. Damaged
    records are left out and counted in the notes. Raises InputError if no record is usable.
    """
    if not text.strip():
        raise InputError("the file is empty: it contains no telemetry", path=source)
    return telemetry_from_records(_records(text), source=source)


def telemetry_from_records(
    texts: Iterable[tuple[int, float, str]], *, source: str, has_lines: bool = True
) -> Telemetry:
    """Parse records given as (line, time_s, text), or as (number, time_s, text) without `has_lines`."""
    place = "line" if has_lines else "record"
    records: list[SrtRecord] = []
    skipped: Skipped = []
    for line, time_s, body in texts:
        if len(records) == MAX_RECORDS:
            raise InputError(f"has more than {MAX_RECORDS:,} records", path=source)
        try:
            record = parse_record(line, time_s, body)
        except ValueError as error:
            skipped.append((line, str(error)))
            continue
        if record is None:
            skipped.append((line, "no position, height or gimbal angle"))
        else:
            records.append(record)
    if not records:
        why = f"the first of {len(skipped)}: {skipped[0][1]}" if skipped else "there are none"
        raise InputError(
            f"no subtitle record contains drone telemetry ({why}); use the .SRT written by the drone",
            path=source,
            line=skipped[0][0] if skipped and has_lines else None,
        )
    records, notes = _with_times(records, source)
    records, time_notes = _in_order(records, skipped, place)
    lat_lon, position_notes = positions(records, place)
    time = np.array([r.time_s for r in records])
    utc = np.array([r.utc_s for r in records])
    abs_alt = np.array([r.abs_alt_m for r in records])
    notes += time_notes + position_notes + _rate_notes(time, lat_lon, utc)
    if any(r.bare_altitude for r in records):
        notes.append("[altitude] is an absolute height of unknown reference")
    if np.any(abs_alt < -50):
        notes.append(
            f"the absolute height goes down to {np.nanmin(abs_alt):.1f} m, below almost all land: "
            "its zero is not sea level"
        )
    if skipped:
        line, why = min(skipped)
        notes.append(f"records left out: {len(skipped)}, the first at {place} {line}: {why}")
    track = Telemetry.from_columns(
        time,
        lat_lon_deg=lat_lon,
        rel_alt_m=np.array([r.rel_alt_m for r in records]),
        abs_alt_m=abs_alt,
        gimbal_deg=np.array([r.gimbal_deg for r in records]),
        zoom=np.array([r.zoom for r in records]),
        utc_s=utc,
        utc_is_local=True,
        kind="dji-srt",
        source=source,
        notes=tuple(notes),
    )
    return without_placeholders(track)


def _records(text: str) -> Iterator[tuple[int, float, str]]:
    """Yield (first line, time_s or NaN, text) of each record.

    A record starts with its times, or with a line that contains only its number. Blank lines do not separate
    records, because some drones write them inside a record.
    """
    start, time_s = 1, NAN
    body: list[str] = []
    for number, line in enumerate(text.split("\n"), 1):
        times = _TIMES.search(line)
        if times or _INDEX.fullmatch(line):
            if body:
                yield start, time_s, "\n".join(body)
            start, time_s, body = number, NAN, []
            if times:
                hours, minutes, seconds, fraction = times.groups()
                whole = int(hours) * 3600 + int(minutes) * 60 + int(seconds)
                time_s = whole + int(fraction) / 10 ** len(fraction)
        elif line.strip():
            body.append(line)
    if body:
        yield start, time_s, "\n".join(body)


def _with_times(records: list[SrtRecord], source: str) -> tuple[list[SrtRecord], list[str]]:
    """Take times from date stamps or durations if the records have no subtitle times."""
    if not all(np.isnan(r.time_s) for r in records):
        return records, []
    since_first = np.array([r.utc_s - records[0].utc_s for r in records])
    durations = np.array([r.diff_s for r in records])
    if len(np.unique(since_first)) == len(records) and np.isfinite(since_first).all():
        times, by = since_first, "date stamps"
    elif np.isfinite(durations).all():
        times, by = np.concatenate([[0.0], np.cumsum(durations)[:-1]]), "DiffTime"
    else:
        raise InputError(
            "the records have neither subtitle times (00:00:01,000 --> 00:00:02,000) "
            "nor date stamps that differ",
            path=source,
            line=records[0].line,
        )
    note = f"the records have no subtitle times; times are taken from their {by}, starting at 0 s"
    timed = [replace(r, time_s=float(t)) for r, t in zip(records, times, strict=True)]
    return timed, [note]


def _in_order(
    records: list[SrtRecord], skipped: Skipped, place: str
) -> tuple[list[SrtRecord], list[str]]:
    """Keep the records whose times increase, up to the point where they start over; extend `skipped`."""
    skipped += [(r.line, "no subtitle times") for r in records if np.isnan(r.time_s)]
    records = [r for r in records if not np.isnan(r.time_s)]
    keep, restart = _increasing([r.time_s for r in records])
    notes = []
    if restart is not None:
        notes.append(
            f"the times start over at {place} {records[restart].line}: the {len(records) - restart} "
            "records from there on belong to another recording and are left out"
        )
        records = records[:restart]
    for record, good in zip(records, keep, strict=True):
        if not good:
            skipped.append((record.line, "its time is not after that of the record before"))
    return [r for r, good in zip(records, keep, strict=True) if good], notes


def _increasing(times: Sequence[float]) -> tuple[list[bool], int | None]:
    """Return which times to keep so that they increase, and the index at which they start over, or None."""
    keep: list[bool] = []
    last = -np.inf
    for i, time_s in enumerate(times):
        following = times[i + 1 : i + 3]
        # A single time that leaps ahead of those after it is wrong, not the others.
        leap = len(following) == 2 and last < following[0] < min(time_s, following[1])
        if time_s <= last - 1.0 and len(following) == 2 and time_s < following[0] < following[1]:
            return keep, i
        keep.append(bool(time_s > last and not leap))
        last = time_s if keep[-1] else last
    return keep, None


def _rate_notes(time_s: np.ndarray, lat_lon: np.ndarray, utc_s: np.ndarray) -> list[str]:
    """Report on resolution and rate of the fixes (N, 2) and on jumps of the clock (N,)."""
    notes = []
    fixed = np.isfinite(lat_lon).all(axis=1)
    if not fixed.any():
        notes.append("no record has a position fix")
    elif (step_m := coordinate_step_m(lat_lon)) > 0.5:
        notes.append(f"the coordinates are rounded to steps of {step_m:.0f} m")
    if fixed.sum() > 10:
        span_s = time_s[fixed][-1] - time_s[fixed][0]
        changes = np.count_nonzero(np.any(np.diff(lat_lon[fixed], axis=0) != 0, axis=1))
        rate_hz = (fixed.sum() - 1) / span_s
        # Records at frame rate repeat the last fix of a slower receiver: they are not independent.
        if rate_hz > 2 and changes / span_s < 0.6 * rate_hz:
            notes.append(
                f"the position changes {changes / span_s:.2g} times per second, "
                f"but there are {rate_hz:.3g} records per second"
            )
    jumps_s = np.diff(utc_s) - np.diff(time_s)
    jumped = np.flatnonzero(np.abs(jumps_s) > 3)
    if len(jumped):
        notes.append(
            f"the drone's clock jumps against the video {len(jumped)} times, first by "
            f"{jumps_s[jumped[0]]:+.0f} s at {time_s[jumped[0] + 1]:.2f} s: "
            "the file joins several recordings, or the recording was paused"
        )
    return notes
