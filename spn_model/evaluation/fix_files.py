"""Fixes of a run as `fixes` of metrics.json, fixes.csv, figures, and what they mean for a flight."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from spn_data.dataset.hdf5_schema import Role
from spn_data.storage.files import write_csv
from spn_data.storage.json_files import number_or
from spn_model.evaluation.evaluate import EvaluatedGroup
from spn_model.evaluation.fixes import (
    COARSE,
    CONFIDENCE,
    MISLEADING_DEG,
    MISLEADING_M,
    FixSummary,
    FlightFixes,
    JudgedImage,
)
from spn_model.evaluation.tables import POSE_COLUMNS, pose_cells

FIX_COLUMNS = (
    *("flight", "method", "name", "time_s", "usable", "state", "source", "reason"),
    *("error", "error_deg", "error_horizontal", "error_vertical"),
    *("protection_horizontal", "protection_vertical", "nees", "misleading"),
    *POSE_COLUMNS,
)
LEAST_USABLE = 0.5  # share of usable fixes below which a flight is not to be flown on them


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What a measurement means for a flight.

    Attributes
    ----------
    may_fly : bool
        False for what speaks against a flight.
    text : str
        One sentence.
    """

    may_fly: bool
    text: str


@dataclass(frozen=True, eq=False, kw_only=True)
class RunFixes:
    """Fixes of the bundle of a run on all evaluation flights.

    Attributes
    ----------
    flights : tuple of FlightFixes
        Empty if none could be measured.
    bundle : mapping of str to str
        SHA-256 of the float32 graph (`network`) and of the `landmarks`, and the hash of the `map`.
    reason : str
        Why nothing was measured; empty otherwise.
    notes : tuple of str
        What is missing, one sentence each.
    """

    flights: tuple[FlightFixes, ...] = ()
    bundle: Mapping[str, str] | None = None
    reason: str = ""
    notes: tuple[str, ...] = ()

    def to_json(self, verdicts: Sequence[Verdict]) -> dict[str, Any]:
        """Return plain values for metrics.json; unknown numbers are NaN."""
        flights: dict[str, dict[str, Any]] = {}
        for one in self.flights:
            flights.setdefault(one.flight, {})[one.method] = asdict(one.summary())
        return {
            "reason": self.reason,
            "notes": list(self.notes),
            "bundle": dict(self.bundle or {}),
            "misleading": {
                "beyond_m": MISLEADING_M,
                "beyond_deg": MISLEADING_DEG,
                "confidence": CONFIDENCE,
            },
            "flights": flights,
            "verdict": [asdict(one) for one in verdicts],
        }


def verdicts_of(
    run: str, fixes: RunFixes, groups: Sequence[EvaluatedGroup], unit: str
) -> tuple[Verdict, ...]:
    """Return what the fixes and the coarse poses of a run mean for a flight.

    Parameters
    ----------
    run : str
        Its name, as that of its method in the groups.
    fixes : RunFixes
    groups : sequence of EvaluatedGroup
    unit : str
        Of positions.

    Returns
    -------
    tuple of Verdict
    """
    found = []
    if not fixes.flights:
        found.append(
            Verdict(
                may_fly=False,
                text=f"{run} is not to be flown: its fixes were not measured ({fixes.reason}).",
            )
        )
    for one in fixes.flights:
        if one.method != COARSE:
            found.append(_of_fixes(run, one))
    for group in groups:
        worse = _worse_than_retrieval(run, group, unit)
        if group.role is Role.TEST and worse:
            found.append(Verdict(may_fly=False, text=worse))
    return tuple(found)


def _of_fixes(run: str, one: FlightFixes) -> Verdict:
    summary, what = one.summary(), f"{one.method} on {one.flight}"
    if summary.misleading:
        return Verdict(
            may_fly=False,
            text=f"{run} is not to be flown: {summary.misleading} of {summary.compared} fixes are misleading "
            f"({what}).",
        )
    if not summary.compared or summary.usable < LEAST_USABLE * summary.images:
        return Verdict(
            may_fly=False,
            text=f"{run} is not to be flown where these images are: {summary.usable} of {summary.images} "
            f"have a usable fix ({what}).",
        )
    return Verdict(
        may_fly=True,
        text=f"Fixes of {run} can be used: {summary.usable} of {summary.images} images, "
        f"{100 * summary.error_m:.1f} cm, {summary.error_deg:.2f} deg, none misleading ({what}).",
    )


def _worse_than_retrieval(run: str, group: EvaluatedGroup, unit: str) -> str:
    """Return that coarse poses of the network are worse than those of the most similar image, or nothing."""
    by = {one.method: one.summary for one in group.evaluations}
    own, other = by.get(run), by.get(group.retrieval or "")
    if own is None or other is None or own.position.median <= other.position.median:
        return ""
    median = own.position.median
    off = f"{median:.2f} {unit}" if math.isfinite(median) else "no pose for half of the frames"
    return (
        f"Coarse poses of {run} alone are not to be flown: on {group.frames.group} they are worse than "
        f"those of the most similar image ({off} against {other.position.median:.2f} {unit}, medians)."
    )


def write_fixes(path: Path, flights: Sequence[FlightFixes]) -> None:
    """Write fixes.csv: one row per image and method; empty cells are unknown.

    Raises StageError if the file cannot be written.
    """
    rows = [_cells(one, image) for one in flights for image in one.images]
    write_csv(path, {name: [row[k] for row in rows] for k, name in enumerate(FIX_COLUMNS)})


def _cells(one: FlightFixes, image: JudgedImage) -> tuple[str, ...]:
    """Return the cells of an image, in the order of `FIX_COLUMNS`."""
    error = image.error
    errors: tuple[str, ...] = ("",) * 6
    if error is not None:
        errors = (
            *(number_cell(v) for v in (error.error_m, error.error_deg)),
            *(number_cell(v) for v in (error.horizontal_m, error.vertical_m)),
            number_cell(error.nees),
            str(int(error.is_misleading)),
        )
    return (
        *(one.flight, one.method, image.name, number_cell(image.time_s)),
        *(str(int(image.is_usable)), image.state, image.source, image.reason),
        *errors[:4],
        *(number_cell(level) for level in image.protection_m),
        *errors[4:],
        *(pose_cells(image.pose)[0] if image.pose is not None else ("",) * len(POSE_COLUMNS)),
    )


FIX_HEADER = (
    *("flight", "from", "usable", "median", "misleading", "NEES/6", "in level", "outage"),
)


def fix_rows(flights: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> list[tuple[str, ...]]:
    """Return a row of text for each flight and method, from `flights` of `RunFixes.to_json`."""
    rows: list[tuple[str, ...]] = []
    for flight, methods in flights.items():
        for method, values in methods.items():
            one = _summary(values)
            rows.append(
                (
                    flight,
                    method,
                    f"{one.usable} of {one.images}",
                    _median(one),
                    f"{one.misleading} (<= {100 * one.misleading_at_most:.1f} %)"
                    if one.compared
                    else "",
                    _text(one.nees, ".2f"),
                    _text(100 * one.protected, ".1f", " %"),
                    _text(one.longest_outage_s, ".1f", " s"),
                )
            )
    return rows


def _summary(values: Mapping[str, Any]) -> FixSummary:
    """Parse a summary; raise KeyError, TypeError or ValueError if it is none."""
    return FixSummary(
        images=int(values["images"]),
        usable=int(values["usable"]),
        compared=int(values["compared"]),
        error_m=number_or(values["error_m"]),
        error_deg=number_or(values["error_deg"]),
        largest_m=number_or(values["largest_m"]),
        misleading=int(values["misleading"]),
        misleading_at_most=number_or(values["misleading_at_most"]),
        nees=number_or(values["nees"]),
        protected=number_or(values["protected"]),
        longest_outage_s=number_or(values["longest_outage_s"]),
    )


def _median(one: FixSummary) -> str:
    if math.isnan(one.error_m):
        return ""
    position = f"{one.error_m:.2f} m" if one.error_m >= 1 else f"{100 * one.error_m:.1f} cm"
    return f"{position}, {one.error_deg:.2f} deg"


def _text(value: float, spec: str, unit: str = "") -> str:
    return "" if math.isnan(value) else f"{value:{spec}}{unit}"


def number_cell(value: float) -> str:
    """Return the cell of a number; empty if it is not finite."""
    return f"{value:.4f}" if math.isfinite(value) else ""
