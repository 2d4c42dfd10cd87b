"""EXIF tags and XMP properties of an open photo, and conversion of their values."""

from __future__ import annotations

import math
import struct
from typing import Any
from xml.etree.ElementTree import ParseError

import defusedxml.ElementTree
from defusedxml.common import DefusedXmlException
from PIL import Image

MAX_XMP_BYTES = 2_000_000
NAN = float("nan")
_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825


def exif_tags(
    image: Image.Image, notes: list[str]
) -> tuple[dict[int, Any], dict[int, Any], dict[int, Any]]:
    """Return the main, EXIF and GPS tags; empty if they are damaged beyond reading."""
    try:
        main = image.getexif()
        # Pillow decodes tags lazily: do it here, where damage is caught.
        return dict(main), dict(main.get_ifd(_EXIF_IFD)), dict(main.get_ifd(_GPS_IFD))
    except (OSError, SyntaxError, ValueError, LookupError, TypeError, struct.error) as error:
        notes.append(f"damaged EXIF left out ({error})")
        return {}, {}, {}


def xmp_properties(image: Image.Image, notes: list[str]) -> dict[str, str]:
    """Return XMP elements and attributes by "{namespace}name"; the first of a name counts."""
    data = image.info.get("xmp")
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
    return properties


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
