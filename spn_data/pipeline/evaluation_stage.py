"""Stage 4-eval/<name>: poses of an evaluation sequence in the frozen map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.area.area import Area, StageWork
from spn_data.area.names import (
    CAMERA,
    EVALUATION,
    FRAMES,
    GEO,
    MODEL,
    OBSERVATIONS,
    POSES,
    REGISTRATION,
)
from spn_data.capture.frames import Frames
from spn_data.capture.sources import Source
from spn_data.errors import InputError, StageError
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_from_json, camera_to_json, read_camera
from spn_data.geometry.initial_lens import Hold, InitialLens
from spn_data.inputs.area_labels import read_geo, read_world_from_model
from spn_data.inputs.evaluation_source import find_source, sample_frames
from spn_data.inputs.flight_telemetry import check_telemetry
from spn_data.inputs.frame_images import STORED
from spn_data.inputs.gnss_check import GnssCheck, check_gnss, focal_witness_notes
from spn_data.inputs.lens_file import map_lens_priors, read_lenses
from spn_data.inputs.source_fingerprints import fingerprints
from spn_data.labels.labels import Labels, pose_sigmas, write_label_observations, write_labels
from spn_data.labels.map_hash import map_hash
from spn_data.reconstruction.correspondences import FramesToMap
from spn_data.registration.covariance import SequenceCovariance
from spn_data.registration.register import RegisteredSequence, labels_of, register_sequence
from spn_data.registration.register_options import RegisterOptions
from spn_data.storage.json_files import VERSION, reporting_damage, write_json
from spn_data.storage.stage_record import StageRecord
from spn_data.telemetry.track import Telemetry
from spn_data.work.parallel import Dispatch
from spn_data.work.timing import Progress, Stopwatch

_MISFIT = 2.0  # ratio of residuals of sequence and map
# Relative differences of focal lengths: above the first, two estimates of one lens contradict each other;
# above the second, they are taken to be of two lenses.
_SAME_LENS, _OTHER_LENS = 0.02, 0.2


@dataclass(frozen=True, kw_only=True)
class RegisterStageOptions:
    """Options of the registration of a sequence.

    Attributes
    ----------
    register : RegisterOptions
    fov_deg : float or None
        Horizontal field of view, if known.
    camera_file : str or None
        File of a calibrated camera to start from.
    any_telemetry : bool
        Whether to accept telemetry whose duration does not match the video.
    time_offset_s : float or None
        Seconds to add to the times of the telemetry; None: estimated for the comparison with GNSS.
    """

    register: RegisterOptions = field(default_factory=RegisterOptions)
    fov_deg: float | None = None
    camera_file: str | None = None
    any_telemetry: bool = False
    time_offset_s: float | None = None


def register(
    area: Area,
    video: Path,
    name: str | None,
    options: RegisterStageOptions,
    progress: Progress,
    *,
    dispatch: Dispatch,
    overwrite: bool = False,
) -> StageRecord:
    """Register the frames of one video, or of a folder of photos, as an evaluation sequence.

    The map is only read: its hash is recorded before and after.

    Parameters
    ----------
    area : Area
    video : Path
    name : str or None
        Name of the sequence; None: the name of the source.
    options : RegisterStageOptions
    progress : Progress
    dispatch : Dispatch
        Runs feature extraction and matching.
    overwrite : bool
        Whether a sequence with other options or inputs may be replaced.

    Returns
    -------
    StageRecord

    Raises
    ------
    InputError
        If the source is part of the map, contains several sequences, or cannot be read.
    StageError
        If the model is missing or stale, or the map changes meanwhile.
    """
    source = find_source(area, video, name)
    given = None if options.camera_file is None else read_camera(Path(options.camera_file))
    made_with = {**asdict(options), "camera_file": None if given is None else camera_to_json(given)}
    stage = f"{EVALUATION}/{source.sequence}"
    inputs = fingerprints((source,), {})
    work = area.begin(stage, made_with, inputs, overwrite=overwrite)
    if isinstance(work, StageRecord):
        return work
    record = _register(area, work, source, given, options, progress, dispatch)
    known = {**area.facts.evaluation, source.sequence: area.stored_path(video)}
    area.write_facts(replace(area.facts, evaluation=known))
    return record


def declare_far(area: Area, name: str, *, is_far: bool) -> None:
    """Declare in area.toml that an evaluation sequence is meant to be far from the map, or that it is not.

    Raises InputError if the area has no such sequence.
    """
    known = area.sequences(EVALUATION)
    if name not in known:
        raise InputError(
            f"there is no evaluation sequence {name!r} whose coverage could be expected to be low; the area "
            f"has: {', '.join(known) or 'none'}"
        )
    others = [other for other in area.facts.expect_low if other != name]
    far = (*others, name) if is_far else tuple(others)
    area.write_facts(replace(area.facts, expect_low=tuple(sorted(set(far)))))


def _register(
    area: Area,
    work: StageWork,
    source: Source,
    given: Camera | None,
    options: RegisterStageOptions,
    progress: Progress,
    dispatch: Dispatch,
) -> StageRecord:
    stopwatch = Stopwatch()
    before = _map_hashes(area)
    with stopwatch.step("frames"):
        check_telemetry(source, time_offset_s=options.time_offset_s)
        sampled = sample_frames(
            work.path,
            source,
            given,
            progress,
            rate_hz=options.register.rate_hz,
            fov_deg=options.fov_deg,
            fixed_lens=options.register.hold_lens,
            any_telemetry=options.any_telemetry,
            time_offset_s=options.time_offset_s,
        )
    chosen = sampled.frames.select(sampled.frames.chosen)
    found = register_sequence(
        _frames_to_match(work.path / STORED, chosen, sampled.lens),
        work.path,
        area.folder(MODEL),
        lambda scene: map_lens_priors(area, scene),
        replace(options.register, hold_lens=sampled.lens.hold is Hold.LENS),
        progress,
        dispatch=dispatch,
        stopwatch=stopwatch,
    )
    labels = labels_of(chosen, found).transformed(read_world_from_model(area))
    with stopwatch.step("write"):
        write_labels(work.path / POSES, labels)
        write_label_observations(work.path / OBSERVATIONS, found.seen)
        _write_camera(work.path / CAMERA, found, sampled.lens)
        gnss = _gnss(area, labels, sampled.track, options.time_offset_s)
        after = _map_hashes(area)
        if after != before:
            raise StageError(f"{area.root}: the map changed while {source.sequence} was registered")
        _write_registration(work.path / REGISTRATION, area, found, gnss, before)
    notes = [*sampled.notes, *_misfit_notes(found)]
    if labels.registered.any():
        notes += lens_notes(found.solution.camera, _mapping_lenses(area))
    if gnss is not None:
        notes += [gnss.describe(), *_focal_witness(area, found, gnss)]
    return work.finish(
        counts=_counts(labels, found.solution.camera, gnss),
        seconds=stopwatch.seconds,
        cpu_seconds=stopwatch.cpu_seconds,
        notes=tuple(notes),
    )


def _map_hashes(area: Area) -> dict[str, str]:
    """Return the hash of the map, and of its georegistered version if there is one, by stage."""
    return {stage: map_hash(area.folder(stage)) for stage in (MODEL, GEO) if area.has(stage)}


def _frames_to_match(folder: Path, chosen: Frames, lens: InitialLens) -> FramesToMap:
    """Return the sampled frames of one sequence as input of matching, without positions."""
    return FramesToMap(
        folder=folder,
        names=tuple(chosen.names.tolist()),
        sequences=chosen.sequences,
        cameras=chosen.cameras,
        positions_m=np.full((len(chosen), 3), np.nan),
        lenses={str(chosen.cameras[0]): lens},
        masks={},
    )


def _write_camera(path: Path, found: RegisteredSequence, lens: InitialLens) -> None:
    """Write the estimated camera with its covariance, and the one it started from."""
    covariance = found.covariance
    estimated = {} if covariance is None else _lens_json(covariance)
    camera = {"version": VERSION, **camera_to_json(found.solution.camera), **estimated}
    write_json(path, {**camera, "start": lens.to_json()})


def _write_registration(
    path: Path,
    area: Area,
    found: RegisteredSequence,
    gnss: GnssCheck | None,
    map_hashes: Mapping[str, str],
) -> None:
    """Write registration.json; the hashes of the map are the same before and after registration."""
    covariance = found.covariance
    write_json(
        path,
        {
            "version": VERSION,
            "world_from_model": read_world_from_model(area).to_json(),
            "map_before": map_hashes[MODEL],
            "map_after": map_hashes[MODEL],
            "geo_before": map_hashes.get(GEO),
            "geo_after": map_hashes.get(GEO),
            "gnss": None if gnss is None else asdict(gnss),
            "map_sigma_px": found.map_sigma_px,
            "sigma_px": None if covariance is None else covariance.sigma_px,
            "design_effect": None if covariance is None else covariance.design_effect,
        },
    )


def _misfit_notes(found: RegisteredSequence) -> list[str]:
    """Return a note if the sequence fits the map much worse than the map fits itself."""
    if found.covariance is None:
        return []
    here_px, map_px = found.covariance.sigma_px, found.map_sigma_px
    if here_px < _MISFIT * map_px:
        return []
    return [
        f"its residuals ({here_px:.2f} px) are {here_px / map_px:.1f} times the map's own ({map_px:.2f} px): "
        "the map is bent (doming) or its lens is wrong, as after a flight at one height with one viewing "
        "direction, and label errors may exceed the stated covariance"
    ]


def _mapping_lenses(area: Area) -> dict[str, Camera]:
    """Return the mapping cameras as estimated by the reconstruction, by key."""
    lenses, folder = read_lenses(area.folder(FRAMES)), area.folder(MODEL)
    estimated = area.record(MODEL).counts["cameras"]
    with reporting_damage(folder, "a model"):
        return {
            key: camera_from_json(
                {
                    **camera_to_json(lenses[key].camera),
                    "model": lens["model"],
                    "params": lens["params"],
                }
            )
            for key, lens in estimated.items()
        }


def lens_notes(camera: Camera, mapping: Mapping[str, Camera]) -> list[str]:
    """Return a note if the focal length differs slightly from that of a mapping lens that may be the same."""
    for key, lens in mapping.items():
        difference = camera.focal_px[0] / lens.focal_px[0] - 1
        same_size = (camera.width, camera.height) == (lens.width, lens.height)
        if same_size and _SAME_LENS < abs(difference) < _OTHER_LENS:
            return [
                f"its estimated focal length is {camera.focal_px[0]:.0f} px, that of {key} (same image size) "
                f"is {lens.focal_px[0]:.0f} px. If both are the same lens, one of them is wrong, and "
                f"with it heights by about {abs(difference):.0%}: a flight at one height with one viewing "
                "direction hardly determines the focal length. Map from two heights, or hold a calibrated "
                "lens with --camera and --fixed-lens"
            ]
    return []


def _focal_witness(area: Area, found: RegisteredSequence, gnss: GnssCheck) -> list[str]:
    """Return what the flight's heights say about the least certain focal length of the map."""
    counts = area.record(MODEL).counts
    distance_m = counts.get("viewing_distance", 0.0) * read_world_from_model(area).scale
    errors = [
        float(np.hypot(lens.get("focal_error_px") or 0.0, lens.get("focal_doubt_px", 0.0)))
        / lens["focal_px"]
        for lens in counts.get("cameras", {}).values()
    ]
    if found.covariance is None or distance_m <= 0 or not errors:
        return []
    own = [name[0] == "f" for name in found.covariance.lens_names]
    variance = np.diag(found.covariance.lens)[own]
    lens_error = float(np.sqrt(variance.max(initial=0.0))) / found.solution.camera.focal_px[0]
    return focal_witness_notes(gnss, distance_m, lens_error, max(errors))


def _lens_json(covariance: SequenceCovariance) -> dict[str, Any]:
    return {"estimated": list(covariance.lens_names), "covariance": covariance.lens.tolist()}


def _gnss(
    area: Area, labels: Labels, track: Telemetry | None, given_offset_s: float | None
) -> GnssCheck | None:
    geo = read_geo(area)
    if geo is None or track is None or not track.has_fix.any():
        return None
    return check_gnss(labels, track, geo, time_is_known=given_offset_s is not None)


def _counts(labels: Labels, camera: Camera, gnss: GnssCheck | None) -> dict[str, Any]:
    registered = labels.registered
    sigma, sigma_deg = pose_sigmas(labels.covariance[registered])
    reasons: dict[str, int] = {}
    for reason in labels.reason[~registered].tolist():
        kind = "ambiguous" if reason.startswith("ambiguous") else "too little agreement"
        reasons[kind] = reasons.get(kind, 0) + 1
    return {
        "frames": len(labels),
        "registered": int(registered.sum()),
        "failed": reasons,
        "focal_px": round(camera.focal_px[0], 3) if registered.any() else None,
        "fov_deg": round(camera.horizontal_fov_deg, 3) if registered.any() else None,
        "error_px": _median(labels.error_px[registered], 4),
        "inliers": _median(labels.inliers[registered], 0),
        "sigma": _median(sigma, 6),
        "sigma_deg": _median(sigma_deg, 6),
        "gnss": None if gnss is None else asdict(gnss),
    }


def _median(values: np.ndarray, digits: int) -> float | None:
    return round(float(np.median(values)), digits) if len(values) else None
