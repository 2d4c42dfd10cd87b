"""Page that follows the work in an area: it asks for the state and shows report.html below."""

from __future__ import annotations

from importlib.resources import files


def live_page() -> bytes:
    """Return the page as self-contained HTML; it asks `state.json` and shows `report.html` next to it."""
    return files("spn_data.report").joinpath("assets", "live.html").read_bytes()
