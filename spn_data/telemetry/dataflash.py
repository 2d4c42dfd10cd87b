"""ArduPilot's dataflash logs (.bin), with the formats of their messages as pymavlink reads them."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.telemetry.accuracy import FIX_2D, FIX_3D, sigma_from_fix
from spn_data.telemetry.autopilot import pymavlink
from spn_data.telemetry.flight_log import (
    LoggedFixes,
    Series,
    check_count,
    check_size,
    log_track,
    utc_from_gps,
)
from spn_data.telemetry.track import Telemetry

HEAD = b"\xa3\x95"
_FORMAT_TYPE, _FORMAT_BYTES = 0x80, 89
_WANTED = ("GPS", "GPS2", "GPA", "GPA2", "POS", "ATT", "MNT", "CAM")
_MAX_MESSAGE_BYTES = 256_000_000  # of the wanted messages together
_BLOCK_BYTES = 4_000_000
_US, _MS = 1e-6, 1e-3

_Table = dict[str, np.ndarray]


def is_dataflash(path: Path) -> bool:
    """Return whether a file starts as dataflash logs do; others of the same suffix hold anything."""
    try:
        with path.open("rb") as file:
            return file.read(3) == HEAD + bytes([_FORMAT_TYPE])
    except OSError:
        return False


@np.errstate(invalid="ignore", over="ignore")  # of numbers in damaged messages
def read_dataflash(path: Path) -> Telemetry:
    """Read the positions of a dataflash log; raise InputError if it has none or pymavlink is missing.

    Positions and accuracies are those of the GNSS receiver, heights above take-off those of the autopilot
    above its home, and camera angles those of the mount. Damaged parts are skipped.
    """
    check_size(path)
    if not is_dataflash(path):
        raise InputError("is not a dataflash log of ArduPilot: it does not start as one", path=path)
    reader = pymavlink("DFReader", "ArduPilot's dataflash logs", path)
    log = _Log(reader)
    try:
        with path.open("rb") as file:
            while block := file.read(_BLOCK_BYTES):
                log.add(block)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=path) from error
    notes = []
    if log.skipped_bytes:
        notes.append(
            f"it is damaged: {log.skipped_bytes} bytes are skipped, the first at byte {log.first_skipped}"
        )
    if log.is_full:
        notes.append(f"only the first {_MAX_MESSAGE_BYTES / 1e6:.0f} MB of its records are used")
    tables = log.tables()
    gps, gps_notes = _receiver(tables, path)
    check_count(len(gps["TimeUS"]), path)
    camera = tables.get("CAM", {}).get("TimeUS", np.empty(0))
    if len(camera):
        first_s = (camera[0] - gps["TimeUS"][0]) * _US
        notes.append(
            f"camera triggers (CAM): {len(camera)}, the first {first_s:.1f} s after the first position record"
        )
    return log_track(
        path,
        "ardupilot-bin",
        _fixes(gps, _accuracies(tables, gps)),
        rel_alt=_series(tables.get("POS"), "RelHomeAlt"),
        gimbal=_mount(tables),
        notes=(*notes, *gps_notes),
    )


class _Log:
    """Bodies of the wanted messages, collected from blocks of a log."""

    def __init__(self, reader: Any):
        self._reader = reader
        self._lengths = [0] * 256
        self._lengths[_FORMAT_TYPE] = _FORMAT_BYTES
        self._wanted: dict[int, tuple[Any, bytearray]] = {}
        self._done: list[tuple[Any, bytearray]] = []
        self._rest = b""
        self._offset = 0
        self._bytes = 0
        self.skipped_bytes, self.first_skipped = 0, 0
        self.is_full = False

    def add(self, block: bytes) -> None:
        """Add the next block; a message that it cuts waits for the one after it."""
        data = self._rest + block
        lengths, wanted = self._lengths, self._wanted
        at, end = 0, len(data)
        while at + 3 <= end:
            kind = data[at + 2]
            length = lengths[kind]
            if data[at] != 0xA3 or data[at + 1] != 0x95 or not length:
                after = data.find(HEAD, at + 1)
                after = max(at + 1, end - 2) if after < 0 else after
                if not self.skipped_bytes:
                    self.first_skipped = self._offset + at
                self.skipped_bytes += after - at
                at = after
                continue
            if at + length > end:
                break
            if kind == _FORMAT_TYPE:
                self._add_format(data[at + 3 : at + length])
            elif kind in wanted:
                self._bytes += length
                self.is_full = self._bytes > _MAX_MESSAGE_BYTES
                if not self.is_full:
                    wanted[kind][1].extend(data[at + 3 : at + length])
            at += length
        self._rest = data[at:]
        self._offset += at

    def _add_format(self, body: bytes) -> None:
        kind, length, name, codes, columns = struct.unpack("<BB4s16s64s", body)
        text = self._reader.null_term
        if length < 3 or kind == _FORMAT_TYPE:
            return
        self._lengths[kind] = length
        if text(name) not in _WANTED:
            self._wanted.pop(kind, None)
            return
        before = self._wanted.get(kind)
        table = self._reader.FORMAT_TO_STRUCT
        if any(code not in table for code in text(codes)):
            return
        form = self._reader.DFFormat(kind, text(name), length, text(codes), text(columns))
        if struct.calcsize(form.msg_struct) + 3 != length or len(form.columns) != len(text(codes)):
            return
        if before is not None and before[0].msg_struct == form.msg_struct:
            return
        if len(self._done) < 1000:
            self._wanted[kind] = (form, bytearray())
            self._done.append(self._wanted[kind])

    def tables(self) -> dict[str, _Table]:
        """Return the columns of each message in the log's units, degrees and metres."""
        tables: dict[str, _Table] = {}
        for form, bodies in self._done:
            if form.name in tables or not bodies:
                continue  # a second definition of the same message
            dtype = np.dtype(
                [
                    (f"{k}", _numpy_code(struct_code))
                    for k, struct_code in enumerate(self._codes(form))
                ]
            )
            rows = np.frombuffer(bodies, dtype=dtype)
            columns: _Table = {}
            for k, (name, factor) in enumerate(zip(form.columns, form.msg_mults, strict=True)):
                if rows.dtype[k].kind != "S":
                    # Dividing, as pymavlink does, is more accurate than multiplying by 1e-7.
                    values = rows[f"{k}"].astype(np.float64)
                    columns[name] = values / round(1 / factor) if factor else values
            tables[form.name] = columns
        return tables

    def _codes(self, form: Any) -> list[str]:
        return [self._reader.FORMAT_TO_STRUCT[code][0] for code in form.format]


def _numpy_code(struct_code: str) -> str:
    """Return the NumPy type of a code of `struct`, such as "h" or "16s"."""
    return f"S{struct_code[:-1]}" if struct_code.endswith("s") else f"<{struct_code}"


def _receiver(tables: dict[str, _Table], path: Path) -> tuple[_Table, list[str]]:
    """Return the records of the receiver that the autopilot used most, else of that with most fixes."""
    found: list[_Table] = []
    for name in ("GPS", "GPS2"):
        table = tables.get(name)
        if table is None or not {"TimeUS", "Status", "Lat", "Lng", "Alt"} <= table.keys():
            continue
        number = table.get("I", np.zeros(len(table["TimeUS"])))
        found += [
            {key: values[number == one] for key, values in table.items()}
            for one in np.unique(number)[:8]
        ]
    if not found:
        raise InputError(
            "contains no positions: it has no GPS messages with TimeUS, Status, Lat, Lng and Alt",
            path=path,
        )
    used = [
        (int((one.get("U", np.zeros(1)) > 0).sum()), int((one["Status"] >= FIX_2D).sum()))
        for one in found
    ]
    best = max(range(len(found)), key=lambda k: used[k])
    if len(found) == 1:
        return found[0], []
    return found[best], [f"of its {len(found)} receivers, number {best + 1} is used"]


def _accuracies(tables: dict[str, _Table], gps: _Table) -> _Table:
    """Return HAcc, VAcc and VDop at the times of the fixes, from GPA messages of the same receiver."""
    count = len(gps["TimeUS"])
    result = {name: np.full(count, np.nan) for name in ("HAcc", "VAcc", "VDop")}
    table = tables.get("GPA")
    if table is None or "TimeUS" not in table or not count:
        return result
    if "I" in table and "I" in gps:
        same = table["I"] == gps["I"][0]
        table = {key: values[same] for key, values in table.items()}
    for name in result.keys() & table.keys():
        series = Series(table["TimeUS"] * _US, table[name])
        result[name] = series.near(gps["TimeUS"] * _US)
    return result


def _fixes(gps: _Table, accuracy: _Table) -> LoggedFixes:
    kind = np.nan_to_num(gps["Status"]).astype(np.int64)
    count = len(kind)
    nothing = np.full(count, np.nan)
    lat_lon = np.stack([gps["Lat"], gps["Lng"]], axis=1)
    lat_lon[kind < FIX_2D] = np.nan
    hdop = gps.get("HDop", nothing)
    stated = zip(
        kind.tolist(), accuracy["HAcc"], accuracy["VAcc"], hdop, accuracy["VDop"], strict=True
    )
    sigma_m = [
        sigma_from_fix(k, horizontal_m=h, vertical_m=v, hdop=hd, vdop=vd)
        for k, h, v, hd, vd in stated
    ]
    utc_s = nothing
    if {"GMS", "GWk"} <= gps.keys():
        utc_s = utc_from_gps(gps["GWk"], gps["GMS"] * _MS)
    return LoggedFixes(
        gps["TimeUS"] * _US,
        np.where(kind >= FIX_2D, utc_s, np.nan),
        lat_lon,
        np.where(kind >= FIX_3D, gps["Alt"], np.nan),
        np.array(sigma_m, dtype=np.float64).reshape(count, 3),
        HeightReference.AMSL,
    )


def _series(table: _Table | None, name: str) -> Series | None:
    if table is None or not {"TimeUS", name} <= table.keys():
        return None
    return Series(table["TimeUS"] * _US, table[name])


def _mount(tables: dict[str, _Table]) -> Series | None:
    """Return camera angles of the first mount; a yaw in the frame of the vehicle is added to its heading."""
    mount = tables.get("MNT")
    if mount is None or not {"TimeUS", "Pitch", "Roll"} <= mount.keys():
        return None
    first = mount.get("I", np.zeros(len(mount["TimeUS"]))) == mount.get("I", np.zeros(1))[0]
    mount = {key: values[first] for key, values in mount.items()}
    time_s = mount["TimeUS"] * _US
    yaw = mount.get("YawE", np.full(len(time_s), np.nan))
    heading = _series(tables.get("ATT"), "Yaw")
    if "YawB" in mount and heading is not None:
        yaw = np.where(np.isfinite(yaw), yaw, mount["YawB"] + heading.near(time_s))
    return Series(time_s, np.stack([yaw % 360.0, mount["Pitch"], mount["Roll"]], axis=1))
