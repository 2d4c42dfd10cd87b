"""Stage 4-eval/<name>: poses of an evaluation sequence in the frozen map."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.area import EVALUATION, FRAMES, GEO, MODEL, Area, Facts, StageWork
from spn_data.camera import Camera
from spn_data.camera_file import camera_from_json, camera_to_json, read_camera
from spn_data.candidates import analyse, frames_of
from spn_data.colmap.database import DatabaseImage, MapDatabase
from spn_data.correspondences import FramesToMap, extract_missing, match_missing
from spn_data.errors import InputError, StageError
from spn_data.extraction import estimate_cost, extract_chosen
from spn_data.frames import Frames, FrameStatus, write_frames
from spn_data.labels import Labels, LabelStatus, SeenPoints, write_labels, write_seen_points
from spn_data.map_covariance import MapCovariance
from spn_data.map_hash import map_hash
from spn_data.pairs import PairOptions, sequence_pairs
from spn_data.pipeline.cameras import start_cameras
from spn_data.pipeline.frames import fingerprints
from spn_data.pipeline.gnss_check import GnssCheck, check_gnss
from spn_data.pipeline.images import STORED
from spn_data.pipeline.labels import (
    CAMERA,
    POSES,
    REGISTRATION,
    SEEN,
    read_origin,
    read_world_from_model,
    similarity_to_json,
)
from spn_data.pipeline.telemetry import check_telemetry, telemetry_of
from spn_data.pose import Poses
from spn_data.record import VERSION, StageRecord, write_json
from spn_data.registration.checks import Evidence, Verdict, gather_evidence, judge
from spn_data.registration.covariance import SequenceCovariance, sequence_covariance
from spn_data.registration.frozen_map import FrozenMap
from spn_data.registration.lookup import look_up_missing
from spn_data.registration.options import RegisterOptions
from spn_data.registration.solution import Sequence, Solution, settle, without
from spn_data.registration.solve import solve
from spn_data.registration.tracks import find_tracks
from spn_data.selection import Choice
from spn_data.sources import Source, SourceKind, discover, safe_name
from spn_data.telemetry.table import write_track
from spn_data.telemetry.track import Telemetry
from spn_data.timing import Progress, Stopwatch

DATABASE, FRAMES_FILE, TRACK = "database.db", "frames.csv", "telemetry.csv"
_MATCHES = ".matches"


@dataclass(frozen=True, kw_only=True)
class RegisterStageOptions:
    """What decides the labels of a sequence."""

    register: RegisterOptions = field(default_factory=RegisterOptions)
    fov_deg: float | None = None  # horizontal field of view, where known
    camera_file: str | None = None  # a calibrated camera to start from
    any_telemetry: bool = False  # also telemetry whose length does not fit the video's


def register(
    area: Area,
    video: Path,
    name: str | None,
    options: RegisterStageOptions,
    progress: Progress,
    *,
    workers: int,
    overwrite: bool = False,
) -> StageRecord:
    """Register the frames of one video, or folder of photos, as an evaluation sequence.

    name : of the sequence; the source's own where None. The map is only read: its hash is taken before and
    after. Raises InputError where the source is part of the map, holds several sequences, or cannot be read.
    """
    source = _source(area, video, name)
    given = None if options.camera_file is None else read_camera(Path(options.camera_file))
    made_with = {**asdict(options), "camera_file": None if given is None else camera_to_json(given)}
    stage = f"{EVALUATION}/{source.sequence}"
    inputs = fingerprints((source,), {})
    work = area.begin(stage, made_with, inputs, overwrite=overwrite)
    if isinstance(work, StageRecord):
        return work
    place = str(video).encode(errors="backslashreplace").decode()
    record = _register(area, work, source, given, options, progress, workers)
    known = {**area.facts.evaluation, source.sequence: place}
    area.write_facts(Facts(sources=area.facts.sources, evaluation=known))
    return record


def _source(area: Area, video: Path, name: str | None) -> Source:
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


def _register(
    area: Area,
    work: StageWork,
    source: Source,
    given: Camera | None,
    options: RegisterStageOptions,
    progress: Progress,
    workers: int,
) -> StageRecord:
    stopwatch = Stopwatch()
    before = {stage: map_hash(area.folder(stage)) for stage in (MODEL, GEO) if area.has(stage)}
    with stopwatch.step("frames"):
        check_telemetry(source)
        frames, track, start, notes = _frames(work.path, source, given, options, progress)
    chosen = frames.select(frames.chosen)
    pixels, solution, evidence, verdict, covariance, seen = _solve(
        area, work.path, chosen, start, options.register, progress, workers, stopwatch
    )
    labels = _labels(chosen, solution, evidence, verdict, covariance, pixels)
    world_from_model = read_world_from_model(area)
    labels = labels.moved(world_from_model)
    with stopwatch.step("write"):
        write_labels(work.path / POSES, labels)
        write_seen_points(work.path / SEEN, seen)
        lens = {} if covariance is None else _lens_json(covariance)
        camera = {"version": VERSION, **camera_to_json(solution.camera), **lens}
        write_json(work.path / CAMERA, {**camera, "start": _start_json(start)})
        gnss = _gnss(area, labels, track)
        after = {stage: map_hash(area.folder(stage)) for stage in before}
        if after != before:
            raise StageError(f"{area.root}: the map changed while {source.sequence} was registered")
        write_json(
            work.path / REGISTRATION,
            {
                "version": VERSION,
                "world_from_model": similarity_to_json(world_from_model),
                "map_before": before[MODEL],
                "map_after": after[MODEL],
                "geo_before": before.get(GEO),
                "geo_after": after.get(GEO),
                "gnss": None if gnss is None else asdict(gnss),
                "sigma_px": None if covariance is None else covariance.sigma_px,
                "design_effect": None if covariance is None else covariance.design_effect,
            },
        )
    if gnss is not None:
        notes.append(gnss.tell())
    return work.finish(
        counts=_counts(labels, solution.camera, gnss),
        seconds=stopwatch.seconds,
        cpu_seconds=stopwatch.cpu_seconds,
        notes=tuple(notes),
    )


def _frames(
    folder: Path,
    source: Source,
    given: Camera | None,
    options: RegisterStageOptions,
    progress: Progress,
) -> tuple[Frames, Telemetry | None, tuple[Camera, bool], list[str]]:
    """All candidate frames, those taken written as images; telemetry; the lens to start from."""
    (folder / ".analysis").mkdir(exist_ok=True)
    expected = estimate_cost([source]).candidates
    candidates = analyse(
        source,
        cache=folder / ".analysis" / "measured.npz",
        progress=lambda done: progress("analysis", done, max(done, expected)),
    )
    measured = candidates.measured
    taken = _taken(measured.time_s, measured.readable, source, options.register.rate_hz)
    status = np.where(taken, FrameStatus.CHOSEN.value, FrameStatus.SKIPPED.value)
    status[~measured.readable] = FrameStatus.UNREADABLE.value
    reason = np.where(taken, "chosen: at the rate asked for", "skipped: between two that are taken")
    reason = np.where(measured.readable, reason, measured.problem)
    choice = Choice(status, reason, np.full(len(status), np.nan))
    track = telemetry_of(source, candidates, any_telemetry=options.any_telemetry)
    zoom = None if track is None else track.at(measured.time_s).zoom
    frames = frames_of(candidates, choice, focal=zoom)
    if track is not None:
        frames = frames.with_telemetry(track.at(frames.time_s))
        write_track(folder / TRACK, track)
    keys = np.unique(frames.cameras[frames.chosen]).tolist()
    if len(keys) != 1:
        raise InputError(
            f"is taken with {len(keys)} lenses or focal lengths: register each part by itself",
            path=source.parts[0],
        )
    fov = {} if options.fov_deg is None else {"*": options.fov_deg}
    starts = start_cameras(frames, candidates.photos, fov, {} if given is None else {"*": given})
    # One lens, whatever the source calls it: its key is the sequence's name.
    frames = replace(frames, cameras=frames.sequences)
    write_frames(folder / FRAMES_FILE, frames)
    extract_chosen(
        source,
        frames,
        folder / STORED / source.sequence,
        progress=lambda done: progress("frames", done, int(frames.chosen.sum())),
    )
    start = starts[keys[0]]
    return (
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


def _solve(
    area: Area,
    folder: Path,
    chosen: Frames,
    start: tuple[Camera, bool],
    options: RegisterOptions,
    progress: Progress,
    workers: int,
    stopwatch: Stopwatch,
) -> tuple[list[np.ndarray], Solution, Evidence, Verdict, SequenceCovariance | None, SeenPoints]:
    """Everything between images and labels, in the map's own gauge."""
    names = tuple(chosen.names.tolist())
    to_match = FramesToMap(
        folder=folder / STORED,
        names=names,
        sequences=chosen.sequences,
        cameras=chosen.cameras,
        positions_m=np.full((len(names), 3), np.nan),
        start_cameras={str(chosen.cameras[0]): start},
        masks={},
    )
    near = sorted(
        sequence_pairs(chosen.sequences, PairOptions(overlap=options.neighbors, far_steps=0))
    )
    with MapDatabase.open(folder / DATABASE) as database:
        database.add_images(
            [DatabaseImage(n, str(c)) for n, c in zip(names, chosen.cameras, strict=True)],
            to_match.start_cameras,
        )
        with stopwatch.step("features"):
            extract_missing(database, to_match, options.features, workers, progress)
        with stopwatch.step("neighbours"):
            match_missing(database, to_match, near, options.matching, workers, progress)
        map_database = area.folder(MODEL) / DATABASE
        with FrozenMap.open(area.folder(MODEL), map_database) as frozen:
            with stopwatch.step("map"):
                putative = look_up_missing(
                    names, database, frozen, folder / _MATCHES, options, workers, progress
                )
            scene, observations, points = frozen.scene, frozen.observations, frozen.points
        pixels = [
            database.read_features(name).keypoints[:, :2].astype(np.float64) for name in names
        ]
        pairs = {(i, j): database.read_inliers(names[i], names[j]) for i, j in near}
    progress("poses", 0, len(names))
    with stopwatch.step("poses"):
        tracks = find_tracks(pairs, [len(p) for p in pixels])
        sequence = Sequence(pixels, [putative[name] for name in names], tracks, points.xyz)
        solution = solve(sequence, *start, options)
        map_covariance = MapCovariance.of(scene, observations)
        _, covariances = _covariances(sequence, solution, map_covariance)
        evidence = gather_evidence(sequence, solution, covariances, pairs, options)
        verdict = judge(solution.posed, evidence, options.checks)
        solution = settle(sequence, without(solution, ~verdict.accepted), options)
        covariance, covariances = _covariances(sequence, solution, map_covariance)
    progress("poses", len(names), len(names))
    of_map = np.flatnonzero(solution.point_row >= 0)
    seen_pixels = sequence.pixels_of(solution.frame[of_map], solution.feature[of_map])
    seen = SeenPoints(solution.frame[of_map], points.ids[solution.point_row[of_map]], seen_pixels)
    if covariance is not None:
        covariance = replace(covariance, poses=covariances)
    return pixels, solution, evidence, verdict, covariance, seen


def _covariances(
    sequence: Sequence, solution: Solution, map_covariance: MapCovariance
) -> tuple[SequenceCovariance | None, np.ndarray]:
    """Of the posed frames; and (N, 6, 6) of all, NaN where there is no pose."""
    everything = np.full((len(solution.posed), 6, 6), np.nan)
    if not solution.posed.any():
        return None, everything
    state, observations = solution.least_squares(sequence)
    covariance = sequence_covariance(state, observations, solution.point_row, map_covariance)
    everything[solution.posed] = covariance.poses
    return covariance, everything


def _labels(
    chosen: Frames,
    solution: Solution,
    evidence: Evidence,
    verdict: Verdict,
    covariance: SequenceCovariance | None,
    pixels: list[np.ndarray],
) -> Labels:
    n = len(chosen)
    accepted = verdict.accepted
    error_px = np.full(n, np.nan)
    if covariance is not None:
        squared = (covariance.residuals_px**2).sum(axis=1)
        of_map = solution.point_row >= 0
        count = np.bincount(solution.frame[of_map], minlength=n)
        total = np.bincount(solution.frame[of_map], weights=squared[of_map], minlength=n)
        error_px = np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
    return Labels(
        names=chosen.names,
        sequences=chosen.sequences,
        cameras=chosen.cameras,
        sources=chosen.sources,
        video_frame=chosen.video_frame,
        dense=np.zeros(n, bool),
        time_s=chosen.time_s,
        status=np.where(accepted, LabelStatus.REGISTERED.value, LabelStatus.FAILED.value),
        reason=np.array(verdict.reason, dtype=np.str_),
        poses=Poses(
            np.where(accepted[:, None], solution.poses.centers, np.nan),
            np.where(accepted[:, None], solution.poses.quats_wxyz, np.nan),
        ),
        covariance=np.full((n, 6, 6), np.nan) if covariance is None else covariance.poses,
        inliers=evidence.inliers,
        coverage=evidence.coverage,
        error_px=np.where(accepted, error_px, np.nan),
    )


def _lens_json(covariance: SequenceCovariance) -> dict[str, Any]:
    return {"estimated": list(covariance.lens_names), "covariance": covariance.lens.tolist()}


def _start_json(start: tuple[Camera, bool]) -> dict[str, Any]:
    return {**camera_to_json(start[0]), "focal_is_known": start[1]}


def _gnss(area: Area, labels: Labels, track: Telemetry | None) -> GnssCheck | None:
    origin = read_origin(area)
    if origin is None or track is None or not track.has_fix.any():
        return None
    return check_gnss(labels, track, origin)


def _counts(labels: Labels, camera: Camera, gnss: GnssCheck | None) -> dict[str, Any]:
    registered = labels.registered
    reasons: dict[str, int] = {}
    for reason in labels.reason[~registered].tolist():
        kind = "ambiguous" if reason.startswith("ambiguous") else "too little agreement"
        reasons[kind] = reasons.get(kind, 0) + 1
    return {
        "frames": len(labels),
        "registered": int(registered.sum()),
        "failed": reasons,
        "focal_px": round(camera.focal_px[0], 3),
        "fov_deg": round(camera.horizontal_fov_deg, 3),
        "error_px": _median(labels.error_px[registered], 4),
        "inliers": _median(labels.inliers[registered], 0),
        "sigma": _median(
            np.sqrt(np.trace(labels.covariance[registered][:, :3, :3], axis1=1, axis2=2)), 6
        ),
        "sigma_deg": _median(
            np.rad2deg(
                np.sqrt(np.trace(labels.covariance[registered][:, 3:, 3:], axis1=1, axis2=2))
            ),
            6,
        ),
        "gnss": None if gnss is None else asdict(gnss),
    }


def _median(values: np.ndarray, digits: int) -> float | None:
    return round(float(np.median(values)), digits) if len(values) else None
