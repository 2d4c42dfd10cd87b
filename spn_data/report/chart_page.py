"""Charts in the page: drawn with the colours of its theme, in columns that fit a phone."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from spn_data.charts import svg

WIDTH = 480.0  # px of a chart; text stays readable at the width of a phone
_BACKGROUND = "#ffffff"
_THEME = {
    svg.INK: "var(--text)",
    svg.SOFT: "var(--soft)",
    svg.GRID: "var(--line)",
    svg.COLOURS[0]: "var(--mapping)",
    svg.COLOURS[1]: "var(--evaluation)",
    svg.COLOURS[2]: "var(--gnss)",
    svg.COLOURS[3]: "var(--again)",
    svg.COLOURS[4]: "var(--evaluation3)",
    svg.COLOURS[5]: "var(--evaluation2)",
    _BACKGROUND: "none",
}


def chart(height: float, label: str, parts: Iterable[str], note: str = "") -> str:
    """Return a chart with a heading and a note, as a figure of the page."""
    drawn = svg.document(WIDTH, height, label, parts)
    for colour, of_theme in _THEME.items():
        drawn = drawn.replace(f'"{colour}"', f'"{of_theme}"')
    caption = f'<figcaption class="note">{escape(note)}</figcaption>' if note else ""
    return f'<figure style="min-width:0;max-width:560px"><h3>{escape(label)}</h3>{drawn}{caption}</figure>'


def side_by_side(charts: Iterable[str]) -> str:
    """Return charts in as many columns as the window has room for."""
    together = "".join(charts)
    if not together:
        return ""
    columns = "repeat(auto-fill,minmax(min(340px,100%),1fr))"
    return f'<div style="display:grid;grid-template-columns:{columns};gap:0 24px">{together}</div>'
