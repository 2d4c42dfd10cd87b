"""What networks were found to be worth, as tables."""

from __future__ import annotations

import math

from cli import console
from spn_data.hdf5_schema import Role
from spn_model.baselines import PAPER_TABLE_1
from spn_model.evaluate import Comparison, Judged
from spn_model.metrics import Evaluation, Summary

_WHAT = {
    Role.TEST: "test frames",
    Role.VALIDATION: "validation frames, of the mapping flights",
    Role.TRAIN: "training images",
}


def comparison(found: Comparison) -> None:
    """Tables of each group, then what the networks cost, and notes."""
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
        "Time an image, from pixels to pose", rows, ("network", "wall", "CPU", "on", "of")
    )
    if found.units != "m":
        console.note("lengths are in units of the model, not metres.")
    for note in found.notes:
        console.note(note)


def _errors(group: Judged, unit: str) -> None:
    rows: list[tuple[str, ...]] = [
        (
            one.method + (" (the better)" if one.method == group.retrieval else ""),
            f"{one.summary.located} of {one.summary.frames}",
            *(
                _pair(
                    getattr(one.summary.position, what),
                    getattr(one.summary.rotation_deg, what),
                    unit,
                )
                for what in ("median", "mean", "p95")
            ),
        )
        for one in group.evaluations
    ]
    published = [
        (
            f"{row.network}, in the paper*",
            "",
            f"{row.position_m:.2f} m, {row.rotation_deg:.1f} deg",
            "",
            "",
        )
        for row in PAPER_TABLE_1
        if row.sequence == group.frames.group
    ]
    console.table(
        f"{group.frames.group}: errors of {len(group.frames)} {_WHAT[group.role]}",
        [*rows, *published],
        ("method", "poses", "median", "mean of poses", "p95"),
    )
    if published:
        console.out.print(
            "* in another court, with other cameras; whether means or medians is not said.\n"
        )


def _shares(group: Judged, unit: str) -> None:
    """Shares within limits, signed errors by axis, and the fit of covariances."""
    within = group.evaluations[0].summary.within
    rows = [
        (
            one.method,
            *(f"{100 * part.share:.0f} %" for part in one.summary.within),
            *(_signed(axis.signed_median) for axis in one.summary.axes),
            _ratio(one),
        )
        for one in group.evaluations
    ]
    header = (
        "method",
        *(f"{part.limit:g} {unit}, {part.limit_deg:g} deg" for part in within),
        *(f"{axis} ({unit})" for axis in group.frames.axes),
        "covariance",
    )
    console.table(
        f"{group.frames.group}: frames within limits, median signed error by axis, median squared error "
        "over what the covariance says (1 is right)",
        rows,
        header,
    )


def _strata(group: Judged, unit: str) -> None:
    first = group.evaluations[0]
    if len(first.strata) < 2:
        return
    rows = [
        (one.method, *(_median(one.strata[name], unit) for name in first.strata))
        for one in group.evaluations
    ]
    header = ("method", *(f"{name} ({part.frames})" for name, part in first.strata.items()))
    console.table(f"{group.frames.group}: medians by coverage", rows, header)


def _median(summary: Summary, unit: str) -> str:
    return _pair(summary.position.median, summary.rotation_deg.median, unit)


def _pair(position: float, rotation_deg: float, unit: str) -> str:
    if math.isnan(position):
        return ""
    if math.isinf(position):
        return "too few poses"
    return f"{position:.2f} {unit}, {rotation_deg:.1f} deg"


def _signed(value: float) -> str:
    return "" if math.isnan(value) else f"{value:+.2f}"


def _ratio(one: Evaluation) -> str:
    if one.calibration is None or math.isnan(one.calibration.ratio):
        return ""
    return f"{one.calibration.ratio:.2f}"
