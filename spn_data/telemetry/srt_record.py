"""One record of a drone's subtitles: which numbers in its text mean what."""

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
# Focal length in a unit of the model's own, and digital zoom: only their changes mean something.
_ZOOM = re.compile(r"(?<![\w.])(focal_len|dzoom_ratio|dzoom)\s*[:(]\s*([\d.]+)", re.IGNORECASE)
_HEIGHT = re.compile(r"(?<![\w.])H\s?[ =:]\s?([-+]?[\d.]+)\s?m(?![\w/])")
_POSITION = re.compile(r"(?<![\w.])(GPS|RTK|HOME)\s*\(([^()]{0,120})\)", re.IGNORECASE)
_GIMBAL = re.compile(r"(?<![\w.])G\.PRY\s*\(([^()]{0,120})\)", re.IGNORECASE)
# U+FFFD: a degree sign that was not written as UTF-8.
_NUMBER = re.compile("([-+]?(?:\\d+\\.?\\d*|\\.\\d+))\\s*(?:ms|m|M|°|\ufffd+|deg)?")
_UNKNOWN = {"", "n/a", "na", "nan", "null", "none", "-", "--"}
_LETTER = re.compile(r"([NSEW])\s*:\s*(.*)", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class SrtRecord:
    """What one record says; NaN or None for what it does not."""

    line: int  # of its times, or else its first, in the file
    time_s: float  # start in the video
    utc_s: float  # the drone's clock, as if it were UTC
    diff_s: float  # since the record before
    lat_lon_deg: tuple[float, float] | None  # where keys or letters name the two
    pair: (
        tuple[float, float] | None
    )  # in GPS(a, b, c), where only the file as a whole tells the order
    home_pair: tuple[float, float] | None  # in HOME(a, b): the same order
    height_third: bool  # GPS(a, b, 0.0M): c is a height and no count of satellites
    rel_alt_m: float
    abs_alt_m: float
    bare_altitude: bool  # abs_alt_m comes from [altitude: x], which does not say above what
    gimbal_deg: tuple[float, float, float]  # heading, pitch, roll
    zoom: float  # focal length times digital zoom, in a unit of the model's own


def parse_record(line: int, time_s: float, body: str) -> SrtRecord | None:
    """The record, or None where it holds no telemetry. Raises ValueError saying what is damaged."""
    text = _TAG.sub(" ", body)
    values: dict[str, float] = {}
    for key, token in _FIELD.findall(text):
        values.setdefault(key.lower().replace("longt", "long"), _number(token, key))
    diff_ms = values.pop("difftime", NAN)
    # For each name the first arguments count, as for the keys.
    calls = {name.upper(): arguments for name, arguments in reversed(_POSITION.findall(text))}
    fix = calls.get("RTK", calls.get("GPS"))
    height = _HEIGHT.search(text)
    gimbal = _GIMBAL.search(text)
    if not (values or fix or height or gimbal):
        return None
    zooms = _ZOOM.findall(text)
    lat_lon, pair, height_third = None, None, False
    if "latitude" in values or "longitude" in values:
        lat_lon = (values.get("latitude", NAN), values.get("longitude", NAN))
    elif fix is not None:
        lat_lon, pair = _coordinates("GPS", fix)
        # Satellites are whole numbers; a third value with a unit or decimals is a height.
        height_third = bool(re.search(r",[^,]*,[^,]*(?:\.\d|[mM]\s*$)", fix))
    home_pair = _coordinates("HOME", calls["HOME"])[1] if "HOME" in calls else None
    rel_alt = values.get("rel_alt", values.get("barometer", NAN))
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
        height_third=height_third,
        rel_alt_m=rel_alt,
        abs_alt_m=values.get("abs_alt", values.get("altitude", NAN)),
        bare_altitude="altitude" in values and "abs_alt" not in values,
        gimbal_deg=(angles[0] % 360.0, angles[1], angles[2]),
        zoom=math.prod(_number(m[1], m[0]) for m in zooms) if zooms else NAN,
    )


def _coordinates(
    name: str, arguments: str
) -> tuple[tuple[float, float] | None, tuple[float, float] | None]:
    """(latitude, longitude) where letters tell them, or else the two numbers as they stand."""
    tokens = [token.strip() for token in arguments.split(",")]
    if len(tokens) < 2:
        raise ValueError(f"{name}({arguments}) is no position")
    letters = [_LETTER.fullmatch(token) for token in tokens[:2]]
    if letters[0] and letters[1]:  # "E: 120.0, N: 20.0"
        values = {m[1].upper(): _number(m[2], name) for m in letters if m}
        latitude = values["N"] if "N" in values else -values.get("S", NAN)
        longitude = values["E"] if "E" in values else -values.get("W", NAN)
        return (latitude, longitude), None
    pair = (_number(tokens[0], name), _number(tokens[1], name))
    if abs(pair[0]) > 180 or abs(pair[1]) > 180:
        raise ValueError(f"{name}({arguments}) is no position on Earth")
    return None, pair


def _number(token: str, name: str) -> float:
    """A number with an optional unit; NaN where the token says that it is unknown."""
    token = token.strip()
    if token.lower() in _UNKNOWN:
        return NAN
    match = _NUMBER.fullmatch(token)
    if match is None:
        raise ValueError(f"{name} is {token[:40]!r}, not a number")
    return float(match[1])


def _stamp(text: str) -> float:
    """Seconds since 1970 of the first date stamp, taken as if it were UTC; NaN without one."""
    match = _STAMP.search(text)
    if match is None:
        return NAN
    year, month, day, hour, minute, second = (int(part) for part in match.groups()[:6])
    fraction = (match[7] or "0") + (match[8] or "")
    try:
        whole = datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp()
    except ValueError:  # a clock that was never set, such as 2000-00-00
        return NAN
    return whole + int(fraction) / 10 ** len(fraction)
