"""PX4's flight logs (.ulg), read by pyulog."""

from __future__ import annotations

import io
import struct
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.errors import InputError
from spn_data.media.extras import import_extra
from spn_data.telemetry.accuracy import FIX_2D, FIX_3D, sigma_from_fix
from spn_data.telemetry.flight_log import (
    LoggedFixes,
    Series,
    absolute_heights,
    camera_angles,
    check_count,
    check_size,
    gimbal_angles,
    log_track,
    quiet,
)
from spn_data.telemetry.track import Telemetry
from spn_data.telemetry.ulog_messages import MAX_MESSAGE_BYTES, needed_messages

_POSITIONS = ("vehicle_gps_position", "sensor_gps")
_HEIGHT, _HOME = "vehicle_global_position", "home_position"
_ATTITUDE, _GIMBAL = "vehicle_attitude", "gimbal_device_attitude_status"
_WANTED = (*_POSITIONS, _HEIGHT, _HOME, _ATTITUDE, _GIMBAL)
_MAX_FIELDS = 20_000  # of the wanted messages together; PX4's have at most some hundreds
_MAX_FORMAT_FIELDS = 200_000
_US = 1e-6

_Data = dict[str, np.ndarray]


@np.errstate(invalid="ignore", over="ignore")  # of numbers in damaged messages
def read_ulog(path: Path) -> Telemetry:
    """Read the positions of a ULog; raise InputError if it has none or pyulog is missing.

    Positions, accuracies and UTC are those of the receiver; heights above take-off are PX4's estimate above
    its home, and camera angles those that a gimbal reports. Records before damage are used.
    """
    check_size(path)
    core = import_extra("pyulog.core", "px4", "PX4's ULog", path)
    try:
        needed = needed_messages(path, _WANTED)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=path) from error
    log = _log_class(core)()
    try:
        with quiet():
            log._load_file(io.BytesIO(needed.data), list(_WANTED))
    except (
        *(core.ULogException, ArithmeticError, LookupError, RecursionError),
        *(TypeError, ValueError, struct.error),
    ) as error:
        words = str(error).replace("\n", " ")[:200] or type(error).__name__
        raise InputError(f"is not a ULog that can be read: {words}", path=path) from error
    notes = []
    if needed.skipped_bytes or log.file_corruption:
        notes.append(
            f"it is damaged: {needed.skipped_bytes} bytes are skipped, and records that contradict "
            "their format"
        )
    if needed.is_full:
        notes.append(f"only the first {MAX_MESSAGE_BYTES / 1e6:.0f} MB of its records are used")
    tables = {
        (data.name, data.multi_id): {
            name: np.nan_to_num(column, nan=np.nan, posinf=np.nan, neginf=np.nan)
            for name, column in data.data.items()
        }
        for data in log.data_list
        if "timestamp" in data.data
    }
    table, choice_notes = _positions(tables, path)
    check_count(len(table["timestamp"]), path)
    return _track(path, table, tables, (*notes, *choice_notes))


def _track(
    path: Path, table: _Data, tables: dict[tuple[str, int], _Data], notes: tuple[str, ...]
) -> Telemetry:
    fixes, height_notes = _fixes(table)
    attitude = tables.get((_ATTITUDE, 0))
    body = None if attitude is None else Series(_seconds(attitude), camera_angles(_quats(attitude)))
    gimbal: Series | None = None
    gimbal_notes: list[str] = []
    found = sorted(key for key in tables if key[0] == _GIMBAL and "device_flags" in tables[key])
    if found:
        data = tables[found[0]]
        gimbal, gimbal_notes = gimbal_angles(
            _seconds(data), _quats(data), data["device_flags"], body
        )
    return log_track(
        path,
        "px4-ulog",
        fixes,
        rel_alt=_above_home(tables),
        gimbal=gimbal,
        notes=(*notes, *height_notes, *gimbal_notes),
    )


def _positions(tables: dict[tuple[str, int], _Data], path: Path) -> tuple[_Data, list[str]]:
    """Return the position messages: those PX4 selected, else of the receiver with most fixes."""
    found = {
        key: data
        for key, data in tables.items()
        if key[0] in _POSITIONS and {"timestamp", "fix_type"} <= data.keys()
    }
    if not found:
        raise InputError(
            "contains no positions: it has neither vehicle_gps_position nor sensor_gps", path=path
        )
    selected = [key for key in found if key[0] == _POSITIONS[0]]
    best = max(selected or found, key=lambda key: int((found[key]["fix_type"] >= FIX_2D).sum()))
    notes = []
    receivers = len(found) - len(selected) if not selected else len(selected)
    if receivers > 1:
        notes.append(
            f"of its {receivers} receivers, number {best[1] + 1} is used, which has most fixes"
        )
    return found[best], notes


def _fixes(table: _Data) -> tuple[LoggedFixes, list[str]]:
    """Return the fixes of position messages, with integer fields up to PX4 1.13 and floats after it."""
    nothing = np.full(len(table["timestamp"]), np.nan)

    def column(name: str, old_name: str = "", scale: float = 1.0) -> np.ndarray:
        if name in table:
            return np.asarray(table[name], dtype=np.float64)
        if old_name in table:
            return np.asarray(table[old_name], dtype=np.float64) * scale
        return nothing

    kind = np.nan_to_num(table["fix_type"]).astype(np.int64)
    lat_lon = np.stack(
        [column("latitude_deg", "lat", 1e-7), column("longitude_deg", "lon", 1e-7)], axis=1
    )
    lat_lon[kind < FIX_2D] = np.nan
    amsl_m = column("altitude_msl_m", "alt", 1e-3)
    ellipsoid_m = column("altitude_ellipsoid_m", "alt_ellipsoid", 1e-3)
    # A receiver of which the driver knows no height above the ellipsoid states 0 throughout.
    if not np.nan_to_num(ellipsoid_m).any():
        ellipsoid_m = nothing
    without = kind < FIX_3D
    height_m, reference, notes = absolute_heights(
        np.where(without, np.nan, amsl_m), np.where(without, np.nan, ellipsoid_m)
    )
    stated = zip(
        kind.tolist(), column("eph"), column("epv"), column("hdop"), column("vdop"), strict=True
    )
    sigma_m = [
        sigma_from_fix(k, horizontal_m=h, vertical_m=v, hdop=hd, vdop=vd)
        for k, h, v, hd, vd in stated
    ]
    utc_s = column("time_utc_usec") * _US
    # Before its first lock, a receiver may count from any date.
    return LoggedFixes(
        _seconds(table),
        np.where(kind >= FIX_2D, utc_s, np.nan),
        lat_lon,
        height_m,
        np.array(sigma_m, dtype=np.float64),
        reference,
    ), notes


def _above_home(tables: dict[tuple[str, int], _Data]) -> Series | None:
    """Return PX4's heights above the home that was valid at the time, which it sets at take-off."""
    height, home = tables.get((_HEIGHT, 0)), tables.get((_HOME, 0))
    if height is None or home is None or "alt" not in height or "alt" not in home:
        return None
    time_s, home_s = _seconds(height), _seconds(home)
    valid = np.asarray(home.get("valid_alt", np.ones(len(home_s))), dtype=bool)
    order = np.argsort(home_s[valid], kind="stable")
    home_s, home_m = home_s[valid][order], np.asarray(home["alt"], dtype=np.float64)[valid][order]
    if len(home_s) == 0:
        return None
    at = np.searchsorted(home_s, time_s, side="right") - 1
    above_m = np.asarray(height["alt"], dtype=np.float64) - home_m[np.maximum(at, 0)]
    good = (at >= 0) & np.asarray(height.get("alt_valid", np.ones(len(time_s))), dtype=bool)
    return Series(time_s, np.where(good, above_m, np.nan))


def _seconds(table: _Data) -> np.ndarray:
    return np.asarray(table["timestamp"], dtype=np.float64) * _US


def _quats(table: _Data) -> np.ndarray:
    names = [f"q[{k}]" for k in range(4)]
    if not all(name in table for name in names):
        return np.full((len(table["timestamp"]), 4), np.nan)
    return np.stack([np.asarray(table[name], dtype=np.float64) for name in names], axis=1)


class _Formats(dict[str, Any]):
    """Formats of messages, of which a damaged log cannot have any number."""

    def __init__(self) -> None:
        super().__init__()
        self._left = _MAX_FORMAT_FIELDS

    def __setitem__(self, name: str, value: Any) -> None:
        """Keep the format unless there are too many."""
        self._left -= len(value.fields) + 1
        if self._left < 0:
            raise ValueError("too many formats")
        super().__setitem__(name, value)


def _log_class(core: Any) -> Any:
    """Return pyulog's log with bounds for formats that contain themselves or many others."""

    class Message(core.ULog._MessageAddLogged):  # type: ignore[misc]
        def __init__(self, *arguments: Any, log: Any):
            self.log = log
            super().__init__(*arguments)

        def _parse_nested_type(self, prefix: str, type_name: str, formats: Any) -> None:
            fields = formats[type_name].fields
            self.log.fields_left -= sum(max(size, 1) for _, size, _ in fields) + 1
            if self.log.fields_left < 0:
                raise ValueError("too many fields")
            super()._parse_nested_type(prefix, type_name, formats)

    class Log(core.ULog):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(None)
            self.fields_left = _MAX_FIELDS
            self._MessageAddLogged = partial(Message, log=self)
            self._message_formats = _Formats()

    return Log
