"""Logs of named columns: our own CSV, Airdata's exports, DJI flight records, RTK loggers."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.telemetry.accuracy import sigma_from_dop
from spn_data.telemetry.csv_columns import COLUMNS, CsvColumn, columns_of
from spn_data.telemetry.textfile import MAX_RECORDS, csv_rows, read_text
from spn_data.telemetry.track import Telemetry, increasing

MAX_DAMAGED_FRACTION = 0.05  # of the rows, above which the log as a whole is not believed
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
# Seconds since 1970 beyond this are a date after 1973, and never a time of flight.
_ABSOLUTE_S = 1e8


def read_csv_log(path: Path | str) -> Telemetry:
    """Telemetry of a log with a header row. Raises InputError naming file and line.

    Needs a latitude, a longitude and a time; `docs/telemetry.md` lists names and units of columns.
    Up to 5 % damaged rows are left out and counted in the notes.
    """
    rows = csv_rows(read_text(path), path, "telemetry")
    header_line, header = next(rows, (1, []))
    columns = _understood(header, header_line, path)
    records: list[dict[str, float]] = []
    damaged: list[tuple[int, str]] = []
    zoneless = False
    references: set[str] = set()
    for line, row in rows:
        if len(records) == MAX_RECORDS:
            raise InputError(f"has more than {MAX_RECORDS:,} rows", path=path, line=line)
        try:
            record, without_zone = _record(row, columns, len(header))
        except ValueError as error:
            damaged.append((line, str(error)))
            continue
        records.append(record)
        zoneless |= without_zone
        if "alt_reference" in columns:
            references.add(row[columns["alt_reference"].index].lower())
    total = len(records) + len(damaged)
    if total == 0:
        raise InputError("a header and no rows", path=path, line=header_line)
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
            "its times are dates, counted from the first: the offset to the video must be given, "
            "taken from the video's creation time, or estimated"
        )
    elif "utc" in columns and columns["time"].unit.startswith("milli"):
        notes.append(
            "its times count from the start of the flight, not of the video (Airdata): the offset "
            "must be given, or is estimated"
        )
    rel_alt_m, abs_alt_m, reference = _heights(table, references, path, header_line)
    lat_lon = np.stack([table["latitude"], table["longitude"]], axis=1)
    lat_lon[(lat_lon == 0).all(axis=1)] = np.nan  # how drones say that there is no fix
    index, order_notes = increasing(time_s)
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
    """Columns (N,) of the rows, NaN where a row, or the whole log, does not say."""

    def __init__(self, records: list[dict[str, float]]):
        self._records = records

    def __getitem__(self, name: str) -> np.ndarray:
        return np.array([record.get(name, NAN) for record in self._records])

    def known(self, name: str) -> int:
        return int(np.isfinite(self[name]).sum())


def _understood(header: list[str], line: int, path: Path | str) -> dict[str, CsvColumn]:
    """The columns by meaning. Raises InputError where one that is needed is missing."""
    columns = columns_of(header)
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
                f"the unit {column.unit!r} of column {column.header!r} is not known",
                path=path,
                line=line,
            )
    return columns


def _record(
    row: list[str], columns: dict[str, CsvColumn], width: int
) -> tuple[dict[str, float], bool]:
    """The numbers of a row in our units, and whether its date is of an unknown zone.

    Raises ValueError saying what is damaged.
    """
    if len(row) < width:
        raise ValueError(f"{len(row)} cells, the header has {width}")
    record: dict[str, float] = {}
    zoneless = False
    for name, column in columns.items():
        cell = row[column.index]
        if name == "alt_reference" or cell.lower() in _UNKNOWN:
            continue
        if name in ("time", "utc"):
            seconds, is_date, without_zone = _moment(cell, column)
            if name == "utc" and not is_date and not column.unit:
                raise ValueError(
                    f"{column.header} is {cell[:40]}, no date: a column of seconds is named time_s"
                )
            record.setdefault("utc" if is_date else "time", seconds)
            zoneless |= without_zone
        else:
            record[name] = _number(cell, column) * column.scale
    if not {"time", "utc"} & record.keys():
        raise ValueError("it has no time")
    lat, lon = record.get("latitude", NAN), record.get("longitude", NAN)
    if abs(lat) > 90 or abs(lon) > 180:
        raise ValueError(f"{lat}, {lon} is no position on Earth")
    return record, zoneless


def _moment(cell: str, column: CsvColumn) -> tuple[float, bool, bool]:
    """(seconds, whether they count from 1970, whether that is in a zone that is not known)."""
    try:
        seconds = float(cell)
    except ValueError:
        try:
            date = datetime.fromisoformat(cell.replace("/", "-"))
        except ValueError:
            raise ValueError(
                f"{column.header} is {cell[:40]!r}, no number and no date like 2024-05-01 12:00:00"
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


def _number(cell: str, column: CsvColumn) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.inf
    if not math.isfinite(value):
        raise ValueError(f"{column.header} is {cell[:40]!r}, not a number")
    return value


def _heights(
    table: _Table, references: set[str], path: Path | str, line: int
) -> tuple[np.ndarray, np.ndarray, HeightReference]:
    """(rel_alt_m, abs_alt_m, reference): the column whose name says most of its reference counts."""
    rel_alt_m = table["rel_alt"]
    for name, reference in (
        ("alt_ellipsoid", HeightReference.ELLIPSOID),
        ("alt_amsl", HeightReference.AMSL),
    ):
        if table.known(name):
            return rel_alt_m, table[name], reference
    if len(references) > 1 or not references <= _REFERENCES.keys():
        raise InputError(
            f"the height references are {', '.join(sorted(references))[:100]}; expected one of "
            f"{', '.join(_REFERENCES)} in all rows",
            path=path,
            line=line,
        )
    reference = _REFERENCES[references.pop()] if references else HeightReference.UNKNOWN
    if reference is HeightReference.TAKEOFF:
        own = rel_alt_m if table.known("rel_alt") else table["altitude"]
        return own, np.full(len(own), np.nan), HeightReference.UNKNOWN
    return rel_alt_m, table["altitude"], reference


def _sigma(table: _Table) -> np.ndarray:
    """(N, 3) from columns of standard deviations, else of accuracies, else of dilutions."""
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
    return np.where(sigma > 0, sigma, np.nan)  # loggers write 0 where they do not know


def _video_notes(time_s: np.ndarray, is_video: np.ndarray) -> list[str]:
    """When the drone recorded, where the log says so: the offsets that a user may give."""
    starts = time_s[is_video & ~np.concatenate([[False], is_video[:-1]])]
    if len(starts) == 0:
        return []
    listed = ", ".join(f"{t:.1f}" for t in starts[:5]) + (", ..." if len(starts) > 5 else "")
    return [f"recordings by its isVideo column: {len(starts)}, starting at {listed} s"]
