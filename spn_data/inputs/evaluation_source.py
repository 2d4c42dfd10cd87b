"""What a sequence is registered from: its frames as images, telemetry, the lens to start from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import FRAMES, FRAMES_TABLE, TRACK
from spn_data.capture.candidates import analyse, build_frames
from spn_data.capture.extraction import estimate_cost, extract_chosen
from spn_data.capture.frames import Frames, FrameStatus, write_frames
from spn_data.capture.selection import FrameChoice
from spn_data.capture.sources import Source, SourceKind, discover, safe_name
from spn_data.errors import InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_from_json
from spn_data.inputs.flight_telemetry import telemetry_of
from spn_data.inputs.frame_images import STORED
from spn_data.inputs.initial_cameras import start_cameras
from spn_data.inputs.source_fingerprints import fingerprints
from spn_data.split.groups import GROUPS
from spn_data.telemetry.table import write_track
from spn_data.telemetry.track import Telemetry
from spn_data.work.timing import Progress


@dataclass(frozen=True, eq=False)
class Taken:
    """frames : all candidates; track : telemetry, if any; start : lens to begin with, and whether its focal
    length is known; notes : one sentence each.
    """

    frames: Frames
    track: Telemetry | None
    start: tuple[Camera, bool]
    notes: list[str]


def find_source(area: Area, video: Path, name: str | None) -> Source:
    """The one sequence of `video`, under its new name."""
    found = discover(video).sources
    if len(found) != 1:
        names = ", ".join(source.sequence for source in found[:6])
        raise InputError(
            f"holds {len(found)} sequences ({names}); register them one at a time", path=video
        )
    (source,) = found
    if name is not None and safe_name(name) != name:
        raise InputError(
            f"{name!r} cannot name a folder; use letters, digits, dot, dash and underscore"
        )
    source = replace(source, sequence=name or source.sequence)
    if source.sequence in GROUPS:
        raise InputError(
            f"a sequence may not be called {source.sequence!r}: that is a group of the split; "
            "give another one as --name"
        )
    record = area.record(FRAMES)
    mapped = {file.split("/", 1)[0] for file in record.inputs}
    if source.sequence.lower() in {sequence.lower() for sequence in mapped}:
        raise InputError(
            f"{source.sequence} is the name of a mapping sequence; give another one as --name"
        )
    prints = set(record.inputs.values())
    for part, print_ in zip(
        source.parts, fingerprints((replace(source, telemetry=()),), {}).values(), strict=True
    ):
        if print_ in prints:
            raise InputError(
                "is part of the map: labels of it would be no independent test", path=part
            )
    return source


def take_frames(
    folder: Path,
    source: Source,
    given: Camera | None,
    progress: Progress,
    *,
    rate_hz: float,
    fov_deg: float | None,
    any_telemetry: bool,
) -> Taken:
    """All candidate frames, those taken written as images; telemetry; the lens to start from."""
    (folder / ".analysis").mkdir(exist_ok=True)
    expected = estimate_cost([source]).candidates
    candidates = analyse(
        source,
        cache=folder / ".analysis" / "measured.npz",
        progress=lambda done: progress("analysis", done, max(done, expected)),
    )
    measured = candidates.measured
    taken = _taken(measured.time_s, measured.readable, source, rate_hz)
    status = np.where(taken, FrameStatus.CHOSEN.value, FrameStatus.SKIPPED.value)
    status[~measured.readable] = FrameStatus.UNREADABLE.value
    reason = np.where(taken, "chosen: at the rate asked for", "skipped: between two that are taken")
    reason = np.where(measured.readable, reason, measured.problem)
    choice = FrameChoice(status, reason, np.full(len(status), np.nan))
    track = telemetry_of(source, candidates, any_telemetry=any_telemetry)
    zoom = None if track is None else track.at(measured.time_s).zoom
    frames = build_frames(candidates, choice, focal=zoom)
    if track is not None:
        frames = frames.with_telemetry(track.at(frames.time_s))
        write_track(folder / TRACK, track)
    keys = np.unique(frames.cameras[frames.chosen]).tolist()
    if len(keys) != 1:
        raise InputError(
            f"is taken with {len(keys)} lenses or focal lengths: register each part by itself",
            path=source.parts[0].parent,
        )
    fov = {} if fov_deg is None else {"*": fov_deg}
    starts = start_cameras(frames, candidates.photos, fov, {} if given is None else {"*": given})
    # One lens, whatever the source calls it: its key is the sequence's name.
    frames = replace(frames, cameras=frames.sequences)
    write_frames(folder / FRAMES_TABLE, frames)
    extract_chosen(
        source,
        frames,
        folder / STORED / source.sequence,
        progress=lambda done: progress("frames", done, int(frames.chosen.sum())),
    )
    start = starts[keys[0]]
    return Taken(
        frames,
        track,
        (camera_from_json(start), bool(start["focal_is_known"])),
        list(candidates.notes),
    )


def _taken(time_s: np.ndarray, readable: np.ndarray, source: Source, rate_hz: float) -> np.ndarray:
    """(N,) bool: all photos; of a video the first readable frame of each interval, whatever it shows."""
    if source.kind is SourceKind.PHOTOS:
        return readable.copy()
    interval = np.floor(time_s * rate_hz + 1e-6).astype(np.int64)
    rows = np.flatnonzero(readable)
    _, first = np.unique(interval[rows], return_index=True)
    taken = np.zeros(len(time_s), bool)
    taken[rows[first]] = True
    return taken
