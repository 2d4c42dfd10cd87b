"""Orthographic view of camera trajectories."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from spn_data.charts import svg
from spn_data.charts.svg import COLOURS, GRID, INK, MARKERS, SOFT
from spn_data.geometry.pose import Poses
from spn_model.evaluation.metrics import Estimates, EvaluationFrames

_MARGIN = 0.25  # of the area's extent: estimates farther outside are not drawn
MOST_DRAWN = 1500  # cameras, and estimates of one method; more are thinned evenly
_LARGE = 1e5  # a coordinate of more digits
_GAP = 8.0  # times the median step: a longer step interrupts the trajectory


def view_matrix(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Return the projection (2, 3) from the world to page right and page up, seen from above the horizon.

    azimuth_deg : direction of the viewer, from the world's first axis towards its second. Elevation 90 with
    azimuth -90 gives a map: first axis right, second axis up.
    """
    azimuth, elevation = np.deg2rad([azimuth_deg, elevation_deg])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    eye = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    return np.stack([right, np.cross(eye, right)])


def trajectory_panel(
    place_px: tuple[float, float, float, float],
    view_deg: tuple[float, float],
    training: Poses,
    frames: EvaluationFrames,
    estimates: Sequence[Estimates],
    unit: str,
) -> tuple[str, list[int]]:
    """Draw one view as SVG and return the number of estimates of each method outside it.

    place_px : left, top, width, height of the panel. view_deg : azimuth and elevation.
    """
    left, top, width, height = place_px
    known = np.concatenate([training.centers, frames.poses.centers])
    low, high = known.min(axis=0), known.max(axis=0)
    margin = max(_MARGIN * float((high - low).max()), 1e-3)
    inside = [
        np.all((e.poses.centers >= low - margin) & (e.poses.centers <= high + margin), axis=1)
        for e in estimates
    ]
    found = np.concatenate(
        [known, *(e.poses.centers[i] for e, i in zip(estimates, inside, strict=True))]
    )
    low, high = found.min(axis=0), np.maximum(found.max(axis=0), found.min(axis=0) + 1e-3)
    step = svg.round_step(float((high - low).max()) / 6)
    low = np.floor(low / step - 1e-9) * step
    high = np.ceil(high / step + 1e-9) * step
    matrix = view_matrix(*view_deg)
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T @ matrix.T
    first, last = corners.min(axis=0), corners.max(axis=0)
    scale = min((width - 70) / (last[0] - first[0]), (height - 50) / (last[1] - first[1]))
    offset = (
        np.array([left + 40, top + 10])
        + (np.array([width - 70, height - 50]) - (last - first) * scale) / 2
    )

    def on_page(points: np.ndarray) -> np.ndarray:
        flat = (np.atleast_2d(points) @ matrix.T - first) * scale
        return np.stack(
            [offset[0] + flat[:, 0], offset[1] + (last - first)[1] * scale - flat[:, 1]], 1
        )

    parts = [_floor(on_page, low, high, step, frames.axes, unit, view_deg=view_deg)]
    tick = 0.03 * float((high - low).max())

    def viewing(poses: Poses, colour: str, width: float) -> str:
        """Draw where cameras look."""
        ahead = poses.centers + tick * poses.rotations[:, 2]
        ends = zip(on_page(poses.centers), on_page(ahead), strict=True)
        return svg.strokes(ends, colour, width=width)

    cameras = training[thinned(len(training))]
    parts.append(viewing(cameras, SOFT, 1.0))
    parts.append(svg.dots(on_page(cameras.centers), SOFT, radius=1.6))
    parts.append(
        svg.strokes(
            _split_at_gaps(on_page(frames.poses.centers), frames.poses.centers), INK, width=1.6
        )
    )
    rows = thinned(len(frames))
    parts.append(viewing(frames.poses[rows], INK, 0.9))
    for k, (one, within) in enumerate(zip(estimates, inside, strict=True)):
        colour = COLOURS[k % len(COLOURS)]
        shown = rows[within[rows]]
        ends, places = on_page(frames.poses.centers[shown]), on_page(one.poses.centers[shown])
        if len(shown):
            parts.append(
                svg.strokes(zip(ends, places, strict=True), colour, width=0.6, opacity=0.5)
            )
            parts.append(viewing(one.poses[shown], colour, 0.9))
            marker, titles = MARKERS[k % len(MARKERS)], frames.names[shown].tolist()
            parts.append(svg.marks(places, colour, marker, titles=titles))
    located = [np.isfinite(e.poses.centers).all(axis=1) for e in estimates]
    return "".join(parts), [int((a & ~b).sum()) for a, b in zip(located, inside, strict=True)]


def thinned(count: int) -> np.ndarray:
    """Return the evenly spaced rows to draw out of `count`."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, MOST_DRAWN)).round().astype(int))


def _floor(
    on_page: Callable[[np.ndarray], np.ndarray],
    low: np.ndarray,
    high: np.ndarray,
    step: float,
    axes: tuple[str, str, str],
    unit: str,
    *,
    view_deg: tuple[float, float],
) -> str:
    """Draw a grid at the lowest height, labels at its front edges, and a height scale at its left corner."""
    eye = np.array([np.cos(np.deg2rad(view_deg[0])), np.sin(np.deg2rad(view_deg[0]))])
    # The edges nearest to the viewer; from straight above, the left and the lower edge.
    front = np.where(eye > 1e-9, high[:2], low[:2])
    grids = [_steps(low[k], high[k], step) for k in range(3)]
    floor = low[2]
    lines = [([x, low[1], floor], [x, high[1], floor]) for x in grids[0]]
    lines += [([low[0], y, floor], [high[0], y, floor]) for y in grids[1]]
    parts = []
    for k, other in ((0, 1), (1, 0)):
        places = np.full((len(grids[k]), 3), floor)
        places[:, k], places[:, other] = grids[k], front[other]
        parts.append(
            _figures(on_page(places), grids[k], axes[k], unit, on_page(_middle(low, high))[0])
        )
    if view_deg[1] != 90:
        corners = np.array([[x, y, floor] for x in (low[0], high[0]) for y in (low[1], high[1])])
        left = corners[on_page(corners)[:, 0].argmin()]
        places = np.tile(left, (len(grids[2]), 1))
        places[:, 2] = grids[2]
        lines.append((places[0].tolist(), places[-1].tolist()))
        parts.append(
            _figures(on_page(places), grids[2], axes[2], unit, on_page(_middle(low, high))[0])
        )
    grid = svg.strokes([on_page(np.array(ends)) for ends in lines], GRID)
    return grid + "".join(parts)


def _figures(
    places: np.ndarray, values: np.ndarray, axis: str, unit: str, middle: np.ndarray
) -> str:
    """Draw tick labels on the outer side of an axis, and the name of the axis."""
    along = places[-1] - places[0]
    across = np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9)
    if np.dot(across, places.mean(axis=0) - middle) < 0:
        across = -across
    anchor = "middle" if abs(across[0]) < 0.5 else "start" if across[0] > 0 else "end"
    # Labels of UTM or Earth-centred coordinates would overlap, so they count from a round number.
    zero = round(float(values.mean()), -3) if abs(values[0]) >= _LARGE else 0.0
    axis = f"{axis} - {zero:.0f}" if zero else axis
    words = [f"{value - zero:g}" for value in values]
    # Skip labels that would overlap on a short axis.
    every = max(1, int(np.ceil(26 / max(float(np.hypot(*along)) / max(len(values) - 1, 1), 1e-9))))
    parts = [
        svg.text(x, y, word, anchor=anchor, colour=SOFT)
        for k, ((x, y), word) in enumerate(zip(places + 13 * across + [0, 4], words, strict=True))
        if k % every == 0
    ]
    x, y = (places[0] + places[-1]) / 2 + 34 * across + [0, 4]
    parts.append(svg.text(x, y, f"{axis} ({unit})", anchor=anchor, colour=SOFT))
    return "".join(parts)


def _middle(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return np.asarray((low + high) / 2)


def _steps(low: float, high: float, step: float) -> np.ndarray:
    """Return the multiples of `step` from `low` to `high`, which are multiples themselves."""
    return np.round(np.arange(round(low / step), round(high / step) + 1) * step, 9) + 0.0


def _split_at_gaps(on_page: np.ndarray, centers: np.ndarray) -> list[np.ndarray]:
    """Split the trajectory where frames are missing or another sequence begins."""
    apart = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    usual = float(np.median(apart)) if len(apart) else 0.0
    breaks = np.flatnonzero(apart > _GAP * max(usual, 1e-9)) + 1
    return [part for part in np.split(on_page, breaks) if len(part) > 1]
