"""Videos with data tracks of telemetry: MPEG-TS with MISB ST 0601, and payloads of GPMF and CAMM."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
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


def write_klv_video(
    path: Path,
    packets: Sequence[tuple[float, bytes]],
    *,
    seconds: float = 4.0,
    size: tuple[int, int] = (64, 48),
) -> None:
    """Write an MPEG-TS with a grey video of 10 frames a second and KLV packets at times in seconds."""
    with av.open(str(path), "w", format="mpegts") as container:
        video = container.add_stream("mpeg4", rate=10)
        video.width, video.height, video.pix_fmt = *size, "yuv420p"
        data = container.add_data_stream("klv")
        waiting = list(packets)
        for number in range(round(10 * seconds)):
            while waiting and waiting[0][0] <= number / 10:
                time_s, payload = waiting.pop(0)
                packet = av.Packet(payload)
                packet.stream, packet.time_base = data, Fraction(1, 90_000)
                packet.pts = packet.dts = round(90_000 * time_s)
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
