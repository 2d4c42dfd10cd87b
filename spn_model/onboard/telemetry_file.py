"""Columns of a telemetry file over time, as `spn-data telemetry` writes it; read by NumPy within bounds."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.json_values import bounded

TIME = "time_s"
MAX_TIME_S = 1e10
MAX_GAP_S = 1.0  # between records that are interpolated
_SAME_S = 1e-3  # from a record, such as that of a photo, which needs no neighbour
_MAX_BYTES, _MAX_ROWS = 50_000_000, 500_000

Bounds = tuple[float, float]


def read_columns(
    path: Path, needed: Mapping[str, Bounds], optional: Mapping[str, Bounds] | None = None
) -> np.ndarray:
    """Read columns of a CSV file with a header; other columns and lines that begin with "#" are ignored.

    Parameters
    ----------
    path : Path
    needed : mapping of str to tuple of float
        Columns beside the time, with the least and the largest value.
    optional : mapping of str to tuple of float, optional
        Columns that the file may lack.

    Returns
    -------
    ndarray, shape (N, columns)
        Time, needed and optional columns of the records with all needed ones; NaN for what is not stated.

    Raises
    ------
    InputError
        If the file cannot be read, a value is out of bounds, or no record has all needed columns.
    """
    columns = {TIME: (-MAX_TIME_S, MAX_TIME_S), **needed, **(optional or {})}
    required = 1 + len(needed)
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise InputError(f"is larger than {_MAX_BYTES // 1_000_000} MB", path=path)
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = ((k, line) for k, line in enumerate(file, 1) if not line.startswith("#"))
            rows = list(_parsed(path, lines, columns, required))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"cannot be read as a telemetry file ({error})", path=path) from error
    table = np.array(rows, dtype=np.float64).reshape(-1, len(columns))
    table = table[np.isfinite(table[:, :required]).all(axis=1)]
    if not len(table):
        raise InputError(f"has no record with {' and '.join(needed)}", path=path)
    return table


def _parsed(
    path: Path,
    lines: Iterator[tuple[int, str]],
    columns: Mapping[str, Bounds],
    required: int,
) -> Iterator[list[float]]:
    first = next(lines, (1, ""))
    header = [name.strip() for name in next(csv.reader([first[1]]), [])]
    wanted = list(columns)[:required]
    if any(header.count(name) != 1 for name in wanted):
        raise InputError(
            f"its header needs the columns {', '.join(wanted[:-1])} and {wanted[-1]}, once each; write it "
            "with spn-data telemetry FILE --to NEW.csv",
            path=path,
            line=first[0],
        )
    at = [header.index(name) if name in header else -1 for name in columns]
    previous_s = -math.inf
    for count, (number, line) in enumerate(lines):
        cells = next(csv.reader([line]), [])
        if not cells:
            continue
        try:
            if count >= _MAX_ROWS:
                raise ValueError(f"more than {_MAX_ROWS} records")
            if len(cells) != len(header):
                raise ValueError(f"{len(cells)} cells instead of {len(header)}")
            values = [
                bounded(float(cells[k]), *between) if k >= 0 and cells[k].strip() else math.nan
                for k, between in zip(at, columns.values(), strict=True)
            ]
            if not values[0] > previous_s:
                raise ValueError(f"{TIME} {cells[at[0]]!r} is not later than that before")
        except ValueError as error:
            raise InputError(str(error), path=path, line=number) from error
        previous_s = values[0]
        yield values


def between(times_s: np.ndarray, time_s: float) -> tuple[list[int], float] | None:
    """Return two records and the share of the second at a time between them.

    None outside the records, and in gaps of more than a second unless a record is within a millisecond.
    """
    after = int(np.searchsorted(times_s, time_s))
    k = [max(after - 1, 0), min(after, len(times_s) - 1)]
    first_s, last_s = times_s[k]
    is_between = first_s <= time_s <= last_s and last_s - first_s <= MAX_GAP_S
    if not is_between and not np.abs(times_s[k] - time_s).min() <= _SAME_S:
        return None
    return k, (time_s - first_s) / (last_s - first_s) if last_s > first_s else 0.0
