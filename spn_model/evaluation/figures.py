"""Figures of an evaluation as SVG: figures 6 to 9 of the paper, and calibration (docs/evaluation.md)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spn_data.charts import svg
from spn_data.charts.svg import COLOURS, INK, MARKERS, SOFT, Panel
from spn_data.geometry.pose import Poses
from spn_model.evaluation.metrics import ENU, CurveBin, Estimates, Evaluation, EvaluationFrames
from spn_model.evaluation.trajectory_view import thinned, trajectory_panel

_MOST_BARS = 25
_FAR = 1.5  # times the p95: larger errors do not extend the scale
_ROW = 150.0


def trajectories(
    training: Poses, frames: EvaluationFrames, estimates: Sequence[Estimates], *, unit: str = "m"
) -> str:
    """Draw training cameras, true trajectory and estimates, obliquely and from above (the paper's 6 and 8).

    A thin line connects each estimate with its true position, and short lines show where cameras look.
    Estimates far outside the area are counted in the legend instead of drawn. Long sequences are thinned
    evenly.
    """
    heading = f"{frames.group}: trajectories"
    drawn = len(thinned(len(frames)))
    parts = [svg.text(20, 22, heading, bold=True)]
    for left, width, (azimuth, elevation), words in (
        (56.0, 524.0, (-60.0, 25.0), "from the south-east, above"),
        (600.0, 380.0, (-90.0, 90.0), "from above"),
    ):
        if frames.axes != ENU:
            words = f"along {frames.axes[2]}" if elevation == 90 else f"{frames.axes[2]} upwards"
        panel, outside = trajectory_panel(
            (left, 50.0, width, 400.0), (azimuth, elevation), training, frames, estimates, unit
        )
        parts += [svg.text(left, 44, words, colour=SOFT), panel]
    entries = [
        (_counted("training cameras", len(thinned(len(training))), len(training)), SOFT),
        (_counted("true poses", drawn, len(frames)), INK),
    ]
    for k, one in enumerate(estimates):
        missing = int(np.isnan(one.poses.centers).any(axis=1).sum())
        notes = [
            f"{len(frames) - missing} estimates",
            *([f"{outside[k]} outside the plot"] if outside[k] else []),
            *([f"{missing} without a pose"] if missing else []),
        ]
        entries.append((f"{one.method} ({', '.join(notes)})", COLOURS[k % len(COLOURS)]))
    markers = ["circle", "circle", *(_marker(k) for k in range(len(estimates)))]
    parts.append(svg.legend(28, 480, entries, markers))
    return svg.document(1000, 480 + 17 * len(entries), heading, parts)


def histograms(
    evaluations: Sequence[Evaluation],
    *,
    unit: str = "m",
    limits: tuple[float, float] | None = None,
) -> str:
    """Draw histograms of position and rotation errors on one group, one row per method (the paper's 7 and 9).

    Bars are shares of the frames, those without a pose included. All methods share the scales. If a few
    errors are far larger than the others, the scale ends at the largest p95, and a paler bar is the share
    beyond it. limits : ends of the scales of position and rotation errors instead.
    """
    heading = f"{evaluations[0].frames.group}: errors"
    parts = [svg.text(20, 22, heading, bold=True)]
    steps: list[float] = []
    tops: list[float] = []
    for column, values in enumerate(
        ([e.errors.error_m for e in evaluations], [e.errors.error_deg for e in evaluations])
    ):
        reach = limits[column] if limits else max(_reach(v[np.isfinite(v)]) for v in values)
        steps.append(svg.round_step(reach / _MOST_BARS))
        tops.append(float(np.ceil(reach / steps[-1] - 1e-9) * steps[-1]))
    counts = [
        [_counts(v, s, t) for v, s, t in zip(_both(one), steps, tops, strict=True)]
        for one in evaluations
    ]
    highest = [
        max(float(c[k].max()) / len(e.frames) for c, e in zip(counts, evaluations, strict=True))
        for k in range(2)
    ]
    for k, one in enumerate(evaluations):
        colour = COLOURS[k % len(COLOURS)]
        top_px = 62 + k * _ROW
        for column in range(2):
            bars = counts[k][column]
            edge = tops[column]
            panel = Panel(
                54.0 + 480 * column,
                top_px,
                420.0,
                80.0,
                (0.0, edge + 1.5 * steps[column]),
                (0.0, min(max(0.05, highest[column]), 1.0) * 1.3),  # room for the text
            )
            label = f"position error ({unit})" if column == 0 else "rotation error (deg)"
            parts.append(panel.axes(label, "share of frames", one.method))
            parts.append(_bars(panel, bars / len(one.frames), steps[column], colour))
            median = one.summary.position.median if column == 0 else one.summary.rotation_deg.median
            if median <= edge:
                ends = panel.on_page(np.array([median, median]), np.array(panel.y_range))
                parts.append(svg.line(ends, INK, dash="4 3"))
            missing = one.summary.frames - one.summary.located
            of = unit if column == 0 else "deg"
            middle = f"median {median:.2f} {of}" if np.isfinite(median) else "no median"
            caption = f"{len(one.frames)} frames: {middle}"
            caption += f", {bars[-1]} beyond {edge:g}" if bars[-1] else ""
            caption += f", {missing} without a pose" if missing else ""
            parts.append(
                svg.text(panel.left + 416, top_px + 12, caption, anchor="end", colour=SOFT)
            )
    return svg.document(1000, 62 + _ROW * len(evaluations), heading, parts)


def error_curves(evaluations: Sequence[Evaluation], *, unit: str = "m") -> str:
    """Draw median errors against the distance to the nearest training frame, with quartiles and counts.

    On the dashed line the error equals that distance: the best that retrieval can achieve.
    """
    frames = evaluations[0].frames
    heading = f"{frames.group}: error against distance to the nearest training frame"
    bins = [part for one in evaluations for part in one.curve]
    # The last bin may be open-ended: clip bins at the largest distance of the group.
    far = max(float(frames.nearest_m.max()) * 1.02, 1e-6)
    limits = [
        _limit([part.position_q75 for part in bins]),
        _limit([part.rotation_median_deg for part in bins]),
    ]
    parts = [svg.text(20, 22, heading, bold=True)]
    for column, (label, limit) in enumerate(
        zip((f"position error ({unit})", "rotation error (deg)"), limits, strict=True)
    ):
        panel = Panel(54.0 + 480 * column, 66.0, 420.0, 260.0, (0.0, far), (0.0, limit))
        parts.append(panel.axes(f"distance to the nearest training frame ({unit})", label))
        if column == 0:
            end = min(far, limit)
            ends = panel.on_page(np.array([0.0, end]), np.array([0.0, end]))
            parts.append(svg.line(ends, SOFT, dash="5 4"))
        for k, one in enumerate(evaluations):
            parts.append(
                _curve(panel, one.curve, far, column, COLOURS[k % len(COLOURS)], _marker(k))
            )
        for part in evaluations[0].curve:
            place = panel.on_page(np.array([_middle(part, far)]), np.array([limit]))[0]
            parts.append(
                svg.text(place[0], place[1] + 10, str(part.frames), anchor="middle", colour=SOFT)
            )
    parts.append(svg.text(54, 376, "Numbers at the top: frames per bin.", colour=SOFT))
    entries = [
        (
            f"{one.method} ({one.summary.located} of {len(one.frames)} frames)",
            COLOURS[k % len(COLOURS)],
        )
        for k, one in enumerate(evaluations)
    ]
    parts.append(svg.legend(62, 398, entries, [_marker(k) for k in range(len(entries))]))
    return svg.document(1000, 398 + 17 * len(entries), heading, parts)


def calibration(evaluations: Sequence[Evaluation]) -> str:
    """Draw the reliability curve of stated covariances: observed against expected share of frames.

    Methods without covariances are left out. Raises ValueError if no method states a covariance.
    """
    stated = [
        (k, one)
        for k, one in enumerate(evaluations)
        if one.calibration is not None and one.calibration.frames
    ]
    if not stated:
        raise ValueError("no method states a covariance")
    heading = f"{stated[0][1].frames.group}: calibration of stated covariances"
    panel = Panel(54.0, 66.0, 320.0, 320.0, (0.0, 1.0), (0.0, 1.0))
    parts = [
        svg.text(20, 22, heading, bold=True),
        panel.axes("expected share within the ellipsoid", "observed share"),
        svg.line(panel.on_page(np.array([0, 1]), np.array([0, 1])), SOFT, dash="5 4"),
        svg.text(panel.left + 8, panel.top + 16, "underconfident", colour=SOFT),
        svg.text(panel.left + 312, panel.top + 308, "overconfident", anchor="end", colour=SOFT),
    ]
    entries = []
    for k, one in stated:
        figures, colour = one.calibration, COLOURS[k % len(COLOURS)]
        assert figures is not None
        points = panel.on_page(np.array(figures.expected), np.array(figures.observed))
        parts.append(svg.line(points, colour, width=1.5))
        parts.append(svg.marks(points, colour, _marker(k)))
        entries.append(
            (
                f"{one.method}: ratio {figures.ratio:.2f} (ideal: 1), "
                f"{100 * figures.beyond:.1f} % beyond (ideal: 0.1 %), {figures.frames} frames",
                colour,
            )
        )
    parts.append(svg.legend(62, 440, entries, [_marker(k) for k, _ in stated]))
    return svg.document(640, 440 + 17 * len(entries), heading, parts)


def _both(one: Evaluation) -> tuple[np.ndarray, np.ndarray]:
    return one.errors.error_m, one.errors.error_deg


def _reach(values: np.ndarray) -> float:
    """Return the end of the scale for finite errors."""
    if len(values) == 0:
        return 1e-6
    p95, largest = float(np.quantile(values, 0.95)), float(values.max())
    return max(largest if largest <= _FAR * p95 else p95, 1e-6)


def _counts(values: np.ndarray, step: float, top: float) -> np.ndarray:
    """Count frames in each bin of width `step` from 0 to `top`, and those beyond; NaN is not counted."""
    known = values[np.isfinite(values)]
    bars = round(top / step)
    index = np.minimum((known / step).astype(np.int64), bars)
    # A value equal to `top` belongs to the last bin.
    return np.bincount(np.where(known == top, bars - 1, index), minlength=bars + 1)


def _bars(panel: Panel, counts: np.ndarray, step: float, colour: str) -> str:
    """Draw the bars of the bins; the one beyond the scale is set apart and paler."""
    last = len(counts) - 1
    parts = []
    for k in np.flatnonzero(counts):
        low = step * (k + 0.5 if k == last else k)
        corners = panel.on_page(np.array([low, low + step]), np.array([float(counts[k]), 0.0]))
        (x, y), (right, bottom) = corners
        faint = 0.4 if k == last else 1.0
        parts.append(svg.box(x + 0.5, y, right - x - 1, bottom - y, colour, opacity=faint))
    return "".join(parts)


def _curve(
    panel: Panel, bins: Sequence[CurveBin], far: float, column: int, colour: str, marker: str
) -> str:
    """Draw medians as a line with marks and quartiles as a band, clipped at the top; skip infinite values."""
    x = np.array([_middle(part, far) for part in bins])
    median = np.array(
        [part.position_median if column == 0 else part.rotation_median_deg for part in bins]
    )
    top = panel.y_range[1]
    shown = np.isfinite(median)
    points = panel.on_page(x[shown], np.minimum(median[shown], top))
    parts = []
    if column == 0 and shown.sum() > 1:
        low = np.array([part.position_q25 for part in bins])[shown]
        high = np.minimum(np.array([part.position_q75 for part in bins])[shown], top)
        edge = np.vstack([panel.on_page(x[shown], low), panel.on_page(x[shown], high)[::-1]])
        parts.append(svg.area(edge, colour, opacity=0.1))
    parts.append(svg.line(points, colour, width=1.5) if len(points) > 1 else "")
    parts.append(svg.marks(points, colour, marker, radius=3))
    return "".join(parts)


def _counted(what: str, drawn: int, count: int) -> str:
    return f"{what} ({count})" if drawn == count else f"{what} ({drawn} of {count} drawn)"


def _marker(k: int) -> str:
    return MARKERS[k % len(MARKERS)]


def _middle(part: CurveBin, far: float) -> float:
    return (part.low + min(part.high, far)) / 2


def _limit(values: Sequence[float]) -> float:
    finite = [value for value in values if np.isfinite(value)]
    return max([*finite, 1e-6]) * 1.15
