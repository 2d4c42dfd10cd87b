"""Stanford diagram of a flight: protection levels against errors, on logarithmic axes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spn_data.charts import svg
from spn_data.charts.svg import COLOURS, GRID, INK, SOFT, Panel
from spn_model.evaluation.comparison_files import file_names
from spn_model.evaluation.fixes import COARSE, FlightFixes

_LIMITS_M = (1e-4, 1e2)
_SIDE = 360.0


def stanford_diagrams(fixes: Sequence[FlightFixes]) -> dict[str, str]:
    """Draw the diagram of each flight, by the name of its figure."""
    flights = list(dict.fromkeys(one.flight for one in fixes))
    return {
        f"{name}-protection": stanford([one for one in fixes if one.flight == flight])
        for name, flight in zip(file_names(flights), flights, strict=True)
    }


def stanford(fixes: Sequence[FlightFixes]) -> str:
    """Draw the protection level of each usable fix of a flight against its error.

    Fixes below the diagonal are not protected. Smaller errors than 0.1 mm and larger ones than 100 m are
    drawn at the edges. Fixes with a known attitude nearly coincide with those without, and are left out.
    """
    shown = [one for one in fixes if one.method != COARSE and one.attitude is None]
    heading = f"{fixes[0].flight}: protection level against error"
    parts = [svg.text(20, 22, heading, bold=True)]
    low, high = np.log10(_LIMITS_M)
    for column, what in enumerate(("horizontal", "vertical")):
        panel = Panel(64.0 + 480 * column, 62.0, _SIDE, _SIDE, (low, high), (low, high))
        parts.append(_axes(panel, what))
        for k, one in enumerate(shown):
            errors = [i.error for i in one.images if i.error is not None]
            levels = [i.protection_m[column] for i in one.images if i.error is not None]
            off = [(e.horizontal_m, e.vertical_m)[column] for e in errors]
            x, y = (np.log10(np.clip(np.array(v, float), *_LIMITS_M)) for v in (off, levels))
            parts.append(svg.dots(panel.on_page(x, y), COLOURS[k % len(COLOURS)], radius=2.0))
    entries = []
    for k, one in enumerate(shown):
        summary = one.summary()
        words = (
            f"{one.method}: {summary.compared} fixes of {summary.images} images, "
            f"{summary.misleading} misleading"
        )
        entries.append((words, COLOURS[k % len(COLOURS)]))
    parts.append(svg.legend(72, 480, entries))
    return svg.document(1000, 480 + 17 * len(entries), heading, parts)


def _axes(panel: Panel, what: str) -> str:
    """Draw the axes with powers of ten, and the area of fixes that are not protected."""
    low, high = panel.x_range
    corners = panel.on_page(np.array([low, high, high]), np.array([low, high, low]))
    bottom, right = panel.top + panel.height, panel.left + panel.width
    parts = [svg.area(corners, COLOURS[1], opacity=0.1)]
    for power in range(int(low), int(high) + 1):
        x, y = panel.on_page(np.array([power]), np.array([power]))[0]
        parts.append(svg.line([(x, panel.top), (x, bottom)], GRID))
        parts.append(svg.line([(panel.left, y), (right, y)], GRID))
        parts.append(svg.text(x, bottom + 15, f"{10.0**power:g}", anchor="middle"))
        parts.append(svg.text(panel.left - 6, y + 4, f"{10.0**power:g}", anchor="end"))
    parts.append(svg.line(corners[:2], INK, dash="4 3"))
    label = f"{what} error (m)"
    parts.append(svg.text(panel.left + panel.width / 2, bottom + 32, label, anchor="middle"))
    parts.append(svg.text(panel.left - 44, panel.top - 10, f"{what} protection level (m)"))
    parts.append(svg.text(right - 6, bottom - 8, "not protected", anchor="end", colour=SOFT))
    return "".join(parts)
