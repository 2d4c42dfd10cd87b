"""Packets of the data tracks of a video that may hold telemetry: GPMF, CAMM, KLV and DJI's djmd."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import av

from spn_data.errors import InputError
from spn_data.media.container import open_container

_MAX_BYTES = 500_000_000
_MAX_PACKETS = 2_000_000
_MAX_OTHER_PACKETS = 1000  # of a track whose format is not recognized yet
# CAMM: two zero bytes, the type, then a body of the size that the type has.
_CAMM_SIZES = {0: 16, 1: 12, 2: 16, 3: 16, 4: 16, 5: 28, 6: 60, 7: 16}
KLV_KEY_START = bytes.fromhex("060e2b34")


class TrackFormat(StrEnum):
    """Format of a data track, recognized by its content: PyAV does not show its four-character code."""

    GPMF = "GoPro GPMF"
    CAMM = "CAMM"
    KLV = "KLV"
    DJI = "DJI djmd"


@dataclass(frozen=True)
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
    try:
        with open_container(path) as container:
            streams = [s for s in container.streams if s.type == "data"]
            if not streams:
                return []
            video = container.streams.video[0] if container.streams.video else None
            if any(stream.name == "klv" for stream in streams) and video is not None:
                streams.append(video)  # KLV may be without times, and then lies beside its pictures
            return _tracks(container, streams, _start_s(video), path)
    except (av.FFmpegError, OSError) as error:
        raise InputError(f"its data tracks cannot be read: {error.strerror}", path=path) from error
    except IndexError as error:  # PyAV does not know streams that appear while a file is read
        raise InputError(
            "its data tracks cannot be read: a track appears in the middle of the file", path=path
        ) from error


def _start_s(video: Any) -> float:
    if video is None or video.start_time is None or video.time_base is None:
        return 0.0
    return float(video.start_time * video.time_base)


def _tracks(container: Any, streams: list[Any], start_s: float, path: Path) -> list[DataTrack]:
    tracks: dict[int, DataTrack] = {}
    others: dict[int, int] = {}
    total_bytes = count = 0
    near_s = math.nan
    for packet in container.demux(streams):
        time_s = math.nan if packet.pts is None else float(packet.pts * packet.time_base) - start_s
        index = packet.stream.index
        if packet.stream.type == "video":
            near_s = time_s if packet.pts is not None else near_s
            continue
        if packet.size == 0 or others.get(index, 0) > _MAX_OTHER_PACKETS:
            continue
        if total_bytes + packet.size > _MAX_BYTES or count >= _MAX_PACKETS:
            raise InputError(
                f"its data tracks exceed {_MAX_BYTES / 1e6:.0f} MB or {_MAX_PACKETS:,} packets",
                path=path,
            )
        payload = bytes(packet)
        if index not in tracks:
            found = _format(packet.stream, payload)
            if found is None:
                others[index] = others.get(index, 0) + 1
                continue
            tracks[index] = DataTrack(found)
        track = tracks[index]
        if track.format is TrackFormat.DJI and track.packets:
            continue
        total_bytes += len(payload)
        count += 1
        duration_s = float((packet.duration or 0) * packet.time_base) if packet.time_base else 0.0
        track.packets.append(DataPacket(time_s, duration_s, payload, near_s))
    return list(tracks.values())


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
