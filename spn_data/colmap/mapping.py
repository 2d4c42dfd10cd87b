"""Mapping, joining and refining models, as a child process (`python -m spn_data.colmap.mapping`).

The functions above `main` run in the parent and know no pycolmap objects, those below in the child.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from spn_data import child
from spn_data.errors import FormatError

_CONVERGED = 1e-5  # relative decrease of the cost
# Deviations at which Cauchy's loss begins to bend: 95 % efficient for normal errors (Holland & Welsch
# 1977, "Robust regression using iteratively reweighted least-squares").
_CAUCHY = 2.385


@dataclass(frozen=True, kw_only=True)
class MappingJob:
    """One run of COLMAP's mapper over a database."""

    database: str
    images: str  # folder, for the points' colours
    output: str  # an existing folder; sub-models are written to model-0, model-1, ... in it
    snapshots: str  # an existing folder
    engine: str = "incremental"  # or "global"
    threads: int = -1
    seed: int = 0
    snapshot_every: int = 20  # registered images
    min_model_size: int = 10  # images, below which a sub-model is dropped
    hold_intrinsics: bool = False  # leave their refinement to the last bundle adjustment
    start_from: str = ""  # folder of a model to go on from


def run_mapping(job: MappingJob, *, log: Path, progress: Callable[[int], None]) -> list[Path]:
    """Folders of the sub-models, most images first; empty where nothing could be mapped.

    progress is told the number of registered images. Snapshots stay where the child dies.
    """
    models: list[Path] = []

    def on_event(event: child.Event) -> None:
        if "registered" in event:
            progress(event["registered"])
        if "models" in event:
            models.extend(Path(folder) for folder in event["models"])

    child.run_child(__name__, {"task": "map", **asdict(job)}, log=log, on_event=on_event)
    return models


def latest_snapshot(snapshots: Path) -> Path | None:
    """The newest snapshot that is complete; an interrupted write is passed over."""
    from spn_data.colmap.model import count_registered

    folders = [f for f in snapshots.iterdir() if f.is_dir()] if snapshots.is_dir() else []
    for folder in sorted(folders, key=lambda f: f.name, reverse=True):
        try:
            if count_registered(folder) > 0:
                return folder
        except FormatError:
            continue
    return None


def refine(
    source: Path,
    target: Path,
    *,
    camera_model: str,
    refine_principal_point: bool,
    threads: int,
    log: Path,
) -> dict[str, Any]:
    """Last bundle adjustments over a whole model, with a fuller camera; returns what it did."""
    result: dict[str, Any] = {}
    job = {
        "task": "refine",
        "source": str(source),
        "target": str(target),
        "camera_model": camera_model,
        "refine_principal_point": refine_principal_point,
        "threads": threads,
    }
    child.run_child(__name__, job, log=log, on_event=result.update)
    return result


def main() -> None:
    job = child.read_job()
    task = job.pop("task")
    if task == "map":
        _map(MappingJob(**job))
    elif task == "refine":
        _refine(**job)
    else:
        raise ValueError(f"no task {task!r}")


def _map(job: MappingJob) -> None:
    from spn_data.colmap import pycolmap
    from spn_data.colmap.model import write_native

    pycolmap.set_random_seed(job.seed)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.INFO.value
    if job.engine == "global":
        options = pycolmap.GlobalPipelineOptions(num_threads=job.threads, random_seed=job.seed)
        models = pycolmap.global_mapping(job.database, job.images, job.output, options)
    else:
        models = _map_incrementally(job)
    # The mapper's own names depend on whether it went on from a model.
    folders = []
    for rank, i in enumerate(sorted(models, key=lambda i: (-models[i].num_reg_images(), i))):
        folder = Path(job.output) / f"model-{rank}"
        write_native(models[i], folder)
        folders.append(str(folder))
    child.send({"models": folders})


def _map_incrementally(job: MappingJob) -> dict[int, Any]:
    from spn_data.colmap import pycolmap

    options = pycolmap.IncrementalPipelineOptions(
        num_threads=job.threads,
        random_seed=job.seed,
        snapshot_path=job.snapshots,
        snapshot_frames_freq=job.snapshot_every,
    )
    options.min_model_size = job.min_model_size
    # 127 degrees wide: shorter focal lengths only fit the noise of a weak geometry.
    for part in (options, options.mapper, options.triangulation):
        part.min_focal_length_ratio = 0.25
    if job.hold_intrinsics:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = False
        options.mapper.abs_pose_refine_extra_params = False
    # A last bundle adjustment follows in `refine`: those on the way need not be many, nor converge.
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.35
    options.ba_global_max_refinements = 2
    options.ba_global_max_num_iterations = 30
    registered = 0
    if job.start_from:
        registered = pycolmap.Reconstruction(job.start_from).num_reg_images()

    # The mapper announces an initial pair also where it goes on from a model.
    initial = 0 if job.start_from else 2

    def count(new: int) -> None:
        nonlocal registered
        registered += new
        child.send({"registered": registered})

    token = pycolmap.CancellationToken()
    with child.interrupts(token.cancel):
        models: dict[int, Any] = pycolmap.incremental_mapping(
            job.database,
            job.images,
            job.output,
            options,
            input_path=job.start_from,
            initial_image_pair_callback=lambda: count(initial),
            next_image_callback=lambda: count(1),
            cancellation_token=token,
        )
    return models


def _refine(
    source: str, target: str, camera_model: str, refine_principal_point: bool, threads: int
) -> None:
    from spn_data.colmap import pycolmap
    from spn_data.colmap.clean import (
        drop_out_of_view,
        drop_outliers,
        drop_without_depth,
        residual_sigma_px,
    )
    from spn_data.colmap.model import upgrade_camera, write_native

    model = pycolmap.Reconstruction(source)
    for camera in model.cameras.values():
        upgrade_camera(camera, camera_model)
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=refine_principal_point)
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.function_tolerance = _CONVERGED
    before = model.compute_mean_reprojection_error()
    dropped = drop_out_of_view(model)
    pycolmap.bundle_adjustment(model, options)
    dropped += drop_out_of_view(model) + drop_outliers(model)
    # What is left of wrong matches shall not bend the model either.
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = _CAUCHY * residual_sigma_px(model)
    pycolmap.bundle_adjustment(model, options)
    dropped += drop_without_depth(model)
    model.update_point_3d_errors()
    write_native(model, Path(target))
    after = model.compute_mean_reprojection_error()
    child.send({"error_before_px": before, "error_px": after, "dropped": dropped})


if __name__ == "__main__":
    main()
