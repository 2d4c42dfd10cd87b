"""Names and units of flight-log columns, and their meaning."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

# Meaning of a column -> its names without units, in lower case with "_" for blanks and dots.
# If a log has several of these columns, the first name in the list counts.
COLUMNS: dict[str, tuple[str, ...]] = {
    "time": ("time", "t", "elapsed_time", "fly_time", "flytime"),
    "utc": ("time_utc", "datetime", "utc", "timestamp", "utc_time", "date_time", "updatetime"),
    "latitude": ("latitude", "lat", "gps_latitude", "gps_lat"),
    "longitude": ("longitude", "lon", "lng", "long", "gps_longitude", "gps_lon"),
    "rel_alt": (
        *("rel_alt", "relative_altitude", "rel_altitude", "height_above_takeoff"),
        *("ascent", "osd_height"),
    ),
    "alt_ellipsoid": ("alt_ellipsoid", "ellipsoidal_height", "ellipsoid_height", "alt_hae", "hae"),
    "alt_amsl": (
        "alt_amsl",
        "amsl",
        "alt_msl",
        "altitude_amsl",
        "altitude_msl",
        "altitude_above_sealevel",
    ),
    "altitude": ("abs_alt", "absolute_altitude", "altitude", "alt", "elevation", "ele"),
    "alt_reference": ("alt_reference", "height_reference", "abs_reference"),
    "heading": (
        "gimbal_heading",
        "gimbal_yaw",
        "gb_yaw",
        "camera_heading",
        "camera_yaw",
        "gimbalyaw",
    ),
    "pitch": ("gimbal_pitch", "gb_pitch", "camera_pitch", "gimbalpitch"),
    "roll": ("gimbal_roll", "gb_roll", "camera_roll", "gimbalroll"),
    "sigma_e": ("sigma_e", "sigma_east", "std_e"),
    "sigma_n": ("sigma_n", "sigma_north", "std_n"),
    "sigma_u": ("sigma_u", "sigma_up", "std_u", "vertical_accuracy", "v_accuracy", "epv"),
    "sigma_h": ("sigma_h", "horizontal_accuracy", "h_accuracy", "accuracy", "eph"),
    "hdop": ("hdop",),
    "vdop": ("vdop",),
    "pdop": ("pdop",),
    "is_video": ("isvideo", "is_video", "camera_isvideo", "istakingvideo"),
}
_LENGTHS = ("rel_alt", "alt_ellipsoid", "alt_amsl", "altitude")
_SIGMAS = ("sigma_e", "sigma_n", "sigma_u", "sigma_h")
_ANGLES = ("heading", "pitch", "roll", "latitude", "longitude")
_METRES = {"m": 1.0, "meter": 1.0, "meters": 1.0, "metre": 1.0, "metres": 1.0}
_FEET = {"ft": 0.3048, "foot": 0.3048, "feet": 0.3048}
_SECONDS = {"s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0}
_PARTS = {
    "ms": 1e-3,
    "millisecond": 1e-3,
    "milliseconds": 1e-3,
    "us": 1e-6,
    "microsecond": 1e-6,
    "usec": 1e-6,
}
_DEGREES = {"deg": 1.0, "degree": 1.0, "degrees": 1.0, "rad": math.degrees(1.0), "360": 1.0}
_UNITS: dict[str, dict[str, float]] = {
    **dict.fromkeys((*_LENGTHS, *_SIGMAS), _METRES | _FEET),
    **dict.fromkeys(_ANGLES, _DEGREES),
    "time": _SECONDS | _PARTS,
    "utc": _SECONDS | _PARTS | {"utc": 1.0, "local": 1.0},
}
# Without repetitions that can match the same blanks: a long header would take long.
_BRACKETS = re.compile(r"(.*)[(\[]([^()\[\]]*)[)\]]")


@dataclass(frozen=True)
class CsvColumn:
    """One recognised column of a CSV log."""

    index: int
    header: str  # as in the file
    scale: float  # from its unit to ours; NaN if the unit is unknown
    unit: str  # as in the file; "" if none is stated


def parse_header(header: Sequence[str]) -> dict[str, list[CsvColumn]]:
    """Return the recognised columns of a header row by meaning, the preferred one first.

    The order is that of the names in `COLUMNS`; of equal names, one in UTC precedes others, and otherwise
    the first in the file.
    """
    parsed: dict[str, list[tuple[int, str]]] = {}
    for index, cell in enumerate(header):
        for name, unit in _names_and_unit(cell):
            parsed.setdefault(name, []).append((index, unit))
    columns: dict[str, list[CsvColumn]] = {}
    for meaning, names in COLUMNS.items():
        units = _UNITS.get(meaning, {})
        found: list[CsvColumn] = []
        for name in names:
            # The unit is in brackets or is a suffix of the name: "rel_alt_m".
            for candidate, suffix in [(name, "")] + [(f"{name}_{unit}", unit) for unit in units]:
                for index, stated in sorted(
                    parsed.get(candidate, ()), key=lambda one: one[1] != "utc"
                ):
                    unit = stated or suffix
                    scale = 1.0 if not unit or not units else units.get(unit, math.nan)
                    found.append(CsvColumn(index, header[index], scale, unit))
        if found:
            columns[meaning] = list(dict.fromkeys(found))
    return columns


def _names_and_unit(cell: str) -> list[tuple[str, str]]:
    """Split "height_above_takeoff(feet)" or "OSD.height [ft]" into normalised names and a unit.

    The name counts with and without the prefix of a DJI flight record.
    """
    match = _BRACKETS.fullmatch(cell.strip())
    name, unit = (match[1], match[2]) if match else (cell, "")
    name = re.sub(r"[\s.\-]+", "_", name.strip().lower())
    plain = name.removeprefix("osd_").removeprefix("custom_")
    return [(one, unit.strip().lower()) for one in dict.fromkeys((name, plain))]
