"""Stage 2-model: one COLMAP model of the chosen frames, in its own gauge."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np

from spn_data.area.area import Area, StageWork
from spn_data.area.names import (
    CAMERAS,
    DATABASE,
    FRAMES,
    FRAMES_TABLE,
    MASKS,
    MODEL,
    OBSERVATIONS,
    POSES,
)
from spn_data.capture.frames import Frames, read_frames
from spn_data.errors import FormatError
from spn_data.geometry.geodesy import GeoOrigin
from spn_data.inputs.lens_file import read_lenses
from spn_data.labels.labels import write_label_observations, write_labels
from spn_data.pipeline.geo_stage import GeoStageOptions
from spn_data.pipeline.gnss_witness import focal_lengths_by_gnss
from spn_data.reconstruction.attempts import ReconstructOptions
from spn_data.reconstruction.correspondences import FramesToMap
from spn_data.reconstruction.diagnosis import missing_passages
from spn_data.reconstruction.focal_trial import FocalTrial, focal_trials
from spn_data.reconstruction.mapping_labels import mapping_labels
from spn_data.reconstruction.reconstruct import ReconstructResult, reconstruct
from spn_data.reconstruction.refinement import RefinedModel
from spn_data.reconstruction.registration_file import write_registration
from spn_data.reconstruction.shutter import ShutterDiagnosis, diagnose_shutter
from spn_data.reconstruction.view_variety import viewing_distance
from spn_data.storage.stage_record import StageRecord, current_options
from spn_data.uncertainty.bundle_jacobians import estimated_names
from spn_data.uncertainty.map_covariance import MapCovariance
from spn_data.work.timing import Progress, Stopwatch


def build_model(
    area: Area,
    options: ReconstructOptions,
    progress: Progress,
    *,
    geo: GeoStageOptions | None = None,
    extend: Area | None = None,
    overwrite: bool = False,
) -> StageRecord:
    """Reconstruct one model from the chosen frames of an area.

    Parameters
    ----------
    area : Area
    options : ReconstructOptions
    progress : Progress
    geo : GeoStageOptions or None
        How fixes are used, which are compared with the focal lengths; None: the defaults.
    extend : Area or None
        Area whose features and matches are reused, if they were computed with the same options.
    overwrite : bool
        Whether a model with other options may be replaced.

    Returns
    -------
    StageRecord

    Raises
    ------
    StageError
        If too few frames can be registered.
    """
    made_of = {k: v for k, v in asdict(options).items() if k not in ("threads", "cluster")}
    work = area.begin(MODEL, made_of, {}, overwrite=overwrite)
    if isinstance(work, StageRecord):
        return work
    notes = () if extend is None else _reuse_features(extend, work)
    frames = read_frames(area.folder(FRAMES) / FRAMES_TABLE)
    chosen = frames.select(frames.chosen)
    stopwatch = Stopwatch()
    to_map = frames_to_map(area, chosen)
    result = reconstruct(to_map, work.path, options, progress, stopwatch)
    passages = missing_passages(result.registrations, chosen.sequences, chosen.time_s)
    shutters = _shutters(result, chosen, stopwatch)
    write_registration(work.path, result.registrations)
    distance = viewing_distance(result.refined.scene, result.refined.observations)
    with stopwatch.step("focal lengths"):
        trials = _trials(area, result.refined, to_map, distance, geo or GeoStageOptions(), progress)
    doubts = {i: trial.doubt_px for i, trial in trials.items()}
    covariance = result.refined.covariance
    covariance = None if covariance is None else covariance.with_focal_errors(doubts)
    _write_labels(work.path, result, chosen, covariance)
    _move_results(work.path, result)
    return work.finish(
        counts=_counts(result, trials, covariance, distance, shutters),
        seconds=stopwatch.seconds,
        cpu_seconds=stopwatch.cpu_seconds,
        notes=(
            *notes,
            *result.attempts,
            *passages,
            *_unlabelled(result),
            *(note for trial in trials.values() for note in trial.notes()),
            *(note for shutter in shutters if (note := shutter.describe())),
        ),
    )


def _reuse_features(extend: Area, work: StageWork) -> tuple[str, ...]:
    """Copy features and matches of an area; return a note if they were computed with other options."""
    before = current_options(extend.record(MODEL).options)
    now = current_options(work.record.options)
    for group in ("features", "matching"):
        for name, value in now[group].items():
            if before[group].get(name) != value:
                return (
                    "features and matches are recomputed: those of the area were computed with "
                    f"{name} = {before[group].get(name)!r}, now {value!r}",
                )
    if not (work.path / DATABASE).exists():
        copied = work.path / "copied.db"
        shutil.copyfile(extend.folder(MODEL) / DATABASE, copied)
        copied.rename(work.path / DATABASE)
    return ()


def frames_to_map(area: Area, chosen: Frames) -> FramesToMap:
    """Collect the input of the reconstruction from stage 1-frames."""
    folder = area.folder(FRAMES)
    lenses = read_lenses(folder)
    missing = set(chosen.cameras.tolist()) - set(lenses)
    if missing:
        raise FormatError(f"{folder / CAMERAS}: camera {min(missing)!r} is missing")
    masks = {p.stem: p for p in sorted((folder / MASKS).glob("*.png"))}
    return FramesToMap(
        folder=folder,
        names=tuple(chosen.names.tolist()),
        sequences=chosen.sequences,
        cameras=chosen.cameras,
        positions_m=rough_positions(chosen),
        lenses={key: lenses[key] for key in np.unique(chosen.cameras).tolist()},
        masks=masks,
    )


def rough_positions(frames: Frames) -> np.ndarray:
    """Return (N, 3) ENU metres from raw telemetry, to find neighbours; NaN without a fix."""
    known = frames.has_fix
    positions = np.full((len(frames), 3), np.nan)
    if known.any():
        lat_lon = frames.lat_lon_deg[known]
        height = np.nan_to_num(frames.rel_alt_m[known])
        middle = np.median(lat_lon, axis=0)
        origin = GeoOrigin(float(middle[0]), float(middle[1]), 0.0)
        positions[known] = origin.enu_from_wgs84(np.column_stack([lat_lon, height]))
    return positions


def _trials(
    area: Area,
    refined: RefinedModel,
    frames: FramesToMap,
    distance: float,
    geo: GeoStageOptions,
    progress: Progress,
) -> dict[int, FocalTrial]:
    """Compare what is known of the focal lengths, by camera id."""
    scene, covariance = refined.scene, refined.covariance
    gnss, metres = focal_lengths_by_gnss(area, scene, covariance, frames, geo, progress)
    return focal_trials(scene, covariance, frames, gnss, distance, metres)


def _write_labels(
    work: Path, result: ReconstructResult, chosen: Frames, covariance: MapCovariance | None
) -> None:
    """Write labels of the mapping frames in the model's gauge, if they have covariances."""
    refined = result.refined
    if covariance is None:
        return
    reasons = {row.name: row.reason for row in result.registrations}
    labels, seen = mapping_labels(
        chosen, refined.scene, refined.observations, refined.points, reasons, covariance
    )
    write_labels(work / POSES, labels)
    write_label_observations(work / OBSERVATIONS, seen)


def _lens_errors(
    refined: RefinedModel, covariance: MapCovariance | None
) -> dict[int, dict[str, object]]:
    """Return standard deviations and correlations of each lens by camera id; empty without a covariance."""
    found: dict[int, dict[str, object]] = {}
    if covariance is None:
        return found
    for camera_id, (is_free, of_lens) in covariance.lens_covariances().items():
        names = estimated_names(refined.scene.cameras[camera_id])
        sigma = np.sqrt(np.diag(of_lens))
        scale = np.where(sigma > 0, sigma, 1.0)
        point = covariance.shared.principal_points.get(camera_id)
        found[camera_id] = {
            "estimated": [name for name, free in zip(names, is_free, strict=True) if free],
            "sigma": [float(f"{value:.4g}") for value in sigma],
            "correlation": np.round(of_lens / np.outer(scale, scale), 4).tolist(),
            "principal_point_sigma_px": []
            if point is None
            else [float(f"{value:.4g}") for value in point.sigma_px],
        }
    return found


def _unlabelled(result: ReconstructResult) -> tuple[str, ...]:
    problem = result.refined.problem
    return (f"the mapping frames have no covariances: {problem}",) if problem else ()


def _shutters(
    result: ReconstructResult, chosen: Frames, stopwatch: Stopwatch
) -> tuple[ShutterDiagnosis, ...]:
    """Diagnose rolling shutter and stabilisation of each video; the interval of photos is too long."""
    with stopwatch.step("shutter"):
        scene = result.refined.scene
        row = {name: k for k, name in enumerate(chosen.names.tolist())}
        rows = np.array([row[name] for name in scene.names], dtype=np.int64)
        if not (chosen.video_frame[rows] >= 0).any():
            return ()
        return diagnose_shutter(
            scene, result.refined.observations, chosen.sequences[rows], chosen.time_s[rows]
        )


def _move_results(work: Path, result: ReconstructResult) -> None:
    """Move the results to their final names.

    Files that a resumed run needs are kept until the stage is complete.
    """
    if result.database != work / DATABASE:
        (work / DATABASE).unlink()
        result.database.rename(work / DATABASE)
    for path in result.refined.folder.iterdir():
        path.rename(work / path.name)


def _counts(
    result: ReconstructResult,
    trials: Mapping[int, FocalTrial],
    covariance: MapCovariance | None,
    distance: float,
    shutters: tuple[ShutterDiagnosis, ...],
) -> dict[str, object]:
    registered = [r for r in result.registrations if r.registered]
    observations = sum(r.observations for r in registered)
    scene = result.refined.scene
    errors = _lens_errors(result.refined, covariance)
    cameras = {
        trial.camera: {
            "focal_px": round(trial.adjusted_px, 2),
            "fov_deg": round(trial.adjusted.horizontal_fov_deg, 2),
            "model": trial.adjusted.model,
            "params": [round(float(p), 6) for p in trial.adjusted.params],
            **trial.counts(),
            **errors.get(camera_id, {}),
        }
        for camera_id, trial in trials.items()
    }
    return {
        "cameras": cameras,
        "shutter": [s.counts() for s in shutters],
        "frames": len(result.registrations),
        "registered": len(registered),
        "contradicted": result.contradicted,
        "submodels": list(result.submodels),
        "pairs_tried": result.pairs_tried,
        "pairs_verified": result.pairs_verified,
        "points": len(scene.points),
        "viewing_distance": round(distance, 6),
        "observations": observations,
        "mean_error_px": round(
            sum(r.error_px * r.observations for r in registered) / observations, 4
        ),
    }
