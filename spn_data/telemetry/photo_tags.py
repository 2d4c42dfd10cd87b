"""EXIF tags and XMP properties of an open photo, and conversion of their values."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import ParseError

import defusedxml.ElementTree
from defusedxml.common import DefusedXmlException
from PIL import Image

MAX_XMP_BYTES = 2_000_000
NAN = float("nan")
_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"


def exif_tags(
    read: Callable[[], Image.Exif], notes: list[str]
) -> tuple[dict[int, Any], dict[int, Any], dict[int, Any]]:
    """Return the main, EXIF and GPS tags; empty if they are damaged beyond reading."""
    try:
        main = read()
        # Pillow decodes tags lazily: do it here, where damage is caught.
        return dict(main), dict(main.get_ifd(_EXIF_IFD)), dict(main.get_ifd(_GPS_IFD))
    except (OSError, SyntaxError, ValueError, LookupError, TypeError, struct.error) as error:
        notes.append(f"damaged EXIF left out ({error})")
        return {}, {}, {}


def tags_of_raw(path: Path) -> Image.Exif:
    """Read the tags of a DNG, which is a TIFF for cameras."""
    tags = Image.Exif()
    with path.open("rb") as file:
        tags.load_from_fp(file)
        # Decode what is read lazily while the file is open.
        for directory in (_EXIF_IFD, _GPS_IFD):
            tags.get_ifd(directory)
        for tag in list(tags):
            tags[tag] = tags[tag]
    return tags


def xmp_properties(data: Any, notes: list[str]) -> dict[str, str]:
    """Return XMP elements and attributes by "{namespace}name"; the first of a name counts.

    Fields of a structure are named "{namespace}structure/{namespace}field".
    """
    if isinstance(data, str):
        data = data.encode()
    if not isinstance(data, bytes):
        return {}
    if len(data) > MAX_XMP_BYTES:
        notes.append(f"XMP of {len(data) / 1e6:.0f} MB left out")
        return {}
    try:
        root = defusedxml.ElementTree.fromstring(data.strip(b"\0 \t\r\n"), forbid_dtd=True)
    except (ParseError, DefusedXmlException, ValueError) as error:
        notes.append(f"damaged XMP left out ({error})")
        return {}
    properties: dict[str, str] = {}
    for element in root.iter():
        for name, value in (*element.attrib.items(), (element.tag, element.text or "")):
            if name.startswith("{") and value.strip():
                properties.setdefault(name, value.strip())
        for field in _fields(element):
            for name, value in (*field.attrib.items(), *((f.tag, f.text or "") for f in field)):
                if name.startswith("{") and value.strip():
                    properties.setdefault(f"{element.tag}/{name}", value.strip())
    return properties


def _fields(element: Any) -> list[Any]:
    """Return the nodes that hold the fields of a structure: itself, or the Description in it."""
    if element.tag.startswith(_RDF):
        return []
    return [element, *element.findall(_RDF + "Description")]


def number(value: Any) -> float:
    """Return a finite number, or NaN for anything else."""
    try:
        result = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return NAN
    return result if math.isfinite(result) else NAN


def positive(value: Any) -> float:
    """Return a positive number, or NaN for anything else, such as the 0 that cameras write for unknown."""
    result = number(value)
    return result if result > 0 else NAN


def text(value: Any) -> str:
    """Return text without the NUL bytes and blanks that cameras pad it with."""
    if isinstance(value, bytes):
        value = value.decode("ascii", errors="replace")
    return value.split("\0")[0].strip()[:200] if isinstance(value, str) else ""
