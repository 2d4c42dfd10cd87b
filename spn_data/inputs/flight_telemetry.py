"""Telemetry of a source, on the clock of the source."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from spn_data.capture.candidates import Candidates
from spn_data.capture.sources import EVENTS_SUFFIX, SUBTITLE_SUFFIXES, Source, SourceKind
from spn_data.capture.video import VideoInfo, probe
from spn_data.errors import InputError
from spn_data.inputs.telemetry_clocks import ImageClock, check_overlap, on_image_clock
from spn_data.telemetry.embedded import read_embedded
from spn_data.telemetry.mrk import read_mrk, with_exposures
from spn_data.telemetry.photo_table import with_photo_table
from spn_data.telemetry.read import read_telemetry
from spn_data.telemetry.subtitles import read_subtitles
from spn_data.telemetry.track import Telemetry

# If the durations of a subtitle file and its video differ by more, they are of different flights.
_LENGTH_TOLERANCE_S = 5.0
_LENGTH_TOLERANCE = 0.1


def check_telemetry(source: Source, *, time_offset_s: float | None = None) -> None:
    """Raise InputError if a telemetry file does not fit its video in duration or time.

    This is checked before hours are spent on the video.
    """
    if source.kind is SourceKind.PHOTOS:
        return
    infos = [probe(part) for part in source.parts]
    durations_s = [info.duration_s for info in infos]
    if not np.isfinite(durations_s).all() or not source.telemetry:
        return
    starts_s = [0.0, *np.cumsum(durations_s)[:-1].tolist()]
    track = _video_telemetry(
        source, starts_s, durations_s, accept=False, offset_s=time_offset_s, embedded=False
    )
    if track is not None:
        frames = sum(info.frame_count for info in infos)
        time_s = np.linspace(0.0, sum(durations_s), max(frames, 2), endpoint=False)
        check_overlap(track, _video_clock(time_s, None, False, time_offset_s), _names(source))


def source_telemetry(
    source: Source,
    candidates: Candidates,
    *,
    any_telemetry: bool = False,
    time_offset_s: float | None = None,
) -> Telemetry | None:
    """Read the telemetry of a source.

    Parameters
    ----------
    source : Source
    candidates : Candidates
        Measured frames of the source.
    any_telemetry : bool
        Whether to accept telemetry that does not fit the images in duration, time or time zone.
    time_offset_s : float or None
        Time offset given by the user; it counts in the comparison, but is not applied.

    Returns
    -------
    Telemetry or None
        From the file next to each video part, else from its subtitle track, else from a data track in it; for
        photos from their metadata or a log. None if there is none.

    Raises
    ------
    InputError
        If a telemetry file cannot be read, or does not fit the images.
    """
    if source.kind is SourceKind.PHOTOS:
        return _photo_telemetry(source, candidates, any_telemetry, time_offset_s)
    measured = candidates.measured
    ends_s = [measured.time_s[measured.source_idx == k] for k in range(len(source.parts))]
    durations_s = [float(t[-1] - t[0]) if len(t) else 0.0 for t in ends_s]
    track = _video_telemetry(
        source,
        candidates.part_start_s,
        durations_s,
        accept=any_telemetry,
        offset_s=time_offset_s,
        embedded=True,
    )
    if track is None:
        return None
    clock = _video_clock(measured.time_s, None, any_telemetry, time_offset_s)
    return check_overlap(track, clock, _names(source))


def with_time_offset(track: Telemetry | None, offset_s: float | None) -> Telemetry | None:
    """Return telemetry with the user's time offset; the tags of a photo are its own and have none."""
    if track is None or track.kind == "exif":
        return track
    return track.shifted(offset_s or 0.0)


def _video_telemetry(
    source: Source,
    starts_s: Sequence[float],
    durations_s: Sequence[float],
    *,
    accept: bool,
    offset_s: float | None,
    embedded: bool,
) -> Telemetry | None:
    """Return the telemetry of all parts of a video on its clock, from files and, if asked, its own tracks."""
    parts = []
    failures: list[str] = []
    for part, start_s, duration_s in zip(source.parts, starts_s, durations_s, strict=True):
        files = [t for t in source.telemetry if t.stem.lower() == part.stem.lower()]
        # Prefer the subtitle file: it is on the clock of the video, a log is not.
        files.sort(
            key=lambda t: (t.suffix.lower() not in SUBTITLE_SUFFIXES, t.suffix.lower() != ".srt")
        )
        info = probe(part)
        track = None
        if files:
            track = read_telemetry(files[0])
            if files[0].suffix.lower() not in SUBTITLE_SUFFIXES:
                time_s = np.array([0.0, duration_s])
                clock = _video_clock(time_s, info, accept, offset_s)
                track = _on_video_clock(track, clock, files[0].name)
            elif not accept:
                _check_length(track, duration_s, files[0].name)
            unused = [file.name for file in files[1:]]
            unused += ["data tracks of the video"] if _telemetry_names(info) else []
            if unused:
                note = f"read from {files[0].name}; not used: {', '.join(unused)}"
                track = replace(track, notes=(*track.notes, note))
        elif embedded:
            track = _own_telemetry(part, info, failures)
        if track is not None:
            parts.append(track.shifted(start_s))
    if not parts:
        return None
    joined = Telemetry.concatenate(parts)
    return replace(joined, notes=(*joined.notes, *failures))


def _own_telemetry(part: Path, info: VideoInfo, failures: list[str]) -> Telemetry | None:
    """Return the telemetry of a video's subtitle track, else of its data tracks; note why one has none."""
    unusable: InputError | None = None
    if info.has_subtitles:
        try:
            track = read_subtitles(part)
        except InputError as error:
            unusable = error
        else:
            if track is not None:
                note = "read from its subtitle track"
                note += "; its data tracks are not used" if _telemetry_names(info) else ""
                return replace(track, notes=(*track.notes, note))
    try:
        track = read_embedded(part) if _telemetry_names(info) else None
    except InputError as error:
        failures.append(str(error))
        track = None
    if track is None and unusable is not None:
        raise unusable
    return track


def _video_clock(
    time_s: np.ndarray, info: VideoInfo | None, accept: bool, offset_s: float | None
) -> ImageClock:
    created = None if info is None else info.created_utc
    zero_utc_s = float("nan") if created is None else created.timestamp()
    return ImageClock(time_s, zero_utc_s, False, "the video", accept, offset_s)


def _names(source: Source) -> str:
    """Name the telemetry of a source in messages."""
    return ", ".join(path.name for path in source.telemetry) or source.parts[0].name


def _check_length(track: Telemetry, video_s: float, name: str) -> None:
    covered_s = float(track.time_s[-1] - track.time_s[0])
    if abs(covered_s - video_s) > max(_LENGTH_TOLERANCE_S, _LENGTH_TOLERANCE * video_s):
        raise InputError(
            f"its telemetry lasts {covered_s:.0f} s, but the video lasts {video_s:.0f} s: it may belong to "
            "another flight; remove it, or use --any-telemetry to accept it",
            path=name,
        )


def _on_video_clock(track: Telemetry, clock: ImageClock, name: str) -> Telemetry:
    """Return a log on the clock of the video, by its creation time if both have absolute times."""
    if not np.isfinite(clock.zero_utc_s) or not np.isfinite(track.utc_s).any():
        note = (
            "no common clock with the video; the log is assumed to start at the first video frame"
        )
        return replace(track, notes=(*track.notes, note))
    note = (
        "synchronised with the video by the creation time of the video, which some cameras write in local "
        "time or at the end of the recording"
    )
    return on_image_clock(replace(track, notes=(*track.notes, note)), clock, name)


def _photo_telemetry(
    source: Source, candidates: Candidates, accept: bool, offset_s: float | None
) -> Telemetry | None:
    own = candidates.photo_telemetry
    events = [path for path in source.telemetry if path.suffix.lower() == EVENTS_SUFFIX]
    if own is not None and events and accept:
        note = f"{', '.join(path.name for path in events)} is not used (--any-telemetry)"
        own = replace(own, notes=(*own.notes, note))
    elif own is not None and events:
        names = [path.name for path in source.parts]
        own = with_exposures(own, names, [read_mrk(path) for path in events])
    if own is not None and not accept:
        for path in source.telemetry:
            named = None if path in events else with_photo_table(own, source.parts, path)
            if named is not None:
                return named
    if own is not None and own.has_fix.any():
        return own
    for path in source.telemetry:
        if path in events:
            continue
        log = read_telemetry(path)
        if own is None or not _are_dated(own) or not np.isfinite(log.utc_s).any():
            if accept:
                continue
            what = (
                "it has no dates" if own is not None and _are_dated(own) else "they have no times"
            )
            raise InputError(
                f"cannot be paired with the photos, as {what}; remove it, or use --any-telemetry to go on "
                "without it",
                path=path.name,
            )
        known = np.isfinite(own.utc_s)
        clock = ImageClock(
            own.time_s[known],
            float(own.utc_s[known][0] - own.time_s[known][0]),
            own.utc_is_local,
            "the photos",
            accept,
            offset_s,
        )
        return check_overlap(on_image_clock(log, clock, path.name), clock, path.name)
    return own if own is not None and np.isfinite(own.gimbal_deg).any() else None


def _are_dated(photos: Telemetry) -> bool:
    """Return whether the times of photos are those of their clock, not only their numbers."""
    known = np.isfinite(photos.utc_s)
    zero_s = photos.utc_s[known] - photos.time_s[known]
    return bool(known.any() and np.allclose(zero_s, zero_s[0], rtol=0, atol=1e-3))


def _telemetry_names(info: VideoInfo) -> list[str]:
    """Return the names of a video's data tracks but time codes, of which cameras write one."""
    codes = ("timecode", "tcd", "tmcd")
    return [name for name in info.data_streams if not any(code in name.lower() for code in codes)]


def unread_tracks(source: Source) -> list[str]:
    """Return notes why the data tracks of a video without telemetry give none, and what to do."""
    if source.kind is SourceKind.PHOTOS:
        return []
    notes = []
    for part in source.parts:
        names = _telemetry_names(probe(part))
        try:
            if not names or read_embedded(part) is not None:
                continue
        except InputError as error:
            notes.append(f"{source.sequence}: {error}")
            continue
        notes.append(
            f"{source.sequence}: its data tracks ({', '.join(names)}) hold no telemetry in a known format "
            "(GPMF, CAMM, KLV); if they do, convert it to GPX or CSV"
        )
    return list(dict.fromkeys(notes))
