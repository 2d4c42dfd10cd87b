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
    "utc": ("datetime", "utc", "timestamp", "utc_time", "date_time", "updatetime"),
    "latitude": ("latitude", "lat", "gps_latitude", "gps_lat"),
    "longitude": ("longitude", "lon", "lng", "long", "gps_longitude", "gps_lon"),
    "rel_alt": ("rel_alt", "relative_altitude", "rel_altitude", "height_above_takeoff"),
    "alt_ellipsoid": ("alt_ellipsoid", "ellipsoidal_height", "ellipsoid_height", "alt_hae", "hae"),
    "alt_amsl": ("alt_amsl", "amsl", "alt_msl", "altitude_amsl", "altitude_above_sealevel"),
    "altitude": ("abs_alt", "absolute_altitude", "altitude", "alt", "elevation", "ele"),
    "alt_reference": ("alt_reference", "height_reference", "abs_reference"),
    "heading": ("gimbal_heading", "gimbal_yaw", "gb_yaw", "camera_heading", "camera_yaw"),
    "pitch": ("gimbal_pitch", "gb_pitch", "camera_pitch"),
    "roll": ("gimbal_roll", "gb_roll", "camera_roll"),
    "sigma_e": ("sigma_e", "sigma_east", "std_e"),
    "sigma_n": ("sigma_n", "sigma_north", "std_n"),
    "sigma_u": ("sigma_u", "sigma_up", "std_u", "vertical_accuracy", "v_accuracy"),
    "sigma_h": ("sigma_h", "horizontal_accuracy", "h_accuracy", "accuracy"),
    "hdop": ("hdop",),
    "vdop": ("vdop",),
    "pdop": ("pdop",),
    "is_video": ("isvideo", "is_video"),
}
_LENGTHS = ("rel_alt", "alt_ellipsoid", "alt_amsl", "altitude")
_SIGMAS = ("sigma_e", "sigma_n", "sigma_u", "sigma_h")
_ANGLES = ("heading", "pitch", "roll", "latitude", "longitude")
_METRES = {"m": 1.0, "meter": 1.0, "meters": 1.0, "metre": 1.0, "metres": 1.0}
_FEET = {"ft": 0.3048, "foot": 0.3048, "feet": 0.3048}
_SECONDS = {"s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0}
_PARTS = {"ms": 1e-3, "millisecond": 1e-3, "milliseconds": 1e-3, "us": 1e-6, "microsecond": 1e-6}
_DEGREES = {"deg": 1.0, "degree": 1.0, "degrees": 1.0, "rad": math.degrees(1.0)}
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


def parse_header(header: Sequence[str]) -> dict[str, CsvColumn]:
    """Return the recognised columns of a header row by meaning; the first of several equal names counts."""
    parsed: dict[str, tuple[int, str]] = {}
    for index, cell in enumerate(header):
        name, unit = _name_and_unit(cell)
        parsed.setdefault(name, (index, unit))
    columns: dict[str, CsvColumn] = {}
    for meaning, names in COLUMNS.items():
        units = _UNITS.get(meaning, {})
        for name in names:
            # The unit is in brackets or is a suffix of the name: "rel_alt_m".
            candidates = [(name, "")] + [(f"{name}_{unit}", unit) for unit in units]
            match = next((c for c in candidates if c[0] in parsed), None)
            if match is None:
                continue
            index, unit = parsed[match[0]]
            unit = unit or match[1]
            scale = 1.0 if not unit or not units else units.get(unit, math.nan)
            columns[meaning] = CsvColumn(index, header[index], scale, unit)
            break
    return columns


def _name_and_unit(cell: str) -> tuple[str, str]:
    """Split "height_above_takeoff(feet)" or "OSD.height [ft]" into a normalised name and a unit."""
    match = _BRACKETS.fullmatch(cell.strip())
    name, unit = (match[1], match[2]) if match else (cell, "")
    name = re.sub(r"[\s.\-]+", "_", name.strip().lower())
    return name.removeprefix("osd_").removeprefix("custom_"), unit.strip().lower()
