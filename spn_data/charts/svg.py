"""SVG charts: panels with axes, lines and dots, styled by attributes so that they work in any page."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

INK, SOFT, GRID = "#222222", "#8a8f98", "#e3e5e8"
# The colour-blind safe palette of Okabe and Ito.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
# Shapes that tell series apart without colours.
MARKERS = ("circle", "square", "triangle", "diamond", "cross", "plus")


@dataclass(frozen=True)
class Panel:
    """Plot area of a chart.

    Attributes
    ----------
    left, top, width, height : float
        Place on the page in pixels.
    x_range, y_range : tuple of float
        Values at the edges of the area.
    """

    left: float
    top: float
    width: float
    height: float
    x_range: tuple[float, float]
    y_range: tuple[float, float]

    def on_page(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return page positions (N, 2) of values; y grows upwards."""
        (x0, x1), (y0, y1) = self.x_range, self.y_range
        across = (np.asarray(x, float) - x0) / (x1 - x0) * self.width + self.left
        return np.stack(
            [across, self.top + self.height * (1 - (np.asarray(y, float) - y0) / (y1 - y0))],
            axis=-1,
        )

    def axes(self, x_label: str, y_label: str, title: str = "", *, decades: bool = False) -> str:
        """Draw grid, ticks and labels. decades : whether y is the logarithm to base 10 of what it shows."""
        bottom, right = self.top + self.height, self.left + self.width
        parts = []
        for value in ticks(*self.x_range):
            x = self.on_page(np.array([value]), np.array([self.y_range[0]]))[0, 0]
            parts.append(line([(x, self.top), (x, bottom)], GRID))
            parts.append(text(x, bottom + 15, f"{value:g}", anchor="middle"))
        for value in ticks(*self.y_range):
            if decades and value != round(value):
                continue
            y = self.on_page(np.array([self.x_range[0]]), np.array([value]))[0, 1]
            parts.append(line([(self.left, y), (right, y)], GRID))
            shown = 10.0**value if decades else value
            parts.append(text(self.left - 6, y + 4, f"{shown:g}", anchor="end"))
        parts.append(line([(self.left, self.top), (self.left, bottom), (right, bottom)], SOFT))
        parts.append(text(self.left + self.width / 2, bottom + 32, x_label, anchor="middle"))
        parts.append(text(self.left - 34, self.top - 10, y_label))
        if title:
            parts.append(text(right, self.top - 10, title, anchor="end", bold=True))
        return "".join(parts)


def document(width: float, height: float, label: str, parts: Iterable[str]) -> str:
    """Return the whole figure. label : accessible description of its content."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" role="img" '
        f'aria-label="{_words(label)}" font-family="system-ui, sans-serif" font-size="12" '
        f'fill="none"><rect width="{width:.0f}" height="{height:.0f}" fill="#ffffff"/>'
        f"{''.join(parts)}</svg>\n"
    )


def line(
    points: Sequence[Sequence[float]] | np.ndarray,
    colour: str,
    *,
    width: float = 1.0,
    dash: str = "",
    opacity: float = 1.0,
) -> str:
    """Draw a line through page positions (N, 2)."""
    return strokes([points], colour, width=width, dash=dash, opacity=opacity)


def strokes(
    lines: Iterable[Sequence[Sequence[float]] | np.ndarray],
    colour: str,
    *,
    width: float = 1.0,
    dash: str = "",
    opacity: float = 1.0,
) -> str:
    """Draw several lines as one path; return an empty string without lines."""
    path = "".join("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) for points in lines)
    dashed = f' stroke-dasharray="{dash}"' if dash else ""
    faint = f' stroke-opacity="{opacity:g}"' if opacity < 1 else ""
    return (
        f'<path d="{path}" stroke="{colour}" stroke-width="{width:g}"{dashed}{faint}/>'
        if path
        else ""
    )


def dots(
    points: np.ndarray, colour: str, *, radius: float = 2.5, titles: Sequence[str] = ()
) -> str:
    """Draw filled circles at page positions (N, 2). titles : tooltips."""
    tooltips = [f"<title>{_words(title)}</title>" for title in titles] or [""] * len(points)
    circles = "".join(
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}">{title}</circle>'
        for (x, y), title in zip(points, tooltips, strict=True)
    )
    return f'<g fill="{colour}">{circles}</g>'


def marks(
    points: np.ndarray,
    colour: str,
    marker: str,
    *,
    radius: float = 2.5,
    titles: Sequence[str] = (),
) -> str:
    """Draw marks, one of `MARKERS`, at page positions (N, 2). titles : tooltips."""
    if marker == "circle":
        return dots(points, colour, radius=radius, titles=titles)
    r = radius
    shapes = {
        "square": [(-r, -r), (r, -r), (r, r), (-r, r)],
        "triangle": [(0, -1.3 * r), (1.2 * r, r), (-1.2 * r, r)],
        "diamond": [(0, -1.4 * r), (1.4 * r, 0), (0, 1.4 * r), (-1.4 * r, 0)],
        "cross": [(-r, -r), (r, r), (-r, r), (r, -r)],
        "plus": [(-1.3 * r, 0), (1.3 * r, 0), (0, -1.3 * r), (0, 1.3 * r)],
    }
    is_open = marker in ("cross", "plus")
    tooltips = [f"<title>{_words(title)}</title>" for title in titles] or [""] * len(points)
    parts = []
    for (x, y), title in zip(points, tooltips, strict=True):
        corners = [f"{x + a:.1f} {y + b:.1f}" for a, b in shapes[marker]]
        if is_open:
            path = f"M{corners[0]}L{corners[1]}M{corners[2]}L{corners[3]}"
        else:
            path = f"M{'L'.join(corners)}Z"
        parts.append(f'<path d="{path}">{title}</path>')
    style = f'stroke="{colour}" stroke-width="1.4"' if is_open else f'fill="{colour}"'
    return f"<g {style}>{''.join(parts)}</g>"


def area(points: np.ndarray, colour: str, *, opacity: float = 0.15) -> str:
    """Draw a filled polygon of page positions (N, 2)."""
    path = "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
    return f'<path d="M{path}Z" fill="{colour}" fill-opacity="{opacity:g}"/>'


def box(x: float, y: float, width: float, height: float, colour: str, *, opacity: float = 1) -> str:
    """Draw a filled rectangle."""
    return (
        f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" '
        f'fill="{colour}" fill-opacity="{opacity:g}"/>'
    )


def text(
    x: float, y: float, words: str, *, anchor: str = "start", bold: bool = False, colour: str = INK
) -> str:
    """Draw text at a page position. anchor : start, middle or end."""
    weight = ' font-weight="600"' if bold else ""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{colour}"{weight}>'
        f"{_words(words)}</text>"
    )


def legend(
    x: float, y: float, entries: Sequence[tuple[str, str]], markers: Sequence[str] = ()
) -> str:
    """Draw legend entries (text, colour) below each other. markers : one of each; circles by default."""
    shapes = markers or ["circle"] * len(entries)
    return "".join(
        marks(np.array([[x, y + 17 * k - 4]]), colour, shape, radius=4)
        + text(x + 10, y + 17 * k, words)
        for k, ((words, colour), shape) in enumerate(zip(entries, shapes, strict=True))
    )


def _words(text: str) -> str:
    """Escape text for XML and replace characters that are not printable, whatever names of files hold."""
    return escape("".join(c if c.isprintable() else "\ufffd" for c in text))


def ticks(low: float, high: float, about: int = 6) -> list[float]:
    """Return round values within a non-empty range, 1, 2 or 5 times a power of ten apart."""
    step = round_step((high - low) / about)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [round(k * step, 12) + 0.0 for k in range(first, last + 1)]


def round_step(value: float) -> float:
    """Return the smallest of 1, 2, 5 times a power of ten that is not smaller than a value.

    Raises ValueError unless the value is positive.
    """
    power = 10.0 ** math.floor(math.log10(value))
    return min(m * power for m in (1, 2, 5, 10) if m * power >= value * (1 - 1e-9))
