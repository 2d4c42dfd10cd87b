"""Flight logs with named columns: our own CSV, Airdata exports, DJI flight records, RTK loggers."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.telemetry.accuracy import sigma_from_dop
from spn_data.telemetry.csv_cells import (
    REQUIRED,
    first_that_parses,
    is_unknown,
    parse_cell,
    parse_time,
)
from spn_data.telemetry.csv_columns import COLUMNS, CsvColumn, parse_header
from spn_data.telemetry.csv_units import with_consistent_units
from spn_data.telemetry.placeholders import without_placeholders
from spn_data.telemetry.textfile import MAX_RECORDS, csv_rows, read_text
from spn_data.telemetry.track import Telemetry, time_order

MAX_DAMAGED_FRACTION = 0.05  # of the rows; a log with more damage is refused as a whole
# Usual seconds between the rows of a log, at most; beyond, a unit that is not stated is another one.
MAX_STEP_S, MAX_DATE_STEP_S = 10.0, 600.0
NAN = float("nan")
_LENGTHS = ("rel_alt", "alt_ellipsoid", "alt_amsl", "altitude")
_REFERENCES = {
    "ellipsoid": HeightReference.ELLIPSOID,
    "wgs84": HeightReference.ELLIPSOID,
    "amsl": HeightReference.AMSL,
    "msl": HeightReference.AMSL,
    "takeoff": HeightReference.TAKEOFF,
    "unknown": HeightReference.UNKNOWN,
}


def read_csv_log(path: Path | str) -> Telemetry:
    """Read a log with a header row; raise InputError naming file and line.

    It needs a latitude, a longitude and a time; `docs/telemetry.md` lists column names and units. Up to 5 %
    damaged rows are left out and counted in the notes, as are other columns that cannot be read.
    """
    rows = csv_rows(read_text(path), path, "telemetry")
    header_line, header = next(rows, (1, []))
    body: list[tuple[int, list[str]]] = []
    for line, row in rows:
        if len(body) == MAX_RECORDS:
            raise InputError(f"has more than {MAX_RECORDS:,} rows", path=path, line=line)
        body.append((line, row))
    return log_of_rows(body, header, header_line, path)


def log_of_rows(
    body: list[tuple[int, list[str]]], header: list[str], header_line: int, path: Path | str
) -> Telemetry:
    """Return the log of rows that were read with their lines; raise InputError naming file and line."""
    columns, notes = _choose_columns(header, header_line, body, path)
    columns, unit_notes = with_consistent_units(columns, body)
    notes += unit_notes
    records, zoneless, references, row_notes = _read_rows(
        body, columns, len(header), path, header_line
    )
    notes += row_notes
    table = _Table(records)
    clock = "time" if table.known("time") >= table.known("utc") else "utc"
    timed = np.isfinite(table[clock])
    if not timed.all():
        notes.append(f"rows without a {clock}, left out: {np.count_nonzero(~timed)}")
    table = _Table([record for record, good in zip(records, timed, strict=True) if good])
    time_s = table[clock]
    _check_steps(time_s, clock, columns, path, header_line)
    if clock == "utc":
        time_s = time_s - time_s.min()
        notes.append(
            "its times are dates, counted from the first: the time offset to the video must be given, "
            "taken from the video's creation time, or estimated"
        )
    elif _is_flight_time(columns.get("time")):
        notes.append(
            "its times count from the start of the flight, not of the video: the time offset "
            "must be given or estimated"
        )
    rel_alt_m, abs_alt_m, reference = _heights(table, references, path, header_line)
    if reference is HeightReference.UNKNOWN and _are_equal(rel_alt_m, abs_alt_m):
        abs_alt_m = np.full(len(abs_alt_m), np.nan)
        notes.append(
            f"{columns['altitude'].header} equals the height above take-off and is no absolute height"
        )
    lat_lon = np.stack([table["latitude"], table["longitude"]], axis=1)
    lat_lon[(lat_lon == 0).all(axis=1)] = np.nan  # drones write 0, 0 if there is no fix
    index, order_notes = time_order(time_s)
    notes += order_notes + _video_notes(time_s[index], table["is_video"][index] == 1)
    track = Telemetry.from_columns(
        time_s,
        lat_lon_deg=lat_lon,
        rel_alt_m=rel_alt_m,
        abs_alt_m=abs_alt_m,
        abs_reference=reference,
        sigma_m=_sigma(table),
        gimbal_deg=np.stack([table["heading"] % 360.0, table["pitch"], table["roll"]], axis=1),
        utc_s=table["utc"],
        utc_is_local=zoneless,
        kind="csv",
        source=str(path),
        notes=tuple(notes),
    ).select(index)
    return without_placeholders(track)


def _read_rows(
    body: list[tuple[int, list[str]]],
    columns: dict[str, CsvColumn],
    width: int,
    path: Path | str,
    header_line: int,
) -> tuple[list[dict[str, float]], bool, set[str], list[str]]:
    """Return the records, whether a date has no zone, the height references, and what was left out.

    Raises InputError if there are no rows, or too many are damaged.
    """
    records: list[dict[str, float]] = []
    damaged: list[tuple[int, str]] = []
    unread: dict[str, list[str]] = {}
    zoneless = False
    references: set[str] = set()
    for line, row in body:
        try:
            record, without_zone, faults = _parse_row(row, columns, width)
        except ValueError as error:
            damaged.append((line, str(error)))
            continue
        for name, fault in faults.items():
            unread.setdefault(columns[name].header, []).append(f"line {line}: {fault}")
        records.append(record)
        zoneless |= without_zone
        if "alt_reference" in columns:
            references.add(row[columns["alt_reference"].index].lower())
    total = len(records) + len(damaged)
    if total == 0:
        raise InputError("has a header but no rows", path=path, line=header_line)
    if len(damaged) > MAX_DAMAGED_FRACTION * total:
        line, why = damaged[0]
        raise InputError(f"{why}; {len(damaged)} of {total} rows are damaged", path=path, line=line)
    notes = [
        f"values left out in column {name}: {len(lines)}, the first at {lines[0]}"
        for name, lines in unread.items()
    ]
    if damaged:
        line, why = damaged[0]
        notes.append(f"rows left out: {len(damaged)}, the first at line {line}: {why}")
    return records, zoneless, references, notes


class _Table:
    """Columns (N,) of the rows; NaN if a row, or the whole log, does not state a value."""

    def __init__(self, records: list[dict[str, float]]):
        self._records = records

    def __getitem__(self, name: str) -> np.ndarray:
        return np.array([record.get(name, NAN) for record in self._records])

    def known(self, name: str) -> int:
        """Count the rows that state a value."""
        return int(np.isfinite(self[name]).sum())


def _choose_columns(
    header: list[str], line: int, body: list[tuple[int, list[str]]], path: Path | str
) -> tuple[dict[str, CsvColumn], list[str]]:
    """Return the columns by meaning, and notes on others that cannot be read.

    Raises InputError if a required one is missing or has an unknown unit.
    """
    found = parse_header(header)
    missing = [name for name in ("latitude", "longitude") if name not in found]
    if "time" not in found and "utc" not in found:
        missing.insert(0, "time")
    if missing:
        names = {n: COLUMNS[n][:2] for n in missing} | {"time": ("time_s", "datetime")}
        expected = ", ".join(" or ".join(names[n]) for n in missing)
        raise InputError(
            f"has no column for {' and '.join(missing)}: found {', '.join(header)[:300] or 'none'}; "
            f"expected {expected} (see docs/telemetry.md)",
            path=path,
            line=line,
        )
    sample = body[:: max(1, len(body) // 2000)]
    chosen: dict[str, CsvColumn] = {}
    faults: dict[str, str] = {}
    for name, candidates in found.items():
        chosen[name], fault = first_that_parses(name, candidates, sample)
        if fault:
            faults[name] = fault
    # One kind of time is enough.
    times = [name for name in ("time", "utc") if name in chosen]
    needed = {"latitude", "longitude"}
    if all(name in faults for name in times):
        needed |= set(times)
    notes = []
    for name, fault in faults.items():
        if math.isnan(chosen[name].scale) and name in (*needed, *_LENGTHS):
            raise InputError(fault, path=path, line=line)
        if name not in needed:
            notes.append(f"column {chosen.pop(name).header} is left out: {fault}")
    return chosen, notes


def _check_steps(
    time_s: np.ndarray, clock: str, columns: dict[str, CsvColumn], path: Path | str, line: int
) -> None:
    """Raise InputError if the usual step of the times shows that their unit is another."""
    column = columns[clock] if clock in columns else columns["time" if clock == "utc" else "utc"]
    if len(time_s) < 2 or (column.unit and column.unit not in ("utc", "local")):
        return
    step_s = float(np.median(np.abs(np.diff(time_s))))
    limit_s = MAX_DATE_STEP_S if clock == "utc" else MAX_STEP_S
    if step_s > limit_s:
        raise InputError(
            f"the values of {column.header} are {step_s:.6g} apart, too far for seconds between the rows of "
            "a log: name the column with its unit, such as time_s, time_ms or time_us (since the start)",
            path=path,
            line=line,
        )


def _is_flight_time(column: CsvColumn | None) -> bool:
    """Return whether a column counts from the start of the flight, as those of flight records do."""
    return column is not None and (
        column.unit.startswith("milli") or "fly" in column.header.lower()
    )


def _are_equal(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two columns state the same values throughout."""
    return bool(
        np.isfinite(one).any() and np.allclose(one, other, rtol=0, atol=0.01, equal_nan=True)
    )


def _parse_row(
    row: list[str], columns: dict[str, CsvColumn], width: int
) -> tuple[dict[str, float], bool, dict[str, str]]:
    """Return the numbers of a row in our units, whether its date has no zone, and what was left out.

    Raises ValueError saying what is damaged.
    """
    if len(row) < width:
        raise ValueError(f"{len(row)} cells, but the header has {width}")
    record: dict[str, float] = {}
    faults: dict[str, str] = {}
    zoneless = False
    for name, column in columns.items():
        cell = row[column.index]
        if name == "alt_reference" or is_unknown(cell):
            continue
        if name in ("time", "utc"):
            seconds, is_date, without_zone = parse_time(name, cell, column)
            record.setdefault("utc" if is_date else "time", seconds)
            zoneless |= without_zone
        elif name in REQUIRED:
            record[name] = parse_cell(name, cell, column)
        else:
            try:
                record[name] = parse_cell(name, cell, column)
            except ValueError as error:
                faults[name] = str(error)
    if not {"time", "utc"} & record.keys():
        raise ValueError("the row has no time")
    lat, lon = record.get("latitude", NAN), record.get("longitude", NAN)
    if abs(lat) > 90 or abs(lon) > 180:
        raise ValueError(f"{lat}, {lon} is not a position on Earth")
    return record, zoneless, faults


def _heights(
    table: _Table, references: set[str], path: Path | str, line: int
) -> tuple[np.ndarray, np.ndarray, HeightReference]:
    """Return (rel_alt_m, abs_alt_m, reference) from the column with the most explicit reference."""
    rel_alt_m = table["rel_alt"]
    for name, reference in (
        ("alt_ellipsoid", HeightReference.ELLIPSOID),
        ("alt_amsl", HeightReference.AMSL),
    ):
        if table.known(name):
            return rel_alt_m, table[name], reference
    if len(references) > 1 or not references <= _REFERENCES.keys():
        raise InputError(
            f"the height references are {', '.join(sorted(references))[:100]}; all rows must have the same "
            f"one of {', '.join(_REFERENCES)}",
            path=path,
            line=line,
        )
    reference = _REFERENCES[references.pop()] if references else HeightReference.UNKNOWN
    if reference is HeightReference.TAKEOFF:
        own = rel_alt_m if table.known("rel_alt") else table["altitude"]
        return own, np.full(len(own), np.nan), HeightReference.UNKNOWN
    return rel_alt_m, table["altitude"], reference


def _sigma(table: _Table) -> np.ndarray:
    """Return (N, 3) from standard deviations if there are any, else from accuracies, else from dilutions."""
    horizontal = table["sigma_h"]
    sigma = np.stack(
        [
            np.where(np.isfinite(table["sigma_e"]), table["sigma_e"], horizontal),
            np.where(np.isfinite(table["sigma_n"]), table["sigma_n"], horizontal),
            table["sigma_u"],
        ],
        axis=1,
    )
    dilutions = zip(table["hdop"], table["vdop"], table["pdop"], strict=True)
    by_dilution = np.array([sigma_from_dop(hdop=h, vdop=v, pdop=p) for h, v, p in dilutions])
    sigma = np.where(np.isfinite(sigma).any(axis=1, keepdims=True), sigma, by_dilution)
    return np.where(sigma > 0, sigma, np.nan)  # loggers write 0 if unknown


def _video_notes(time_s: np.ndarray, is_video: np.ndarray) -> list[str]:
    """Report when the drone recorded, if the log says so: these are candidate time offsets."""
    starts = time_s[is_video & ~np.concatenate([[False], is_video[:-1]])]
    if len(starts) == 0:
        return []
    listed = ", ".join(f"{t:.1f}" for t in starts[:5]) + (", ..." if len(starts) > 5 else "")
    return [f"recordings by its isVideo column: {len(starts)}, starting at {listed} s"]
