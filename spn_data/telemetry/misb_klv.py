"""MISB ST 0601 metadata (KLV) in videos of larger drones: position, attitude and field of view."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator, Sequence

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.geometry.rotations import angles_from_rotations
from spn_data.telemetry.data_tracks import MAX_RECORDS, DataPacket
from spn_data.telemetry.track import Telemetry, time_order

UNIVERSAL_KEY = bytes.fromhex("060e2b34020b01010e01030101000000")
KIND = "misb-klv"
_MAX_SET_BYTES = 65_536
_MAX_ITEMS = 512
_LARGEST_FOV_DEG = 170.0

_CHECKSUM, _TIME = 1, 2
# Tag: (bytes, signed, range). A signed value of the most negative number means "out of range".
_LINEAR: dict[int, tuple[int, bool, float, float]] = {
    5: (2, False, 0.0, 360.0),  # platform heading
    6: (2, True, -20.0, 20.0),  # platform pitch
    7: (2, True, -50.0, 50.0),  # platform roll
    13: (4, True, -90.0, 90.0),  # sensor latitude
    14: (4, True, -180.0, 180.0),  # sensor longitude
    15: (2, False, -900.0, 19000.0),  # sensor altitude above mean sea level
    16: (2, False, 0.0, 180.0),  # sensor horizontal field of view
    17: (2, False, 0.0, 180.0),  # sensor vertical field of view
    18: (4, False, 0.0, 360.0),  # sensor azimuth relative to the platform
    19: (4, True, -180.0, 180.0),  # sensor elevation
    20: (4, False, 0.0, 360.0),  # sensor roll
    75: (2, False, -900.0, 19000.0),  # sensor height above the ellipsoid
    90: (4, True, -90.0, 90.0),  # platform pitch, full range
    91: (4, True, -90.0, 90.0),  # platform roll, full range
}
_HEIGHT_EXTENDED = 104  # IMAPB (MISB ST 1201) from -900 to 40000 m above the ellipsoid
_COLUMNS = (*_LINEAR, _HEIGHT_EXTENDED)


class _DamagedSetError(ValueError):
    """A local set that does not agree with its lengths or its checksum."""


def read_misb(packets: Sequence[DataPacket], source: str) -> Telemetry:
    """Read sensor positions, angles and fields of view of a KLV track.

    Parameters
    ----------
    packets : sequence of DataPacket
        Packets of the track.
    source : str
        Name of the file.

    Returns
    -------
    Telemetry
        `gimbal_deg` composes platform and sensor angles; `zoom` is the focal length over the image width
        that the horizontal field of view gives. Heights are above the ellipsoid if all positions state
        them, otherwise above sea level.

    Raises
    ------
    InputError
        If no set has a right checksum and a position.
    """
    rows = array("d")
    stamps_s, times_s, near_s = array("d"), array("d"), array("d")
    damaged = 0
    for packet in packets:
        try:
            for items in _sets(packet.payload):
                if len(stamps_s) >= MAX_RECORDS:
                    raise InputError(
                        f"its KLV track has more than {MAX_RECORDS:,} records", path=source
                    )
                rows.extend(_value(tag, items) for tag in _COLUMNS)
                stamps_s.append(_stamp_s(items))
                times_s.append(packet.time_s)
                near_s.append(packet.near_s)
        except _DamagedSetError:
            damaged += 1
    values = dict(zip(_COLUMNS, np.array(rows).reshape(-1, len(_COLUMNS)).T, strict=True))
    lat_lon_deg = np.column_stack([values[13], values[14]])
    lat_lon_deg[(lat_lon_deg == 0).all(axis=1) | np.isnan(lat_lon_deg).any(axis=1)] = np.nan
    if not np.isfinite(lat_lon_deg).any():
        wrong = (
            f"; {damaged} of its {len(packets)} packets have a wrong checksum or length"
            if damaged
            else ""
        )
        raise InputError(
            f"its KLV track holds no sensor position (MISB ST 0601){wrong}", path=source
        )
    utc_s = np.array(stamps_s)
    time_s, notes = _times(np.array(times_s), utc_s, np.array(near_s), source)
    alt_m, reference = _heights(values, np.isfinite(lat_lon_deg.sum(axis=1)))
    if damaged:
        notes.append(f"KLV packets with a wrong checksum or length left out: {damaged}")
    index, more = time_order(time_s)
    return Telemetry.from_columns(
        time_s,
        lat_lon_deg=lat_lon_deg,
        abs_alt_m=alt_m,
        gimbal_deg=_camera_angles(values),
        utc_s=utc_s,
        zoom=_focal_shares(values[16]),
        abs_reference=reference,
        kind=KIND,
        source=source,
        notes=("read from its KLV track (MISB ST 0601)", *notes, *more),
    ).select(index)


def _sets(payload: bytes) -> Iterator[dict[int, bytes]]:
    """Yield the items of each local set of a packet, which may start with a header of a few bytes."""
    position = payload.find(UNIVERSAL_KEY)
    while position >= 0:
        length, start = _length(payload, position + len(UNIVERSAL_KEY))
        end = start + length
        if length > _MAX_SET_BYTES or end > len(payload):
            raise _DamagedSetError("a set is longer than its packet")
        yield _items(payload, position, start, end)
        position = payload.find(UNIVERSAL_KEY, end)


def _items(payload: bytes, first: int, start: int, end: int) -> dict[int, bytes]:
    """Return the items of one set, whose checksum comes last and covers all before its value."""
    items: dict[int, bytes] = {}
    position = start
    while position < end:
        tag, position = _tag(payload, position, end)
        length, position = _length(payload, position)
        if position + length > end or len(items) >= _MAX_ITEMS:
            raise _DamagedSetError("an item is longer than its set")
        value = payload[position : position + length]
        if tag == _CHECKSUM:
            if length != 2 or int.from_bytes(value, "big") != _checksum(payload[first:position]):
                raise _DamagedSetError("wrong checksum")
            items[tag] = value
            return items
        items[tag] = value
        position += length
    raise _DamagedSetError("no checksum")


def _checksum(data: bytes) -> int:
    """Return the sum of big-endian 16-bit words, modulo 65536."""
    return (256 * sum(data[0::2]) + sum(data[1::2])) & 0xFFFF


def _tag(data: bytes, position: int, end: int) -> tuple[int, int]:
    """Read a BER-OID tag of at most three bytes; return it and the position after it."""
    tag = 0
    for at in range(position, min(position + 3, end)):
        tag = tag << 7 | data[at] & 0x7F
        if data[at] < 0x80:
            return tag, at + 1
    raise _DamagedSetError("a tag without an end")


def _length(data: bytes, position: int) -> tuple[int, int]:
    """Read a BER length of at most four bytes after the first; return it and the position after it."""
    if position >= len(data):
        raise _DamagedSetError("no length")
    first = data[position]
    if first < 0x80:
        return first, position + 1
    count = first & 0x7F
    if not 1 <= count <= 4 or position + 1 + count > len(data):
        raise _DamagedSetError("a length that is not allowed")
    return int.from_bytes(data[position + 1 : position + 1 + count], "big"), position + 1 + count


def _value(tag: int, items: dict[int, bytes]) -> float:
    """Return the value of an item in its unit; NaN if it is not there or marked as unknown."""
    raw = items.get(tag)
    if raw is None:
        return math.nan
    if tag == _HEIGHT_EXTENDED:
        return _imapb(raw, -900.0, 40000.0)
    size, signed, low, high = _LINEAR[tag]
    if len(raw) != size:
        return math.nan
    number = int.from_bytes(raw, "big", signed=signed)
    if not signed:
        return low + number * (high - low) / (256**size - 1)
    if number == -(256**size) // 2:
        return math.nan
    return number * (high - low) / (256**size - 2)


def _imapb(raw: bytes, low: float, high: float) -> float:
    """Decode a floating-point value mapped to an integer (MISB ST 1201)."""
    if not 1 <= len(raw) <= 8 or raw[0] & 0x80:  # the first bit marks special values such as NaN
        return math.nan
    step = 2.0 ** (math.ceil(math.log2(high - low)) - (8 * len(raw) - 1))
    zero = 0.0
    if low < 0 < high:
        zero = low / step - math.floor(low / step)
    value = step * (int.from_bytes(raw, "big") - zero) + low
    return value if low - step <= value <= high + step else math.nan


def _stamp_s(items: dict[int, bytes]) -> float:
    raw = items.get(_TIME, b"")
    return int.from_bytes(raw, "big") / 1e6 if len(raw) == 8 else math.nan


def _times(
    time_s: np.ndarray, utc_s: np.ndarray, near_s: np.ndarray, source: str
) -> tuple[np.ndarray, list[str]]:
    """Return video times: those of the packets, else their UTC stamps placed beside the pictures."""
    if np.isfinite(time_s).all():
        return time_s, []
    zero_s = near_s - utc_s
    if not np.isfinite(zero_s).any() or not np.isfinite(utc_s).all():
        raise InputError(
            "its KLV track has neither presentation times nor UTC stamps beside pictures, so its records "
            "cannot be placed in the video",
            path=source,
        )
    note = (
        "its KLV track has no presentation times: records are placed by their position in the file, to about "
        "a second"
    )
    return utc_s + float(np.nanmedian(zero_s)), [note]


def _heights(
    values: dict[int, np.ndarray], fixed: np.ndarray
) -> tuple[np.ndarray, HeightReference]:
    """Return heights above the ellipsoid if all fixes state them, otherwise above sea level."""
    ellipsoid_m = np.where(
        np.isfinite(values[_HEIGHT_EXTENDED]), values[_HEIGHT_EXTENDED], values[75]
    )
    if np.isfinite(ellipsoid_m[fixed]).all() or not np.isfinite(values[15]).any():
        return ellipsoid_m, HeightReference.ELLIPSOID
    return values[15], HeightReference.AMSL


def _camera_angles(values: dict[int, np.ndarray]) -> np.ndarray:
    """Return heading, pitch, roll of the camera: the sensor's angles on those of the platform.

    Both turn about the axes forward, right, down in the order heading, pitch, roll. Without the sensor's
    roll, which does not move the optical axis, only roll is unknown.
    """
    pitch = np.where(np.isfinite(values[90]), values[90], values[6])
    roll = np.where(np.isfinite(values[91]), values[91], values[7])
    platform = _turns(values[5], pitch, roll)
    sensor = _turns(values[18], values[19], np.nan_to_num(values[20]))
    # Rows of the result: forward, right, down of the sensor in north, east, down.
    axes = np.swapaxes(platform @ sensor, 1, 2)
    enu = np.stack([axes[..., 1], axes[..., 0], -axes[..., 2]], axis=-1)
    angles = angles_from_rotations(np.stack([enu[:, 1], enu[:, 2], enu[:, 0]], axis=1))
    angles[np.isnan(values[20]), 2] = np.nan
    return angles


def _turns(heading_deg: np.ndarray, pitch_deg: np.ndarray, roll_deg: np.ndarray) -> np.ndarray:
    """Return rotations (N, 3, 3) from a body (forward, right, down) to its reference."""
    (sh, ch), (sp, cp), (sr, cr) = (
        (np.sin(np.deg2rad(a)), np.cos(np.deg2rad(a))) for a in (heading_deg, pitch_deg, roll_deg)
    )
    return np.stack(
        [
            np.stack([ch * cp, ch * sp * sr - sh * cr, ch * sp * cr + sh * sr], axis=-1),
            np.stack([sh * cp, sh * sp * sr + ch * cr, sh * sp * cr - ch * sr], axis=-1),
            np.stack([-sp, cp * sr, cp * cr], axis=-1),
        ],
        axis=-2,
    )


def _focal_shares(fov_deg: np.ndarray) -> np.ndarray:
    """Return focal lengths over the image width; NaN for a field of view that no lens without fisheye has."""
    usable = (fov_deg > 0) & (fov_deg < _LARGEST_FOV_DEG)
    return 0.5 / np.tan(np.deg2rad(np.where(usable, fov_deg, np.nan)) / 2)
