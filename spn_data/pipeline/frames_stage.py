"""Stage 1-frames: videos and photos with telemetry to chosen frames."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import CAMERAS, EVALUATION, FRAMES, FRAMES_TABLE, MASKS, TELEMETRY, TRACKED
from spn_data.capture.candidates import Candidates, analyse, build_frames
from spn_data.capture.extraction import ExtractionCost, check_space, estimate_cost, extract_chosen
from spn_data.capture.frames import Frames, read_frames, write_frames
from spn_data.capture.photo_selection import choose_photos
from spn_data.capture.photos import load_mask
from spn_data.capture.selection import (
    FrameChoice,
    SelectionOptions,
    check_usable,
    choose_all,
)
from spn_data.capture.sources import PHOTO_SUFFIXES, VIDEO_SUFFIXES, Source, SourceKind, discover
from spn_data.capture.video import probe
from spn_data.errors import InputError
from spn_data.geometry.camera_file import camera_to_json, read_camera
from spn_data.geometry.geodesy import metres_from_first_fix
from spn_data.inputs.flight_telemetry import check_telemetry, source_telemetry, unread_tracks
from spn_data.inputs.initial_cameras import start_cameras
from spn_data.inputs.source_fingerprints import fingerprints
from spn_data.storage.fingerprints import content_fingerprint
from spn_data.storage.json_files import read_json, write_json
from spn_data.storage.stage_record import StageRecord
from spn_data.telemetry.table import write_track
from spn_data.telemetry.track import Telemetry, TelemetrySummary, summarize
from spn_data.work.timing import Progress, Stopwatch

# Names beside the folders of the sequences.
_RESERVED = (TELEMETRY, MASKS, FRAMES_TABLE, CAMERAS, "stage.json", "started.json")


@dataclass(frozen=True, kw_only=True)
class FramesOptions:
    """How frames are made from sources."""

    selection: SelectionOptions = field(default_factory=SelectionOptions)
    # Horizontal field of view, and files of whole cameras (`camera_file`), by sequence; "*" for all.
    fov_deg: Mapping[str, float] = field(default_factory=dict)
    camera_files: Mapping[str, str] = field(default_factory=dict)
    mask: str | None = None  # an image, or a folder of <sequence>.png
    any_telemetry: bool = False  # also telemetry whose length does not fit the video's


@dataclass(frozen=True)
class Plan:
    """What lies before the user, ahead of any work."""

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
    """Sources of all inputs, with names that no two of them and none of the area to extend have.

    tested : the area whose evaluation sequences must stay out of the map, and keep their names.
    Sources whose every file is in the area to extend are ignored; InputError where there are no others, and
    for the file of an evaluation sequence.
    """
    sources: list[Source] = []
    ignored: list[tuple[Path, str]] = []
    names = set(_RESERVED)
    held: set[str] = set()
    if extended is not None:
        frames = read_frames(extended.folder(FRAMES) / FRAMES_TABLE)
        names |= {name.lower() for name in np.unique(frames.sequences).tolist()}
        held = set(extended.record(FRAMES).inputs.values())
    evaluated = {} if tested is None else _evaluated(tested)
    names |= {name.lower() for name in evaluated.values()}
    for path in inputs:
        found = discover(path)
        ignored += found.ignored
        for source in found.sources:
            prints = {part: content_fingerprint(part) for part in source.parts}
            for part, print_ in prints.items():
                if print_ in evaluated:
                    raise InputError(
                        f"is of the evaluation sequence {evaluated[print_]}, which would be no test of a "
                        "map that holds it; to map it all the same, remove its folders in "
                        f"{EVALUATION} and {TRACKED}",
                        path=part,
                    )
            known = [part for part, print_ in prints.items() if print_ in held]
            if len(known) == len(source.parts):
                ignored += [(part, "already in the area") for part in known]
                continue
            name, number = source.sequence, 2
            while name.lower() in names:
                name, number = f"{source.sequence}-{number}", number + 1
            names.add(name.lower())
            sources.append(replace(source, sequence=name))
    if not sources:
        raise InputError(
            "nothing to add: what it holds is already in the area",
            path=", ".join(str(path) for path in inputs),
        )
    return Plan(
        tuple(sources),
        tuple(ignored),
        estimate_cost(sources, target_count=options.selection.target_count),
    )


def _evaluated(area: Area) -> dict[str, str]:
    """Name of the evaluation sequence of each video or photo, by the file's fingerprint."""
    return {
        print_: name
        for name in area.sequences(EVALUATION)
        for file, print_ in area.record(f"{EVALUATION}/{name}").inputs.items()
        if Path(file).suffix.lower() in VIDEO_SUFFIXES | PHOTO_SUFFIXES
    }


def masks_of(sources: tuple[Source, ...], given: str | None) -> dict[str, Path]:
    """The mask of each sequence that has one. InputError where a folder of masks has none of them."""
    if given is None:
        return {}
    path = Path(given)
    if not path.is_dir():
        return {source.sequence: path for source in sources}
    files = {source.sequence: path / f"{source.sequence}.png" for source in sources}
    found = {name: file for name, file in files.items() if file.exists()}
    if not found:
        raise InputError(
            f"holds no mask: none of {', '.join(f.name for f in files.values())}", path=path
        )
    return found


def choose_frames(
    area: Area,
    found: Plan,
    options: FramesOptions,
    progress: Progress,
    *,
    extend: Area | None = None,
    overwrite: bool = False,
    tell: Callable[[str, TelemetrySummary | None], None] = lambda *_: None,
) -> StageRecord:
    """Choose and write frames of the sources; `tell` hears each source's telemetry as it is read.

    extend : the area whose frames are kept and come first.
    """
    masks = masks_of(found.sources, options.mask)
    inputs = fingerprints(found.sources, masks)
    if extend is not None:
        inputs = {**extend.record(FRAMES).inputs, **inputs}
    for source in found.sources:
        if not options.any_telemetry:
            check_telemetry(source)
        if source.sequence in masks:
            _check_mask(masks[source.sequence], source)
    # Masks and cameras count by their content, wherever they lie.
    given = {name: read_camera(Path(path)) for name, path in options.camera_files.items()}
    made_with = asdict(replace(options, mask=None, camera_files={}))
    made_with["cameras"] = {name: camera_to_json(camera) for name, camera in given.items()}
    work = area.begin(FRAMES, made_with, inputs, overwrite=overwrite)
    if isinstance(work, StageRecord):
        return work
    check_space(work.path, found.cost.disk_bytes)
    stopwatch = Stopwatch()
    notes: list[str] = []
    for name in (TELEMETRY, MASKS, ".analysis"):
        (work.path / name).mkdir(exist_ok=True)
    cameras: dict[str, dict[str, object]] = {}
    kept: list[Frames] = []
    if extend is not None:
        kept, cameras = _take_over(extend, work.path)
    candidates, tracks = [], []
    for source in found.sources:
        with stopwatch.step("analysis"):
            measured = _analyse(source, work.path / ".analysis", found.cost, progress)
        track = source_telemetry(source, measured, any_telemetry=options.any_telemetry)
        check_usable(measured.measured, options.selection, source.parts[0].name)
        tell(source.sequence, None if track is None else summarize(track))
        notes += measured.notes
        notes += [] if track is not None else unread_tracks(source)
        candidates.append(measured)
        tracks.append(track)
    _check_some_fit(candidates)
    choices = _choose(candidates, tracks, options.selection)
    parts = []
    done_before = 0
    total = sum(int(choice.chosen.sum()) for choice in choices)
    for one, track, choice in zip(candidates, tracks, choices, strict=True):
        zoom = None if track is None else track.at(one.measured.time_s).zoom
        frames = build_frames(one, choice, focal=zoom)
        if track is not None:
            frames = frames.with_telemetry(track.at(frames.time_s))
            write_track(work.path / TELEMETRY / f"{one.source.sequence}.csv", track)
        cameras.update(start_cameras(frames, one.photos, options.fov_deg, given))
        if one.source.sequence in masks:
            _write_mask(masks[one.source.sequence], frames, work.path / MASKS)
        elif masks:
            notes.append(f"{one.source.sequence}: no mask of that name")
        with stopwatch.step("frames"):
            extract_chosen(
                one.source,
                frames,
                work.path / one.source.sequence,
                progress=lambda n, before=done_before: progress("frames", before + n, total),  # type: ignore[misc]
            )
        done_before += int(choice.chosen.sum())
        parts.append(frames)
    frames = Frames.concatenate([*kept, *parts])
    write_frames(work.path / FRAMES_TABLE, frames)
    write_json(work.path / CAMERAS, {"version": 1, "cameras": cameras})
    return work.finish(
        counts={
            "candidates": len(frames),
            "chosen": int(frames.chosen.sum()),
            "sequences": len(np.unique(frames.sequences)),
            "with_fix": int((frames.has_fix & frames.chosen).sum()),
            "unreadable": int((frames.status == "unreadable").sum()),
        },
        seconds=stopwatch.seconds,
        cpu_seconds=stopwatch.cpu_seconds,
        notes=tuple(notes),
    )


def _take_over(extend: Area, target: Path) -> tuple[list[Frames], dict[str, dict[str, object]]]:
    """The frames of an area, linked rather than copied where the disk allows."""
    folder = extend.folder(FRAMES)
    frames = read_frames(folder / FRAMES_TABLE)
    chosen = [folder / name for name in frames.names[frames.chosen].tolist()]
    others = [*(folder / TELEMETRY).glob("*.csv"), *(folder / MASKS).glob("*.png")]
    for path in [*chosen, *others]:
        link = target / path.relative_to(folder)
        link.parent.mkdir(exist_ok=True)
        if not link.exists():
            try:
                os.link(path, link)
            except OSError:  # a disk without hard links
                copy = link.with_name(f"{link.name}.part")
                shutil.copy2(path, copy)
                copy.replace(link)
    return [frames], dict(read_json(folder / CAMERAS)["cameras"])


def _analyse(source: Source, folder: Path, cost: ExtractionCost, progress: Progress) -> Candidates:
    """Measurements of a source; those of videos are kept, so that an interrupted run has them."""
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


def _check_some_fit(candidates: list[Candidates]) -> None:
    if sum(int(one.measured.readable.sum()) for one in candidates) < 3:
        raise InputError("fewer than three images can be read, a model needs more")


def _check_mask(path: Path, source: Source) -> None:
    """Raises InputError where the mask does not fit, before hours are spent on the video."""
    if source.kind is SourceKind.VIDEO:
        info = probe(source.parts[0])
        load_mask(path, info.width, info.height)


def _write_mask(path: Path, frames: Frames, folder: Path) -> None:
    """The source's mask at its size."""
    row = int(np.flatnonzero(frames.width > 0)[0])
    usable = load_mask(path, int(frames.width[row]), int(frames.height[row]))
    ok, data = cv2.imencode(".png", usable.astype(np.uint8) * 255)
    assert ok
    (folder / f"{frames.sequences[0]}.png").write_bytes(data.tobytes())
