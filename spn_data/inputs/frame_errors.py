"""Errors of single frames in errors.csv and fixes.csv of a run, read as untrusted files."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from spn_data.area.names import ERRORS, FIXES
from spn_data.errors import InputError
from spn_data.report.frame_errors import FlightErrors
from spn_data.storage.files import read_csv

_MAX_BYTES = 100_000_000
_MAX_ROWS = 200_000  # of one method
_MAX_NAME = 300
_NEEDED = ("method", "name", "error", "error_deg")
_MAX_HEADER = 2000
_FLOWN = "track"  # the way of fixing that a flight uses: image after image


def read_frame_errors(folder: Path, network: str) -> tuple[FlightErrors, ...]:
    """Read the errors of a network on single frames, and those of the fixes of its bundle.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    network : str
        Name of the network, a method in errors.csv.

    Returns
    -------
    tuple of FlightErrors
        Of the network, and of the fixes if there are any; empty if nothing was written.

    Raises
    ------
    InputError
        If a file is damaged or too large.
    """
    found = []
    errors, fixes = folder / ERRORS, folder / FIXES
    if errors.is_file() and not errors.is_symlink():
        found.append(_read(errors, network, network))
    if fixes.is_file() and not fixes.is_symlink():
        found.append(_read(fixes, _FLOWN, f"{network}, fixes"))
    return tuple(one for one in found if len(one.names))


def _read(path: Path, method: str, title: str) -> FlightErrors:
    names: list[str] = []
    errors: list[float] = []
    angles: list[float] = []
    for line, row in read_csv(path, _header(path), max_bytes=_MAX_BYTES):
        if row["method"] != method:
            continue
        if len(names) >= _MAX_ROWS:
            raise InputError(f"has more than {_MAX_ROWS} rows of one method", path=path, line=line)
        names.append(row["name"][:_MAX_NAME])
        try:
            errors.append(_positive(row["error"]))
            angles.append(_positive(row["error_deg"]))
        except ValueError as error:
            raise InputError(str(error), path=path, line=line) from error
    return FlightErrors(title, np.array(names, np.str_), np.array(errors), np.array(angles))


def _header(path: Path) -> list[str]:
    """Return the columns of a file; which there are beside the needed ones depends on the evaluation."""
    with path.open("rb") as file:
        first = file.readline(_MAX_HEADER).decode("utf-8", "replace")
    columns = first.rstrip("\r\n").split(",")
    missing = [name for name in _NEEDED if columns.count(name) != 1]
    if missing:
        raise InputError(f"the header has no column {missing[0]!r}", path=path, line=1)
    return columns


def _positive(cell: str) -> float:
    """Return an error; NaN if it is unknown."""
    if cell == "":
        return math.nan
    value = float(cell)
    if not 0 <= value < 1e12:
        raise ValueError(f"{cell!r} is not an error")
    return value
