"""Flight logs with named columns: our own CSV, Airdata exports, DJI flight records, RTK loggers."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.telemetry.accuracy import sigma_from_dop
from spn_data.telemetry.csv_columns import COLUMNS, CsvColumn, parse_header
from spn_data.telemetry.textfile import MAX_RECORDS, csv_rows, finite_number, read_text
from spn_data.telemetry.track import Telemetry, time_order

MAX_DAMAGED_FRACTION = 0.05  # of the rows; a log with more damage is refused as a whole
NAN = float("nan")
_UNKNOWN = {"", "nan", "n/a", "na", "null", "none", "-"}
_REFERENCES = {
    "ellipsoid": HeightReference.ELLIPSOID,
    "wgs84": HeightReference.ELLIPSOID,
    "amsl": HeightReference.AMSL,
    "msl": HeightReference.AMSL,
    "takeoff": HeightReference.TAKEOFF,
    "unknown": HeightReference.UNKNOWN,
}
# Larger values are seconds since 1970 (a date after 1973), never a flight time.
_ABSOLUTE_S = 1e8


def read_csv_log(path: Path | str) -> Telemetry:
    """Read a log with a header row; raise InputError naming file and line.

    It needs a latitude, a longitude and a time; `docs/telemetry.md` lists column names and units. Up to 5 %
    damaged rows are left out and counted in the notes.
    """
    rows = csv_rows(read_text(path), path, "telemetry")
    header_line, header = next(rows, (1, []))
    columns = _parse_columns(header, header_line, path)
    records: list[dict[str, float]] = []
    damaged: list[tuple[int, str]] = []
    zoneless = False
    references: set[str] = set()
    for line, row in rows:
        if len(records) == MAX_RECORDS:
            raise InputError(f"has more than {MAX_RECORDS:,} rows", path=path, line=line)
        try:
            record, without_zone = _parse_row(row, columns, len(header))
        except ValueError as error:
            damaged.append((line, str(error)))
            continue
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
    table = _Table(records)
    notes: list[str] = []
    if damaged:
        line, why = damaged[0]
        notes.append(f"rows left out: {len(damaged)}, the first at line {line}: {why}")
    clock = "time" if table.known("time") >= table.known("utc") else "utc"
    timed = np.isfinite(table[clock])
    if not timed.all():
        notes.append(f"rows without a {clock}, left out: {np.count_nonzero(~timed)}")
    table = _Table([record for record, good in zip(records, timed, strict=True) if good])
    time_s = table[clock]
    if clock == "utc":
        time_s = time_s - time_s.min()
        notes.append(
            "its times are dates, counted from the first: the time offset to the video must be given, "
            "taken from the video's creation time, or estimated"
        )
    elif "utc" in columns and columns["time"].unit.startswith("milli"):
        notes.append(
            "its times count from the start of the flight, not of the video (Airdata): the time offset "
            "must be given or estimated"
        )
    rel_alt_m, abs_alt_m, reference = _heights(table, references, path, header_line)
    lat_lon = np.stack([table["latitude"], table["longitude"]], axis=1)
    lat_lon[(lat_lon == 0).all(axis=1)] = np.nan  # drones write 0, 0 if there is no fix
    index, order_notes = time_order(time_s)
    notes += order_notes + _video_notes(time_s[index], table["is_video"][index] == 1)
    return Telemetry.from_columns(
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


class _Table:
    """Columns (N,) of the rows; NaN if a row, or the whole log, does not state a value."""

    def __init__(self, records: list[dict[str, float]]):
        self._records = records

    def __getitem__(self, name: str) -> np.ndarray:
        return np.array([record.get(name, NAN) for record in self._records])

    def known(self, name: str) -> int:
        """Count the rows that state a value."""
        return int(np.isfinite(self[name]).sum())


def _parse_columns(header: list[str], line: int, path: Path | str) -> dict[str, CsvColumn]:
    """Return the columns by meaning; raise InputError if a required one is missing or a unit is unknown."""
    columns = parse_header(header)
    missing = [name for name in ("latitude", "longitude") if name not in columns]
    if "time" not in columns and "utc" not in columns:
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
    for column in columns.values():
        if math.isnan(column.scale):
            raise InputError(
                f"unknown unit {column.unit!r} in column {column.header!r}",
                path=path,
                line=line,
            )
    return columns


def _parse_row(
    row: list[str], columns: dict[str, CsvColumn], width: int
) -> tuple[dict[str, float], bool]:
    """Return the numbers of a row in our units, and whether its date has no time zone.

    Raises ValueError saying what is damaged.
    """
    if len(row) < width:
        raise ValueError(f"{len(row)} cells, but the header has {width}")
    record: dict[str, float] = {}
    zoneless = False
    for name, column in columns.items():
        cell = row[column.index]
        if name == "alt_reference" or cell.lower() in _UNKNOWN:
            continue
        if name in ("time", "utc"):
            seconds, is_date, without_zone = _parse_time(cell, column)
            if name == "utc" and not is_date and not column.unit:
                raise ValueError(
                    f"{column.header} is {cell[:40]}, not a date; name a column of seconds time_s"
                )
            record.setdefault("utc" if is_date else "time", seconds)
            zoneless |= without_zone
        else:
            record[name] = finite_number(cell, column.header) * column.scale
    if not {"time", "utc"} & record.keys():
        raise ValueError("the row has no time")
    lat, lon = record.get("latitude", NAN), record.get("longitude", NAN)
    if abs(lat) > 90 or abs(lon) > 180:
        raise ValueError(f"{lat}, {lon} is not a position on Earth")
    return record, zoneless


def _parse_time(cell: str, column: CsvColumn) -> tuple[float, bool, bool]:
    """Return (seconds, whether they count from 1970, whether their time zone is unknown)."""
    try:
        seconds = float(cell)
    except ValueError:
        try:
            date = datetime.fromisoformat(cell.replace("/", "-"))
        except ValueError:
            raise ValueError(
                f"{column.header} is {cell[:40]!r}, neither a number nor a date like 2024-05-01 12:00:00"
            ) from None
        zoneless = date.tzinfo is None
        date = date.replace(tzinfo=UTC) if zoneless else date
        return date.timestamp(), True, zoneless and "utc" not in column.header.lower()
    if column.unit in ("", "utc", "local"):  # loggers write seconds, milli- or microseconds
        seconds *= 1e-6 if seconds > 1e14 else 1e-3 if seconds > 1e11 else 1.0
    else:
        seconds *= column.scale
    if not math.isfinite(seconds):
        raise ValueError(f"{column.header} is {cell}, not a time")
    return seconds, seconds > _ABSOLUTE_S, column.unit == "local" and seconds > _ABSOLUTE_S


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
