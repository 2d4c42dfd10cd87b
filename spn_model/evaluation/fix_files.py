"""Fixes of a run as `fixes` of metrics.json, as fixes.csv, and as rows of a table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from spn_data.storage.files import write_csv
from spn_data.storage.json_files import number_or
from spn_model.evaluation.fixes import (
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

    @property
    def attitudes(self) -> tuple[str, ...]:
        """A sentence on the known attitude of each flight that has rows with one."""
        texts = [one.attitude.text for one in self.flights if one.attitude is not None]
        return tuple(dict.fromkeys(texts))

    def to_json(self) -> dict[str, Any]:
        """Return plain values for metrics.json; unknown numbers are NaN."""
        flights: dict[str, dict[str, Any]] = {}
        for one in self.flights:
            flights.setdefault(one.flight, {})[one.row] = asdict(one.summary())
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
            "attitudes": list(self.attitudes),
        }


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
        *(one.flight, one.row, image.name, number_cell(image.time_s)),
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
