"""Times of photos and the order of their names."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

from spn_data.telemetry.photo_tags import NAN, number, text

_DATE_TIME, _DATE_TIME_ORIGINAL, _SUB_SEC_ORIGINAL = 306, 36867, 37521
_OFFSET_TIMES = (36881, 36880, 36882)  # of the exposure, the file and the digitisation: one clock
_GPS_TIME, _GPS_DATE = 7, 29
_ZONE_STEP_S = 900.0  # time zones are whole quarters of an hour
_MAX_ZONE_S = 14 * 3600.0
_GPS_AGE_S = 120.0  # the fix may be older than the exposure
_DIGITS = re.compile(r"(\d+)")


def exposure_times(
    main: Mapping[int, Any],
    exif: Mapping[int, Any],
    gps: Mapping[int, Any],
    *,
    utc_at_exposure: str = "",
) -> tuple[float, float]:
    """Return the time of exposure on the camera's clock and in UTC.

    Parameters
    ----------
    main, exif, gps : mapping of int to object
        Tags of the photo's three directories.
    utc_at_exposure : str
        DJI's XMP property of this name, which has precedence.

    Returns
    -------
    local_s, utc_s : float
        Seconds since 1970; NaN if unknown. UTC is known if the photo states the zone of its clock, or also
        the UTC of its fix, whose difference to the clock must be a time zone.
    """
    taken = text(exif.get(_DATE_TIME_ORIGINAL)) or text(main.get(_DATE_TIME))
    local_s = _seconds(taken, "%Y:%m:%d %H:%M:%S")
    fraction = text(exif.get(_SUB_SEC_ORIGINAL))
    if fraction.isdecimal():
        local_s += int(fraction) / 10 ** len(fraction)
    zones_s = [_stated_zone_s(exif.get(tag)) for tag in _OFFSET_TIMES]
    stated_s = [zone_s for zone_s in zones_s if not math.isnan(zone_s)]
    utc_s = local_s - (stated_s[0] if stated_s else _zone_by_fix_s(local_s, gps))
    if utc_at_exposure:
        whole, _, part = utc_at_exposure.replace("T", " ").partition(".")
        exposure_s = _seconds(whole, "%Y-%m-%d %H:%M:%S")
        digits = part.rstrip("Z")
        utc_s = exposure_s + (int(digits) / 10 ** len(digits) if digits.isdecimal() else 0.0)
    return local_s, utc_s


def natural_order(name: str) -> tuple[object, ...]:
    """Return a sort key of a file name by which numbers count by their value.

    Parameters
    ----------
    name : str
        The file name with its suffix.

    Returns
    -------
    tuple
        By it, `img2.jpg` comes before `img10.jpg`, and `img.jpg` before `img (1).jpg`.
    """
    stem = name.rpartition(".")[0] or name
    parts = _DIGITS.split(stem.lower())
    return (*[(k % 2, int(part) if k % 2 else part) for k, part in enumerate(parts)], (0, name))


def _stated_zone_s(value: Any) -> float:
    """Return the seconds of an offset like "+02:00"; NaN if it is not stated."""
    try:
        zone = datetime.strptime(text(value), "%z").utcoffset()
    except ValueError:
        return NAN
    return NAN if zone is None else zone / timedelta(seconds=1)


def _zone_by_fix_s(local_s: float, gps: Mapping[int, Any]) -> float:
    """Return the time zone that the UTC of the fix shows; NaN if there is none or the clocks disagree."""
    parts = gps.get(_GPS_TIME)
    day_s = _seconds(text(gps.get(_GPS_DATE)), "%Y:%m:%d")
    if not isinstance(parts, tuple) or len(parts) != 3 or math.isnan(day_s + local_s):
        return NAN
    hours, minutes, seconds = (number(part) for part in parts)
    apart_s = local_s - (day_s + 3600 * hours + 60 * minutes + seconds)
    if not abs(apart_s) <= _MAX_ZONE_S + _GPS_AGE_S:
        return NAN
    zone_s = _ZONE_STEP_S * round(apart_s / _ZONE_STEP_S)
    return zone_s if abs(apart_s - zone_s) <= _GPS_AGE_S else NAN


def _seconds(stamp: str, layout: str) -> float:
    try:
        return datetime.strptime(stamp, layout).replace(tzinfo=UTC).timestamp()
    except ValueError:  # a camera whose clock was never set writes "0000:00:00 00:00:00"
        return NAN
