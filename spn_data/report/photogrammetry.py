"""Section on photogrammetry: calibration, reprojection errors, tracks, overlap, errors along the flights."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from spn_data.geometry.camera import MODELS
from spn_data.report.chart_page import side_by_side
from spn_data.report.data import ReportData
from spn_data.report.flight_charts import (
    control_residuals,
    errors_over_time,
    precision_over_time,
    vertical_residuals,
)
from spn_data.report.photogrammetry_charts import (
    error_ellipses,
    error_field,
    error_histogram,
    overlap_map,
    track_histogram,
)
from spn_data.report.photogrammetry_facts import LensFacts
from spn_data.report.pictures import COARSE, TRACK, RunEstimates

_STRONG = 0.9  # correlation that is set in bold


def photogrammetry(data: ReportData, estimates: Sequence[RunEstimates] = ()) -> str:
    """Return the section, with the errors of estimates along the flights; empty without a model."""
    facts = data.photogrammetry
    if facts is None:
        return ""
    unit = "m" if data.units == "m" else "units"
    of_map = [error_histogram(facts.lenses), *map(error_field, facts.lenses)]
    of_map += [track_histogram(facts.track_lengths)]
    if facts.overlap is not None:
        of_map.append(overlap_map(facts.overlap))
    of_map.append(error_ellipses(facts.positions, unit))
    along = [vertical_residuals(data.frames)]
    if data.geo is not None:
        along.append(control_residuals(data.geo.control))
    for is_evaluation in (False, True):
        along += precision_over_time(data.frames, evaluation=is_evaluation, unit=unit)
    reason = (
        f'<p class="note">No overlap map: {escape(facts.no_overlap)}.</p>'
        if facts.no_overlap
        else ""
    )
    return (
        '<section id="photogrammetry"><h2>Photogrammetry</h2><h3>Calibration</h3>'
        f"{''.join(map(_calibration, facts.lenses))}{_explained(facts.lenses)}"
        f"{side_by_side(of_map)}{reason}{side_by_side(along)}{_networks(data, estimates, unit)}</section>"
    )


def _networks(data: ReportData, estimates: Sequence[RunEstimates], unit: str) -> str:
    """Return the errors of networks alone and of tracked fixes along each evaluation flight."""
    methods = [one for one in estimates if one.method in (COARSE, TRACK)]
    charts = [
        drawn
        for flight in data.evaluation_sequences
        if methods
        for drawn in errors_over_time(data.frames, flight, methods, unit)
    ]
    if not charts:
        return ""
    return f"<h3>Errors of networks along the evaluation flights</h3>{side_by_side(charts)}"


def _calibration(lens: LensFacts) -> str:
    """Return the table of a lens: parameters, sigma and correlations."""
    names = MODELS[lens.camera.model]
    stated = lens.calibration
    estimated = () if stated is None else stated.estimated
    correlated = [
        k for k in range(len(estimated)) if stated and np.isfinite(stated.correlation[k]).any()
    ]
    header = ["parameter", "value", "sigma", *(estimated[k] for k in correlated)]
    rows = []
    for name, value in zip(names, lens.camera.params.tolist(), strict=True):
        unit = "" if name[0] in "kp" else " px"
        row = [name, f"{value:.5f}" if not unit else f"{value:.3f}{unit}"]
        if stated is not None and name in estimated:
            k = estimated.index(name)
            row.append(f"{stated.sigma[k]:.2g}{unit}")
            row += ["1" if j == k else _correlation(stated.correlation[k, j]) for j in correlated]
        else:
            row += ["&ndash;"] * (1 + len(correlated))
        rows.append(row)
    title = f"{lens.key}, {'evaluation' if lens.is_evaluation else 'mapping'}: {lens.camera.model}"
    size = (
        f"{lens.camera.width} x {lens.camera.height} px, {lens.camera.horizontal_fov_deg:.1f} deg"
    )
    head = "".join(f"<th>{cell}</th>" for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return (
        f"<p><b>{escape(title)}</b>, {size}, {lens.frames:,} frames</p>"
        f'<div class="wide"><table class="errors"><thead><tr>{head}</tr></thead><tbody>{body}</tbody>'
        "</table></div>"
    )


def _correlation(value: float) -> str:
    if not np.isfinite(value):
        return "&ndash;"
    shown = f"{value:+.2f}"
    return f"<b>{shown}</b>" if abs(value) >= _STRONG else shown


def _explained(lenses: Sequence[LensFacts]) -> str:
    """Return what the tables say, and which lenses have nothing stored."""
    explanation = (
        "Standard deviations and correlations of the adjusted parameters, errors of the lens model included; "
        f"correlations of {_STRONG:g} or more are bold. The sigma of the principal point of a mapping camera "
        "comes from the residuals, and has no correlations."
    )
    without = ", ".join(one.key for one in lenses if one.calibration is None)
    if without:
        explanation += (
            f" Nothing is stored for {without}: the lens was held, its frames have no covariance, or an "
            "earlier version made them; run spn-data reconstruct, or register, again to get it."
        )
    return f'<p class="note">{escape(explanation)}</p>'
