"""Positions of a whole subtitle file: what no record decides alone, and what two statements contradict."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spn_data.geometry.geodesy import METRES_PER_DEGREE
from spn_data.telemetry.srt_record import NAN, SrtRecord

_FAR_DEG = 1.0  # from HOME in latitude or longitude: further than any drone with a video link flies
_MIN_HOME_M = 5.0  # below, rounding of the coordinates decides the distance
_DISTANCE_SHARE = 0.1  # of the stated distance from HOME, tolerated on top of the rounding


def positions(records: Sequence[SrtRecord], place: str) -> tuple[np.ndarray, list[str]]:
    """Return the positions of all records.

    Parameters
    ----------
    records : sequence of SrtRecord
        The N records of one file.
    place : str
        What `SrtRecord.line` counts, for the notes.

    Returns
    -------
    lat_lon : ndarray, shape (N, 2)
        Latitude and longitude in degrees, NaN without a fix.
    notes : list of str
        How the order of latitude and longitude was decided, and what was left out.
    """
    lon_first, notes = _order(records)
    lat_lon = np.full((len(records), 2), np.nan)
    impossible: list[str] = []
    far: list[str] = []
    for i, record in enumerate(records):
        lat, lon = record.lat_lon_deg or (NAN, NAN)
        if record.pair is not None:
            lat, lon = record.pair[::-1] if lon_first else record.pair
        if abs(lat) > 90 or abs(lon) > 180:
            impossible.append(f"{lat}, {lon} at {place} {record.line}")
        elif record.pair is None and _contradicts_home(record):
            far.append(f"{lat}, {lon} at {place} {record.line} with HOME{record.home_pair}")
        elif lat != 0 or lon != 0:  # DJI writes 0, 0 if there is no fix
            lat_lon[i] = (lat, lon) if np.isfinite(lat + lon) else NAN
    if impossible:
        notes.append(f"positions not on Earth: {len(impossible)}, the first is {impossible[0]}")
    if far:
        notes.append(
            f"positions left out because HOME in the same record is in another place: {len(far)}, "
            f"the first is {far[0]}"
        )
    return lat_lon, notes


def _order(records: Sequence[SrtRecord]) -> tuple[bool, list[str]]:
    """Return whether pairs are longitude first, and a note unless the file itself decides it."""
    pairs = [p for r in records for p in (r.pair, r.home_pair) if p is not None]
    # Latitudes are at most 90 degrees, so one larger value decides the order for the whole file.
    votes = sum(abs(a) > 90 for a, _ in pairs) - sum(abs(b) > 90 for _, b in pairs)
    if votes or not any(r.pair is not None for r in records):
        return votes > 0, []
    by_distance = _order_by_distance(records)
    is_rtk = any(r.is_rtk for r in records)
    name = "RTK" if is_rtk else "GPS"
    lon_first = is_rtk or not any(r.height_third for r in records)
    if by_distance is not None:
        lon_first = by_distance
    order = "longitude, latitude" if lon_first else "latitude, longitude"
    if by_distance is not None:
        return lon_first, [
            f"{name}(a, b, c) is read as {order}: only this order gives the stated distance D from HOME"
        ]
    third = "satellites" if lon_first else "a height"
    by = "Phantom 4 RTK" if is_rtk else f"drones whose third value is {third}"
    return lon_first, [
        f"{name}(a, b, c) could be in either order; it is read as {order}, the order of {by}"
    ]


def _order_by_distance(records: Sequence[SrtRecord]) -> bool | None:
    """Return whether pairs are longitude first by the stated distances from HOME; None if they do not tell.

    Exchanging latitude and longitude changes the length of a degree of longitude, and so the distance.
    """
    rows = [
        (*r.pair, *r.home_pair, r.home_m)
        for r in records
        if r.pair is not None and r.home_pair is not None and r.home_m >= _MIN_HOME_M
    ]
    if not rows:
        return None
    table = np.array(rows)
    table = table[np.isfinite(table).all(axis=1) & table[:, 2:4].any(axis=1)]
    if len(table) == 0:
        return None
    stated_m = table[:, 4]
    step = table[:, :2] - table[:, 2:4]
    off_m = [
        float(np.median(np.abs(_length_m(north, east, lat) - stated_m)))
        for north, east, lat in (
            (step[:, 1], step[:, 0], table[:, 1]),  # longitude first
            (step[:, 0], step[:, 1], table[:, 0]),
        )
    ]
    tolerance_m = _rounding_m(table[:, :2]) + _DISTANCE_SHARE * float(np.median(stated_m))
    if min(off_m) > tolerance_m or max(off_m) < 3 * min(off_m) + 1.0:
        return None
    return off_m[0] < off_m[1]


def _length_m(north_deg: np.ndarray, east_deg: np.ndarray, lat_deg: np.ndarray) -> np.ndarray:
    return METRES_PER_DEGREE * np.hypot(north_deg, east_deg * np.cos(np.deg2rad(lat_deg)))


def _rounding_m(pairs: np.ndarray) -> float:
    """Return the rounding step of coordinates (N, 2) in metres."""
    for decimals in range(9):
        if np.abs(pairs - np.round(pairs, decimals)).max() < 1e-10:
            break
    return float(10.0**-decimals * METRES_PER_DEGREE)


def _contradicts_home(record: SrtRecord) -> bool:
    """Return whether HOME lies elsewhere, in whichever order its two numbers are."""
    if record.lat_lon_deg is None or record.home_pair is None:
        return False
    if not np.isfinite(sum(record.home_pair)) or not any(record.home_pair):
        return False
    lat, lon = record.lat_lon_deg
    return all(
        abs(lat - home[0]) > _FAR_DEG or abs((lon - home[1] + 180) % 360 - 180) > _FAR_DEG
        for home in (record.home_pair, record.home_pair[::-1])
    )
