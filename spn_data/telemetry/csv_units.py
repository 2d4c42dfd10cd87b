"""Units that a CSV log does not state, decided by the consistency of whole columns."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from spn_data.telemetry.csv_columns import CsvColumn

Rows = Sequence[tuple[int, list[str]]]

_INTEGER_DEG = 1e-7  # latitude and longitude as integers: MAVLink and PX4
_MILLIMETRES = 1e-3  # heights beside them
_HEIGHTS = ("rel_alt", "alt_ellipsoid", "alt_amsl", "altitude")


def with_consistent_units(
    columns: dict[str, CsvColumn], rows: Rows
) -> tuple[dict[str, CsvColumn], list[str]]:
    """Return the columns with scales that make them consistent, and notes on what was decided.

    Parameters
    ----------
    columns : dict of str to CsvColumn
        Columns by meaning.
    rows : sequence of (int, list of str)
        Line and cells of the rows.

    Returns
    -------
    columns : dict of str to CsvColumn
        Latitude and longitude as integers of 1e-7 degrees, together with heights as integers of millimetres,
        and gimbal angles as tenths of degrees, if no other unit is possible. Angles without a decimal point
        that could be either are left out.
    notes : list of str
        One sentence for each decision.
    """
    result = dict(columns)
    notes: list[str] = []
    lat, lon = (_values(columns[name], rows) for name in ("latitude", "longitude"))
    if _are_integers(lat) and _are_integers(lon) and max(map(_largest, (lat, lon))) > 180:
        names = ["latitude", "longitude"]
        heights = [
            name
            for name in _HEIGHTS
            if name in columns
            and not columns[name].unit
            and _are_integers(_values(columns[name], rows))
        ]
        for name in names:
            result[name] = replace(columns[name], scale=_INTEGER_DEG)
        for name in heights:
            result[name] = replace(columns[name], scale=_MILLIMETRES)
        listed = ", ".join(columns[name].header for name in heights)
        notes.append(
            "latitude and longitude are integers, read as 1e-7 degrees (PX4, MAVLink)"
            + (f"; the heights {listed} beside them are read as millimetres" if listed else "")
        )
    angles = [
        name for name in ("heading", "pitch", "roll") if name in columns and not columns[name].unit
    ]
    known = {name: _values(columns[name], rows) for name in angles}
    limits = {"heading": 360.0, "pitch": 180.0, "roll": 180.0}
    headers = ", ".join(columns[name].header for name in angles)
    if any(_largest(known[name]) > limits[name] for name in angles):
        for name in angles:
            result[name] = replace(columns[name], scale=0.1)
        notes.append(f"{headers} exceed a full circle and are read as tenths of degrees (Litchi)")
    elif any(columns[name].header.lower() == "gimbalpitch" for name in angles) and all(
        _are_integers(known[name]) for name in angles
    ):
        if any(_largest(known[name]) > 0 for name in angles):
            notes.append(
                f"{headers} could be degrees or tenths of degrees (Litchi) and are left out: write the unit "
                "in brackets behind the name"
            )
        for name in angles:
            del result[name]
    return result, notes


def _values(column: CsvColumn, rows: Rows) -> np.ndarray:
    """Return the numbers of a column as they are in the file, without the cells that are none."""
    values = []
    for _, row in rows:
        try:
            value = float(row[column.index])
        except (ValueError, IndexError):
            continue
        if math.isfinite(value):
            values.append(value)
    return np.array(values)


def _are_integers(values: np.ndarray) -> bool:
    return len(values) > 0 and bool(np.all(values == np.round(values)))


def _largest(values: np.ndarray) -> float:
    return float(np.abs(values).max()) if len(values) else 0.0
