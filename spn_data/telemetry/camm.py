"""Positions of a CAMM track (Street View cameras): packets of type 5 and 6."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.media.extras import import_extra
from spn_data.telemetry.accuracy import NAN_SIGMA, Sigma
from spn_data.telemetry.data_tracks import DataPacket
from spn_data.telemetry.track import Telemetry, time_order

_MIN_GPS, _GPS = 5, 6


def read_camm(packets: Sequence[DataPacket], source: str) -> Telemetry:
    """Read the positions of a CAMM track.

    Parameters
    ----------
    packets : sequence of DataPacket
        Packets of the track, one measurement each.
    source : str
        Name of the file.

    Returns
    -------
    Telemetry
        From packets with accuracy (type 6), heights above the ellipsoid as the format defines; else from
        those with a position only (type 5), whose height reference is unknown.

    Raises
    ------
    InputError
        If the package is missing, or the track holds no position.
    """
    module = import_extra("mapillary_tools.camm.camm_parser", "gopro", "its CAMM track", source)
    by_type: dict[int, list[tuple[float, Any]]] = {_MIN_GPS: [], _GPS: []}
    for packet in packets:
        if not (math.isfinite(packet.time_s) and len(packet.payload) in (28, 60)):
            continue
        records_of_kind = by_type.get(int.from_bytes(packet.payload[2:4], "little"))
        if records_of_kind is None:
            continue
        try:
            data = module.CAMMSampleData.parse(packet.payload).data
        except module.C.ConstructError:
            continue
        records_of_kind.append((packet.time_s, data))
    full = bool(by_type[_GPS])
    records = by_type[_GPS] or by_type[_MIN_GPS]
    if not records:
        raise InputError("its CAMM track holds no positions", path=source)
    rows = np.array([_full_row(data) if full else _short_row(data) for _, data in records])
    notes = ["read from its CAMM track"]
    if not full:
        notes.append("its CAMM track states no accuracy and no height reference")
    lost = int(np.isnan(rows[:, 0]).sum())
    if lost:
        notes.append(f"records without a fix in its CAMM track: {lost}")
    index, more = time_order(np.array([time_s for time_s, _ in records]))
    return Telemetry.from_columns(
        np.array([time_s for time_s, _ in records]),
        lat_lon_deg=rows[:, :2],
        abs_alt_m=rows[:, 2],
        sigma_m=rows[:, 3:],
        abs_reference=HeightReference.ELLIPSOID if full else HeightReference.UNKNOWN,
        kind="camm",
        source=source,
        notes=(*notes, *more),
    ).select(index)


def _row(lat: float, lon: float, alt: float, sigma: Sigma, fix: int) -> tuple[float, ...]:
    """Return position, height and sigma; NaN without a fix, and no height with a two-dimensional one."""
    if fix < 2 or not (abs(lat) <= 90 and abs(lon) <= 180) or (lat, lon) == (0, 0):
        return (math.nan, math.nan, math.nan, *NAN_SIGMA)
    return (lat, lon, alt if fix > 2 and math.isfinite(alt) else math.nan, *sigma)


def _full_row(data: Any) -> tuple[float, ...]:
    horizontal_m, vertical_m = data.horizontal_accuracy, data.vertical_accuracy
    stated = all(
        math.isfinite(accuracy_m) and accuracy_m > 0 for accuracy_m in (horizontal_m, vertical_m)
    )
    sigma = (horizontal_m, horizontal_m, vertical_m) if stated else NAN_SIGMA
    return _row(data.latitude, data.longitude, data.altitude, sigma, data.gps_fix_type)


def _short_row(data: Any) -> tuple[float, ...]:
    # Writers put -1 where they have no height.
    return _row(data[0], data[1], math.nan if data[2] == -1.0 else data[2], NAN_SIGMA, 3)
