"""Stage 4-tracked/<sequence>: poses of the video frames between the chosen ones."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import (
    CAMERA,
    EVALUATION,
    FRAMES,
    FRAMES_TABLE,
    MODEL,
    OBSERVATIONS,
    POSES,
    REGISTRATION,
    TRACKED,
)
from spn_data.capture.frames import Frames, read_frames
from spn_data.colmap.model import read_map
from spn_data.errors import FormatError, InputError, StageError
from spn_data.geometry.camera import Camera
from spn_data.inputs.area_labels import (
    LabelledArea,
    map_folder,
    read_labelled_area,
    read_world_from_model,
)
from spn_data.inputs.lens_file import map_lens_priors
from spn_data.inputs.source_videos import find_videos
from spn_data.labels.labels import LabelObservations, Labels, write_label_observations, write_labels
from spn_data.labels.map_hash import map_hash
from spn_data.labels.map_points import MapPoints
from spn_data.registration.adjustment import lens_parameters
from spn_data.registration.frame_covariance import (
    LensUncertainty,
    PointObservations,
    frame_covariances,
)
from spn_data.storage.json_files import DAMAGE, VERSION, read_json, write_json
from spn_data.storage.stage_record import StageRecord
from spn_data.tracking.label_video import track_frames
from spn_data.tracking.tracked_frames import TrackingOptions
from spn_data.uncertainty.map_covariance import MapCovariance, MapCovarianceOptions
from spn_data.work.timing import Progress, Stopwatch


def sequences_with_video(area: Area) -> list[str]:
    """Return mapping and evaluation sequences that are videos; raise StageError if there is no model."""
    area.record(MODEL)
    frames = read_frames(area.folder(FRAMES) / FRAMES_TABLE)
    names = np.unique(frames.sequences[frames.video_frame >= 0]).tolist()
    for name in area.sequences(EVALUATION):
        own = read_frames(area.folder(f"{EVALUATION}/{name}") / FRAMES_TABLE)
        names += [name] if (own.video_frame >= 0).any() else []
    return [str(name) for name in names]


def track_sequence(
    area: Area,
    sequence: str,
    progress: Progress,
    *,
    workers: int,
    options: TrackingOptions | None = None,
    video: Path | None = None,
    overwrite: bool = False,
) -> StageRecord:
    """Label the frames of a sequence that were not chosen, by tracking. The map is only read.

    Parameters
    ----------
    area : Area
    sequence : str
        A mapping or evaluation sequence.
    progress : Progress
    workers : int
        Number of processes.
    options : TrackingOptions or None
    video : Path or None
        Where to look first for the files of the video.
    overwrite : bool
        Whether labels with other options may be replaced.

    Returns
    -------
    StageRecord

    Raises
    ------
    InputError
        If the sequence is unknown.
    StageError
        If it is not a video, or its video is not found.
    """
    options = options or TrackingOptions()
    frames = _frames_of(area, sequence)
    work = area.begin(f"{TRACKED}/{sequence}", asdict(options), {}, overwrite=overwrite)
    if isinstance(work, StageRecord):
        return work
    stopwatch = Stopwatch()
    before = map_hash(area.folder(MODEL))
    videos = find_videos(area, sequence, video)
    labelled = read_labelled_area(area, mapping_covariance=False, tracked=False)
    known, seen_by_known = _known(labelled, sequence)
    with stopwatch.step("tracking"):
        labels, seen = track_frames(
            videos,
            frames,
            known,
            seen_by_known,
            labelled.cameras,
            labelled.points,
            options,
            workers=workers,
            progress=progress,
        )
    with stopwatch.step("covariance"):
        labels = _with_covariances(area, labelled, labels, seen, sequence)
    with stopwatch.step("write"):
        write_labels(work.path / POSES, labels)
        write_label_observations(work.path / OBSERVATIONS, seen)
        after = map_hash(area.folder(MODEL))
        if after != before:
            raise StageError(f"{area.root}: the map changed while {sequence} was labelled")
        write_json(
            work.path / REGISTRATION,
            {
                "version": VERSION,
                "world_from_model": read_world_from_model(area).to_json(),
                "map_before": before,
                "map_after": after,
            },
        )
    return work.finish(
        counts=_counts(labels, known),
        seconds=stopwatch.seconds,
        cpu_seconds=stopwatch.cpu_seconds,
    )


def _frames_of(area: Area, sequence: str) -> Frames:
    if area.has(f"{EVALUATION}/{sequence}"):
        frames = read_frames(area.folder(f"{EVALUATION}/{sequence}") / FRAMES_TABLE)
    else:
        frames = read_frames(area.folder(FRAMES) / FRAMES_TABLE)
        frames = frames.select(frames.sequences == sequence)
    if not len(frames):
        leftover = f"{TRACKED}/{sequence}"
        remedy = (
            f"; {leftover} is a leftover of it: remove that folder" if area.has(leftover) else ""
        )
        raise InputError(f"there is no sequence {sequence!r} in {area.root}{remedy}")
    return frames


def _known(labelled: LabelledArea, sequence: str) -> tuple[Labels, LabelObservations]:
    """Return the labels of the chosen frames, and the map points that they observe."""
    if sequence in labelled.evaluation:
        labels, seen = labelled.evaluation[sequence], labelled.evaluation_seen[sequence]
        rows = np.flatnonzero(~labels.tracked)
    else:
        labels, seen = labelled.mapping, labelled.mapping_seen
        rows = np.flatnonzero(labels.sequences == sequence)
    return labels.select(rows), seen.select(rows)


def _with_covariances(
    area: Area, labelled: LabelledArea, labels: Labels, seen: LabelObservations, sequence: str
) -> Labels:
    """Add covariances from the errors of measurements, map and lens to the labels."""
    scene, observations, points = read_map(map_folder(area))
    options = MapCovarianceOptions(lenses=map_lens_priors(area, scene))
    map_covariance = MapCovariance.of(scene, observations, options)
    covariance = np.full((len(labels), 6, 6), np.nan)
    registered = np.flatnonzero(labels.registered)
    for key in np.unique(labels.cameras[registered]).tolist():
        rows = registered[labels.cameras[registered] == key]
        camera = labelled.cameras[key]
        lens = (
            _own_lens(area, sequence, camera)
            if sequence in labelled.evaluation
            else LensUncertainty(camera_id=_camera_id(labelled, key, scene.names, scene.camera_ids))
        )
        frames = [_points_of(seen, row, points) for row in rows.tolist()]
        covariance[rows] = frame_covariances(
            labels.poses[rows], camera, frames, lens, map_covariance
        )
    return replace(labels, covariance=covariance)


def _points_of(seen: LabelObservations, row: int, points: MapPoints) -> PointObservations:
    point_ids, pixels = seen.of_frame(row)
    rows = points.rows_of(point_ids)
    return PointObservations(pixels, rows, points.xyz[rows])


def _camera_id(
    labelled: LabelledArea, key: str, names: tuple[str, ...], camera_ids: np.ndarray
) -> int:
    """Return the COLMAP id of a mapping camera."""
    names_of_key = set(labelled.mapping.names[labelled.mapping.cameras == key].tolist())
    return next(int(i) for name, i in zip(names, camera_ids, strict=True) if name in names_of_key)


def _own_lens(area: Area, sequence: str, camera: Camera) -> LensUncertainty:
    path = area.folder(f"{EVALUATION}/{sequence}") / CAMERA
    value = read_json(path)
    try:
        names = lens_parameters(camera)
        estimated = tuple(value["estimated"])  # empty if the lens was held fixed
        if estimated not in (names, ()):
            raise ValueError("its covariance is for other parameters")
        matrix = np.array(value["covariance"], np.float64).reshape((len(estimated),) * 2)
    except DAMAGE as error:
        raise FormatError(f"{path}: cannot be read ({error})") from error
    return LensUncertainty(covariance=matrix)


def _counts(labels: Labels, known: Labels) -> dict[str, Any]:
    registered = labels.registered
    reasons, counts = np.unique(labels.reason[~registered], return_counts=True)
    order = np.argsort(-counts)[:8]
    return {
        "frames": len(labels),
        "registered": int(registered.sum()),
        "failed": {str(reasons[k]): int(counts[k]) for k in order},
        "of_all": len(labels) + len(known),
        "registered_of_all": int(registered.sum() + known.registered.sum()),
    }
