"""Stage 2-model: chosen frames to one COLMAP model in its own gauge."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

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
from spn_data.colmap.model import Scene
from spn_data.errors import FormatError, GeometryError
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_from_json
from spn_data.geometry.geodesy import GeoOrigin
from spn_data.labels.labels import write_label_observations, write_labels
from spn_data.reconstruction.attempts import ReconstructOptions
from spn_data.reconstruction.contradiction import focal_changes
from spn_data.reconstruction.correspondences import FramesToMap
from spn_data.reconstruction.diagnosis import missing_passages
from spn_data.reconstruction.mapping_labels import mapping_labels
from spn_data.reconstruction.reconstruct import ReconstructResult, reconstruct
from spn_data.reconstruction.registration_file import write_registration
from spn_data.reconstruction.shutter import ShutterDiagnosis, diagnose_shutter
from spn_data.storage.json_files import read_json
from spn_data.storage.stage_record import StageRecord
from spn_data.work.timing import Progress, Stopwatch


def build_model(
    area: Area,
    options: ReconstructOptions,
    progress: Progress,
    *,
    extend: Area | None = None,
    overwrite: bool = False,
) -> StageRecord:
    """Reconstruct the area's frames into one model.

    extend : the area whose features and matches are taken over, if they were made with the same options.
    """
    made_of = {k: v for k, v in asdict(options).items() if k not in ("threads", "cluster")}
    work = area.begin(MODEL, made_of, {}, overwrite=overwrite)
    if isinstance(work, StageRecord):
        return work
    notes = () if extend is None else _take_over(extend, work)
    frames = read_frames(area.folder(FRAMES) / FRAMES_TABLE)
    chosen = frames.select(frames.chosen)
    stopwatch = Stopwatch()
    to_map = frames_to_map(area, chosen)
    result = reconstruct(to_map, work.path, options, progress, stopwatch)
    passages = missing_passages(result.registrations, chosen.sequences, chosen.time_s)
    shutters = _shutters(result, chosen, stopwatch)
    write_registration(work.path, result.registrations)
    unlabelled = _write_labels(work.path, result, chosen, stopwatch)
    _name_results(work.path, result)
    return work.finish(
        counts=_counts(result, chosen, shutters),
        seconds=stopwatch.seconds,
        cpu_seconds=stopwatch.cpu_seconds,
        notes=(
            *notes,
            *result.attempts,
            *passages,
            *unlabelled,
            *_focal_remarks(result.scene, to_map),
            *(told for shutter in shutters if (told := shutter.describe())),
        ),
    )


def _take_over(extend: Area, work: StageWork) -> tuple[str, ...]:
    """Features and matches of an area, where they were made with the same options; else a note on it."""
    before = extend.record(MODEL).made_of["options"]
    now = work.record.made_of["options"]
    for group in ("features", "matching"):
        for name, value in now[group].items():
            if before[group].get(name) != value:
                return (
                    f"features and matches are made anew: the area's were made with {name} = "
                    f"{before[group].get(name)!r}, now {value!r}",
                )
    if not (work.path / DATABASE).exists():
        copied = work.path / "copied.db"
        shutil.copyfile(extend.folder(MODEL) / DATABASE, copied)
        copied.rename(work.path / DATABASE)
    return ()


def frames_to_map(area: Area, chosen: Frames) -> FramesToMap:
    """What reconstruction needs of the chosen frames, from stage 1."""
    folder = area.folder(FRAMES)
    start = read_json(folder / CAMERAS)["cameras"]
    masks = {p.stem: p for p in sorted((folder / MASKS).glob("*.png"))}
    return FramesToMap(
        folder=folder,
        names=tuple(chosen.names.tolist()),
        sequences=chosen.sequences,
        cameras=chosen.cameras,
        positions_m=rough_positions(chosen),
        start_cameras={
            key: _start_camera(key, start) for key in np.unique(chosen.cameras).tolist()
        },
        masks=masks,
    )


def _start_camera(key: str, start: Mapping[str, dict[str, Any]]) -> tuple[Camera, bool]:
    try:
        return camera_from_json(start[key]), bool(start[key]["focal_is_known"])
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{CAMERAS}: camera {key!r} is missing or damaged ({error})") from error


def rough_positions(frames: Frames) -> np.ndarray:
    """(N, 3) ENU metres by telemetry as it is, to find neighbours; NaN where there is no fix."""
    known = frames.has_fix
    positions = np.full((len(frames), 3), np.nan)
    if known.any():
        lat_lon = frames.lat_lon_deg[known]
        height = np.nan_to_num(frames.rel_alt_m[known])
        middle = np.median(lat_lon, axis=0)
        origin = GeoOrigin(float(middle[0]), float(middle[1]), 0.0)
        positions[known] = origin.enu_from_wgs84(np.column_stack([lat_lon, height]))
    return positions


_FOCAL_SURPRISE = 1.1  # ratio to a focal length that was known


def _focal_remarks(scene: Scene, frames: FramesToMap) -> list[str]:
    """A word where a focal length came out far from what it was said to be."""
    return [
        f"camera {change.camera}: the focal length came out at {change.estimated_px:.0f} px, "
        f"{change.estimated_px / change.known_px - 1:+.0%} from the known {change.known_px:.0f} px. "
        "A flight at one height that looks one way hardly determines it, and heights are off by as much; or "
        "the video is cropped. --camera settles it"
        for change in focal_changes(scene, frames, _FOCAL_SURPRISE)
    ]


def _write_labels(
    work: Path, result: ReconstructResult, chosen: Frames, stopwatch: Stopwatch
) -> tuple[str, ...]:
    """Write the labels of the mapping frames in the model's gauge; return a note if that is impossible."""
    reasons = {row.name: row.reason for row in result.registrations}
    model = (result.scene, result.observations, result.points)
    try:
        with stopwatch.step("covariance"):
            labels, seen = mapping_labels(chosen, *model, reasons)
    except GeometryError as error:
        return (f"no covariance of the mapping frames: {error}",)
    write_labels(work / POSES, labels)
    write_label_observations(work / OBSERVATIONS, seen)
    return ()


def _shutters(
    result: ReconstructResult, chosen: Frames, stopwatch: Stopwatch
) -> tuple[ShutterDiagnosis, ...]:
    """Rolling shutter and stabilisation of each video; photos are taken too far apart to tell."""
    with stopwatch.step("shutter"):
        scene = result.scene
        row = {name: k for k, name in enumerate(chosen.names.tolist())}
        rows = np.array([row[name] for name in scene.names], dtype=np.int64)
        if not (chosen.video_frame[rows] >= 0).any():
            return ()
        return diagnose_shutter(
            scene, result.observations, chosen.sequences[rows], chosen.time_s[rows]
        )


def _name_results(work: Path, result: ReconstructResult) -> None:
    """The results under their names; what an interrupted run goes on from stays until the stage is done."""
    if result.database != work / DATABASE:
        (work / DATABASE).unlink()
        result.database.rename(work / DATABASE)
    for path in result.model.iterdir():
        path.rename(work / path.name)


def _counts(
    result: ReconstructResult, chosen: Frames, shutters: tuple[ShutterDiagnosis, ...]
) -> dict[str, object]:
    registered = [r for r in result.registrations if r.registered]
    observations = sum(r.observations for r in registered)
    scene = result.scene
    key_of = dict(zip(chosen.names.tolist(), chosen.cameras.tolist(), strict=True))
    keys = {int(i): key_of[name] for i, name in zip(scene.camera_ids, scene.names, strict=True)}
    cameras = {
        key: {
            "focal_px": round(scene.cameras[i].focal_px[0], 2),
            "fov_deg": round(scene.cameras[i].horizontal_fov_deg, 2),
            "model": scene.cameras[i].model,
            "params": [round(float(p), 6) for p in scene.cameras[i].params],
        }
        for i, key in keys.items()
    }
    return {
        "cameras": cameras,
        "shutter": [s.counts() for s in shutters],
        "frames": len(result.registrations),
        "registered": len(registered),
        "submodels": list(result.submodels),
        "pairs_tried": result.pairs_tried,
        "pairs_verified": result.pairs_verified,
        "points": len(scene.points),
        "observations": observations,
        "mean_error_px": round(
            sum(r.error_px * r.observations for r in registered) / observations, 4
        ),
    }
