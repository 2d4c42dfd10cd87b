"""Figure of a training's loss and errors, drawn from its log.csv as SVG."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spn_data.charts import svg
from spn_data.charts.svg import COLOURS, INK, SOFT, Panel
from spn_data.errors import InputError
from spn_data.storage.files import read_csv
from spn_model.training.training_state import COLUMNS

_MOST_POINTS = 400  # largest number of points of a line; of more, an even selection is drawn
_EVENTS = {
    "validation": ("validation frames", COLOURS[1]),
    "views": ("rendered views", COLOURS[2]),
    "training": ("training images", SOFT),
}
_MAX_BYTES = 200_000_000


@dataclass(frozen=True, eq=False)
class Curve:
    """Values over the minutes of a training, both of shape (N,); NaN if unknown."""

    minutes: np.ndarray
    values: np.ndarray


@dataclass(frozen=True, eq=False)
class TrainingLog:
    """Contents of a training's log.

    Attributes
    ----------
    loss : Curve
        Loss of the steps.
    errors : dict of str to (Curve, Curve)
        Median errors of position and rotation by event.
    stages : tuple of (str, float)
        Name of each stage and the minute at which it began.
    minutes : float
        Duration of the training.
    images : int
        Number of images shown to the network.
    """

    loss: Curve
    errors: dict[str, tuple[Curve, Curve]]
    stages: tuple[tuple[str, float], ...]
    minutes: float
    images: int

    def facts(self) -> dict[str, float]:
        """Return duration and number of images, for metrics.json."""
        return {"minutes": round(self.minutes, 3), "images": self.images}


def read_log(path: Path) -> TrainingLog:
    """Read log.csv. Raises InputError, with the line, if it is not a training log."""
    rows: dict[str, list[tuple[float, float, float]]] = {"steps": [], **{e: [] for e in _EVENTS}}
    stages: list[tuple[str, float]] = []
    before, images = 0.0, 0
    for line, row in read_csv(path, COLUMNS, max_bytes=_MAX_BYTES):
        try:
            minutes, images = float(row["train_s"]) / 60, int(row["images"])
            if not (np.isfinite(minutes) and minutes >= 0):
                raise ValueError(f"train_s is {row['train_s']!r}")
            if row["event"] == "steps":
                rows["steps"].append((minutes, _number(row["loss"]), np.nan))
            elif row["event"] in _EVENTS:
                errors = _number(row["median_m"]), _number(row["median_deg"])
                rows[row["event"]].append((minutes, *errors))
        except ValueError as error:
            raise InputError(f"is not a training log: {error}", path=path, line=line) from error
        if not stages or stages[-1][0] != row["stage"]:
            stages.append((row["stage"], before))
        before = max(before, minutes)
    tables = {name: np.array(values).reshape(-1, 3) for name, values in rows.items()}
    return TrainingLog(
        Curve(tables["steps"][:, 0], tables["steps"][:, 1]),
        {
            name: (
                Curve(tables[name][:, 0], tables[name][:, 1]),
                Curve(tables[name][:, 0], tables[name][:, 2]),
            )
            for name in _EVENTS
        },
        tuple(stages),
        before,
        images,
    )


def training_figure(log: TrainingLog, *, unit: str = "m") -> str:
    """Draw loss and median errors of position and rotation over the minutes of training.

    Parameters
    ----------
    log : TrainingLog
        Contents of log.csv.
    unit : str
        Unit of positions.

    Returns
    -------
    str
        SVG document.
    """
    heading = f"training: {log.minutes:.1f} minutes, {log.images:,} images"
    parts = [svg.text(20, 22, heading, bold=True)]
    far = max(log.minutes, 1e-3)
    panels: list[tuple[str, list[tuple[Curve, str]]]] = [
        ("loss", [(log.loss, COLOURS[0])]),
        *(
            (label, [(log.errors[event][k], colour) for event, (_, colour) in _EVENTS.items()])
            for k, label in enumerate((f"median error ({unit})", "median error (deg)"))
        ),
    ]
    for column, (label, courses) in enumerate(panels):
        low, high = _limits([course for course, _ in courses], from_zero=column > 0)
        panel = Panel(54.0 + 320 * column, 66.0, 250.0, 190.0, (0.0, far), (low, high))
        parts.append(panel.axes("minutes of training", label))
        for _, began in log.stages[1:]:
            ends = panel.on_page(np.array([began, began]), np.array([low, high]))
            parts.append(svg.line(ends, INK, dash="2 4"))
        for course, colour in courses:
            parts += [_line(panel, course, colour), _marks(panel, course, colour, column > 0)]
    judged = [shown for event, shown in _EVENTS.items() if len(log.errors[event][0].values)]
    parts.append(svg.legend(62, 318, [("loss of steps", COLOURS[0]), *judged]))
    if len(log.stages) > 1:
        words = "; ".join(f"{name} from {began:.1f} min" for name, began in log.stages)
        parts.append(svg.text(374, 318, f"Dotted: stages ({words}).", colour=SOFT))
    return svg.document(1000, 384, heading, parts)


def _line(panel: Panel, course: Curve, colour: str) -> str:
    """Draw a line through the known values, or an even selection of them."""
    known = np.flatnonzero(np.isfinite(course.values))
    if len(known) == 0:
        return ""
    rows = known[np.unique(np.linspace(0, len(known) - 1, _MOST_POINTS).round().astype(int))]
    points = panel.on_page(course.minutes[rows], np.minimum(course.values[rows], panel.y_range[1]))
    return svg.line(points, colour, width=1.5) if len(points) > 1 else ""


def _marks(panel: Panel, course: Curve, colour: str, wanted: bool) -> str:
    known = np.isfinite(course.values) & (course.values <= panel.y_range[1])
    if not wanted or not known.any():
        return ""
    return svg.dots(panel.on_page(course.minutes[known], course.values[known]), colour)


def _limits(courses: Sequence[Curve], *, from_zero: bool) -> tuple[float, float]:
    """Return axis limits that show all values except isolated spikes."""
    values = np.concatenate([course.values[np.isfinite(course.values)] for course in courses])
    if len(values) == 0:
        return 0.0, 1.0
    high = float(np.quantile(values, 0.98))
    low = 0.0 if from_zero else min(0.0, float(values.min()))
    return low, high + max(0.08 * (high - low), 1e-6)


def _number(cell: str) -> float:
    """Parse a cell; empty and infinite values become NaN and are not drawn."""
    value = float(cell) if cell else np.nan
    return value if np.isfinite(value) else np.nan
