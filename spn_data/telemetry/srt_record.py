"""Parsing of one subtitle record of a drone."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from datetime import UTC, datetime

NAN = float("nan")
_TAG = re.compile(r"</?[A-Za-z][^<>]{0,200}>")
_STAMP = re.compile(
    r"(\d{4})[-./](\d{1,2})[-./](\d{1,2})[ T](\d{1,2}):(\d{2}):(\d{2})"
    r"(?:[.,](\d{1,6})(?:,(\d{3}))?)?"  # "28.219" and the "08,438,904" of milli- and microseconds
)
_FIELD = re.compile(
    r"(?<![\w.])(latitude|longt?itude|rel_alt|abs_alt|altitude|barometer|gb_yaw|gb_pitch|gb_roll"
    r"|difftime)\s*[:(]\s*([^\s\],;()<>]*)",
    re.IGNORECASE,
)
# Focal length in a model-specific unit, and digital zoom: only their changes are meaningful.
_ZOOM = re.compile(r"(?<![\w.])(focal_len|dzoom_ratio|dzoom)\s*[:(]\s*([\d.]+)", re.IGNORECASE)
_HEIGHT = re.compile(r"(?<![\w.])H\s?[ =:]\s?([-+]?[\d.]+)\s?m(?![\w/])")
_RELATIVE_HEIGHT = re.compile(r"(?<![\w.])ReH\s?[ =:(]\s?([^\s,;()<>\]]+)")  # Autel
_DISTANCE = re.compile(r"(?<![\w.])D\s?[ =:]\s?([\d.]+)\s?m(?![\w/])")  # from HOME
_POSITION = re.compile(r"(?<![\w.])(GPS|RTK|HOME)\s*\(([^()]{0,120})\)", re.IGNORECASE)
_GIMBAL = re.compile(r"(?<![\w.])G\.PRY\s*\(([^()]{0,120})\)", re.IGNORECASE)
# U+FFFD is a degree sign that was not written as UTF-8.
_NUMBER = re.compile("([-+]?(?:\\d+(?:\\.\\d*)?|\\.\\d+))\\s*(?:ms|m|M|°|\ufffd+|deg)?")
_UNKNOWN = {"", "n/a", "na", "nan", "null", "none", "-", "--"}
_LETTER = re.compile(r"([NSEW])\s*:\s*(.*)", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class SrtRecord:
    """Values of one record; NaN or None if not stated."""

    line: int  # of its times in the file, or its first line
    time_s: float  # start in the video
    utc_s: float  # the drone's clock, as if it were UTC
    diff_s: float  # since the record before
    lat_lon_deg: tuple[float, float] | None  # if keys or letters name them
    pair: tuple[float, float] | None  # of GPS(a, b, c); only the whole file decides the order
    home_pair: tuple[float, float] | None  # of HOME(a, b), in the same order
    home_m: float  # horizontal distance from HOME, as the drone states it
    is_rtk: bool  # the position is RTK(a, b, c)
    height_third: bool  # GPS(a, b, 0.0M): c is a height, not a number of satellites
    rel_alt_m: float
    abs_alt_m: float
    bare_altitude: bool  # abs_alt_m is from [altitude: x], which has no stated reference
    gimbal_deg: tuple[float, float, float]  # heading, pitch, roll
    zoom: float  # focal length times digital zoom, in a model-specific unit


def parse_record(line: int, time_s: float, body: str) -> SrtRecord | None:
    """Parse a record; None if it has no telemetry. Raises ValueError saying what is damaged."""
    text = _TAG.sub(" ", body)
    values: dict[str, float] = {}
    for key, token in _FIELD.findall(text):
        values.setdefault(key.lower().replace("longt", "long"), _number(token, key))
    diff_ms = values.pop("difftime", NAN)
    # The first occurrence of each name counts, as for the keys.
    calls = {name.upper(): arguments for name, arguments in reversed(_POSITION.findall(text))}
    fix = calls.get("RTK", calls.get("GPS"))
    height = _HEIGHT.search(text)
    relative = _RELATIVE_HEIGHT.search(text)
    distance = _DISTANCE.search(text)
    gimbal = _GIMBAL.search(text)
    if not (values or fix or height or relative or gimbal):
        return None
    zooms = _ZOOM.findall(text)
    lat_lon, pair, height_third = None, None, False
    if "latitude" in values or "longitude" in values:
        lat_lon = (values.get("latitude", NAN), values.get("longitude", NAN))
    elif fix is not None:
        lat_lon, pair = _coordinates("GPS", fix)
        # Satellite counts are integers; a third value with a unit or decimals is a height.
        height_third = bool(re.search(r",[^,]*,[^,]*(?:\.\d|[mM]\s*$)", fix))
    home_pair = _home(calls)
    rel_alt = values.get("rel_alt", values.get("barometer", NAN))
    if relative and math.isnan(rel_alt):
        rel_alt = _number(relative[1], "ReH")
    if height and math.isnan(rel_alt):
        rel_alt = _number(height[1], "H")
    angles = (values.get("gb_yaw", NAN), values.get("gb_pitch", NAN), values.get("gb_roll", NAN))
    if gimbal:
        pitch_roll_yaw = [_number(token, "G.PRY") for token in gimbal[1].split(",")]
        if len(pitch_roll_yaw) != 3:
            raise ValueError(f"G.PRY({gimbal[1]}) is not pitch, roll, yaw")
        angles = (pitch_roll_yaw[2], pitch_roll_yaw[0], pitch_roll_yaw[1])
    return SrtRecord(
        line=line,
        time_s=time_s,
        utc_s=_stamp(text),
        diff_s=diff_ms / 1000,
        lat_lon_deg=lat_lon,
        pair=pair,
        home_pair=home_pair,
        home_m=_number(distance[1], "D") if distance else NAN,
        is_rtk="RTK" in calls,
        height_third=height_third,
        rel_alt_m=rel_alt,
        abs_alt_m=values.get("abs_alt", values.get("altitude", NAN)),
        bare_altitude="altitude" in values and "abs_alt" not in values,
        gimbal_deg=(angles[0] % 360.0, angles[1], angles[2]),
        zoom=math.prod(_number(m[1], m[0]) for m in zooms) if zooms else NAN,
    )


def _home(calls: dict[str, str]) -> tuple[float, float] | None:
    """Return the two numbers of HOME; None if letters name them, or it is damaged: no position needs it."""
    try:
        return _coordinates("HOME", calls["HOME"])[1]
    except (KeyError, ValueError):
        return None


def _coordinates(
    name: str, arguments: str
) -> tuple[tuple[float, float] | None, tuple[float, float] | None]:
    """Return (latitude, longitude) if letters name them, otherwise the two numbers in file order."""
    tokens = [token.strip() for token in arguments.split(",")]
    if len(tokens) < 2:
        raise ValueError(f"{name}({arguments}) is not a position")
    letters = [_LETTER.fullmatch(token) for token in tokens[:2]]
    if letters[0] and letters[1]:  # "E: 120.0, N: 20.0"
        values = {m[1].upper(): _number(m[2], name) for m in letters if m}
        if len(values.keys() & {"N", "S"}) != 1 or len(values.keys() & {"E", "W"}) != 1:
            raise ValueError(f"{name}({arguments}) is not one latitude and one longitude")
        for letter, value in values.items():
            if letter in "NE" and value < 0:
                raise ValueError(
                    f"{name}({arguments}): the letter {letter} and the minus sign contradict each other"
                )
        # With S and W some drones write the minus as well: letter and sign say the same.
        latitude = values["N"] if "N" in values else -abs(values["S"])
        longitude = values["E"] if "E" in values else -abs(values["W"])
        return (latitude, longitude), None
    pair = (_number(tokens[0], name), _number(tokens[1], name))
    if abs(pair[0]) > 180 or abs(pair[1]) > 180:
        raise ValueError(f"{name}({arguments}) is not a position on Earth")
    return None, pair


def _number(token: str, name: str) -> float:
    """Parse a number with an optional unit; NaN if the token says that it is unknown."""
    token = token.strip()
    if token.lower() in _UNKNOWN:
        return NAN
    match = _NUMBER.fullmatch(token)
    if match is None:
        raise ValueError(f"{name} is {token[:40]!r}, not a number")
    return float(match[1])


def _stamp(text: str) -> float:
    """Parse the first date stamp as seconds since 1970, as if it were UTC; NaN if there is none."""
    match = _STAMP.search(text)
    if match is None:
        return NAN
    year, month, day, hour, minute, second = (int(part) for part in match.groups()[:6])
    fraction = (match[7] or "0") + (match[8] or "")
    try:
        whole = datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp()
    except ValueError:  # the clock was never set, as in 2000-00-00
        return NAN
    return whole + int(fraction) / 10 ** len(fraction)
