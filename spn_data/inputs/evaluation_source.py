"""Source of an evaluation sequence: sampled frames, telemetry, and the initial camera."""

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
from spn_data.geometry.initial_lens import InitialLens
from spn_data.inputs.flight_telemetry import source_telemetry, with_time_offset
from spn_data.inputs.frame_images import STORED
from spn_data.inputs.initial_cameras import start_lenses
from spn_data.inputs.source_fingerprints import fingerprints
from spn_data.split.groups import GROUPS
from spn_data.telemetry.table import write_track
from spn_data.telemetry.track import Telemetry
from spn_data.work.timing import Progress


@dataclass(frozen=True, eq=False)
class SampledSequence:
    """Frames sampled from a video or folder of photos.

    Attributes
    ----------
    frames : Frames
        All candidate frames; the sampled ones have status "chosen".
    track : Telemetry or None
    lens : InitialLens
    notes : list of str
        One sentence each.
    """

    frames: Frames
    track: Telemetry | None
    lens: InitialLens
    notes: list[str]


def find_source(area: Area, video: Path, name: str | None) -> Source:
    """Find the one sequence in `video`, which becomes an evaluation sequence.

    Parameters
    ----------
    area : Area
    video : Path
        A video, or a folder with the parts of one video or the photos of one flight.
    name : str or None
        Name of the sequence; None: the name of the source.

    Returns
    -------
    Source

    Raises
    ------
    InputError
        If there are several sequences, the name is invalid or used by a mapping sequence or a group of the
        split, or a file is part of the map.
    """
    found = discover(video).sources
    if len(found) != 1:
        names = ", ".join(source.sequence for source in found[:6])
        raise InputError(
            f"contains {len(found)} sequences ({names}); register them one at a time", path=video
        )
    (source,) = found
    if name is not None and safe_name(name) != name:
        raise InputError(
            f"{name!r} is not a valid sequence name; use letters, digits, dot, dash and underscore"
        )
    source = replace(source, sequence=name or source.sequence)
    if source.sequence in GROUPS:
        raise InputError(
            f"a sequence may not be called {source.sequence!r}, which is a group of the split; "
            "choose another --name"
        )
    record = area.record(FRAMES)
    mapped = {file.split("/", 1)[0] for file in record.inputs}
    if source.sequence.lower() in {sequence.lower() for sequence in mapped}:
        raise InputError(
            f"{source.sequence} is the name of a mapping sequence; choose another --name"
        )
    mapped_files = set(record.inputs.values())
    for part, fingerprint in zip(
        source.parts, fingerprints((replace(source, telemetry=()),), {}).values(), strict=True
    ):
        if fingerprint in mapped_files:
            raise InputError(
                "is part of the map, so its labels would not be an independent test", path=part
            )
    return source


def sample_frames(
    folder: Path,
    source: Source,
    given: Camera | None,
    progress: Progress,
    *,
    rate_hz: float,
    fov_deg: float | None,
    fixed_lens: bool,
    any_telemetry: bool,
    time_offset_s: float | None,
) -> SampledSequence:
    """Sample frames of a sequence and write them as images, with its telemetry and frame table.

    Parameters
    ----------
    folder : Path
        Folder of the stage in progress.
    source : Source
    given : Camera or None
        Calibrated camera, if known.
    progress : Progress
    rate_hz : float
        Frames per second to sample from a video; all photos are used.
    fov_deg : float or None
        Horizontal field of view, if known.
    fixed_lens : bool
        Whether to hold the lens that is given.
    any_telemetry : bool
        Whether to accept telemetry whose duration does not match the video.
    time_offset_s : float or None
        Seconds to add to the times of the telemetry, if the user gave them.

    Returns
    -------
    SampledSequence

    Raises
    ------
    InputError
        If the frames have several cameras or focal lengths, or no image can be read.
    """
    (folder / ".analysis").mkdir(exist_ok=True)
    expected = estimate_cost([source]).candidates
    candidates = analyse(
        source,
        cache=folder / ".analysis" / "measured.npz",
        progress=lambda done: progress("analysis", done, max(done, expected)),
    )
    measured = candidates.measured
    sampled = _sampled(measured.time_s, measured.readable, source, rate_hz)
    status = np.where(sampled, FrameStatus.CHOSEN.value, FrameStatus.SKIPPED.value)
    status[~measured.readable] = FrameStatus.UNREADABLE.value
    reason = np.where(
        sampled, "chosen: at the requested rate", "skipped: between two sampled frames"
    )
    reason = np.where(measured.readable, reason, measured.problem)
    choice = FrameChoice(status, reason, np.full(len(status), np.nan))
    track = with_time_offset(
        source_telemetry(
            source, candidates, any_telemetry=any_telemetry, time_offset_s=time_offset_s
        ),
        time_offset_s,
    )
    zoom = None if track is None else track.at(measured.time_s).zoom
    frames = build_frames(candidates, choice, focal=zoom)
    if track is not None:
        frames = frames.with_telemetry(track.at(frames.time_s))
        write_track(folder / TRACK, track)
    keys = np.unique(frames.cameras[frames.chosen]).tolist()
    if len(keys) != 1:
        raise InputError(
            f"was taken with {len(keys)} lenses or focal lengths; register each part separately",
            path=source.parts[0].parent,
        )
    fov = {} if fov_deg is None else {"*": fov_deg}
    cameras = {} if given is None else {"*": given}
    lenses, notes = start_lenses(frames, candidates.photos, fov, cameras, fixed=fixed_lens)
    # There is only one lens; its key is the name of the sequence.
    frames = replace(frames, cameras=frames.sequences)
    write_frames(folder / FRAMES_TABLE, frames)
    extract_chosen(
        source,
        frames,
        folder / STORED / source.sequence,
        progress=lambda done: progress("frames", done, int(frames.chosen.sum())),
    )
    return SampledSequence(frames, track, lenses[keys[0]], [*candidates.notes, *notes])


def _sampled(
    time_s: np.ndarray, readable: np.ndarray, source: Source, rate_hz: float
) -> np.ndarray:
    """Return (N,) bool: all readable photos, or the first readable frame of each interval of a video."""
    if source.kind is SourceKind.PHOTOS:
        return readable.copy()
    interval = np.floor(time_s * rate_hz + 1e-6).astype(np.int64)
    rows = np.flatnonzero(readable)
    _, first = np.unique(interval[rows], return_index=True)
    sampled = np.zeros(len(time_s), bool)
    sampled[rows[first]] = True
    return sampled
