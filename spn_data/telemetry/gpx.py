"""GPX tracks, the exchange format of GNSS loggers and flight planners."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, ParseError

import defusedxml.ElementTree
import numpy as np
from defusedxml.common import DefusedXmlException

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.telemetry.accuracy import Sigma, sigma_from_dop
from spn_data.telemetry.textfile import finite_number, read_text
from spn_data.telemetry.track import Telemetry, time_order

NAN = float("nan")
MAX_GPX_BYTES = (
    100_000_000  # about half a million points; the parsed tree takes ten times as much memory
)


class _Point(NamedTuple):
    utc_s: float
    lat_deg: float
    lon_deg: float
    elevation_m: float
    sigma_m: Sigma
    has_geoid: bool


def read_gpx(path: Path | str) -> Telemetry:
    """Read all track points of all segments; raise InputError if there are none, or none has a time.

    time_s counts from the first point, as a GPX file does not know when the video started. abs_alt_m is
    `ele`, which GPX does not define; it is above mean sea level if every point also has a `geoidheight`,
    because then the receiver distinguishes the two heights.
    """
    text = read_text(path, max_bytes=MAX_GPX_BYTES)
    if not text.strip():
        raise InputError("the file is empty: it contains no track", path=path)
    try:
        root = defusedxml.ElementTree.fromstring(text, forbid_dtd=True)
    except ParseError as error:
        raise InputError(f"is not valid XML: {error}", path=path, line=error.position[0]) from error
    except (DefusedXmlException, ValueError) as error:
        raise InputError(f"its XML is refused: {error}", path=path) from error
    if _name(root) != "gpx":
        raise InputError(f"is XML but not GPX: its root element is <{_name(root)[:40]}>", path=path)
    found = [point for point in root.iter() if _name(point) == "trkpt"]
    if not found:
        kinds = sorted({_name(e) for e in root.iter() if _name(e) in ("wpt", "rtept")})
        extra = f", only {' and '.join(kinds)}, which have no times" if kinds else ""
        raise InputError(f"contains no track points (trkpt){extra}", path=path)
    points, faults = _points(found)
    if not points:
        raise InputError(f"none of its {len(found)} track points is usable: {faults[0]}", path=path)
    times = np.array([p.utc_s for p in points])
    index, notes = time_order(times)
    points = [points[i] for i in index]
    notes.append(
        "its times are the receiver's clock, counted from the first point: the time offset to the video "
        "must be given, taken from the video's creation time, or estimated"
    )
    if faults:
        notes.append(f"track points left out: {len(faults)}, the first is {faults[0]}")
    utc_s = np.array([p.utc_s for p in points])
    amsl = all(p.has_geoid for p in points)
    return Telemetry.from_columns(
        utc_s - utc_s[0],
        lat_lon_deg=np.array([(p.lat_deg, p.lon_deg) for p in points]),
        abs_alt_m=np.array([p.elevation_m for p in points]),
        sigma_m=np.array([p.sigma_m for p in points]),
        utc_s=utc_s,
        abs_reference=HeightReference.AMSL if amsl else HeightReference.UNKNOWN,
        kind="gpx",
        source=str(path),
        notes=tuple(notes),
    )


def _points(elements: list[Element]) -> tuple[list[_Point], list[str]]:
    """Return the usable points, and what is wrong with each of the others."""
    points, faults = [], []
    for count, element in enumerate(elements, 1):
        try:
            points.append(_point(element))
        except ValueError as error:
            faults.append(f"number {count}: {error}")
    return points, faults


def _point(element: Element) -> _Point:
    """Parse one track point; raise ValueError saying what is wrong with it."""
    children = {_name(child): (child.text or "").strip() for child in element}
    if "time" not in children:
        raise ValueError("the point has no time")
    lat, lon = (finite_number(element.get(name, ""), name) for name in ("lat", "lon"))
    if not (abs(lat) <= 90 and abs(lon) <= 180) or (lat == 0 and lon == 0):
        raise ValueError(f"{lat}, {lon} is not a position on Earth")
    dilutions = {name: _optional(children, name) for name in ("hdop", "vdop", "pdop")}
    return _Point(
        _utc_seconds(children["time"]),
        lat,
        lon,
        _optional(children, "ele"),
        sigma_from_dop(**dilutions),
        "geoidheight" in children,
    )


def _utc_seconds(text: str) -> float:
    """Parse an ISO 8601 time as seconds since 1970; without a zone it is UTC."""
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        raise ValueError(f"{text[:40]!r} is not a time like 2024-05-01T12:00:00Z") from None
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def _optional(children: dict[str, str], name: str) -> float:
    return finite_number(children[name], name) if children.get(name) else NAN


def _name(element: Element) -> str:
    """Return the element name without the namespace of its GPX version."""
    return str(element.tag).rsplit("}", 1)[-1]
