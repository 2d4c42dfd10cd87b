"""Stage 1-frames: frames chosen from videos and photos, with telemetry."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import CAMERAS, EVALUATION, FRAMES, FRAMES_TABLE, MASKS, TELEMETRY, TRACKED
from spn_data.capture.candidates import Candidates, analyse, build_frames
from spn_data.capture.extraction import ExtractionCost, check_space, estimate_cost, extract_chosen
from spn_data.capture.frames import Frames, read_frames, write_frames
from spn_data.capture.photo_selection import choose_photos
from spn_data.capture.selection import (
    FrameChoice,
    SelectionOptions,
    check_usable,
    choose_all,
)
from spn_data.capture.sources import PHOTO_SUFFIXES, VIDEO_SUFFIXES, Source, SourceKind, discover
from spn_data.errors import InputError
from spn_data.geometry.camera_file import camera_to_json, read_camera
from spn_data.geometry.geodesy import metres_from_first_fix
from spn_data.geometry.initial_lens import InitialLens
from spn_data.inputs.file_links import link_or_copy
from spn_data.inputs.flight_telemetry import (
    check_telemetry,
    source_telemetry,
    unread_tracks,
    with_time_offset,
)
from spn_data.inputs.initial_cameras import start_lenses
from spn_data.inputs.lens_file import read_lenses, write_lenses
from spn_data.inputs.sequence_masks import check_mask, find_masks, write_mask
from spn_data.inputs.source_fingerprints import fingerprints
from spn_data.storage.fingerprints import content_fingerprint
from spn_data.storage.stage_record import StageRecord
from spn_data.telemetry.table import write_track
from spn_data.telemetry.track import Telemetry, TelemetrySummary, summarize
from spn_data.work.timing import Progress, Stopwatch

# Names in the stage folder that are not sequences.
_RESERVED = (TELEMETRY, MASKS, FRAMES_TABLE, CAMERAS, "stage.json", "started.json")


@dataclass(frozen=True, kw_only=True)
class FramesOptions:
    """Options of the selection of frames.

    Attributes
    ----------
    selection : SelectionOptions
    fov_deg : mapping of str to float
        Horizontal field of view by sequence; "*" for all.
    camera_files : mapping of str to str
        Files of calibrated cameras (`camera_file`) by sequence; "*" for all.
    fixed_lens : bool
        Hold the focal lengths that are given or stated by metadata, and given cameras wholly.
    mask : str or None
        An image, or a folder of `<sequence>.png`.
    any_telemetry : bool
        Whether to accept telemetry whose duration does not match the video.
    """

    selection: SelectionOptions = field(default_factory=SelectionOptions)
    fov_deg: Mapping[str, float] = field(default_factory=dict)
    camera_files: Mapping[str, str] = field(default_factory=dict)
    mask: str | None = None
    fixed_lens: bool = False
    any_telemetry: bool = False


@dataclass(frozen=True)
class Plan:
    """Sources of an area and their expected cost, before any work.

    Attributes
    ----------
    sources : tuple of Source
    ignored : tuple of (Path, str)
        Files that are not used, with the reason.
    cost : ExtractionCost
    """

    sources: tuple[Source, ...]
    ignored: tuple[tuple[Path, str], ...]
    cost: ExtractionCost


def plan(
    inputs: list[Path],
    options: FramesOptions,
    *,
    extended: Area | None = None,
    tested: Area | None = None,
) -> Plan:
    """Find the sources of all inputs, and give each sequence a unique name.

    Parameters
    ----------
    inputs : list of Path
        Videos, or folders with videos or photos.
    options : FramesOptions
    extended : Area or None
        Area to extend. Sources whose files are all in it are ignored, and its names are not used again; the
        plan may then be without sources.
    tested : Area or None
        Area whose evaluation sequences must not become part of the map, and keep their names.

    Returns
    -------
    Plan

    Raises
    ------
    InputError
        If a file belongs to an evaluation sequence.
    """
    sources: list[Source] = []
    ignored: list[tuple[Path, str]] = []
    names = set(_RESERVED)
    mapped_files: set[str] = set()
    if extended is not None:
        frames = read_frames(extended.folder(FRAMES) / FRAMES_TABLE)
        names |= {name.lower() for name in np.unique(frames.sequences).tolist()}
        mapped_files = set(extended.record(FRAMES).inputs.values())
    evaluated = {} if tested is None else _evaluation_files(tested)
    names |= {name.lower() for name in evaluated.values()}
    for path in inputs:
        found = discover(path)
        ignored += found.ignored
        for source in found.sources:
            prints = {part: content_fingerprint(part) for part in source.parts}
            for part, fingerprint in prints.items():
                if fingerprint in evaluated:
                    raise InputError(
                        f"belongs to the evaluation sequence {evaluated[fingerprint]}, which would not be an "
                        "independent test of a map that contains it; to map it anyway, remove its folders in "
                        f"{EVALUATION} and {TRACKED}",
                        path=part,
                    )
            known = [part for part, fingerprint in prints.items() if fingerprint in mapped_files]
            if len(known) == len(source.parts):
                ignored += [(part, "already in the area") for part in known]
                continue
            name, number = source.sequence, 2
            while name.lower() in names:
                name, number = f"{source.sequence}-{number}", number + 1
            names.add(name.lower())
            sources.append(replace(source, sequence=name))
    return Plan(
        tuple(sources),
        tuple(ignored),
        estimate_cost(sources, target_count=options.selection.target_count),
    )


def _evaluation_files(area: Area) -> dict[str, str]:
    """Return the evaluation sequence of each video or photo, by the fingerprint of the file."""
    return {
        fingerprint: name
        for name in area.sequences(EVALUATION)
        for file, fingerprint in area.record(f"{EVALUATION}/{name}").inputs.items()
        if Path(file).suffix.lower() in VIDEO_SUFFIXES | PHOTO_SUFFIXES
    }


def choose_frames(
    area: Area,
    found: Plan,
    options: FramesOptions,
    progress: Progress,
    *,
    extend: Area | None = None,
    overwrite: bool = False,
    time_offset_s: Mapping[str, float] | None = None,
    on_telemetry: Callable[[str, TelemetrySummary | None], None] = lambda *_: None,
) -> StageRecord:
    """Select frames of the sources and write them as images.

    Parameters
    ----------
    area : Area
    found : Plan
    options : FramesOptions
    progress : Progress
    extend : Area or None
        Area whose frames are kept and come first.
    overwrite : bool
        Whether frames of other sources or options may be replaced.
    time_offset_s : mapping of str to float, optional
        Added to the times of the telemetry, by sequence ("*" for all). The stored tracks are without it.
    on_telemetry : callable
        Called with the name of each sequence and the summary of its telemetry, as soon as it is read.

    Returns
    -------
    StageRecord

    Raises
    ------
    InputError
        If masks, telemetry or cameras do not fit the sources, or too few frames are usable.
    StageError
        If there is not enough disk space.
    """
    masks = find_masks(found.sources, options.mask)
    inputs = fingerprints(found.sources, masks)
    if extend is not None:
        inputs = {**extend.record(FRAMES).inputs, **inputs}
    offsets_s = {s.sequence: _offset(time_offset_s, s.sequence) for s in found.sources}
    _check_sources(found.sources, masks, options, offsets_s)
    # Masks and cameras are identified by their content, not by their path.
    given = {name: read_camera(Path(path)) for name, path in options.camera_files.items()}
    made_with = asdict(replace(options, mask=None, camera_files={}))
    if not options.fixed_lens:
        del made_with["fixed_lens"]  # unknown to earlier versions, whose results are equal
    made_with["cameras"] = {name: camera_to_json(camera) for name, camera in given.items()}
    work = area.begin(FRAMES, made_with, inputs, overwrite=overwrite)
    if isinstance(work, StageRecord):
        return work
    check_space(work.path, found.cost.disk_bytes)
    stopwatch = Stopwatch()
    for name in (TELEMETRY, MASKS, ".analysis"):
        (work.path / name).mkdir(exist_ok=True)
    lenses: dict[str, InitialLens] = {}
    parts: list[Frames] = []
    if extend is not None:
        parts, lenses = _reuse_frames(extend, work.path)
    candidates, tracks, notes = _measure(
        found, work.path / ".analysis", options, progress, stopwatch, on_telemetry, offsets_s
    )
    shifted = [
        with_time_offset(track, offsets_s[source.sequence])
        for track, source in zip(tracks, found.sources, strict=True)
    ]
    choices = _choose(candidates, shifted, options.selection)
    done_before = 0
    total = sum(int(choice.chosen.sum()) for choice in choices)
    for one, track, stored, choice in zip(candidates, shifted, tracks, choices, strict=True):
        frames = _frames_with_telemetry(one, track, choice)
        if stored is not None:
            write_track(work.path / TELEMETRY / f"{one.source.sequence}.csv", stored)
        own, doubts = start_lenses(
            frames, one.photos, options.fov_deg, given, track, fixed=options.fixed_lens
        )
        lenses, notes = lenses | own, notes + doubts
        if one.source.sequence in masks:
            write_mask(masks[one.source.sequence], frames, work.path / MASKS)
        elif masks:
            notes.append(f"{one.source.sequence}: no mask with this name")
        with stopwatch.step("frames"):
            extract_chosen(
                one.source,
                frames,
                work.path / one.source.sequence,
                progress=lambda n, before=done_before: progress("frames", before + n, total),  # type: ignore[misc]
            )
        done_before += int(choice.chosen.sum())
        parts.append(frames)
    frames = Frames.concatenate(parts)
    write_frames(work.path / FRAMES_TABLE, frames)
    write_lenses(work.path, lenses)
    return work.finish(
        counts=_counts(frames),
        seconds=stopwatch.seconds,
        cpu_seconds=stopwatch.cpu_seconds,
        notes=tuple(notes),
    )


def _check_sources(
    sources: tuple[Source, ...],
    masks: Mapping[str, Path],
    options: FramesOptions,
    offsets_s: Mapping[str, float | None],
) -> None:
    """Raise InputError if telemetry or masks do not fit, before hours are spent on the videos."""
    for source in sources:
        if not options.any_telemetry:
            check_telemetry(source, time_offset_s=offsets_s[source.sequence])
        if source.sequence in masks:
            check_mask(masks[source.sequence], source)


def _measure(
    found: Plan,
    cache: Path,
    options: FramesOptions,
    progress: Progress,
    stopwatch: Stopwatch,
    on_telemetry: Callable[[str, TelemetrySummary | None], None],
    offsets_s: Mapping[str, float | None],
) -> tuple[list[Candidates], list[Telemetry | None], list[str]]:
    """Measure the candidate frames of each source and read its telemetry; return both with notes."""
    candidates: list[Candidates] = []
    tracks: list[Telemetry | None] = []
    notes: list[str] = []
    for source in found.sources:
        with stopwatch.step("analysis"):
            measured = _analyse(source, cache, found.cost, progress)
        offset_s = offsets_s[source.sequence]
        track = source_telemetry(
            source, measured, any_telemetry=options.any_telemetry, time_offset_s=offset_s
        )
        check_usable(measured.measured, options.selection, source.parts[0].name)
        on_telemetry(source.sequence, None if track is None else summarize(track))
        notes += measured.notes
        notes += [] if track is not None else unread_tracks(source)
        candidates.append(measured)
        tracks.append(track)
    _check_enough_readable(candidates)
    return candidates, tracks, notes


def _offset(time_offset_s: Mapping[str, float] | None, sequence: str) -> float | None:
    """Return the time offset that the user gave for a sequence, or for all."""
    given = time_offset_s or {}
    return given.get(sequence, given.get("*"))


def _frames_with_telemetry(
    candidates: Candidates, track: Telemetry | None, choice: FrameChoice
) -> Frames:
    """Build the frame table of a source."""
    zoom = None if track is None else track.at(candidates.measured.time_s).zoom
    frames = build_frames(candidates, choice, focal=zoom)
    return frames if track is None else frames.with_telemetry(track.at(frames.time_s))


def _counts(frames: Frames) -> dict[str, int]:
    return {
        "candidates": len(frames),
        "chosen": int(frames.chosen.sum()),
        "sequences": len(np.unique(frames.sequences)),
        "with_fix": int((frames.has_fix & frames.chosen).sum()),
        "unreadable": int((frames.status == "unreadable").sum()),
    }


def _reuse_frames(extend: Area, target: Path) -> tuple[list[Frames], dict[str, InitialLens]]:
    """Link the frames, telemetry and masks of an area; return its frame table and lenses."""
    folder = extend.folder(FRAMES)
    frames = read_frames(folder / FRAMES_TABLE)
    chosen = [folder / name for name in frames.names[frames.chosen].tolist()]
    others = [*(folder / TELEMETRY).glob("*.csv"), *(folder / MASKS).glob("*.png")]
    for path in [*chosen, *others]:
        link = target / path.relative_to(folder)
        link.parent.mkdir(exist_ok=True)
        if not link.exists():
            link_or_copy(path, link)
    return [frames], read_lenses(folder)


def _analyse(source: Source, folder: Path, cost: ExtractionCost, progress: Progress) -> Candidates:
    """Measure a source; measurements of videos are cached for a resumed run."""
    step = f"analysis {source.sequence}"
    total = cost.candidates if source.kind is SourceKind.VIDEO else len(source.parts)
    return analyse(
        source,
        cache=folder / f"{source.sequence}.npz",
        progress=lambda done: progress(step, done, max(done, total)),
    )


def _choose(
    candidates: list[Candidates], tracks: list[Telemetry | None], options: SelectionOptions
) -> list[FrameChoice]:
    positions = []
    for one, track in zip(candidates, tracks, strict=True):
        positions.append(None if track is None else _positions(track.at(one.measured.time_s)))
    videos = [k for k, one in enumerate(candidates) if one.source.kind is SourceKind.VIDEO]
    chosen = dict(
        zip(
            videos,
            choose_all([(candidates[k].measured, positions[k]) for k in videos], options),
            strict=True,
        )
    )
    return [
        chosen[k] if k in chosen else choose_photos(one.measured, options, position_m=positions[k])
        for k, one in enumerate(candidates)
    ]


def _positions(rows: Telemetry) -> np.ndarray:
    """Return (N, 3) metres east and north of the first fix and above take-off; NaN if unknown."""
    return np.column_stack([metres_from_first_fix(rows.lat_lon_deg), rows.rel_alt_m])


def _check_enough_readable(candidates: list[Candidates]) -> None:
    if sum(int(one.measured.readable.sum()) for one in candidates) < 3:
        raise InputError("fewer than three images can be read, too few for a model")
