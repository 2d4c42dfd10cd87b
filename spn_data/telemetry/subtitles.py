"""Telemetry that a drone recorded as a subtitle track inside the video."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any

from spn_data.errors import InputError
from spn_data.media.container import first_picture_s, open_tracks, packet_time_s, packets
from spn_data.telemetry.dji_srt import telemetry_from_records
from spn_data.telemetry.textfile import MAX_TEXT_BYTES
from spn_data.telemetry.track import Telemetry

_logger = logging.getLogger(__name__)

_TEXT_CODECS = ("mov_text", "srt", "subrip", "text", "ass", "ssa")


def read_subtitles(path: Path | str) -> Telemetry | None:
    """Read the telemetry of the first subtitle track that contains any.

    Parameters
    ----------
    path : Path or str
        The video file.

    Returns
    -------
    Telemetry or None
        time_s is 0 at the first frame. None if the video has no text subtitle track.

    Raises
    ------
    InputError
        If the subtitles contain no telemetry, or the file is not a video.
    """
    with open_tracks(Path(path), "subtitles") as container:
        streams = [
            s
            for s in container.streams.subtitles
            if s.codec_context is not None and s.codec_context.name in _TEXT_CODECS
        ]
        tracks = _tracks(container, streams, first_picture_s(container), path)
    failure: InputError | None = None
    for records in tracks:
        try:
            return telemetry_from_records(records, source=str(path), has_lines=False)
        except InputError as error:
            _logger.debug("a subtitle track is not telemetry: %s", error)
            failure = failure or error
    if failure is not None:
        raise failure
    return None


def _tracks(
    container: Any, streams: list[Any], start_s: float, path: Path | str
) -> list[list[tuple[int, float, str]]]:
    """Return (number from 1, time_s, text) of the subtitles of each stream."""
    tracks: dict[int, list[tuple[int, float, str]]] = {stream.index: [] for stream in streams}
    total_bytes = 0
    for packet in packets(container, streams) if streams else ():
        data = bytes(packet)
        total_bytes += len(data)
        if total_bytes > MAX_TEXT_BYTES:
            raise InputError(f"its subtitles exceed {MAX_TEXT_BYTES / 1e6:.0f} MB", path=path)
        text = _text(data, packet.stream.codec_context.name)
        time_s = packet_time_s(packet) - start_s
        if math.isfinite(time_s) and text.strip():
            records = tracks[packet.stream.index]
            records.append((len(records) + 1, time_s, text))
    return list(tracks.values())


def _text(data: bytes, codec: str) -> str:
    """Extract the plain text of one subtitle packet."""
    if codec == "mov_text":  # two length bytes, the text, then style boxes
        data = data[2 : 2 + int.from_bytes(data[:2], "big")]
    text = data.decode("utf-8", errors="replace")
    if codec in ("ass", "ssa"):  # "ReadOrder,Layer,Style,Name,MarginL,MarginR,MarginV,Effect,Text"
        text = text.split(",", 8)[-1].replace("\\N", "\n")
    return text
