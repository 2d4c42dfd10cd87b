"""Key figures of the area as tiles."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

import numpy as np

from spn_data.report.data import FrameTable, ReportData
from spn_data.split.groups import OPTIMISTIC, TRAIN
from spn_data.storage.stage_record import StageRecord


def key_figures(data: ReportData) -> str:
    """Return the tiles with the key figures, each with its unit."""
    tiles = []
    unit = "m" if data.units == "m" else "model units"
    if data.model_record is not None:
        c = data.model_record.counts
        tiles.append(
            _tile(
                "Map",
                f"{c['registered']:,} of {c['frames']:,}",
                "chosen frames have a pose",
                [f"{c['points']:,} points", f"{c['mean_error_px']:.2f} px reprojection error"],
            )
        )
    if data.geo is not None:
        stated, summary = data.geo.uncertainty, data.geo.summary
        origin = data.geo.origin
        tiles.append(
            _tile(
                "Georegistration",
                f"{format_value(2 * stated.horizontal_m, '.2f')} m",
                "horizontal uncertainty of the whole map (2 sigma)",
                [
                    f"vertical {format_value(2 * stated.vertical_m, '.2f')} m (2 sigma)",
                    f"tilt {format_value(stated.tilt_deg, '.2f')} deg, "
                    f"heading {format_value(stated.heading_deg, '.2f')} deg (1 sigma)",
                    f"scale {format_value(stated.scale, '.2%')} (1 sigma)",
                    f"origin {origin.lat_deg:.6f}, {origin.lon_deg:.6f}, height {origin.alt_m:.2f} m "
                    f"({origin.height_reference})",
                ],
            )
        )
        tiles.append(
            _tile(
                "GNSS residuals",
                f"{format_value(summary.horizontal_rmse_m, '.2f')} m",
                "horizontal RMSE: noise of the receiver, not errors of poses",
                [
                    f"vertical {format_value(summary.vertical_rmse_m, '.2f')} m",
                    f"CE90 {format_value(summary.ce90_m, '.2f')} m, "
                    f"LE90 {format_value(summary.le90_m, '.2f')} m",
                    f"{summary.fixes:,} fixes, {summary.outliers:,} of them outliers",
                ],
            )
        )
    elif data.model_record is not None:
        tiles.append(
            _tile(
                "Georegistration",
                "units: model",
                "lengths are not in metres; north and up are unknown",
                [],
            )
        )
    for name in data.evaluation_sequences:
        mine = data.frames.evaluation & (data.frames.sequences == name) & data.frames.tried
        more = _lens_and_gnss(data.evaluation_records.get(name))
        tiles.append(_labels_tile(f"Evaluation: {name}", data.frames, mine, unit, more))
    tracked = data.frames.tracked & ~data.frames.evaluation & data.frames.tried
    if tracked.any():
        tiles.append(_labels_tile("Tracked mapping frames", data.frames, tracked, unit, []))
    if data.split is not None:
        counts = data.split.counts()
        others = [f"{n:,} {group}" for group, n in counts.items() if group != TRAIN]
        optimistic = [OPTIMISTIC] if data.split.optimistic else []
        tiles.append(
            _tile("Split", f"{counts.get(TRAIN, 0):,}", "training frames", others + optimistic)
        )
    return f'<section class="tiles">{"".join(tiles)}</section>' if tiles else ""


def _lens_and_gnss(record: StageRecord | None) -> list[str]:
    """Describe the lens estimated at registration, and how the sequence's own GNSS compares."""
    if record is None:
        return []
    lines = []
    if record.counts.get("fov_deg"):
        lines.append(f"horizontal field of view {record.counts['fov_deg']:.1f} deg")
    if gnss := record.counts.get("gnss"):
        offset_m = float(np.hypot(gnss["offset_e_m"], gnss["offset_n_m"]))
        lines.append(
            f"own GNSS (not used): horizontal offset {offset_m:.2f} m (median), "
            f"scatter {gnss['scatter_h_m']:.2f} m"
        )
    return lines


def _labels_tile(
    title: str, frames: FrameTable, mask: np.ndarray, unit: str, more: Iterable[str]
) -> str:
    registered = mask & frames.registered
    lines = []
    for values, text, form in (
        (frames.sigma_m[registered], f"{unit} position, 1 sigma (median)", ".3f"),
        (frames.sigma_deg[registered], "deg rotation, 1 sigma (median)", ".3f"),
        (frames.error_px[registered], "px reprojection error (median)", ".2f"),
    ):
        known = values[np.isfinite(values)]
        if len(known):
            lines.append(f"{np.median(known):{form}} {text}")
    chosen, tracked = mask & ~frames.tracked, mask & frames.tracked
    if chosen.any() and tracked.any():
        lines.append(
            f"tracked frames: {(tracked & frames.registered).sum():,} of {tracked.sum():,}"
        )
    lines += more
    return _tile(title, f"{registered.sum():,} of {mask.sum():,}", "frames have a pose", lines)


def _tile(title: str, value: str, what: str, lines: Iterable[str]) -> str:
    more = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return (
        f'<div class="tile"><h3>{escape(title)}</h3><p class="value">{escape(value)}</p>'
        f"<p>{escape(what)}</p><ul>{more}</ul></div>"
    )


def format_value(value: float, spec: str) -> str:
    """Format a number; NaN and infinity are shown as "unknown"."""
    return format(value, spec) if np.isfinite(value) else "unknown"
