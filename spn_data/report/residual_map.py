"""GNSS residuals in plan view, as SVG."""

from __future__ import annotations

import math
from html import escape

import numpy as np

from spn_data.report.data import FrameTable

_WIDTH, _MARGIN = 640.0, 40.0
_MAX_ARROWS = 2000
_MAX_EXTENT = (
    0.2  # of the flight's extent: longer arrows are truncated, or one outlier would fill the page
)


def residual_map(frames: FrameTable) -> str:
    """Draw cameras in plan view, each with an arrow to its GNSS fix, enlarged by a round factor.

    Returns an empty string if fewer than two frames have a residual.
    """
    rows = np.flatnonzero(np.isfinite(frames.gnss_m[:, :2]).all(axis=1) & frames.registered)
    if len(rows) < 2:
        return ""
    if len(rows) > _MAX_ARROWS:
        rows = rows[np.linspace(0, len(rows) - 1, _MAX_ARROWS).astype(np.int64)]
    xy, arrows = frames.poses.centers[rows, :2], frames.gnss_m[rows]
    lengths = np.hypot(arrows[:, 0], arrows[:, 1])
    fitting = lengths[~frames.gnss_outlier[rows]]
    usual = max(float(np.percentile(fitting if len(fitting) else lengths, 90)), 1e-3)
    extent = max(float(np.ptp(xy, axis=0).max()), 1e-3)
    factor = max(1.0, round_down(0.1 * extent / usual))
    longest = _MAX_EXTENT * extent / factor
    ends = (
        xy + factor * arrows[:, :2] * np.minimum(1.0, longest / np.maximum(lengths, 1e-9))[:, None]
    )
    low, high = np.minimum(xy, ends).min(axis=0), np.maximum(xy, ends).max(axis=0)
    scale = (_WIDTH - 2 * _MARGIN) / float(max(high - low))
    used = (high - low) * scale
    size = np.array([_WIDTH, max(used[1] + 2 * _MARGIN, 160.0)])
    offset = (size - used) / 2

    def on_page(points: np.ndarray) -> np.ndarray:
        x, y = (points - low).T * scale
        return np.column_stack([x + offset[0], size[1] - offset[1] - y])

    plan, tips = on_page(xy), on_page(ends)
    parts = [*_paths(frames.sequences[rows], plan)]
    for k, row in enumerate(rows):
        kind = "outlier" if frames.gnss_outlier[row] else "fix"
        e, n, u = arrows[k]
        up = f", {u:+.2f} m up" if math.isfinite(u) else ""
        parts.append(
            f'<g class="{kind}" data-frame="{escape(str(frames.names[row]), quote=True)}">'
            f"<title>{escape(str(frames.names[row]))}: "
            f"{e:+.2f} m east, {n:+.2f} m north{up}</title>"
            f'<path d="M{_xy(plan[k])}L{_xy(tips[k])}"/>'
            f'<circle cx="{tips[k, 0]:.1f}" cy="{tips[k, 1]:.1f}" r="2.5"/></g>'
        )
    bar_m, arrow_m = round_down(extent / 4), round_down(1.5 * usual)
    top = size[1] - 12
    parts.append(_bar(12, top, bar_m * scale, f"{bar_m:g} m", "bar"))
    arrow_bar = arrow_m * scale * factor
    parts.append(_bar(84 + bar_m * scale, top, arrow_bar, f"residual {arrow_m:g} m", "fix"))
    parts.append(
        f'<g class="north"><path d="M{size[0] - 24:.0f} 46V14m-6 10 6-10 6 10"/>'
        f'<text x="{size[0] - 24:.0f}" y="60" text-anchor="middle">N</text></g>'
    )
    enlarged = "drawn to scale" if factor == 1 else f"drawn {factor:g} times longer"
    note = f"Lines connect each camera to its GNSS fix (dot), {enlarged}; {len(rows):,} frames."
    if np.any(frames.gnss_outlier[rows]):
        note += " Dashed lines are outliers excluded from the fit."
    if np.any(lengths > longest):
        note += f" Residuals longer than {longest:.1f} m are truncated."
    return (
        f'<svg class="residuals" viewBox="0 0 {size[0]:.0f} {size[1]:.0f}" role="img" '
        f'aria-label="GNSS residuals in plan view">{"".join(parts)}</svg><p class="note">{note}</p>'
    )


def round_down(value: float) -> float:
    """Round a positive value down to 1, 2 or 5 times a power of ten; raise ValueError if not positive."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(m * power for m in (1, 2, 5) if m * power <= value * (1 + 1e-9))


def _paths(sequences: np.ndarray, plan: np.ndarray) -> list[str]:
    """Draw a thin line through the cameras of each sequence in temporal order."""
    return [
        '<path class="path" d="M' + "L".join(_xy(p) for p in plan[sequences == name]) + '"/>'
        for name in np.unique(sequences)
    ]


def _bar(x: float, y: float, length: float, text: str, kind: str) -> str:
    return (
        f'<g class="{kind}"><path d="M{x:.1f} {y:.1f}h{length:.1f}"/>'
        f'<text x="{x:.1f}" y="{y - 6:.1f}">{text}</text></g>'
    )


def _xy(point: np.ndarray) -> str:
    return f"{point[0]:.1f} {point[1]:.1f}"
