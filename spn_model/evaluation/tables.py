"""Evaluations as metrics.json, errors.csv, and rows of a table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.geometry.pose import Poses
from spn_data.storage.files import write_csv
from spn_data.storage.json_files import finite, write_json
from spn_model.evaluation.baselines import PAPER_SOURCE, PAPER_TABLE_1
from spn_model.evaluation.metrics import Evaluation, Summary

VERSION = 1
POSE_COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz")  # of the estimated pose, as in poses.csv
HEADER = (
    *("method", "frames", "located", "position median", "mean", "p95"),
    *("rotation median", "mean", "p95"),
)


def write_metrics(
    path: Path,
    evaluations: Sequence[Evaluation],
    *,
    units: str,
    retrieval: Mapping[str, str],
    facts: Mapping[str, Any],
    fixes: Mapping[str, Any] | None = None,
) -> None:
    """Write metrics.json atomically.

    units : "m" or "model", of all lengths. retrieval : name of the better retrieval method, by group. facts :
    additional plain values of the run (times, memory, seeds). fixes : those of the run, None for several
    runs. Raises ValueError for two evaluations of the same method and group.
    """
    groups: dict[str, dict[str, Any]] = {}
    for one in evaluations:
        methods = groups.setdefault(one.frames.group, {})
        if one.method in methods:
            raise ValueError(f"duplicate evaluation of {one.method} on {one.frames.group}")
        methods[one.method] = {
            **asdict(one.summary),
            "strata": {name: asdict(summary) for name, summary in one.strata.items()},
            "curve": [asdict(part) for part in one.curve],
            "calibration": None if one.calibration is None else asdict(one.calibration),
        }
    document = {
        "version": VERSION,
        "units": units,
        "groups": groups,
        "retrieval": dict(retrieval),
        "paper": {"source": PAPER_SOURCE, "table_1": [asdict(row) for row in PAPER_TABLE_1]},
        "facts": dict(facts),
        **({} if fixes is None else {"fixes": dict(fixes)}),
    }
    write_json(path, finite(document))


def write_errors(path: Path, evaluations: Sequence[Evaluation]) -> None:
    """Write errors.csv: one row per frame and method; empty cells are unknown.

    All evaluations have to be in the same world.
    """
    columns: dict[str, list[str]] = {}
    for one in evaluations:
        frames, errors = one.frames, one.errors
        parts: dict[str, Sequence[str]] = {
            "method": [one.method] * len(frames),
            "group": [frames.group] * len(frames),
            "name": [str(name) for name in frames.names],
            "stratum": [str(stratum) for stratum in frames.strata],
            "nearest": _cells(frames.nearest_m, 4),
            "nearest_deg": _cells(frames.nearest_deg, 3),
            "located": [str(int(found)) for found in errors.located],
            "error": _cells(errors.error_m, 4),
            "error_deg": _cells(errors.error_deg, 4),
            **{
                f"signed_{axis}": _cells(errors.signed_m[:, k], 4)
                for k, axis in enumerate(frames.axes)
            },
            "sigma": _cells(errors.sigma_m, 4),
            "sigma_deg": _cells(errors.sigma_deg, 4),
            "distance_sq": _cells(errors.nees, 4),
            **dict(zip(POSE_COLUMNS, zip(*pose_cells(one.poses), strict=True), strict=True)),
        }
        for name, cells in parts.items():
            columns.setdefault(name, []).extend(cells)
    write_csv(path, columns)


def header(evaluations: Sequence[Evaluation]) -> list[str]:
    """Return the column titles of `rows`."""
    within = evaluations[0].summary.within
    axes = evaluations[0].frames.axes
    return [
        *HEADER,
        *(f"within {part.limit:g} m, {part.limit_deg:g} deg" for part in within),
        *(f"{axis} signed" for axis in axes),
        "calibration",
    ]


def rows(evaluations: Sequence[Evaluation]) -> list[list[str]]:
    """Return the table of one group as text, one row per method; `paper_rows` gives the paper's rows."""
    return [[one.method, *_figures(one.summary), _calibration(one)] for one in evaluations]


def paper_rows(sequence: str, columns: int) -> list[list[str]]:
    """Return table 1 of the paper for sequence "medium" or "low", with as many columns as `rows`.

    Other sequences have no rows.
    The paper does not say whether its figures are means or medians: they are listed as medians, with a mark.
    """
    return [
        [
            *(f"{row.network} (paper, another place)", "", ""),
            *(f"{row.position_m:.2f}*", "", "", f"{row.rotation_deg:.2f}*"),
            *[""] * (columns - 7),
        ]
        for row in PAPER_TABLE_1
        if row.sequence == sequence
    ]


def _figures(summary: Summary) -> list[str]:
    position, rotation = summary.position, summary.rotation_deg
    return [
        *(str(summary.frames), str(summary.located)),
        *(_text(value, 2) for value in (position.median, position.mean, position.p95)),
        *(_text(value, 2) for value in (rotation.median, rotation.mean, rotation.p95)),
        *(f"{100 * part.share:.0f} %" for part in summary.within),
        *(_text(axis.signed_median, 2, sign="+") for axis in summary.axes),
    ]


def _calibration(one: Evaluation) -> str:
    return "" if one.calibration is None else _text(one.calibration.ratio, 2)


def _text(value: float, digits: int, sign: str = "") -> str:
    """Format a value; NaN (unknown) gives an empty string, infinity (too few poses) "none"."""
    if math.isnan(value):
        return ""
    return "none" if math.isinf(value) else f"{value:{sign}.{digits}f}"


def pose_cells(poses: Poses) -> list[tuple[str, ...]]:
    """Return the cells of `POSE_COLUMNS` for each pose; empty where it is unknown."""
    digits = (4, 4, 4, 6, 6, 6, 6)
    values = np.hstack([poses.centers, poses.quats_wxyz])
    columns = [_cells(values[:, k], digit) for k, digit in enumerate(digits)]
    return list(zip(*columns, strict=True))


def _cells(values: np.ndarray, digits: int) -> list[str]:
    return [f"{value + 0.0:.{digits}f}" if np.isfinite(value) else "" for value in values]
