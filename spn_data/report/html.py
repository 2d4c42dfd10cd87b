"""The report as one self-contained HTML file."""

from __future__ import annotations

import re
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

from spn_data.report import picture_sections, sections
from spn_data.report.area_verdict import AreaVerdict, judge
from spn_data.report.data import ReportData
from spn_data.report.expected import expected_plans
from spn_data.report.figures import key_figures
from spn_data.report.networks import networks
from spn_data.report.pack import script_json
from spn_data.report.photogrammetry import photogrammetry
from spn_data.report.pictures import Pictures
from spn_data.report.scene import pack_scene
from spn_data.report.thinning import thin_frames

_SCRIPTS = ("data", "draw", "estimates", "layers", "view", "timeline", "table", "frame", "main")
_HEADING = re.compile(r'<section id="([\w-]+)"[^>]*><h2>([^<]+)</h2>')


def render(
    data: ReportData,
    judged: AreaVerdict | None = None,
    *,
    pictures: Pictures | None = None,
    max_points: int = 100_000,
    max_frames: int = 30_000,
) -> str:
    """Render the report as self-contained HTML in ASCII, which loads nothing from elsewhere.

    Parameters
    ----------
    data : ReportData
        What to show.
    judged : AreaVerdict, optional
        Verdict on it, if it is known already.
    pictures : Pictures or None
        Estimates and images to show; None: no frame has any.
    max_points : int
        Maximum number of map points in the page.
    max_frames : int
        Approximate maximum number of frames in the page (`thin_frames`).

    Returns
    -------
    str
        The page.
    """
    pictures = pictures or Pictures()
    frames, left_out = thin_frames(data.frames, max_frames)
    sections_by_name = {
        "title": escape(data.title),
        "heading": sections.heading(data),
        "verdict": sections.verdict_box(judged or judge(data), Path(data.path)),
        "figures": key_figures(data),
        "view": sections.view(data, max_points, picture_sections.notes(pictures)),
        "networks": networks(data) + expected_plans(data.plans, data.broken_plans),
        "worst": picture_sections.worst(pictures, data.units),
        "coverage": sections.coverage(data),
        "residuals": sections.residuals(data) + sections.control(data),
        "photogrammetry": photogrammetry(data, pictures.estimates),
        "split": sections.split(data),
        "timeline": sections.timeline(data, left_out),
        "failed": picture_sections.failed(frames, pictures),
        "table": sections.table(frames),
        "stages": sections.stages(data),
    }
    sections_by_name |= {
        "contents": _contents("".join(sections_by_name.values())),
        "style": _asset("style.css"),
        "data": script_json(pack_scene(data, frames, pictures, max_points)),
        "script": "\n".join(_asset(f"{name}.js") for name in _SCRIPTS),
    }
    page = Template(_asset("page.html")).substitute(sections_by_name)
    # ASCII is safe whatever encoding the file is served with; names that are not valid text show as "?".
    return page.encode("ascii", "xmlcharrefreplace").decode("ascii")


def _contents(html: str) -> str:
    """Return a link to each section that has an id and a plain heading."""
    links = [f'<a href="#{name}">{title}</a>' for name, title in _HEADING.findall(html)]
    return f'<nav aria-label="Contents">{"".join(links)}</nav>'


def _asset(name: str) -> str:
    return files("spn_data.report").joinpath("assets", name).read_text(encoding="utf-8")
