"""GoPro's GPMF: positions of the camera (GPS5, GPS9) or of the drone that carries it (Karma: GPRI, GLPI).

The package's own reader (`extract_gopro_info` of mapillary-tools) drops the height reference GPSA and does
not know the Karma. Its parser of values is used here, on pieces whose counts are checked before.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.media.extras import import_extra
from spn_data.telemetry.accuracy import NAN_SIGMA, Sigma, sigma_from_dop
from spn_data.telemetry.data_tracks import MAX_RECORDS, DataPacket
from spn_data.telemetry.track import Telemetry, time_order

_USED = (b"GPS9", b"GPS5", b"GPRI", b"GLPI", b"SYST")
_HEADERS = (b"SCAL", b"TYPE", b"GPSF", b"GPSP", b"GPSU", b"GPSA")
# Bounds of one payload, which holds a second: the parser takes microseconds for each value.
_MAX_ITEMS = 1000
_MAX_ROWS = 10_000
_MAX_HEADER_BYTES = 256
_STRUCT = dict(zip("bBsSlLjJfd", "bBhHiIqQfd", strict=True))
_2000_S = datetime(2000, 1, 1, tzinfo=UTC).timestamp()
_SAME_HOME_M = 0.05  # two heights whose difference varies less have one zero each
_MAX_ACCURACY_M = 655.0  # MAVLink writes 65535 cm for an unknown accuracy
_LAG_NOTE = (
    "the positions of a GoPro may lag its picture; the camera does not state by how much, and nothing is "
    "corrected"
)

_Values = dict[bytes, list[Any]]


@dataclass(frozen=True, slots=True)
class _Fix:
    time_s: float
    lat_deg: float
    lon_deg: float
    alt_m: float
    sigma_m: Sigma
    utc_s: float


@dataclass
class _Found:
    """What the payloads hold, by kind of stream."""

    fixes: dict[bytes, list[_Fix]] = field(default_factory=dict)
    references: dict[bytes, set[bytes]] = field(default_factory=dict)
    heights: list[tuple[float, float, float]] = field(
        default_factory=list
    )  # stamp, absolute, relative
    clock: list[tuple[float, float]] = field(default_factory=list)  # stamp since power-on, UTC
    stamp_zero_s: list[float] = field(default_factory=list)  # video time at stamp 0, by record
    no_fix: int = 0
    damaged: int = 0

    @property
    def count(self) -> int:
        """Number of records so far."""
        return sum(map(len, self.fixes.values())) + len(self.heights) + len(self.clock)


def read_gpmf(packets: Sequence[DataPacket], source: str) -> Telemetry:
    """Read the positions of a GPMF track.

    Parameters
    ----------
    packets : sequence of DataPacket
        Payloads of the track, a second each.
    source : str
        Name of the file.

    Returns
    -------
    Telemetry
        From GPS9, else GPS5, else the Karma's GPRI. Records without a fix are NaN. A sigma comes from the
        dilution of precision, that of a Karma from its stated accuracy in metres.

    Raises
    ------
    InputError
        If the package is missing, or the track holds no position.
    """
    parse = _parser(source)
    found = _Found()
    for packet in packets:
        try:
            for body in _position_streams(packet.payload):
                _add(found, parse(body), packet)
                if found.count > MAX_RECORDS:
                    raise InputError(
                        f"its GoPro track has more than {MAX_RECORDS:,} records", path=source
                    )
        except (ValueError, IndexError, KeyError, TypeError, OverflowError, struct.error):
            found.damaged += 1
    kinds = [kind for kind in (b"GPS9", b"GPS5", b"GPRI") if found.fixes.get(kind)]
    if not kinds:
        damaged = (
            f"; {found.damaged} of its {len(packets)} payloads are damaged" if found.damaged else ""
        )
        raise InputError(
            f"its GoPro track holds no positions (was the camera's GPS off?){damaged}", path=source
        )
    return _telemetry(found, kinds, source)


def _parser(source: str) -> Any:
    """Return the function of mapillary-tools that parses the values of one GPMF stream."""
    what = "its GoPro track (GPMF)"
    module = import_extra("mapillary_tools.gpmf.gpmf_parser", "gopro", what, source)
    construct = import_extra("construct", "gopro", what, source)

    def parse(body: bytes) -> _Values:
        try:
            return {
                bytes(item["key"]): list(item["data"]) for item in module.GPMFSampleData.parse(body)
            }
        except construct.ConstructError as error:
            raise ValueError("a damaged GPMF stream") from error

    return parse


def _items(data: bytes) -> Iterator[tuple[bytes, bytes, int, int, bytes]]:
    """Yield (key, type, size, count, whole item) of the items of one level; end at padding."""
    position = items = 0
    while position + 8 <= len(data):
        key, kind, size, count = struct.unpack_from(">4scBH", data, position)
        if key == b"\0\0\0\0":
            return
        start, end = position, position + 8 + size * count
        items += 1
        if end > len(data) or items > _MAX_ITEMS:
            raise ValueError("an item is longer than its payload, or there are too many")
        position = position + 8 + -(-size * count // 4) * 4
        yield key, kind, size, count, data[start:position]


def _position_streams(payload: bytes) -> Iterator[bytes]:
    """Yield the items with which positions are stated, stream by stream, within bounds."""
    for device, _, _, _, inside in _items(payload):
        if device != b"DEVC":
            continue
        for key, _, _, _, body in _items(inside[8:]):
            if key == b"STRM":
                kept = _needed_items(body[8:])
                if kept:
                    yield kept


def _needed_items(body: bytes) -> bytes:
    """Return the items of a stream that are used, whose counts are bounded by their bytes; else nothing."""
    kept = []
    records = rows = 0
    for key, kind, size, count, item in _items(body):
        if key not in _USED and (key not in _HEADERS or len(item) > 8 + _MAX_HEADER_BYTES):
            continue
        if kind == b"\0" or (size == 0 and count):
            return b""  # nested, or values without bytes, of which a header can claim any number
        records += key in _USED
        rows += count if key in _USED else 0
        kept.append(item)
    if rows > _MAX_ROWS:
        raise ValueError("more records than a second has")
    return b"".join(kept) if records else b""


def _add(found: _Found, values: _Values, packet: DataPacket) -> None:
    """Add the records of one stream of one payload."""
    if values.get(b"GPS9"):
        _add_gps9(found, values, packet)
    elif values.get(b"GPS5"):
        _add_gps5(found, values, packet)
    elif values.get(b"GPRI"):
        _add_karma(found, values, packet)
    elif values.get(b"GLPI"):
        rows = _rows(values, b"GLPI", 9)
        found.heights += [(row[0], row[3], row[4]) for row in rows]
    elif values.get(b"SYST"):
        found.clock += [(row[0], row[1]) for row in _rows(values, b"SYST", 2)]


def _scales(values: _Values, count: int) -> list[float]:
    """Return the divisor of each value of a record."""
    scales = [float(row[0]) for row in values[b"SCAL"]]
    scales = scales * count if len(scales) == 1 else scales
    if len(scales) != count or not all(scales):
        raise ValueError("not one scale for each value")
    return scales


def _rows(values: _Values, key: bytes, count: int) -> list[list[float]]:
    """Return the scaled records of a stream whose values have several types (TYPE)."""
    types = b"".join(values[b"TYPE"]).decode("ascii").rstrip("\0")
    form = struct.Struct(">" + "".join(_STRUCT[letter] for letter in types))
    if len(types) != count:
        raise ValueError("another number of values than this stream has")
    scales = _scales(values, count)
    return [
        [value / scale for value, scale in zip(form.unpack(row), scales, strict=True)]
        for row in values[key]
    ]


def _times(packet: DataPacket, count: int) -> list[float]:
    """Return the times of records, which a payload spreads evenly over its duration."""
    return [packet.time_s + packet.duration_s * i / count for i in range(count)]


def _fix(
    found: _Found, time_s: float, place: Sequence[float], lock: float, sigma: Sigma, utc_s: float
) -> _Fix:
    """Return one record; without a lock it has no position, with a two-dimensional one no height."""
    lat, lon, alt = place
    on_earth = abs(lat) <= 90 and abs(lon) <= 180 and (lat, lon) != (0, 0)
    if lock < 2 or not on_earth:
        found.no_fix += 1
        return _Fix(time_s, math.nan, math.nan, math.nan, NAN_SIGMA, utc_s)
    return _Fix(time_s, lat, lon, math.nan if lock == 2 else alt, sigma, utc_s)


def _add_gps9(found: _Found, values: _Values, packet: DataPacket) -> None:
    rows = _rows(values, b"GPS9", 9)
    found.references.setdefault(b"GPS9", set()).add(_reference(values))
    fixes = found.fixes.setdefault(b"GPS9", [])
    for time_s, row in zip(_times(packet, len(rows)), rows, strict=True):
        utc_s = _2000_S + 86400 * row[5] + row[6]
        fixes.append(_fix(found, time_s, row[:3], row[8], sigma_from_dop(pdop=row[7]), utc_s))


def _add_gps5(found: _Found, values: _Values, packet: DataPacket) -> None:
    scales = _scales(values, 5)
    rows = [[v / s for v, s in zip(row, scales, strict=True)] for row in values[b"GPS5"]]
    lock = float(values[b"GPSF"][0][0]) if values.get(b"GPSF") else 3.0
    dop = float(values[b"GPSP"][0][0]) / 100 if values.get(b"GPSP") else math.nan
    start_utc_s = _utc_s(values[b"GPSU"][0]) if values.get(b"GPSU") else math.nan
    found.references.setdefault(b"GPS5", set()).add(_reference(values))
    fixes = found.fixes.setdefault(b"GPS5", [])
    for time_s, row in zip(_times(packet, len(rows)), rows, strict=True):
        utc_s = start_utc_s + time_s - packet.time_s
        fixes.append(_fix(found, time_s, row[:3], lock, sigma_from_dop(pdop=dop), utc_s))


def _add_karma(found: _Found, values: _Values, packet: DataPacket) -> None:
    """Add the drone's raw fixes; their times are stamps since power-on, moved to the video's clock later."""
    rows = _rows(values, b"GPRI", 10)
    fixes = found.fixes.setdefault(b"GPRI", [])
    for number, row in enumerate(rows):
        accurate = all(0 < accuracy_m < _MAX_ACCURACY_M for accuracy_m in row[4:6])
        sigma = (row[4], row[4], row[5]) if accurate else NAN_SIGMA
        fixes.append(_fix(found, row[0], row[1:4], row[8], sigma, math.nan))
        middle_s = packet.time_s + packet.duration_s * (number + 0.5) / len(rows)
        found.stamp_zero_s.append(middle_s - row[0])


def _reference(values: _Values) -> bytes:
    """Return the height reference GPSA, empty if not stated."""
    stated = values.get(b"GPSA")
    return b"".join(np.ravel(stated).tolist()) if stated else b""


def _utc_s(value: Any) -> float:
    """Parse GPSU, such as 240501120000.123; NaN if it is no time."""
    text = bytes(value[0] if isinstance(value, list) else value).decode("ascii", errors="replace")
    try:
        return (
            datetime.strptime(text.strip("\0 "), "%y%m%d%H%M%S.%f").replace(tzinfo=UTC).timestamp()
        )
    except ValueError:
        return math.nan


def _telemetry(found: _Found, kinds: list[bytes], source: str) -> Telemetry:
    """Make the track of the best kind of stream."""
    kind = kinds[0]
    fixes = found.fixes[kind]
    time_s = np.array([fix.time_s for fix in fixes])
    rel_alt_m = np.full(len(fixes), np.nan)
    utc_s = np.array([fix.utc_s for fix in fixes])
    notes = [f"read from its GoPro track ({kind.decode()})"]
    if kind == b"GPRI":
        rel_alt_m, utc_s, more = _karma_columns(found, time_s)
        time_s = time_s + float(np.median(found.stamp_zero_s))
        reference = HeightReference.AMSL
        notes += more
    else:
        reference, more = _height_reference(kind, found.references[kind])
        notes += [*more, _LAG_NOTE]
    if not np.isfinite(time_s).all():
        raise InputError("its GoPro track has payloads without a time", path=source)
    if len(kinds) > 1:
        notes.append(f"not used: {', '.join(other.decode() for other in kinds[1:])}")
    if found.no_fix:
        notes.append(f"records without a fix in its GoPro track: {found.no_fix}")
    if found.damaged:
        notes.append(f"damaged payloads left out of its GoPro track: {found.damaged}")
    index, more = time_order(time_s)
    return Telemetry.from_columns(
        time_s,
        lat_lon_deg=np.array([(fix.lat_deg, fix.lon_deg) for fix in fixes]),
        rel_alt_m=rel_alt_m,
        abs_alt_m=np.array([fix.alt_m for fix in fixes]),
        sigma_m=np.array([fix.sigma_m for fix in fixes]),
        utc_s=utc_s,
        abs_reference=reference,
        kind="gopro",
        source=source,
        notes=(*notes, *more),
    ).select(index)


def _height_reference(kind: bytes, stated: set[bytes]) -> tuple[HeightReference, list[str]]:
    """Return what heights are measured from.

    GPSA states it. Cameras that did not write it yet recorded heights above the ellipsoid
    (github.com/gopro/gpmf-parser, issues 4 and 81).
    """
    if stated == {b"MSLV"}:
        return HeightReference.AMSL, []
    if stated == {b""} and kind == b"GPS5":
        return HeightReference.ELLIPSOID, []
    names = ", ".join(
        sorted(value.decode("ascii", errors="replace") or "none" for value in stated)[:4]
    )
    return HeightReference.UNKNOWN, [
        f"the height reference of its GoPro track is unknown (GPSA: {names})"
    ]


def _karma_columns(found: _Found, stamps_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return heights above take-off, UTC, and notes, at the stamps of the raw fixes of a Karma."""
    notes = [
        "positions, accuracy and heights above sea level are those of the Karma drone, whose streams have "
        "the layout of MAVLink's GPS_RAW_INT"
    ]
    rel_alt_m = np.full(len(stamps_s), np.nan)
    if len(found.heights) > 1:
        stamp_s, absolute_m, relative_m = np.array(sorted(found.heights)).T
        # The fifth value is not documented: it is taken for the height above take-off only where it moves
        # as the height above sea level does.
        if np.std(absolute_m - relative_m) < _SAME_HOME_M:
            rel_alt_m = np.interp(stamps_s, stamp_s, relative_m, left=np.nan, right=np.nan)
            notes.append("heights above take-off are those of the drone's own filter (GLPI)")
    utc_s = np.full(len(stamps_s), np.nan)
    if found.clock:
        utc_s = stamps_s + float(np.median([utc - stamp for stamp, utc in found.clock]))
    return rel_alt_m, utc_s, notes
