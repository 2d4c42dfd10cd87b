"""Charts of errors along the flights: vertical residuals, precision, and errors of networks over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spn_data.charts import svg
from spn_data.charts.svg import COLOURS, INK, MARKERS, Panel
from spn_data.georegistration.control import PointResidual
from spn_data.report.chart_page import chart
from spn_data.report.data import FrameTable
from spn_data.report.pictures import COARSE, RunEstimates

_LEFT, _TOP, _WIDE, _HIGH = 52.0, 30.0, 410.0, 200.0
_MOST_DRAWN = 600  # frames of one series; more are thinned evenly
_GAP = 6.0  # times the median step: a longer step interrupts a line


def vertical_residuals(frames: FrameTable) -> str:
    """Draw the height of GNSS fixes above their cameras over time, for each mapping flight."""
    known = np.isfinite(frames.gnss_m[:, 2]) & frames.registered
    if not known.any():
        return ""
    up = frames.gnss_m[known, 2]
    panel = _over_time(frames.time_s[known], (min(0.0, float(up.min())), max(0.0, float(up.max()))))
    parts = [panel.axes("time in the flight (s)", "fix minus camera, up (m)"), _zero(panel)]
    entries, markers = [], []
    for k, name in enumerate(np.unique(frames.sequences[known]).tolist()):
        mine = np.flatnonzero(known & (frames.sequences == name))
        colour, marker = COLOURS[k % len(COLOURS)], MARKERS[k % len(MARKERS)]
        used, outliers = mine[~frames.gnss_outlier[mine]], mine[frames.gnss_outlier[mine]]
        for rows, opacity in ((_thinned(used), 1.0), (_thinned(outliers), 0.4)):
            places = panel.on_page(frames.time_s[rows], frames.gnss_m[rows, 2])
            titles = [f"{frames.names[i]}: {frames.gnss_m[i, 2]:+.2f} m" for i in rows]
            drawn = svg.marks(places, colour, marker, radius=2.2, titles=titles)
            parts.append(f'<g opacity="{opacity:g}">{drawn}</g>')
        rmse = float(np.sqrt(np.mean(frames.gnss_m[used, 2] ** 2))) if len(used) else np.nan
        left_out = f", {len(outliers)} outliers (pale)" if len(outliers) else ""
        rmse_text = f", RMSE {rmse:.2f} m" if len(used) else ""
        entries.append((f"{name}: {len(used)} fixes{rmse_text}{left_out}", colour))
        markers.append(marker)
    return _with_legend("Vertical residuals of GNSS", parts, entries, markers)


def control_residuals(control: Sequence[PointResidual]) -> str:
    """Draw the vertical residuals of surveyed points with their stated standard deviation."""
    shown = [p for p in control if np.isfinite([p.residual_m[2], p.sigma_m[2]]).all()]
    if not shown:
        return ""
    ends = np.array(
        [[p.residual_m[2] - p.sigma_m[2], p.residual_m[2] + p.sigma_m[2]] for p in shown]
    )
    low, high = _padded(min(0.0, float(ends.min())), max(0.0, float(ends.max())))
    panel = Panel(_LEFT, _TOP, _WIDE, _HIGH, (0, len(shown) + 1.0), (low, high))
    parts = [
        panel.axes("point, in the order of the table", "surveyed minus mapped, up (m)"),
        _zero(panel),
    ]
    entries, markers = [], []
    for k, role in enumerate(("control", "check")):
        mine = [j for j, p in enumerate(shown) if p.role == role]
        if not mine:
            continue
        x = np.array(mine) + 1.0
        up = np.array([shown[j].residual_m[2] for j in mine])
        bars = [panel.on_page(np.array([a, a]), ends[j]) for a, j in zip(x, mine, strict=True)]
        parts.append(svg.strokes(bars, COLOURS[k]))
        titles = [f"{shown[j].name}: {shown[j].residual_m[2]:+.3f} m" for j in mine]
        parts.append(
            svg.marks(panel.on_page(x, up), COLOURS[k], MARKERS[k], radius=3, titles=titles)
        )
        rmse = float(np.sqrt(np.mean(up**2)))
        entries.append(
            (f"{len(mine)} {role} points: RMSE {rmse:.3f} m, bars one sigma", COLOURS[k])
        )
        markers.append(MARKERS[k])
    return _with_legend("Vertical residuals of surveyed points", parts, entries, markers)


def precision_over_time(frames: FrameTable, *, evaluation: bool, unit: str) -> list[str]:
    """Draw reprojection error and position sigma of chosen frames over time, of mapping or other flights."""
    chosen = frames.registered & ~frames.tracked & (frames.evaluation == evaluation)
    flights = "evaluation flights" if evaluation else "mapping flights"
    columns = (
        (frames.error_px, "RMS reprojection error (px)", f"Reprojection error along the {flights}"),
        (frames.sigma_m, f"sigma of the position ({unit})", f"Precision along the {flights}"),
    )
    return [
        _series(frames, values, chosen, label, title)
        for values, label, title in columns
        if (chosen & np.isfinite(values)).any()
    ]


def _series(
    frames: FrameTable, values: np.ndarray, chosen: np.ndarray, label: str, title: str
) -> str:
    """Draw values (N,) of chosen frames over time, a line for each flight."""
    known = chosen & np.isfinite(values)
    panel = _over_time(frames.time_s[known], (0.0, float(values[known].max())))
    parts, entries, markers = [panel.axes("time in the flight (s)", label)], [], []
    for k, name in enumerate(np.unique(frames.sequences[known]).tolist()):
        mine = np.flatnonzero(known & (frames.sequences == name))
        rows = _thinned(mine)
        colour, marker = COLOURS[k % len(COLOURS)], MARKERS[k % len(MARKERS)]
        titles = [f"{frames.names[i]}: {values[i]:.3g}" for i in rows]
        parts.append(_line(panel, frames.time_s[rows], values[rows], colour, marker, titles))
        median = float(np.median(values[mine]))
        entries.append((f"{name}: {len(mine)} frames, median {median:.3g}", colour))
        markers.append(marker)
    return _with_legend(title, parts, entries, markers)


def errors_over_time(
    frames: FrameTable, flight: str, methods: Sequence[RunEstimates], unit: str
) -> list[str]:
    """Draw the errors of each network and its fixes over the time of a flight, on logarithmic axes."""
    rows = np.flatnonzero(frames.sequences == flight)
    asked = [_errors_of(one, frames.names[rows]) for one in methods]
    drawn = []
    for which, label, title in (
        (1, f"position error ({unit})", f"Position errors along {flight}"),
        (2, "rotation error (deg)", f"Rotation errors along {flight}"),
    ):
        finite = np.concatenate([found[which][np.isfinite(found[which])] for found in asked])
        if not len(finite):
            continue
        smallest = max(float(finite[finite > 0].min()) if (finite > 0).any() else 1e-3, 1e-4)
        low, high = (
            np.floor(np.log10(smallest)),
            np.ceil(np.log10(max(float(finite.max()), 10 * smallest))),
        )
        panel = _over_time(frames.time_s[rows], (low, high), pad=False)
        parts, entries, markers = (
            [panel.axes("time in the flight (s)", label, decades=True)],
            [],
            [],
        )
        for k, (one, found) in enumerate(zip(methods, asked, strict=True)):
            is_asked, values = found[0], found[which]
            if not is_asked.any():
                continue
            known = _thinned(np.flatnonzero(np.isfinite(values)))
            colour, marker = COLOURS[k % len(COLOURS)], MARKERS[k % len(MARKERS)]
            logs = np.log10(np.maximum(values[known], smallest))
            titles = [f"{frames.names[rows[j]]}: {values[j]:.3g}" for j in known]
            parts.append(_line(panel, frames.time_s[rows[known]], logs, colour, marker, titles))
            count, missing = (
                int(np.isfinite(values).sum()),
                int((is_asked & np.isnan(values)).sum()),
            )
            median = f", median {np.median(values[np.isfinite(values)]):.3g}" if count else ""
            none = f", {missing} without a pose" if missing else ""
            name = one.run if one.method == COARSE else f"{one.run}, fixes"
            entries.append((f"{name}: {count} frames{median}{none}", colour))
            markers.append(marker)
        drawn.append(_with_legend(title, parts, entries, markers))
    return drawn


def _errors_of(one: RunEstimates, names: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return whether frames (M,) were asked, with their errors and angles; NaN if not."""
    row = {name: k for k, name in enumerate(one.names.tolist())}
    index = np.array([row.get(name, -1) for name in names.tolist()], dtype=np.int64)
    asked = index >= 0
    error = np.where(asked, one.error[index], np.nan)
    return asked, error, np.where(asked, one.error_deg[index], np.nan)


def _line(
    panel: Panel, x: np.ndarray, y: np.ndarray, colour: str, marker: str, titles: Sequence[str]
) -> str:
    """Draw a line through values, interrupted where frames are missing, with markers."""
    places = panel.on_page(x, y)
    steps = np.diff(x)
    usual = float(np.median(steps)) if len(steps) else 0.0
    breaks = np.flatnonzero(steps > _GAP * max(usual, 1e-9)) + 1
    lines = [part for part in np.split(places, breaks) if len(part) > 1]
    return svg.strokes(lines, colour, opacity=0.6) + svg.marks(
        places, colour, marker, radius=2.0, titles=titles
    )


def _over_time(time_s: np.ndarray, y_range: tuple[float, float], *, pad: bool = True) -> Panel:
    first, last = float(time_s.min()), float(time_s.max())
    y = _padded(*y_range) if pad else y_range
    return Panel(_LEFT, _TOP, _WIDE, _HIGH, (first, max(last, first + 1.0)), y)


def _padded(low: float, high: float) -> tuple[float, float]:
    room = max(0.08 * (high - low), 1e-6)
    return (low - room if low < 0 else low), high + room


def _zero(panel: Panel) -> str:
    return svg.line(panel.on_page(np.array(panel.x_range), np.zeros(2)), INK, dash="4 3")


def _thinned(rows: np.ndarray) -> np.ndarray:
    if len(rows) <= _MOST_DRAWN:
        return rows
    return rows[np.linspace(0, len(rows) - 1, _MOST_DRAWN).astype(np.int64)]


def _with_legend(
    title: str, parts: list[str], entries: Sequence[tuple[str, str]], markers: Sequence[str]
) -> str:
    bottom = _TOP + _HIGH + 52
    legend = svg.legend(_LEFT + 6, bottom, entries, markers)
    return chart(bottom - 4 + 17 * len(entries), title, [*parts, legend])
