"""Videos with data tracks of telemetry, and payloads of MISB ST 0601, GPMF and CAMM."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from datetime import datetime
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

MISB_KEY = bytes.fromhex("060e2b34020b01010e01030101000000")


def misb_set(stamp_us: int, items: Mapping[int, bytes]) -> bytes:
    """Return one MISB ST 0601 local set: the stamp first, the checksum last."""
    body = b"\x02\x08" + struct.pack(">Q", stamp_us)
    for tag, value in items.items():
        body += bytes([tag, len(value)]) + value
    length = len(body) + 4
    ber = bytes([length]) if length < 128 else b"\x82" + struct.pack(">H", length)
    start = MISB_KEY + ber + body + b"\x01\x02"
    total = sum(byte << (8 if i % 2 == 0 else 0) for i, byte in enumerate(start))
    return start + struct.pack(">H", total % 65536)


def write_data_video(
    path: Path,
    packets: Sequence[tuple[float, bytes]],
    *,
    seconds: float = 4.0,
    size: tuple[int, int] = (64, 48),
) -> None:
    """Write a grey video of 10 frames a second with data packets at times in seconds.

    The data track of a .ts is one of KLV, that of an .mp4 has the code of GoPro's.
    """
    with av.open(str(path), "w") as container:
        video = container.add_stream("mpeg4", rate=10)
        video.width, video.height, video.pix_fmt = *size, "yuv420p"
        data = container.add_data_stream("klv" if path.suffix == ".ts" else "bin_data")
        waiting = list(packets)
        for number in range(round(10 * seconds)):
            while waiting and waiting[0][0] <= number / 10:
                time_s, payload = waiting.pop(0)
                packet = av.Packet(payload)
                packet.stream, packet.time_base = data, Fraction(1, 90_000)
                packet.pts = packet.dts = round(90_000 * time_s)
                packet.duration = 45_000
                container.mux(packet)
            image = np.full((size[1], size[0], 3), 5 * number % 256, np.uint8)
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts = number
            for packet in video.encode(frame):
                container.mux(packet)
        for packet in video.encode(None):
            container.mux(packet)


def gpmf_item(key: bytes, kind: bytes, size: int, values: bytes, count: int | None = None) -> bytes:
    """Return one GPMF item, padded to 4 bytes."""
    count = len(values) // size if count is None else count
    return struct.pack(">4scBH", key, kind, size, count) + values + b"\0" * (-len(values) % 4)


def gpmf_payload(*items: bytes) -> bytes:
    """Return a payload of one device with one stream of these items."""
    stream = b"".join(items)
    inside = gpmf_item(b"DVID", b"L", 4, b"\0\0\0\1") + gpmf_item(b"STRM", b"\0", 4, stream)
    return gpmf_item(b"DEVC", b"\0", 4, inside)


def _uint(value: float, low: float, high: float, size: int) -> bytes:
    return round((value - low) / (high - low) * (256**size - 1)).to_bytes(size, "big")


def _int(value: float, half: float, size: int) -> bytes:
    return round(value / half * (256**size // 2 - 1)).to_bytes(size, "big", signed=True)


def misb_height(value_m: float) -> bytes:
    """Return item 75 of MISB ST 0601, a height above the ellipsoid."""
    return _uint(value_m, -900, 19000, 2)


def misb_items(**changes: float) -> dict[int, bytes]:
    """Return the items of a level platform that heads east, with a sensor that looks ahead and down."""
    values = {"lat": 48.1, "lon": 11.5, "alt": 700.0, "fov": 20.0, "elevation": -45.0}
    values |= {"heading": 90.0, "pitch": 0.0, "roll": 0.0, "azimuth": 0.0, "turn": 0.0} | changes
    return {
        5: _uint(values["heading"], 0, 360, 2),
        6: _int(values["pitch"], 20, 2),
        7: _int(values["roll"], 50, 2),
        13: _int(values["lat"], 90, 4),
        14: _int(values["lon"], 180, 4),
        15: _uint(values["alt"], -900, 19000, 2),
        16: _uint(values["fov"], 0, 180, 2),
        18: _uint(values["azimuth"], 0, 360, 4),
        19: _int(values["elevation"], 180, 4),
        20: _uint(values["turn"], 0, 360, 4),
    }


def gps5_payload(fix: int, *, reference: bytes = b"") -> bytes:
    """Return a GoPro payload of four positions at 12:00:00.5 on 1 May 2024."""
    rows = [(481_000_000 + 100 * i, 115_000_000, 500_000, 1000, 100) for i in range(4)]
    return gpmf_payload(
        gpmf_item(b"GPSF", b"L", 4, struct.pack(">L", fix)),
        gpmf_item(b"GPSU", b"U", 16, b"240501120000.500"),
        gpmf_item(b"GPSP", b"S", 2, struct.pack(">H", 150)),
        gpmf_item(b"SCAL", b"l", 4, struct.pack(">5l", 10_000_000, 10_000_000, 1000, 1000, 100)),
        *([gpmf_item(b"GPSA", b"F", 4, reference)] if reference else []),
        gpmf_item(b"GPS5", b"l", 20, b"".join(struct.pack(">5l", *row) for row in rows)),
    )


def gps9_payload() -> bytes:
    """Return a GoPro payload of two records at 12:00:00.25 on 1 May 2024, the first without a lock."""
    days = (datetime(2024, 5, 1) - datetime(2000, 1, 1)).days
    rows = [
        (481_000_000, 115_000_000, 500_000, 0, 0, days, 43_200_250 + i, 120, 3 * i)
        for i in range(2)
    ]
    scales = struct.pack(">9l", 10**7, 10**7, 1000, 1000, 100, 1, 1000, 100, 1)
    return gpmf_payload(
        gpmf_item(b"TYPE", b"c", 9, b"lllllllSS"),
        gpmf_item(b"SCAL", b"l", 4, scales),
        gpmf_item(b"GPSA", b"F", 4, b"MSLV"),
        gpmf_item(b"GPS9", b"?", 32, b"".join(struct.pack(">7l2H", *row) for row in rows)),
    )


def karma_payload() -> bytes:
    """Return a payload of a Karma's raw fixes."""
    rows = [
        (10**6 + 250_000 * i, 481_000_000, 115_000_000, 500_000 + i, 80, 120, 0, 0, 3, 9)
        for i in range(4)
    ]
    scales = struct.pack(">10l", 10**6, 10**7, 10**7, 1000, 100, 100, 100, 100, 1, 1)
    return gpmf_payload(
        gpmf_item(b"TYPE", b"c", 10, b"JlllSSSSBB"),
        gpmf_item(b"SCAL", b"l", 4, scales),
        gpmf_item(b"GPRI", b"?", 30, b"".join(struct.pack(">Q3l4H2B", *row) for row in rows)),
    )


def camm_packet(fix: int) -> bytes:
    """Return a CAMM packet of type 6."""
    head = struct.pack("<HHdi", 0, 6, 1.4e9, fix)
    return head + struct.pack("<dd7f", 48.1, 11.5, 500, 2, 3, 0, 0, 0, 0)
