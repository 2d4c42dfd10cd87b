"""Packets of the data tracks of a video that may hold telemetry: GPMF, CAMM, KLV and DJI's djmd."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from spn_data.errors import InputError
from spn_data.media.container import first_picture_s, open_tracks, packet_time_s, packets

# A camera writes some 10 kB and 20 positions a second.
_MAX_BYTES = 256_000_000
_MAX_PACKET_BYTES = 4_000_000
MAX_RECORDS = 500_000
_MAX_OTHER_PACKETS = 1000  # of a track whose format is not recognized yet
# CAMM: two zero bytes, the type, then a body of the size that the type has.
_CAMM_SIZES = {0: 16, 1: 12, 2: 16, 3: 16, 4: 16, 5: 28, 6: 60, 7: 16}
_CAMM_POSITIONS = (b"\5\0", b"\6\0")
KLV_KEY_START = bytes.fromhex("060e2b34")


class TrackFormat(StrEnum):
    """Format of a data track, recognized by its content: PyAV does not show its four-character code."""

    GPMF = "GoPro GPMF"
    CAMM = "CAMM"
    KLV = "KLV"
    DJI = "DJI djmd"


@dataclass(frozen=True, slots=True)
class DataPacket:
    """One packet: its time after the first frame (NaN: not stated), how long it holds, and its bytes.

    `near_s` is the time of the video packet stored before it, the only clock of a track without times.
    """

    time_s: float
    duration_s: float
    payload: bytes
    near_s: float


@dataclass
class DataTrack:
    """One data track of a recognized format."""

    format: TrackFormat
    packets: list[DataPacket] = field(default_factory=list)


def read_data_tracks(path: Path) -> list[DataTrack]:
    """Read the packets of all data tracks in a recognized format.

    Parameters
    ----------
    path : Path
        The video file.

    Returns
    -------
    list of DataTrack
        In the order of the file. Of a djmd track, only the first packet.

    Raises
    ------
    InputError
        If the file is not a video, or the tracks exceed the limits.
    """
    with open_tracks(path, "data tracks") as container:
        streams = [s for s in container.streams if s.type == "data"]
        if not streams:
            return []
        if any(stream.name == "klv" for stream in streams):
            # KLV may be without times, and then lies beside its pictures.
            streams += container.streams.video[:1]
        return _tracks(container, streams, first_picture_s(container), path)


def _tracks(container: Any, streams: list[Any], start_s: float, path: Path) -> list[DataTrack]:
    tracks: dict[int, DataTrack] = {}
    others: dict[int, int] = {}
    total_bytes = count = 0
    near_s = math.nan
    for packet in packets(container, streams):
        time_s = packet_time_s(packet) - start_s
        index = packet.stream.index
        if packet.stream.type == "video":
            near_s = time_s if math.isfinite(time_s) else near_s
            continue
        if packet.size == 0 or others.get(index, 0) > _MAX_OTHER_PACKETS:
            continue
        payload = bytes(packet)
        if index not in tracks:
            found = _format(packet.stream, payload)
            if found is None:
                others[index] = others.get(index, 0) + 1
                continue
            tracks[index] = DataTrack(found)
        track = tracks[index]
        if not _is_needed(track, payload):
            continue
        total_bytes += len(payload)
        count += 1
        if len(payload) > _MAX_PACKET_BYTES or total_bytes > _MAX_BYTES or count > MAX_RECORDS:
            raise InputError(
                f"its data tracks exceed {_MAX_BYTES / 1e6:.0f} MB, {MAX_RECORDS:,} packets or "
                f"{_MAX_PACKET_BYTES / 1e6:.0f} MB in a packet",
                path=path,
            )
        duration_s = float((packet.duration or 0) * packet.time_base) if packet.time_base else 0.0
        track.packets.append(DataPacket(time_s, duration_s, payload, near_s))
    return list(tracks.values())


def _is_needed(track: DataTrack, payload: bytes) -> bool:
    """Return whether a packet may hold a position; those of a djmd track are not read after the first."""
    if track.format is TrackFormat.DJI:
        return not track.packets
    return track.format is not TrackFormat.CAMM or payload[2:4] in _CAMM_POSITIONS


def _format(stream: Any, payload: bytes) -> TrackFormat | None:
    """Recognize the format of a track by one of its packets."""
    if payload[:4] == b"DEVC":
        return TrackFormat.GPMF
    if stream.name == "klv" or payload[:4] == KLV_KEY_START:
        return TrackFormat.KLV
    if b"dvtm_" in payload[:200]:
        return TrackFormat.DJI
    if len(payload) >= 4:
        reserved, kind = struct.unpack("<HH", payload[:4])
        if reserved == 0 and _CAMM_SIZES.get(kind) == len(payload):
            return TrackFormat.CAMM
    return None
