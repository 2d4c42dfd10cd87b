"""Telemetry logs of ground stations (.tlog): MAVLink with times of reception, decoded by pymavlink."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from spn_data.errors import InputError
from spn_data.telemetry.accuracy import FIX_2D, FIX_3D, sigma_from_fix
from spn_data.telemetry.autopilot import pymavlink
from spn_data.telemetry.flight_log import (
    LoggedFixes,
    Series,
    absolute_heights,
    check_count,
    check_size,
    gimbal_angles,
    log_track,
)
from spn_data.telemetry.track import Telemetry

_HEARTBEAT, _SYSTEM_TIME, _GPS_RAW, _ATTITUDE, _GLOBAL, _GPS2_RAW = 0, 2, 24, 30, 33, 124
_MOUNT_ORIENTATION, _GIMBAL_DEVICE, _MOUNT_STATUS = 265, 285, 158
_IDS = {
    *(_HEARTBEAT, _SYSTEM_TIME, _GPS_RAW, _ATTITUDE, _GLOBAL),
    *(_MOUNT_ORIENTATION, _GIMBAL_DEVICE, _MOUNT_STATUS),
}
_THINNED = {_HEARTBEAT, _ATTITUDE, _MOUNT_ORIENTATION, _GIMBAL_DEVICE, _MOUNT_STATUS}
_THIN_US = 90_000  # interval of messages other than positions
# A time of the years 2000 to 2100 in microseconds since 1970, and the first byte of a MAVLink message.
_START = re.compile(rb"\x00[\x03-\x0e].{6}[\xfd\xfe]", re.DOTALL)
_BLOCK_BYTES = 4_000_000
_MAX_MESSAGES = 2_000_000  # of all vehicles, some hours
_REBOOT_S = 5.0  # by which the time since boot steps back if the autopilot was restarted
_NO_AUTOPILOT = 8  # in heartbeats of ground stations, cameras and gimbals
_NAN = float("nan")
_US, _MS = 1e-6, 1e-3


@np.errstate(invalid="ignore", over="ignore")  # of numbers in damaged messages
def read_tlog(path: Path) -> Telemetry:
    """Read the positions of a telemetry log; raise InputError if it has none or pymavlink is missing.

    Positions and accuracies are those of the GNSS receiver of the one vehicle in it, heights above take-off
    those of its autopilot above its home. Times are the vehicle's, so that the delay of the radio does not
    count; damaged messages are skipped.
    """
    check_size(path)
    dialect = pymavlink("dialects.v20.ardupilotmega", "MAVLink telemetry logs", path)
    log = _Log(dialect.MAVLink(None))
    try:
        with path.open("rb") as file:
            for received_us, message in _packets(file, log):
                log.add(received_us, message, path)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=path) from error
    vehicle, notes = _vehicle(log, path)
    if log.damaged:
        notes.insert(0, f"it is damaged: {log.damaged} parts or messages are skipped")
    return _track(path, vehicle, notes)


class _Vehicle:
    """Messages of one system; times are on the clock of reception, without the delay of each message."""

    def __init__(self) -> None:
        self.is_autopilot = self.has_boot_times = False
        self.stale = 0
        self.boot = _Boot()
        self.boots = [self.boot]
        self.fixes: list[tuple[_Boot, float, tuple[float, ...]]] = []
        self.rows: dict[int, list[tuple[_Boot, float, tuple[float, ...]]]] = {}

    def seen(self, boot_s: float, received_s: float) -> _Boot:
        """Return the run of the autopilot that a time since boot belongs to."""
        if boot_s < self.boot.last_s - _REBOOT_S:
            self.boot = _Boot()
            self.boots.append(self.boot)
        self.boot.last_s = max(self.boot.last_s, boot_s)
        self.boot.delay_s = min(self.boot.delay_s, received_s - boot_s)
        return self.boot

    def times(self, rows: list[tuple[_Boot, float, tuple[float, ...]]]) -> np.ndarray:
        """Return times (N,) of rows, in seconds since 1970 as the autopilot or ground station states it."""
        return np.array([boot.zero_s + time_s for boot, time_s, _ in rows], dtype=np.float64)


class _Boot:
    """One run of an autopilot: its time since boot, and what that is in UTC."""

    def __init__(self) -> None:
        self.last_s = -np.inf
        self.delay_s = np.inf  # smallest difference of reception and time since boot
        self.stated_s: list[float] = []  # UTC minus time since boot, as the autopilot states it

    @property
    def zero_s(self) -> float:
        """Second 0 of the time since boot, in seconds since 1970."""
        return float(np.median(self.stated_s)) if self.stated_s else float(self.delay_s)


_UNIX = _Boot()
_UNIX.stated_s.append(0.0)


class _Log:
    """What was decoded so far, by system."""

    def __init__(self, mavlink: Any):
        self._mavlink = mavlink
        self._last_us: Counter[tuple[int, int, int]] = Counter()
        self.damaged = self.kept = 0
        self.vehicles: dict[int, _Vehicle] = {}

    def wants(self, received_us: int, system: int, component: int, number: int) -> bool:
        """Return whether a message is needed; those other than positions at most at 11 Hz."""
        if number not in _IDS:
            return False
        key = (system, component, number)
        if number in _THINNED and 0 <= received_us - self._last_us[key] < _THIN_US:
            return False
        self._last_us[key] = received_us
        return True

    def decode(self, packet: bytes) -> Any:
        """Return a message, or None if its checksum is wrong."""
        try:
            return self._mavlink.decode(bytearray(packet))
        except Exception:  # pymavlink raises MAVError, and what damaged fields cause
            self.damaged += 1
            return None

    def add(self, received_us: int, message: Any, path: Path) -> None:
        """Keep the values of a message."""
        self.kept += 1
        if self.kept > _MAX_MESSAGES:
            raise InputError(
                f"contains more than {_MAX_MESSAGES:,} messages of positions and attitudes",
                path=path,
            )
        vehicle = self.vehicles.setdefault(message.get_srcSystem(), _Vehicle())
        number, received_s = message.get_msgId(), received_us * _US
        if number == _HEARTBEAT:
            vehicle.is_autopilot |= message.autopilot != _NO_AUTOPILOT
        elif number == _SYSTEM_TIME:
            boot_s, utc_s = message.time_boot_ms * _MS, message.time_unix_usec * _US
            if 946_684_800 <= utc_s <= 4_102_444_800:
                vehicle.seen(boot_s, received_s).stated_s.append(utc_s - boot_s)
        elif number == _GPS_RAW:
            time_s = message.time_usec * _US
            if time_s >= 1e9:  # seconds since 1970
                boot = _UNIX
            elif vehicle.has_boot_times:
                boot = vehicle.boot
                # Without a lock the time of the last fix is repeated; after a restart, others come later.
                if time_s < boot.last_s - _REBOOT_S:
                    vehicle.stale += 1
                    return
            else:
                boot = vehicle.seen(time_s, received_s)
            vehicle.fixes.append(
                (boot, time_s, (message.get_srcComponent(), *_gps_values(message)))
            )
            check_count(len(vehicle.fixes), path)
        else:
            values = _values(number, message)
            if hasattr(message, "time_boot_ms"):
                vehicle.has_boot_times = True
                boot_s = message.time_boot_ms * _MS
                row = (vehicle.seen(boot_s, received_s), boot_s, values)
            else:  # received soon after it was sent
                row = (vehicle.boot, received_s - vehicle.boot.delay_s, values)
            if np.isfinite(row[1]):
                vehicle.rows.setdefault(number, []).append(row)


def _packets(file: BinaryIO, log: _Log) -> Iterator[tuple[int, Any]]:
    """Yield the time of reception in microseconds since 1970 and each message needed, past damage."""
    data, at = b"", 0
    while True:
        block = file.read(_BLOCK_BYTES)
        data, at, end = data[at:] + block, 0, len(data) - at + len(block)
        while at + 24 <= end or (not block and at + 16 <= end):
            magic = data[at + 8]
            if data[at] or not 3 <= data[at + 1] <= 14 or magic not in (0xFD, 0xFE):
                log.damaged += 1
                found = _START.search(data, at + 1)
                at = found.start() if found else max(at + 1, end - 8)
                continue
            head = at + 8
            if magic == 0xFD:
                if head + 10 > end:
                    break
                size = 12 + data[head + 1] + (13 if data[head + 2] & 1 else 0)
                system, component = data[head + 5], data[head + 6]
                number = data[head + 7] | data[head + 8] << 8 | data[head + 9] << 16
            else:
                size = 8 + data[head + 1]
                system, component, number = data[head + 3], data[head + 4], data[head + 5]
            if head + size > end:
                if block:
                    break
                log.damaged += 1
                return
            received_us = int.from_bytes(data[at : at + 8], "big")
            if log.wants(received_us, system, component, number):
                message = log.decode(data[head : head + size])
                if message is None:
                    at += 1  # its length may be damaged, too
                    continue
                yield received_us, message
            at = head + size
        if not block:
            return


def _gps_values(m: Any) -> tuple[float, ...]:
    """Return fix type, latitude, longitude, heights above sea level and ellipsoid, accuracies, dilutions."""
    stated = [value / 1e3 if 0 < value < 2**32 - 1 else _NAN for value in (m.h_acc, m.v_acc)]
    dops = [value / 100 if 0 < value < 65535 else _NAN for value in (m.eph, m.epv)]
    ellipsoid_m = m.alt_ellipsoid / 1e3 if m.alt_ellipsoid else _NAN
    return (m.fix_type, m.lat / 1e7, m.lon / 1e7, m.alt / 1e3, ellipsoid_m, *stated, *dops)


def _values(number: int, m: Any) -> tuple[float, ...]:
    """Return the values of a message other than fixes."""
    if number == _GLOBAL:
        return (m.relative_alt / 1e3, m.lat / 1e7, m.lon / 1e7, m.alt / 1e3)
    if number == _ATTITUDE:
        return tuple(np.degrees([m.yaw, m.pitch, m.roll]).tolist())
    if number == _MOUNT_ORIENTATION:
        return (m.yaw_absolute, m.pitch, m.roll, m.yaw)
    if number == _GIMBAL_DEVICE:
        return (*m.q, m.flags)
    return (m.pointing_c / 100, m.pointing_a / 100, m.pointing_b / 100)


def _vehicle(log: _Log, path: Path) -> tuple[_Vehicle, list[str]]:
    """Return the one vehicle with positions; raise InputError if there is none or several autopilots have."""
    found = {
        number: one
        for number, one in sorted(log.vehicles.items())
        if one.fixes or _GLOBAL in one.rows
    }
    if not found:
        raise InputError(
            "contains no positions: it has no GPS_RAW_INT or GLOBAL_POSITION_INT that can be read",
            path=path,
        )
    autopilots = {number: one for number, one in found.items() if one.is_autopilot} or found
    if len(autopilots) > 1:
        raise InputError(
            f"contains {len(autopilots)} vehicles (systems {', '.join(map(str, autopilots))}): which one has "
            "the camera is not known; export its messages alone",
            path=path,
        )
    ((number, vehicle),) = autopilots.items()
    others = [str(one) for one in found if one != number]
    notes = []
    if others:
        notes.append(
            f"system {number} is used, the autopilot; positions of systems {', '.join(others)} are not"
        )
    return vehicle, notes


def _track(path: Path, vehicle: _Vehicle, notes: list[str]) -> Telemetry:
    boots = [boot for boot in vehicle.boots if np.isfinite(boot.last_s)]
    if len(boots) > 1:
        notes.append(
            f"the autopilot was started {len(boots)} times: their times are joined by the date"
        )
    if any(not boot.stated_s for boot in boots):
        notes.append(
            "its dates are those of the ground station's computer, as the autopilot states none"
        )
    if vehicle.stale:
        notes.append(
            f"position records left out because their time is {_REBOOT_S:.0f} s or more behind: "
            f"{vehicle.stale}"
        )
    fixes, fix_notes = _fixes(vehicle)
    heights = vehicle.rows.get(_GLOBAL, [])
    rel_alt = None
    if heights:
        rel_alt = Series(vehicle.times(heights), np.array([values[0] for *_, values in heights]))
    gimbal, gimbal_notes = _gimbal(vehicle)
    return log_track(
        path,
        "mavlink-tlog",
        fixes,
        rel_alt=rel_alt,
        gimbal=gimbal,
        notes=(*notes, *fix_notes, *gimbal_notes),
    )


def _fixes(vehicle: _Vehicle) -> tuple[LoggedFixes, list[str]]:
    """Return the fixes of the receiver, or the autopilot's estimates if there are none."""
    notes: list[str] = []
    rows = vehicle.fixes
    if not rows:
        rows = [
            (boot, time_s, (1.0, float(FIX_3D), lat, lon, alt, _NAN, _NAN, _NAN, _NAN, _NAN))
            for boot, time_s, (_, lat, lon, alt) in vehicle.rows[_GLOBAL]
        ]
        notes.append(
            "its positions are the autopilot's estimates (GLOBAL_POSITION_INT): it has no GPS_RAW_INT"
        )
    # The autopilot is component 1; another one may forward or repeat its positions.
    components = Counter(int(values[0]) for *_, values in rows)
    chosen = 1 if 1 in components else components.most_common(1)[0][0]
    rows = [row for row in rows if row[2][0] == chosen]
    if len(components) > 1:
        notes.append(f"of the components with positions, number {chosen} is used")
    time_s = vehicle.times(rows)
    table = np.array([values for *_, values in rows], dtype=np.float64)
    kind = table[:, 1].astype(np.int64)
    lat_lon = table[:, 2:4]
    lat_lon[kind < FIX_2D] = np.nan
    heights = np.where((kind >= FIX_3D)[:, None], table[:, 4:6], np.nan)
    height_m, reference, height_notes = absolute_heights(heights[:, 0], heights[:, 1])
    sigma_m = [
        sigma_from_fix(k, horizontal_m=h, vertical_m=v, hdop=hd, vdop=vd)
        for k, (h, v, hd, vd) in zip(kind.tolist(), table[:, 6:10].tolist(), strict=True)
    ]
    return LoggedFixes(time_s, time_s, lat_lon, height_m, np.array(sigma_m), reference), [
        *notes,
        *height_notes,
    ]


def _gimbal(vehicle: _Vehicle) -> tuple[Series | None, list[str]]:
    """Return camera angles from the most explicit of the messages that state them."""

    def series(number: int) -> Series | None:
        rows = vehicle.rows.get(number, [])
        if not rows:
            return None
        return Series(
            vehicle.times(rows), np.array([values for *_, values in rows], dtype=np.float64)
        )

    attitude = series(_ATTITUDE)
    device, orientation, status = (
        series(number) for number in (_GIMBAL_DEVICE, _MOUNT_ORIENTATION, _MOUNT_STATUS)
    )
    if device is not None:
        return gimbal_angles(device.time_s, device.values[:, :4], device.values[:, 4], attitude)
    given = orientation if orientation is not None else status
    if given is None:
        return None, []
    angles = given.values[:, :3].copy()
    relative = given.values[:, 0 if orientation is None else 3]
    if orientation is None:
        angles[:, 0] = np.nan
    heading = np.full(len(angles), np.nan)
    if attitude is not None:
        heading = attitude.near(given.time_s)[:, 0] + relative
    angles[:, 0] = np.where(np.isfinite(angles[:, 0]), angles[:, 0], heading) % 360.0
    return Series(given.time_s, angles), []
