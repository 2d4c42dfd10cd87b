"""Sections that show frames as pictures: the worst of each flight and network, and failed ones."""

from __future__ import annotations

from html import escape
from itertools import groupby

import numpy as np

from spn_data.report.data import FAILED, FrameTable
from spn_data.report.pictures import COARSE, Pictures, WorstFrame

_MAX_FAILED = 24  # of each kind


def worst(pictures: Pictures, units: str) -> str:
    """Return the worst frames of each flight, beside the nearest training frames of truth and estimate.

    Parameters
    ----------
    pictures : Pictures
    units : str
        "m" or "model".

    Returns
    -------
    str
        The section, empty without estimates; the page's script fills in the images.
    """
    if not pictures.worst:
        return ""
    unit = "m" if units == "m" else "units"
    parts = ['<section id="worst"><h2>Worst frames of each flight</h2>']
    for (run, sequence), found in groupby(pictures.worst, lambda one: (one.run, one.sequence)):
        rows = "".join(_row(one, unit) for one in found)
        parts.append(f"<h3>{escape(sequence)}: network of {escape(run)}</h3>{rows}")
    parts.append(
        '<p class="note">Of the frames with a stored image, those with the largest position error of the '
        "network alone. Left: the frame. Middle: the training image nearest to where it was. Right: the "
        "training image nearest to where the network took it to be, what it mistook the frame for.</p>"
    )
    return "".join(parts) + "</section>"


def _row(one: WorstFrame, unit: str) -> str:
    off = f"off by {one.error:.2f} {unit}, {one.error_deg:.1f} deg"
    nearest = f"nearest training image: {one.distance:.1f} {unit}, {one.angle_deg:.0f} deg from it"
    figures = (
        (one.name, off),
        (one.nearest, nearest),
        (one.taken_for, "what the network took it for"),
    )
    return f'<div class="trio">{"".join(_figure(*figure) for figure in figures)}</div>'


def failed(frames: FrameTable, pictures: Pictures) -> str:
    """Return pictures of frames without a label, and without a usable fix, with their reasons.

    Parameters
    ----------
    frames : FrameTable
        All frames.
    pictures : Pictures

    Returns
    -------
    str
        The section, empty if there are none; the page's script fills in the images.
    """
    has_none = frames.status == FAILED
    parts = [
        _gallery("No pose in the map", frames.names[has_none], frames.reason[has_none], pictures)
    ]
    for one in pictures.estimates:
        if one.method != COARSE:
            title = f"No usable fix: {one.run}, {one.method}"
            parts.append(
                _gallery(title, one.names[~one.located], one.reasons[~one.located], pictures)
            )
    shown = "".join(parts)
    return f'<section id="failed"><h2>Failed frames</h2>{shown}</section>' if shown else ""


def _gallery(title: str, names: np.ndarray, reasons: np.ndarray, pictures: Pictures) -> str:
    """Return pictures of the frames that have an image; of many, an evenly spaced subset."""
    rows = np.flatnonzero(np.isin(names, list(pictures.thumbnails)))
    if not len(rows):
        return ""
    shown = rows[np.linspace(0, len(rows) - 1, min(_MAX_FAILED, len(rows))).astype(np.int64)]
    figures = "".join(_figure(str(names[row]), str(reasons[row])) for row in shown)
    return (
        f'<h3>{escape(title)}</h3><div class="gallery">{figures}</div>'
        f'<p class="note">{len(shown):,} of {len(names):,} frames are shown; frames without a stored image '
        "are not.</p>"
    )


def notes(pictures: Pictures) -> str:
    """Return what is missing, as notes."""
    return "".join(f'<p class="note warn">{escape(text)}</p>' for text in pictures.notes)


def _figure(name: str, words: str) -> str:
    return (
        f'<figure class="frame" data-frame="{escape(name, quote=True)}" tabindex="0"><img alt="">'
        f"<figcaption><b>{escape(name)}</b> {escape(words)}</figcaption></figure>"
    )
