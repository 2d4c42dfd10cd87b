"""Results of an evaluation, as tables."""

from __future__ import annotations

import math
from itertools import chain

from spn_cli import console
from spn_data.dataset.hdf5_schema import Role
from spn_model.evaluation.baselines import GEM, MEAN, ORACLE, PAPER_TABLE_1, VLAD
from spn_model.evaluation.evaluate import EvaluatedGroup, NetworkComparison
from spn_model.evaluation.fix_files import FIX_HEADER, fix_rows
from spn_model.evaluation.metrics import Evaluation, Summary
from spn_model.runs.run_evaluation import EvaluatedRuns

# Short names for tables with many columns; the table of errors has the full ones.
_SHORT = {MEAN: "mean pose", VLAD: "VLAD", GEM: "GeM", ORACLE: "oracle"}
_WHAT = {
    Role.TEST: "test frames",
    Role.VALIDATION: "validation frames of the mapping flights",
    Role.TRAIN: "training images",
}


def comparison(found: NetworkComparison) -> None:
    """Print the tables of each group and the cost of the networks."""
    unit = "m" if found.units == "m" else "units"
    for group in found.groups:
        _errors(group, unit)
        if group.role is not Role.TRAIN:
            _shares(group, unit)
            _strata(group, unit)
    rows = [
        (
            name,
            f"{1000 * cost.seconds / cost.images:.1f} ms",
            f"{1000 * cost.cpu_seconds / cost.images:.1f} ms",
            f"{cost.threads} threads" if cost.device == "cpu" else cost.device,
            f"{cost.images} images",
        )
        for name, cost in found.costs.items()
    ]
    console.table(
        "Time per image, from pixels to pose",
        rows,
        ("network", "wall", "CPU", "device", "measured on"),
    )


def fixes(evaluated: EvaluatedRuns) -> None:
    """Print the fixes of each run; what they mean for a flight is in the verdict."""
    for name, found in evaluated.fixes.items():
        rows = fix_rows(found.to_json()["flights"])
        if rows:
            console.table(f"{name}: fixes of its bundle on evaluation flights", rows, FIX_HEADER)
        for text in found.attitudes:
            console.say(text)


def notes(evaluated: EvaluatedRuns) -> None:
    """Print the notes on an evaluation."""
    if evaluated.comparison.units != "m":
        console.note("lengths are in model units, not metres.")
    of_fixes = [found.notes for found in evaluated.fixes.values()]
    for note in chain(evaluated.comparison.notes, *of_fixes):
        console.note(note)


def _errors(group: EvaluatedGroup, unit: str) -> None:
    rows: list[tuple[str, ...]] = [
        (
            one.method + (" (the better)" if one.method == group.retrieval else ""),
            f"{one.summary.located} of {one.summary.frames}",
            *(
                _pair(getattr(one.summary.position, what), getattr(one.summary.rotation_deg, what))
                for what in ("median", "mean", "p95")
            ),
        )
        for one in group.evaluations
    ]
    published = [
        (
            f"{row.network}, in the paper*",
            "",
            _pair(row.position_m, row.rotation_deg),
            "",
            "",
        )
        for row in PAPER_TABLE_1
        if row.sequence == group.frames.group
    ]
    console.table(
        f"{group.frames.group}: errors of {len(group.frames)} {_WHAT[group.role]} ({unit} / deg)",
        [*rows, *published],
        ("method", "poses", "median", "mean", "p95"),
    )
    if published:
        console.say(
            "* on another courtyard, with other cameras; the paper does not state whether these are means or "
            "medians.\n"
        )


def _shares(group: EvaluatedGroup, unit: str) -> None:
    """Print shares within limits, signed errors by axis, and the fit of covariances."""
    within = group.evaluations[0].summary.within
    rows = [
        (
            _short(one),
            *(f"{100 * part.share:.0f} %" for part in one.summary.within),
            *(_signed(axis.signed_median) for axis in one.summary.axes),
            _ratio(one),
        )
        for one in group.evaluations
    ]
    header = (
        "method",
        *(f"{part.limit:g}/{part.limit_deg:g}" for part in within),
        *group.frames.axes,
        "fit",
    )
    console.table(
        f"{group.frames.group}: share within {unit}/deg, median signed errors ({unit}), fit of covariances "
        "(1 is ideal)",
        rows,
        header,
    )


def _strata(group: EvaluatedGroup, unit: str) -> None:
    """Print medians by coverage."""
    first = group.evaluations[0]
    if len(first.strata) < 2:
        return
    rows = [
        (_short(one), *(_median(one.strata[name]) for name in first.strata))
        for one in group.evaluations
    ]
    header = ("method", *(f"{name} ({part.frames})" for name, part in first.strata.items()))
    console.table(f"{group.frames.group}: medians by coverage ({unit} / deg)", rows, header)


def _short(one: Evaluation) -> str:
    return _SHORT.get(one.method, one.method)


def _median(summary: Summary) -> str:
    return _pair(summary.position.median, summary.rotation_deg.median)


def _pair(position: float, rotation_deg: float) -> str:
    if math.isnan(position):
        return ""
    return "too few" if math.isinf(position) else f"{position:.2f} / {rotation_deg:.1f}"


def _signed(value: float) -> str:
    return "" if math.isnan(value) else f"{value:+.2f}"


def _ratio(one: Evaluation) -> str:
    if one.calibration is None or math.isnan(one.calibration.ratio):
        return ""
    return f"{one.calibration.ratio:.2f}"
