"""Charts of a map's photogrammetry: reprojection errors, tracks, overlap, error ellipses."""

from __future__ import annotations

import base64
from collections.abc import Sequence

import cv2
import numpy as np

from spn_data.charts import svg
from spn_data.charts.svg import COLOURS, INK, MARKERS, SOFT, Panel
from spn_data.report.chart_page import WIDTH, chart
from spn_data.report.photogrammetry_facts import LensFacts, Overlap, PositionCovariances
from spn_data.report.residual_map import round_down

_LEFT, _TOP = 52.0, 30.0
_BINS = 30
_MOST_ELLIPSES = 250
_LONGEST_ARROW = 1.2  # sides of a cell
_LONGEST_TRACK = 20
_MANY_VIEWS = 20  # end of the colour scale of the overlap


def error_histogram(lenses: Sequence[LensFacts]) -> str:
    """Draw the share of measurements by the length of their reprojection error, for each lens."""
    shown = [(one, one.errors) for one in lenses if one.errors is not None]
    if not shown:
        return ""
    reach = max(float(np.percentile(errors.errors_px, 99)) for _, errors in shown)
    step = svg.round_step(max(reach, 1e-3) / _BINS)
    bins = int(np.ceil(reach / step))
    shares = []
    for _, errors in shown:
        index = np.minimum((errors.errors_px / step).astype(np.int64), bins)
        shares.append(np.bincount(index, minlength=bins + 1) / len(index))
    top = max(float(share[:bins].max()) for share in shares)
    panel = Panel(_LEFT, _TOP, 410, 220, (0, bins * step), (0, 1.1 * max(top, 1e-6)))
    parts = [panel.axes("reprojection error (px)", f"share per {step:g} px")]
    entries = []
    for k, ((one, errors), share) in enumerate(zip(shown, shares, strict=True)):
        colour, marker = COLOURS[k % len(COLOURS)], MARKERS[k % len(MARKERS)]
        places = panel.on_page(step * (np.arange(bins) + 0.5), share[:bins])
        parts += [
            svg.line(places, colour, width=1.4),
            svg.marks(places, colour, marker, radius=2.2),
        ]
        entries.append(
            (
                f"{_title(one)}: {len(errors.errors_px):,} errors, RMS {errors.rms_px:.2f} px, "
                f"{share[bins]:.1%} beyond",
                colour,
            )
        )
    parts.append(svg.legend(_LEFT + 6, 304, entries, _markers(len(entries))))
    return chart(300 + 17 * len(entries), "Reprojection errors", parts)


def error_field(lens: LensFacts) -> str:
    """Draw the mean reprojection error of each cell of the image, enlarged."""
    if lens.errors is None:
        return ""
    cells = lens.errors.cells_px
    rows, columns = cells.shape[:2]
    known = np.isfinite(cells).all(axis=2)
    if not known.any():
        return ""
    lengths = np.linalg.norm(cells[known], axis=1)
    side = 430 / columns
    height = side * rows
    bar_px = round_down(max(float(np.percentile(lengths, 90)), 1e-6))
    factor = 0.6 * side / bar_px  # page px per image px
    left, top = 25.0, 20.0
    parts = [svg.strokes([_frame(left, top, 430, height)], SOFT)]
    y, x = np.nonzero(known)
    starts = np.column_stack([left + side * (x + 0.5), top + side * (y + 0.5)])
    is_cut = lengths * factor > _LONGEST_ARROW * side
    shown = cells[known] * factor
    shown[is_cut] *= (_LONGEST_ARROW * side / (lengths[is_cut] * factor))[:, None]
    for mask, dash in ((~is_cut, ""), (is_cut, "3 2")):
        lines = zip(starts[mask], (starts + shown)[mask], strict=True)
        parts.append(svg.strokes(lines, COLOURS[1], width=1.6, dash=dash))
    titles = [f"{dx:+.3f}, {dy:+.3f} px" for dx, dy in cells[known]]
    parts.append(svg.marks(starts, INK, "circle", radius=1.6, titles=titles))
    bottom = top + height + 26
    parts.append(svg.line([(left, bottom), (left + 0.6 * side, bottom)], COLOURS[1], width=1.6))
    parts.append(svg.text(left + 0.6 * side + 8, bottom + 4, f"{bar_px:g} px"))
    rms = float(np.sqrt((lengths**2).mean()))
    cut = f" {is_cut.sum()} longer ones are cut (dashed)." if is_cut.any() else ""
    return chart(
        bottom + 12,
        f"Reprojection errors over the image: {_title(lens)}",
        parts,
        "Mean error of each cell, projected minus measured, from its dot; RMS of these means "
        f"{rms:.3f} px.{cut} A pattern is what the lens model does not describe.",
    )


def track_histogram(track_lengths: np.ndarray) -> str:
    """Draw the number of points by the number of mapping frames that observe them."""
    if not len(track_lengths):
        return ""
    count = np.bincount(np.minimum(track_lengths, _LONGEST_TRACK), minlength=_LONGEST_TRACK + 1)
    panel = Panel(
        _LEFT + 10, _TOP, 400, 220, (1, _LONGEST_TRACK + 1), (0, 1.08 * max(int(count.max()), 1))
    )
    parts = [panel.axes("mapping frames that observe a point", "points")]
    for length in np.flatnonzero(count).tolist():
        (x, y), (right, bottom) = panel.on_page(
            np.array([length - 0.4, length + 0.4]), np.array([float(count[length]), 0.0])
        )
        is_last = length == _LONGEST_TRACK
        parts.append(
            svg.box(x, y, right - x, bottom - y, COLOURS[0], opacity=0.5 if is_last else 1)
        )
    mean = float(track_lengths.mean())
    longer = f" The last bar counts {_LONGEST_TRACK} and more." if count[-1] else ""
    return chart(
        290,
        "Track lengths",
        parts,
        f"{len(track_lengths):,} points; mean {mean:.1f}, median {np.median(track_lengths):.0f}, longest "
        f"{track_lengths.max()}; {count[2] / len(track_lengths):.0%} in two frames only.{longer}",
    )


def overlap_map(overlap: Overlap) -> str:
    """Draw how many mapping frames see each cell of the ground."""
    count = overlap.count[::-1]  # north up
    share = np.clip(count / _MANY_VIEWS, 0, 1)
    colours = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    image = np.dstack([colours, np.where(count > 0, 255, 0).astype(np.uint8)])
    ok, png = cv2.imencode(".png", image)
    assert ok
    rows, columns = count.shape
    scale = min(400 / columns, 400 / rows)
    width, height = columns * scale, rows * scale
    extent = overlap.low + overlap.cell_m * np.array([columns, rows])
    panel = Panel(
        _LEFT,
        _TOP,
        width,
        height,
        (float(overlap.low[0]), float(extent[0])),
        (float(overlap.low[1]), float(extent[1])),
    )
    data = base64.b64encode(png.tobytes()).decode()
    parts = [
        panel.axes("east (m)", "north (m)"),
        f'<image x="{_LEFT:g}" y="{_TOP:g}" width="{width:.1f}" height="{height:.1f}" '
        f'preserveAspectRatio="none" style="image-rendering:pixelated" '
        f'href="data:image/png;base64,{data}"/>',
    ]
    inside = np.all((overlap.centers > overlap.low) & (overlap.centers < extent), axis=1)
    parts.append(
        svg.marks(panel.on_page(*overlap.centers[inside].T), COLOURS[1], "cross", radius=2.2)
    )
    bottom = _TOP + height + 48
    for k in range(40):
        shade = cv2.applyColorMap(np.full((1, 1), 255 * k // 39, np.uint8), cv2.COLORMAP_VIRIDIS)
        blue, green, red = (int(v) for v in shade[0, 0])
        parts.append(svg.box(_LEFT + 5 * k, bottom, 5.5, 10, f"#{red:02x}{green:02x}{blue:02x}"))
    parts.append(svg.text(_LEFT, bottom + 24, "1"))
    parts.append(
        svg.text(_LEFT + 200, bottom + 24, f"{_MANY_VIEWS} and more frames", anchor="middle")
    )
    known = overlap.count >= 0
    seen = overlap.count[known]
    return chart(
        bottom + 34,
        "Overlap on the ground",
        parts,
        f"Mapping frames that see each cell of {overlap.cell_m:.1f} m at the height of the ground, hidden "
        "ones and views flatter than 12 deg not counted. Of the ground around the flights, "
        f"{(seen > 0).mean():.0%} is seen, {(seen >= 3).mean():.0%} by 3 frames or more; median "
        f"{np.median(seen):.0f}. Crosses are cameras.",
    )


def error_ellipses(positions: PositionCovariances, unit: str) -> str:
    """Draw ellipses of one sigma of camera positions in plan view, enlarged."""
    rows = np.arange(len(positions.names))
    if len(rows) < 2:
        return ""
    rows = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _MOST_ELLIPSES)).astype(int))
    xy, plan = positions.centers[rows, :2], positions.covariance[rows, :2, :2]
    values, vectors = np.linalg.eigh(plan)
    axes = np.sqrt(np.maximum(values, 0))
    usual = max(float(np.median(axes[:, 1])), 1e-9)
    low, extent = xy.min(axis=0), max(float(np.ptp(xy, axis=0).max()), 1e-6)
    scale = 390 / extent
    size = np.ptp(xy, axis=0) * scale
    factor = max(1.0, round_down(0.03 * extent / usual))
    left, top = 45.0, 25.0
    longest = 0.15 * extent / factor
    turn = np.linspace(0, 2 * np.pi, 25)
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    sequences = sorted(set(positions.sequences.tolist()))
    parts, entries = [], []
    for k, name in enumerate(sequences):
        colour, marker = COLOURS[k % len(COLOURS)], MARKERS[k % len(MARKERS)]
        mine = np.flatnonzero(positions.sequences[rows] == name)
        lines, places, titles = [], [], []
        for j in mine:
            shape = (circle * np.minimum(axes[j], longest)) @ vectors[j].T * factor
            at = (xy[j] + shape - low) * scale
            lines.append(np.column_stack([left + at[:, 0], top + size[1] - at[:, 1]]))
            center = (xy[j] - low) * scale
            places.append((left + center[0], top + size[1] - center[1]))
            up = float(np.sqrt(positions.covariance[rows[j], 2, 2]))
            titles.append(
                f"{positions.names[rows[j]]}: {axes[j, 1]:.3g} by {axes[j, 0]:.3g} {unit}, up {up:.3g} {unit}"
            )
        parts.append(svg.strokes(lines, colour))
        parts.append(svg.marks(np.array(places), colour, marker, radius=1.8, titles=titles))
        of_all = np.sqrt(positions.covariance[positions.sequences == name][:, [0, 1, 2], [0, 1, 2]])
        east, north, up = np.median(of_all, axis=0)
        entries.append(
            (
                f"{name}: median sigma {east:.2g}, {north:.2g}, {up:.2g} {unit} (east, north, up)",
                colour,
            )
        )
    bottom = top + size[1] + 34
    bar = round_down(usual)
    parts.append(svg.line([(left, bottom), (left + bar * factor * scale, bottom)], INK, width=1.6))
    parts.append(
        svg.text(left + bar * factor * scale + 8, bottom + 4, f"{bar:g} {unit} of an ellipse")
    )
    ground = round_down(extent / 4)
    parts.append(svg.line([(250, bottom), (250 + ground * scale, bottom)], SOFT, width=1.6))
    parts.append(svg.text(258 + ground * scale, bottom + 4, f"{ground:g} {unit}"))
    parts.append(svg.legend(left, bottom + 30, entries, _markers(len(entries))))
    cut = " Longer ones are cut." if (axes[:, 1] > longest).any() else ""
    return chart(
        bottom + 26 + 17 * len(entries),
        "Error ellipses of camera positions",
        parts,
        f"One sigma in plan view, drawn {factor:g} times larger, {len(rows):,} of "
        f"{len(positions.names):,} frames.{cut} Relative to the map, whose own place is "
        "stated with the georegistration.",
    )


def _title(lens: LensFacts) -> str:
    return f"{lens.key} (evaluation)" if lens.is_evaluation else lens.key


def _markers(count: int) -> list[str]:
    return [MARKERS[k % len(MARKERS)] for k in range(count)]


def _frame(left: float, top: float, width: float, height: float) -> np.ndarray:
    right, bottom = min(left + width, WIDTH), top + height
    return np.array([(left, top), (right, top), (right, bottom), (left, bottom), (left, top)])
