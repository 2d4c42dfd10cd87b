"""PNG and PDF of charts, drawn by matplotlib from the elements that `svg` writes."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from defusedxml.ElementTree import fromstring

from spn_data.errors import InputError
from spn_data.storage.files import write_atomically

FORMATS = ("png", "pdf")
_DPI = 200
_POINTS_A_PX = 0.75
_STEP = re.compile(r"([ML])([-\d.]+) ([-\d.]+)|(Z)")
_SVG = "{http://www.w3.org/2000/svg}"
_FONT_PX = 12.0  # of `svg.document`


def require_matplotlib() -> None:
    """Raise InputError with the command that installs matplotlib if it is missing."""
    try:
        importlib.import_module("matplotlib.figure")
    except ImportError as error:
        raise InputError(
            "figures as PNG and PDF need another package: pip install 'squeezeposenet-toolkit[figures]'"
        ) from error


def convert_figures(folder: Path, formats: Iterable[str]) -> int:
    """Write each SVG figure of a folder in other formats beside it.

    Parameters
    ----------
    folder : Path
    formats : iterable of str
        Of `FORMATS`.

    Returns
    -------
    int
        Number of files written.

    Raises
    ------
    InputError
        If matplotlib is not installed.
    StageError
        If a file cannot be written.
    """
    require_matplotlib()
    written = 0
    for path in sorted(folder.glob("*.svg")):
        for name, content in convert(path.read_text(encoding="utf-8"), formats).items():
            write_atomically(path.with_suffix(f".{name}"), content)
            written += 1
    return written


def convert(drawing: str, formats: Iterable[str]) -> dict[str, bytes]:
    """Draw a chart of `svg` in other formats.

    Parameters
    ----------
    drawing : str
        Content of an SVG file that `svg.document` returned.
    formats : iterable of str
        Of `FORMATS`.

    Returns
    -------
    dict of str to bytes
        Content of the file of each format.
    """
    import matplotlib
    from matplotlib.figure import Figure

    root = fromstring(drawing)
    width, height = (float(v) for v in root.get("viewBox").split()[2:])
    figure = Figure(figsize=(width * _POINTS_A_PX / 72, height * _POINTS_A_PX / 72))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.set_axis_off()
    _draw(axes, root)
    found = {}
    with matplotlib.rc_context({"pdf.fonttype": 42}):  # text stays text
        for name in formats:
            buffer = BytesIO()
            metadata = {"CreationDate": None} if name == "pdf" else {}
            figure.savefig(buffer, format=name, dpi=_DPI, metadata=metadata)
            found[name] = buffer.getvalue()
    return found


def _draw(axes: Any, root: Any, order: float = 1.0) -> None:
    """Draw the elements of a chart, later ones over earlier ones."""
    for node in root:
        order += 1e-4
        kind = node.tag.removeprefix(_SVG)
        if kind == "text":
            _draw_text(axes, node, order)
        elif kind in ("g", "path", "circle", "rect"):
            _draw_shape(axes, node, kind, order)
        else:
            raise ValueError(f"an element {kind!r}, which no chart has")


def _outline(node: Any, kind: str) -> Any:
    """Return the outline of an element; that of a group has those of all its elements."""
    from matplotlib.path import Path as Outline

    def number(name: str) -> float:
        return float(node.get(name, 0.0))

    if kind == "g":
        parts = [_outline(child, child.tag.removeprefix(_SVG)) for child in node]
        return Outline.make_compound_path(*parts) if parts else Outline(np.zeros((0, 2)))
    if kind == "circle":
        return Outline.circle((number("cx"), number("cy")), number("r"))
    if kind == "rect":
        corner = np.array([number("x"), number("y")])
        size = [number("width"), number("height")]
        return Outline(Outline.unit_rectangle().vertices * size + corner, closed=True)
    codes = {"M": Outline.MOVETO, "L": Outline.LINETO, "Z": Outline.CLOSEPOLY}
    steps = [
        ((float(x), float(y)), codes[letter]) if letter else ((0.0, 0.0), codes["Z"])
        for letter, x, y, _ in _STEP.findall(node.get("d"))
    ]
    return Outline([at for at, _ in steps], [code for _, code in steps])


def _draw_shape(axes: Any, node: Any, kind: str, order: float) -> None:
    from matplotlib.patches import PathPatch

    outline = _outline(node, kind)
    if not len(outline):
        return
    fill, stroke = node.get("fill", "none"), node.get("stroke", "none")
    line = 0.0 if stroke == "none" else float(node.get("stroke-width", 1.0)) * _POINTS_A_PX
    shape = PathPatch(
        outline,
        facecolor="none" if fill == "none" else (fill, float(node.get("fill-opacity", 1.0))),
        edgecolor="none" if stroke == "none" else (stroke, float(node.get("stroke-opacity", 1.0))),
        linewidth=line,
        zorder=order,
    )
    dashes = node.get("stroke-dasharray")
    if dashes:
        shape.set_linestyle((0, [float(v) * _POINTS_A_PX / line for v in dashes.split()]))
    axes.add_patch(shape)


def _draw_text(axes: Any, node: Any, order: float) -> None:
    axes.text(
        float(node.get("x")),
        float(node.get("y")),
        "".join(node.itertext()),
        fontsize=_FONT_PX * _POINTS_A_PX,
        ha={"start": "left", "middle": "center", "end": "right"}[node.get("text-anchor", "start")],
        va="baseline",
        color=node.get("fill"),
        weight="bold" if node.get("font-weight") else "normal",
        parse_math=False,
        zorder=order,
    )
