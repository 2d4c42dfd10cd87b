"""Telemetry of a source, on the clock of the source."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spn_data.capture.candidates import Candidates
from spn_data.capture.sources import Source, SourceKind
from spn_data.capture.video import VideoInfo, probe
from spn_data.errors import InputError
from spn_data.telemetry.read import read_telemetry
from spn_data.telemetry.subtitles import read_subtitles
from spn_data.telemetry.track import Telemetry

# If the durations of a subtitle file and its video differ by more, they are of different flights.
_LENGTH_TOLERANCE_S = 5.0
_LENGTH_TOLERANCE = 0.1


def check_telemetry(source: Source) -> None:
    """Raise InputError if a subtitle file does not match its video in duration.

    This is checked before hours are spent on the video.
    """
    if source.kind is SourceKind.PHOTOS:
        return
    for part in source.parts:
        for path in source.telemetry:
            if path.stem.lower() == part.stem.lower() and path.suffix.lower() == ".srt":
                duration_s = probe(part).duration_s
                if np.isfinite(duration_s):
                    _check_length(read_telemetry(path), duration_s, path.name)


def source_telemetry(
    source: Source, candidates: Candidates, *, any_telemetry: bool = False
) -> Telemetry | None:
    """Read the telemetry of a source.

    Parameters
    ----------
    source : Source
    candidates : Candidates
        Measured frames of the source.
    any_telemetry : bool
        Whether to accept a subtitle file whose duration does not match the video.

    Returns
    -------
    Telemetry or None
        From the file next to each video part, else from its subtitle track; for photos from their metadata
        or a log. None if there is none.

    Raises
    ------
    InputError
        If a telemetry file cannot be read, or its duration does not match the video.
    """
    if source.kind is SourceKind.PHOTOS:
        return _photo_telemetry(source, candidates)
    parts = []
    for index, (part, start_s) in enumerate(
        zip(source.parts, candidates.part_start_s, strict=True)
    ):
        files = [t for t in source.telemetry if t.stem.lower() == part.stem.lower()]
        if len(files) > 1:
            # Prefer the subtitle file: it is on the clock of the video, a log is not.
            files.sort(key=lambda t: t.suffix.lower() != ".srt")
        info = probe(part)
        track = None
        if files:
            track = read_telemetry(files[0])
            if files[0].suffix.lower() != ".srt":
                track = _on_video_clock(track, info)
            elif not any_telemetry:
                times = candidates.measured.time_s[candidates.measured.source_idx == index]
                _check_length(track, float(times[-1] - times[0]), files[0].name)
        elif info.has_subtitles:
            track = read_subtitles(part)
        if track is not None:
            parts.append(track.shifted(start_s))
    return Telemetry.concatenate(parts) if parts else None


def _check_length(track: Telemetry, video_s: float, name: str) -> None:
    covered_s = float(track.time_s[-1] - track.time_s[0])
    if abs(covered_s - video_s) > max(_LENGTH_TOLERANCE_S, _LENGTH_TOLERANCE * video_s):
        raise InputError(
            f"its telemetry lasts {covered_s:.0f} s, but the video lasts {video_s:.0f} s: it may belong to "
            "another flight; remove it, or use --any-telemetry to accept it",
            path=name,
        )


def _on_video_clock(track: Telemetry, info: VideoInfo) -> Telemetry:
    """Return a log on the clock of the video, by its creation time if both have absolute times."""
    if info.created_utc is None or not np.isfinite(track.utc_s).any():
        note = (
            "no common clock with the video; the log is assumed to start at the first video frame"
        )
        return replace(track, notes=(*track.notes, note))
    note = "synchronised with the video by the creation time of the video"
    moved = replace(track, time_s=track.utc_s - info.created_utc.timestamp())
    return replace(moved.select(np.isfinite(moved.time_s)), notes=(*track.notes, note))


def _photo_telemetry(source: Source, candidates: Candidates) -> Telemetry | None:
    own = candidates.photo_telemetry
    if own is not None and own.has_fix.any():
        return own
    for path in source.telemetry:
        log = read_telemetry(path)
        if own is None or not np.isfinite(log.utc_s).any() or not np.isfinite(own.utc_s).any():
            continue
        zero_s = float(own.utc_s[np.isfinite(own.utc_s)][0] - own.time_s[np.isfinite(own.utc_s)][0])
        moved = replace(log, time_s=log.utc_s - zero_s)
        return moved.select(np.isfinite(moved.time_s))
    return own if own is not None and np.isfinite(own.gimbal_deg).any() else None


def unread_tracks(source: Source) -> list[str]:
    """Return a note if a video without readable telemetry has data tracks that are not supported."""
    if source.kind is SourceKind.PHOTOS:
        return []
    names = sorted({name for part in source.parts for name in probe(part).data_streams})
    return [
        f"{source.sequence}: its data tracks ({', '.join(names)}) are not supported; "
        "convert GoPro GPMF or DJI metadata to GPX or CSV"
        for _ in names[:1]
    ]
