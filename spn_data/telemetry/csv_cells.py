"""Cells of a CSV log: numbers, times and flags."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime

from spn_data.telemetry.csv_columns import CsvColumn
from spn_data.telemetry.textfile import finite_number

REQUIRED = ("time", "utc", "latitude", "longitude")
_UNKNOWN = {"", "nan", "n/a", "na", "null", "none", "-"}
_TRUE = {"true", "yes", "on", "recording", "start", "started", "1.0"}
_FALSE = {"false", "no", "off", "stop", "stopped", "idle", "0.0"}
# Seconds since 1970 of the years 2000 to 2100: no flight time, and no other date.
_DATES_S = (946_684_800.0, 4_102_444_800.0)


def is_unknown(cell: str) -> bool:
    """Return whether a cell states no value."""
    return cell.lower() in _UNKNOWN


def parse_cell(name: str, cell: str, column: CsvColumn) -> float:
    """Return the number of a cell in our units; raise ValueError saying what is damaged.

    `name` is the meaning of its column, which is not a time.
    """
    if name == "is_video":
        lower = cell.lower()
        if lower in _TRUE | _FALSE:
            return float(lower in _TRUE)
    return finite_number(cell, column.header) * column.scale


def parse_time(name: str, cell: str, column: CsvColumn) -> tuple[float, bool, bool]:
    """Return (seconds, whether they count from 1970, whether their time zone is unknown).

    Raises ValueError if the cell is no time, or no date in a column of dates without a unit.
    """
    try:
        seconds = float(cell)
    except ValueError:
        date = _date(cell, column)
        zoneless = date.tzinfo is None
        date = date.replace(tzinfo=UTC) if zoneless else date
        return date.timestamp(), True, zoneless and "utc" not in column.header.lower()
    if not math.isfinite(seconds):
        raise ValueError(f"{column.header} is {cell}, not a time")
    if column.unit in ("", "utc", "local"):  # loggers write seconds, milli- or microseconds
        for scale in (1.0, 1e-3, 1e-6, 1e-9):
            if _DATES_S[0] <= seconds * scale <= _DATES_S[1]:
                return seconds * scale, True, column.unit == "local"
        if name == "utc" and not column.unit:
            raise ValueError(
                f"{column.header} is {cell[:40]}, not a date; name a column of seconds time_s, and one of "
                "microseconds time_us"
            )
        return seconds, False, False
    seconds *= column.scale
    return seconds, seconds >= _DATES_S[0], False


def first_that_parses(
    name: str, columns: Sequence[CsvColumn], rows: Sequence[tuple[int, list[str]]]
) -> tuple[CsvColumn, str]:
    """Return the first column of a meaning of which at least half of the stated cells parse.

    Parameters
    ----------
    name : str
        The meaning.
    columns : sequence of CsvColumn
        The columns of this meaning, the preferred one first.
    rows : sequence of (int, list of str)
        Line and cells of rows of the log.

    Returns
    -------
    column : CsvColumn
        The column; the first if none parses.
    fault : str
        What is wrong with it, or "". A column without any stated cell comes after those with some.
    """
    faults: list[str] = []
    empty: list[CsvColumn] = []
    for column in columns:
        if math.isnan(column.scale):
            faults.append(f"unknown unit {column.unit!r} in column {column.header!r}")
            continue
        bad, stated, first = 0, 0, ""
        for line, row in rows:
            cell = row[column.index] if column.index < len(row) else ""
            if is_unknown(cell):
                continue
            stated += 1
            try:
                if name in ("time", "utc"):
                    parse_time(name, cell, column)
                elif name != "alt_reference":
                    parse_cell(name, cell, column)
            except ValueError as error:
                bad += 1
                first = first or f"{error} (line {line})"
        if stated and 2 * bad <= stated:
            return column, ""
        if stated:
            faults.append(first)
        else:
            empty.append(column)
    if empty:
        return empty[0], ""
    return columns[0], faults[0]


def _date(cell: str, column: CsvColumn) -> datetime:
    """Parse a date like 2024-05-01 12:00:00, also with slashes."""
    try:
        return datetime.fromisoformat(cell.replace("/", "-"))
    except ValueError:
        raise ValueError(
            f"{column.header} is {cell[:40]!r}, neither a number nor a date like 2024-05-01 12:00:00"
        ) from None
