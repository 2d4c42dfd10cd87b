"""Which telemetry belongs to a source, on the source's own clock."""

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

# A subtitle file this much shorter or longer than its video is another flight's.
_LENGTH_TOLERANCE_S = 5.0
_LENGTH_TOLERANCE = 0.1


def check_telemetry(source: Source) -> None:
    """Raises InputError where a file beside a video is not of its length: before hours go into the video."""
    if source.kind is SourceKind.PHOTOS:
        return
    for part in source.parts:
        for path in source.telemetry:
            if path.stem.lower() == part.stem.lower() and path.suffix.lower() == ".srt":
                duration_s = probe(part).duration_s
                if np.isfinite(duration_s):
                    _check_length(read_telemetry(path), duration_s, path.name)


def telemetry_of(
    source: Source, candidates: Candidates, *, any_telemetry: bool = False
) -> Telemetry | None:
    """Telemetry of a source: the file beside it, the subtitles inside it, or the photos' own; None without.

    Raises InputError where a file beside it can't be read, or is as long as no part of it.
    """
    if source.kind is SourceKind.PHOTOS:
        return _of_photos(source, candidates)
    parts = []
    for index, (part, start_s) in enumerate(
        zip(source.parts, candidates.part_start_s, strict=True)
    ):
        files = [t for t in source.telemetry if t.stem.lower() == part.stem.lower()]
        if len(files) > 1:
            # The subtitle file is on the video's clock; a log is not.
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
            f"its telemetry lasts {covered_s:.0f} s, the video beside it {video_s:.0f} s: of another "
            "flight? Remove it, or give --any-telemetry to use it all the same",
            path=name,
        )


def _on_video_clock(track: Telemetry, info: VideoInfo) -> Telemetry:
    """A log's records at the video's times, by the video's creation time where both know the hour."""
    if info.created_utc is None or not np.isfinite(track.utc_s).any():
        note = "its clock is not the video's: it is taken to begin with the video's first frame"
        return replace(track, notes=(*track.notes, note))
    note = "its clock is tied to the video by the video's creation time"
    moved = replace(track, time_s=track.utc_s - info.created_utc.timestamp())
    return replace(moved.select(np.isfinite(moved.time_s)), notes=(*track.notes, note))


def _of_photos(source: Source, candidates: Candidates) -> Telemetry | None:
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
    """A sentence where a video without readable telemetry carries some of a kind that is not read."""
    if source.kind is SourceKind.PHOTOS:
        return []
    names = sorted({name for part in source.parts for name in probe(part).data_streams})
    return [
        f"{source.sequence}: its data tracks ({', '.join(names)}) are not read: GoPro's GPMF and DJI's own "
        "need to be converted to GPX or CSV first"
        for _ in names[:1]
    ]
