"""Writers of flight logs of all formats from one flight, independent of the readers."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

UTC_S = 1_714_564_800.0  # 2024-05-01 12:00:00 UTC
BOOT_S = 100.0  # clock of the autopilot at the first record


@dataclass(frozen=True, eq=False)
class Flight:
    """Truth of a flight: records (N,) of the time, position, heights, lock and camera angles."""

    time_s: np.ndarray
    lat_deg: np.ndarray
    lon_deg: np.ndarray
    amsl_m: np.ndarray
    geoid_m: float
    rel_m: np.ndarray
    fix_type: np.ndarray
    gimbal_deg: np.ndarray
    sigma_m: tuple[float, float] = (0.6, 0.9)
    utc_s: float = UTC_S

    @property
    def ellipsoid_m(self) -> np.ndarray:
        """Height above the ellipsoid (N,)."""
        return self.amsl_m + self.geoid_m


def make_flight(count: int = 40, step_s: float = 0.2, no_lock: int = 3) -> Flight:
    """Return a climbing flight to the north-east, without a lock in its first records."""
    k = np.arange(count, dtype=np.float64)
    kind = np.where(k < no_lock, 1, 3)
    gimbal = np.stack([40 + k, -30 - 0.5 * k, 0.1 * k], axis=1)
    return Flight(
        k * step_s, -35.36 + 1e-5 * k, 149.16 + 2e-5 * k, 600 + 0.5 * k, 19.3, 0.5 * k, kind, gimbal
    )


def quaternion(heading_deg: float, pitch_deg: float, roll_deg: float) -> list[float]:
    """Return the quaternion, scalar first, from forward, right, down to north, east, down."""
    y, p, r = np.radians([heading_deg, pitch_deg, roll_deg]) / 2
    cy, sy, cp, sp, cr, sr = np.cos(y), np.sin(y), np.cos(p), np.sin(p), np.cos(r), np.sin(r)
    return [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]


_ULOG_TYPES = {"uint64_t": "Q", "int32_t": "i", "float": "f", "double": "d", "uint8_t": "B"}
_ULOG_TYPES |= {"bool": "?", "uint16_t": "H"}
_ULOG_OLD = (
    "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;int32_t alt_ellipsoid;"
    "float eph;float epv;uint8_t fix_type;"
)
_ULOG_NEW = (
    "uint64_t timestamp;uint64_t time_utc_usec;double latitude_deg;double longitude_deg;"
    "double altitude_msl_m;double altitude_ellipsoid_m;float eph;float epv;uint8_t fix_type;"
)
_ULOG_OTHERS = {
    "vehicle_global_position": "uint64_t timestamp;double lat;double lon;float alt;bool alt_valid;",
    "home_position": "uint64_t timestamp;float alt;bool valid_alt;",
    "vehicle_attitude": "uint64_t timestamp;float[4] q;",
    "gimbal_device_attitude_status": "uint64_t timestamp;float[4] q;uint16_t device_flags;",
}


def write_ulog(path: Path, flight: Flight, *, old: bool = False, in_vehicle: bool = False) -> None:
    """Write a ULog as its format is documented, with the fields of PX4 before or after 1.14."""
    position = "vehicle_gps_position" if old else "sensor_gps"
    formats = {position: _ULOG_OLD if old else _ULOG_NEW, **_ULOG_OTHERS}
    out = io.BytesIO()
    out.write(b"\x55\x4c\x6f\x67\x01\x12\x35\x01" + struct.pack("<Q", int(BOOT_S * 1e6)))

    def message(kind: str, body: bytes) -> None:
        out.write(struct.pack("<HB", len(body), ord(kind)) + body)

    message("B", bytes(40))
    for name, fields in formats.items():
        message("F", f"{name}:{fields}".encode())
    for number, name in enumerate(formats):
        message("A", struct.pack("<BH", 0, number) + name.encode())

    def record(name: str, *values: float) -> None:
        fields = formats[name].replace("float[4] q;", "float a;float b;float c;float d;")
        codes = "".join(_ULOG_TYPES[field.split()[0]] for field in fields.split(";") if field)
        message("D", struct.pack(f"<H{codes}", list(formats).index(name), *values))

    start_us = int(BOOT_S * 1e6)
    record("home_position", start_us, float(flight.amsl_m[0] - flight.rel_m[0]), True)
    for k, time_s in enumerate(flight.time_s):
        us, utc_us = start_us + round(time_s * 1e6), round((flight.utc_s + time_s) * 1e6)
        lat, lon = flight.lat_deg[k], flight.lon_deg[k]
        place: tuple[float, ...] = (lat, lon, flight.amsl_m[k], flight.ellipsoid_m[k])
        if old:
            scales = (1e7, 1e7, 1e3, 1e3)
            place = tuple(round(value * scale) for value, scale in zip(place, scales, strict=True))
        kind = int(flight.fix_type[k])
        record(position, us, utc_us if kind > 1 else 0, *place, *flight.sigma_m, kind)
        record("vehicle_global_position", us, lat, lon, flight.amsl_m[k], True)
        heading, pitch, roll = flight.gimbal_deg[k]
        record("vehicle_attitude", us, *quaternion(30.0, 2.0, -3.0))
        quat = quaternion(heading - (30.0 if in_vehicle else 0.0), pitch, roll)
        record("gimbal_device_attitude_status", us, *quat, 32 if in_vehicle else 64)
    path.write_bytes(out.getvalue())


_DATAFLASH = {
    "GPS": ("QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"),
    "GPA": ("QBCCCCfBIHf", "TimeUS,I,VDop,HAcc,VAcc,SAcc,YAcc,VV,SMS,Delta,Und"),
    "POS": ("QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "ATT": ("Qccccf", "TimeUS,DesRoll,Roll,DesPitch,Pitch,Yaw"),
    "MNT": ("QBfffffff", "TimeUS,I,DRoll,Roll,DPitch,Pitch,DYawB,YawB,YawE"),
    "CAM": ("QBHIHLLfff", "TimeUS,I,Img,GPSTime,GPSWeek,Lat,Lng,Alt,RelAlt,GPSAlt"),
}


def gps_week(utc_s: float) -> tuple[int, int]:
    """Return GPS week and milliseconds of it, 18 s ahead of UTC since 2017."""
    seconds = utc_s - datetime(1980, 1, 6, tzinfo=UTC).timestamp() + 18
    return int(seconds // 604_800), round(seconds % 604_800 * 1000)


def write_dataflash(path: Path, flight: Flight, *, yaw_in_earth: bool = True) -> None:
    """Write a dataflash log by pymavlink's own formats."""
    from pymavlink.DFReader import DFFormat, DFReader_binary

    pack = DFReader_binary.make_msgbuf
    formats = {
        name: DFFormat(150 + k, name, 0, codes, columns)
        for k, (name, (codes, columns)) in enumerate(_DATAFLASH.items())
    }
    own = DFFormat(0x80, "FMT", 89, "BBnNZ", "Type,Length,Name,Format,Columns")

    def definition(form: DFFormat) -> bytes:
        length = struct.calcsize(form.msg_struct) + 3
        names = (form.name.encode(), form.format.encode(), ",".join(form.columns).encode())
        return pack(None, own, [form.type, length, *names])

    out = [definition(own), *(definition(form) for form in formats.values())]
    start_us = int(BOOT_S * 1e6)
    for k, time_s in enumerate(flight.time_s):
        us = start_us + round(time_s * 1e6)
        week, ms = gps_week(flight.utc_s + time_s)
        kind = int(flight.fix_type[k])
        lat, lon = round(flight.lat_deg[k] * 1e7), round(flight.lon_deg[k] * 1e7)
        amsl, rel = float(flight.amsl_m[k]), float(flight.rel_m[k])
        heading, pitch, roll = flight.gimbal_deg[k]
        week, ms = (week, ms) if kind > 1 else (0, 0)
        sigma = [round(100 * value) for value in flight.sigma_m]
        rows: dict[str, list[float]] = {
            "GPS": [us, 0, kind, ms, week, 12, 80, lat, lon, round(100 * amsl), 0, 0, 0, 0, 1],
            "GPA": [us, 0, 120, *sigma, 20, 0, 1, 0, 200, flight.geoid_m],
            "POS": [us, lat, lon, amsl, rel, rel],
            "ATT": [us, 0, 0, 0, 0, 30.0],
            "MNT": [us, 0, 0, roll, 0, pitch, 0, heading - 30, heading if yaw_in_earth else np.nan],
        }
        if k % 10 == 5:
            rows["CAM"] = [us, 0, k, ms, week, lat, lon, amsl, rel, amsl]
        out += [pack(None, formats[name], row) for name, row in rows.items()]
    path.write_bytes(b"".join(out))


def write_tlog(
    path: Path, flight: Flight, *, system: int = 1, gimbal: str = "device", delay_s: float = 0.3
) -> None:
    """Write a telemetry log by pymavlink; messages arrive late, by a delay that varies."""
    from pymavlink.dialects.v20 import ardupilotmega as dialect

    mavlink = dialect.MAVLink(None, srcSystem=system, srcComponent=1)
    out: list[bytes] = []

    def send(time_s: float, message: object) -> None:
        late_s = delay_s * (1 + 0.5 * np.sin(7 * time_s))
        out.append(struct.pack(">Q", round((flight.utc_s + time_s + late_s) * 1e6)))
        out.append(message.pack(mavlink))  # type: ignore[attr-defined]
        mavlink.seq = (mavlink.seq + 1) % 256

    send(0.0, mavlink.heartbeat_encode(2, 3, 0, 0, 4))
    for k, time_s in enumerate(flight.time_s):
        boot_ms = round((BOOT_S + time_s) * 1e3)
        kind = int(flight.fix_type[k])
        lat, lon = round(flight.lat_deg[k] * 1e7), round(flight.lon_deg[k] * 1e7)
        amsl, hae, rel = (
            round(1000 * float(value[k]))
            for value in (flight.amsl_m, flight.ellipsoid_m, flight.rel_m)
        )
        sigma = [round(1000 * value) for value in flight.sigma_m]
        if kind > 1 and k % 5 == 0:
            utc_us = round((flight.utc_s + time_s) * 1e6)
            send(time_s, mavlink.system_time_encode(utc_us, boot_ms))
        gps = (boot_ms * 1000, kind, lat, lon, amsl, 80, 120, 0, 0, 12, hae, *sigma, 0, 0, 0)
        send(time_s, mavlink.gps_raw_int_encode(*gps))
        send(time_s, mavlink.global_position_int_encode(boot_ms, lat, lon, amsl, rel, 0, 0, 0, 0))
        yaw = np.radians(30.0)
        send(time_s, mavlink.attitude_encode(boot_ms, 0.0, 0.0, yaw, 0, 0, 0))
        heading, pitch, roll = flight.gimbal_deg[k]
        if gimbal == "device":
            quat = quaternion(heading - 30, pitch, roll)
            fields = (0, 0, boot_ms, 32, quat, 0.0, 0.0, 0.0, 0)
            send(time_s, mavlink.gimbal_device_attitude_status_encode(*fields))
        else:
            angles = (round(100 * pitch), round(100 * roll), round(100 * (heading - 30)))
            send(time_s, mavlink.mount_status_encode(0, 0, *angles))
    path.write_bytes(b"".join(out))


def nmea_lines(
    flight: Flight, *, geoid: bool = True, gst: bool = True, date: bool = True, quality: int = 1
) -> list[str]:
    """Return the sentences of a receiver with checksums of their own."""

    def sentence(body: str) -> str:
        total = 0
        for byte in body.encode():
            total ^= byte
        return f"${body}*{total:02X}"

    def angle(value: float, digits: int, letters: str) -> str:
        whole = int(abs(value))
        minutes = (abs(value) - whole) * 60
        return f"{whole:0{digits}d}{minutes:09.6f},{letters[int(value < 0)]}"

    lines = []
    for k, time_s in enumerate(flight.time_s):
        now = datetime.fromtimestamp(flight.utc_s + time_s, UTC)
        clock = now.strftime("%H%M%S.") + f"{now.microsecond // 10_000:02d}"
        place = f"{angle(flight.lat_deg[k], 2, 'NS')},{angle(flight.lon_deg[k], 3, 'EW')}"
        fixed = flight.fix_type[k] > 1
        if date:
            status, day = ("A", now.strftime("%d%m%y")) if fixed else ("V", "")
            lines.append(sentence(f"GPRMC,{clock},{status},{place},0.1,0.0,{day},,,A"))
        separation = f"{flight.geoid_m:.1f}" if geoid else ""
        kind = quality if fixed else 0
        height = f"{flight.amsl_m[k]:.2f},M,{separation},M"
        lines.append(sentence(f"GPGGA,{clock},{place},{kind},12,0.8,{height},,"))
        if gst:
            east, up = flight.sigma_m
            lines.append(sentence(f"GPGST,{clock},1.0,1.0,1.0,0.0,{east},{east},{up}"))
    return lines


def write_nmea(path: Path, flight: Flight, **options: bool | int) -> None:
    """Write an NMEA log."""
    path.write_text("\r\n".join(nmea_lines(flight, **options)) + "\r\n")  # type: ignore[arg-type]


def fit_crc(data: bytes) -> int:
    """Return the checksum of Garmin's FIT."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
    return crc


def write_fit(path: Path, flight: Flight) -> None:
    """Write a FIT activity of records once per whole second, as its protocol is documented."""
    fields = [(253, 4, 0x86), (0, 4, 0x85), (1, 4, 0x85), (78, 4, 0x86), (31, 1, 0x02)]
    body = struct.pack("<BBBHB", 0x40, 0, 0, 20, len(fields))
    body += b"".join(struct.pack("<BBB", *one) for one in fields)
    epoch_s = datetime(1989, 12, 31, tzinfo=UTC).timestamp()
    for k, time_s in enumerate(flight.time_s):
        if abs(time_s - round(time_s)) > 1e-6:
            continue
        fixed = flight.fix_type[k] > 1
        place = [
            round(value[k] * 2**31 / 180) if fixed else 0x7FFFFFFF
            for value in (flight.lat_deg, flight.lon_deg)
        ]
        height = round((float(flight.amsl_m[k]) + 500) * 5)
        seconds = round(flight.utc_s + time_s - epoch_s)
        body += struct.pack("<BIiiIB", 0, seconds, *place, height, 3)
    header = struct.pack("<BBHI4s", 14, 0x20, 2100, len(body), b".FIT")
    header += struct.pack("<H", fit_crc(header))
    path.write_bytes(header + body + struct.pack("<H", fit_crc(header + body)))
