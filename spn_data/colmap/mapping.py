"""Mapping, triangulation and refinement in a child process (`python -m spn_data.colmap.mapping`).

The functions above `main` run in the parent and use no pycolmap objects; those below run in the child.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from spn_data.colmap.job import MappingJob
from spn_data.geometry.initial_lens import Hold
from spn_data.work import child


def run_mapping(job: MappingJob, *, log: Path, progress: Callable[[int], None]) -> list[Path]:
    """Run COLMAP's mapper.

    Parameters
    ----------
    job : MappingJob
    log : Path
        Log file of the child process.
    progress : callable
        Called with the number of images in the largest sub-model so far.

    Returns
    -------
    list of Path
        Folders of the sub-models, most images first; empty if nothing could be mapped. Snapshots remain if
        the child dies.
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
    """Return the newest complete snapshot.

    Parameters
    ----------
    snapshots : Path
        Folder of the snapshots; may be missing.

    Returns
    -------
    Path or None
        None if there is none. Snapshots whose writing was interrupted are skipped.
    """
    from spn_data.colmap.model import count_registered, is_whole

    folders = [f for f in snapshots.iterdir() if f.is_dir()] if snapshots.is_dir() else []
    for folder in sorted(folders, key=lambda f: f.name, reverse=True):
        if is_whole(folder) and count_registered(folder) > 0:
            return folder
    return None


def triangulate(source: Path, target: Path, *, database: Path, log: Path) -> None:
    """Triangulate the points of all matches in a database from the cameras and poses of a model.

    Parameters
    ----------
    source : Path
        Model whose cameras and poses are used unchanged. Its features may differ from those of the database;
        images and cameras are the same.
    target : Path
        Folder to write.
    database : Path
        Database file.
    log : Path
        Log file of the child process.
    """
    job = {
        "task": "triangulate",
        "source": str(source),
        "target": str(target),
        "database": str(database),
    }
    child.run_child(__name__, job, log=log, on_event=lambda _: None)


def refine(
    source: Path,
    target: Path,
    *,
    images: Path,
    positions: Mapping[str, Sequence[float]],
    camera_model: str,
    refine_principal_point: bool,
    held: Mapping[int, Hold],
    threads: int,
    log: Path,
) -> dict[str, Any]:
    """Run the final bundle adjustments over a whole model, with more distortion terms.

    Parameters
    ----------
    source, target : Path
        Folders to read and write.
    images : Path
        Image folder, for the colours of the points.
    positions : mapping of str to sequence of float
        Positions in metres of those images that have one.
    camera_model : str
        COLMAP's camera model.
    refine_principal_point : bool
    held : mapping of int to Hold
        What is not changed of a camera, by COLMAP's id.
    threads : int
    log : Path
        Log file of the child process.

    Returns
    -------
    dict
        "error_before_px" and "error_px" (mean reprojection error), "dropped" (measurements), and "bend_m"
        (median displacement by the correction of doming, 0 if there was none).
    """
    result: dict[str, Any] = {}
    job = {
        "task": "refine",
        "source": str(source),
        "target": str(target),
        "images": str(images),
        "positions": {name: list(position) for name, position in positions.items()},
        "camera_model": camera_model,
        "refine_principal_point": refine_principal_point,
        "held": list(held.items()),
        "threads": threads,
    }
    child.run_child(__name__, job, log=log, on_event=result.update)
    return result


def main() -> None:
    """Run the task of the child process."""
    job = child.read_job()
    task = job.pop("task")
    if task == "map":
        _map(MappingJob(**job))
    elif task == "triangulate":
        _triangulate(**job)
    elif task == "refine":
        _refine(**job)
    else:
        raise ValueError(f"unknown task {task!r}")


def _map(job: MappingJob) -> None:
    from spn_data.colmap import pycolmap
    from spn_data.colmap.incremental import map_incrementally
    from spn_data.colmap.model import write_native

    pycolmap.set_random_seed(job.seed)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.INFO.value
    models = _map_globally(job) if job.engine == "global" else map_incrementally(job)
    # The mapper's own names depend on whether it continued from a model.
    folders = []
    for rank, i in enumerate(sorted(models, key=lambda i: (-models[i].num_reg_images(), i))):
        folder = Path(job.output) / f"model-{rank}"
        write_native(models[i], folder)
        folders.append(str(folder))
    child.send({"models": folders})


def _map_globally(job: MappingJob) -> Any:
    from spn_data.colmap import pycolmap
    from spn_data.colmap.lens_limits import fit_to_lenses

    options = pycolmap.GlobalPipelineOptions(num_threads=job.threads, random_seed=job.seed)
    with contextlib.closing(pycolmap.Database.open(job.database)) as database:
        cameras = database.read_all_cameras()
    fit_to_lenses(options.mapper.retriangulation, cameras)
    if (
        job.held
    ):  # the mapper knows only all cameras or none; what it holds too much is adjusted later
        options.mapper.bundle_adjustment.refine_focal_length = False
        options.mapper.bundle_adjustment.refine_extra_params = all(
            hold == Hold.FOCAL for _, hold in job.held
        )
    return pycolmap.global_mapping(job.database, job.images, job.output, options)


def _triangulate(source: str, target: str, database: str) -> None:
    from spn_data.colmap import pycolmap
    from spn_data.colmap.lens_limits import fit_to_lenses
    from spn_data.colmap.model import write_native

    posed, model = pycolmap.Reconstruction(source), pycolmap.Reconstruction()
    with contextlib.closing(pycolmap.Database.open(database)) as opened:
        cache = pycolmap.DatabaseCache.create(opened, pycolmap.DatabaseCacheOptions())
    model.load(cache)
    for camera_id, camera in posed.cameras.items():
        model.cameras[camera_id].params = camera.params
    for frame_id in posed.reg_frame_ids():
        model.frames[frame_id].rig_from_world = posed.frames[frame_id].rig_from_world
        model.register_frame(frame_id)
    mapper = pycolmap.IncrementalMapper(cache)
    options, filtering = (
        pycolmap.IncrementalTriangulatorOptions(),
        pycolmap.IncrementalMapperOptions(),
    )
    for limited in (options, filtering):
        fit_to_lenses(limited, model.cameras.values())
    mapper.begin_reconstruction(model)
    for image_id in sorted(model.reg_image_ids()):
        mapper.triangulate_image(options, image_id)
    mapper.complete_and_merge_tracks(options)
    mapper.filter_points(filtering)
    mapper.end_reconstruction(False)
    write_native(model, Path(target))


def _refine(
    source: str,
    target: str,
    images: str,
    positions: dict[str, list[float]],
    camera_model: str,
    refine_principal_point: bool,
    held: list[tuple[int, Hold]],
    threads: int,
) -> None:
    from spn_data.colmap import pycolmap
    from spn_data.colmap.adjust import adjust
    from spn_data.colmap.clean import drop_without_depth
    from spn_data.colmap.doming import correct_doming
    from spn_data.colmap.model import upgrade_camera, write_native

    model = pycolmap.Reconstruction(source)
    holds = {camera_id: Hold(hold) for camera_id, hold in held}
    for camera_id, camera in model.cameras.items():
        if holds.get(camera_id) is not Hold.LENS:
            upgrade_camera(camera, camera_model)
    before = model.compute_mean_reprojection_error()
    bend_m = correct_doming(model, positions)
    dropped = adjust(
        model, refine_principal_point=refine_principal_point, held=holds, threads=threads
    )
    dropped += drop_without_depth(model)
    model.update_point_3d_errors()
    model.extract_colors_for_all_images(images, threads)
    write_native(model, Path(target))
    after = model.compute_mean_reprojection_error()
    child.send({"error_before_px": before, "error_px": after, "dropped": dropped, "bend_m": bend_m})


if __name__ == "__main__":
    main()
