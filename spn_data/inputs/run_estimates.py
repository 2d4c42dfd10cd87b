"""Estimated poses of trained networks for the report: errors.csv and fixes.csv, read as untrusted files."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import ERRORS, FIXES, RUNS
from spn_data.errors import InputError
from spn_data.geometry.pose import Poses
from spn_data.report.pictures import COARSE, RunEstimates
from spn_data.report.run_facts import RunFacts

_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_ERRORS = ("method", "name", "error", "error_deg", *_POSE)
_FIXES = (*_ERRORS, "reason")
_MAX_BYTES, _MAX_ROWS, _MAX_TEXT = 500_000_000, 2_000_000, 200
_MAX_METHODS = 20
_MAX_UNIT_ERROR = 1e-3  # of the norm of a quaternion

_Row = tuple[list[float], float, float, str]  # pose, errors, reason


def read_estimates(
    area: Area, runs: Sequence[RunFacts]
) -> tuple[tuple[RunEstimates, ...], tuple[str, ...]]:
    """Read the estimated poses of the runs of an area.

    Parameters
    ----------
    area : Area
    runs : sequence of RunFacts
        Those with one network, evaluated on the current data set, are read.

    Returns
    -------
    estimates : tuple of RunEstimates
        By run: the network alone first, then fixes.
    notes : tuple of str
        Why poses of a run cannot be shown.
    """
    found: list[RunEstimates] = []
    notes: list[str] = []
    for run in runs:
        if len(run.networks) != 1 or not run.is_current or run.is_outdated:
            continue
        (network,) = run.networks
        folder = area.root / RUNS / run.name
        try:
            rows = _read(folder / ERRORS, _ERRORS).get(network)
            found += [_estimates(run.name, COARSE, rows)] if rows else []
            if (folder / FIXES).is_file():
                by_method = _read(folder / FIXES, _FIXES)
                by_method.pop(COARSE, None)  # of fewer frames than errors.csv has
                found += [_estimates(run.name, *item) for item in by_method.items()]
        except InputError as error:
            notes.append(f"{error}; run spn-model evaluate --run {run.name} again")
    return tuple(found), tuple(notes)


def _read(path: Path, columns: Sequence[str]) -> dict[str, dict[str, _Row]]:
    """Return the estimates of a table by method and frame."""
    rows: dict[str, dict[str, _Row]] = {}
    for line, cells in _cells(path, columns):
        of = rows.setdefault(cells["method"][:_MAX_TEXT], {})
        if len(rows) > _MAX_METHODS:
            raise InputError(f"has more than {_MAX_METHODS} methods", path=path, line=line)
        try:
            of[cells["name"][:_MAX_TEXT]] = _row(cells)
        except ValueError as error:
            what = f"not an estimated pose ({str(error)[:_MAX_TEXT]})"
            raise InputError(what, path=path, line=line) from error
    return rows


def _cells(path: Path, columns: Sequence[str]) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield line and cells of a table that has these columns among others."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise InputError(f"is larger than {_MAX_BYTES // 1_000_000} MB", path=path)
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file, strict=True, restval="")
            missing = [name for name in columns if name not in (reader.fieldnames or ())]
            if missing:
                raise InputError(
                    f"has no column {missing[0]}: estimated poses cannot be shown", path=path
                )
            for count, cells in enumerate(reader):
                if count >= _MAX_ROWS:
                    raise InputError(f"has more than {_MAX_ROWS:,} rows", path=path)
                yield reader.line_num, cells
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"cannot be read ({str(error)[:_MAX_TEXT]})", path=path) from error


def _row(cells: dict[str, str]) -> _Row:
    pose = [_number(cells[name]) for name in _POSE]
    if all(math.isnan(value) for value in pose):
        pose = [math.nan] * len(_POSE)
    elif abs(math.hypot(*pose[3:]) - 1) < _MAX_UNIT_ERROR and math.isfinite(sum(pose[:3])):
        norm = math.hypot(*pose[3:])
        pose[3:] = [value / norm for value in pose[3:]]
    else:
        raise ValueError("position and unit quaternion expected")
    reason = cells.get("reason", "")[:_MAX_TEXT]
    errors = _number(cells["error"]), _number(cells["error_deg"])
    if any(value < 0 for value in errors):
        raise ValueError("a negative error")
    return pose, *errors, reason


def _number(cell: str) -> float:
    value = float(cell) if cell else math.nan
    if math.isinf(value):
        raise ValueError("an infinite number")
    return value


def _estimates(run: str, method: str, rows: dict[str, _Row]) -> RunEstimates:
    poses = np.array([row[0] for row in rows.values()])
    return RunEstimates(
        run=run,
        method=method,
        names=np.array(list(rows), dtype=np.str_),
        poses=Poses(poses[:, :3], poses[:, 3:]),
        error=np.array([row[1] for row in rows.values()]),
        error_deg=np.array([row[2] for row in rows.values()]),
        reasons=np.array([row[3] for row in rows.values()], dtype=np.str_),
    )
