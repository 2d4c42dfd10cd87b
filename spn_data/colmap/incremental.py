"""COLMAP's incremental mapper, run in the child process that `mapping` starts.

COLMAP's global bundle adjustments use a direct solver up to 1,000 images. Above that, each takes minutes and
leaves doming in a survey; they are then replaced by our own adjustment over the longest tracks.
"""

from __future__ import annotations

import contextlib

from spn_data.colmap import pycolmap
from spn_data.colmap.adjust import adjust_long_tracks
from spn_data.colmap.job import MappingJob
from spn_data.colmap.lens_limits import fit_to_lenses
from spn_data.geometry.initial_lens import Hold
from spn_data.work import child

_MAX_IMAGES_COLMAP = 1000  # up to which COLMAP's own bundle adjustment uses a direct solver
_GROWTH = 1.35  # factor of images or points after which a global bundle adjustment follows
_CONVERGED = 1e-4  # relative decrease of the cost at which a global bundle adjustment stops
_NEVER = 1_000_000_000


def map_incrementally(job: MappingJob) -> dict[int, pycolmap.Reconstruction]:
    """Map the images of a database; return models by COLMAP's index. Report each registered image."""
    options = _pipeline_options(job)
    with contextlib.closing(pycolmap.Database.open(job.database)) as database:
        images = database.num_images()
        cameras = database.read_all_cameras()
    fit_to_lenses(options, cameras)
    fit_to_lenses(options.mapper, cameras)
    fit_to_lenses(options.triangulation, cameras)
    _hold(options, dict(job.held), {camera.camera_id for camera in cameras})
    run = _map_small if images <= _MAX_IMAGES_COLMAP else _map_large
    return run(job, options)


def _pipeline_options(job: MappingJob) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=job.threads,
        random_seed=job.seed,
        snapshot_path=job.snapshots,
        snapshot_frames_freq=job.snapshot_every,
    )
    options.min_model_size = job.min_model_size
    options.extract_colors = False  # `refine` extracts them once
    if job.hold_intrinsics:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = False
        options.mapper.abs_pose_refine_extra_params = False
    # `refine` runs the final bundle adjustment: the ones before it may be few and need not converge.
    options.ba_global_frames_ratio = options.ba_global_points_ratio = _GROWTH
    options.ba_global_frames_freq = options.ba_global_points_freq = _NEVER
    options.ba_global_max_refinements = 1
    options.ba_global_max_num_iterations = 30
    options.ba_global_function_tolerance = _CONVERGED
    return options


def _hold(
    options: pycolmap.IncrementalPipelineOptions, held: dict[int, Hold], cameras: set[int]
) -> None:
    """Keep held lenses, and the focal lengths if all cameras hold theirs; else distortion has to wait too."""
    if held.keys() == cameras:
        options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = False
        constant = {i for i, hold in held.items() if hold == Hold.LENS}
    else:
        constant = set(held)
    options.constant_cameras = options.mapper.constant_cameras = constant


class _ProgressCounter:
    """Number of images in the largest sub-model so far, reported to the parent process."""

    def __init__(self, job: MappingJob):
        self._continued = 0  # images of the model from which the mapper continues
        if job.start_from:
            self._continued = pycolmap.Reconstruction(job.start_from).num_reg_images()
        self._current = self._largest = 0

    def initial(self) -> None:
        """Count the initial pair of a sub-model; the mapper announces one for a continued model too."""
        self._current, self._continued = self._continued or 2, 0
        self._report()

    def next(self) -> None:
        """Count one more image."""
        self._current += 1
        self._report()

    def _report(self) -> None:
        self._largest = max(self._largest, self._current)
        child.send({"registered": self._largest})


def _map_small(
    job: MappingJob, options: pycolmap.IncrementalPipelineOptions
) -> dict[int, pycolmap.Reconstruction]:
    counter, token = _ProgressCounter(job), pycolmap.CancellationToken()
    with child.cancel_on_interrupt(token.cancel):
        models: dict[int, pycolmap.Reconstruction] = pycolmap.incremental_mapping(
            job.database,
            job.images,
            job.output,
            options,
            input_path=job.start_from,
            initial_image_pair_callback=counter.initial,
            next_image_callback=counter.next,
            cancellation_token=token,
        )
    return models


def _map_large(
    job: MappingJob, options: pycolmap.IncrementalPipelineOptions
) -> dict[int, pycolmap.Reconstruction]:
    counter, models = _ProgressCounter(job), pycolmap.ReconstructionManager()
    if job.start_from:
        models.read(job.start_from)
    with contextlib.closing(pycolmap.Database.open(job.database)) as database:
        pipeline = pycolmap.IncrementalPipeline(options, database, models)
    mapper = pycolmap.IncrementalMapper(pipeline.database_cache)
    adjusted: dict[int, int] = {}  # number of images at a model's last adjustment
    local_refinements = options.ba_local_max_refinements
    interrupted = False

    def interrupt() -> None:
        nonlocal interrupted
        interrupted = True

    def adjust(number: int) -> None:
        model = models.get(number)
        adjusted[number] = model.num_reg_images()
        mapper.complete_and_merge_tracks(options.get_triangulation())
        mapper.retriangulate(options.get_triangulation())
        # Intrinsics are well known by now, and a single distortion term would cause doming.
        adjust_long_tracks(
            model, threads=job.threads, refine_intrinsics=False, cost_tolerance=_CONVERGED
        )
        mapper.filter_points(options.get_mapper())

    def on_next() -> None:
        counter.next()
        if interrupted:
            raise KeyboardInterrupt
        number = models.size() - 1
        images = models.get(number).num_reg_images()
        large = images >= _MAX_IMAGES_COLMAP
        # The pipeline reads these before each of its own global adjustments.
        options.ba_global_frames_ratio = options.ba_global_points_ratio = (
            _NEVER if large else _GROWTH
        )
        options.ba_global_max_refinements = 0 if large else 1
        # Before each adjustment, even a local one, COLMAP validates the whole model.
        options.ba_local_max_refinements = 1 if large else local_refinements
        if not large:
            adjusted.pop(number, None)
        elif images >= _GROWTH * adjusted.get(number, 0):
            adjust(number)

    callbacks = pycolmap.IncrementalPipelineCallback
    pipeline.add_callback(int(callbacks.INITIAL_IMAGE_PAIR_REG_CALLBACK), counter.initial)
    pipeline.add_callback(int(callbacks.NEXT_IMAGE_REG_CALLBACK), on_next)
    with child.cancel_on_interrupt(interrupt):
        pipeline.reconstruct(mapper, options.get_mapper(), bool(job.start_from))
    finished = {i: models.get(i) for i in range(models.size())}
    # The last images may have closed a loop and still be metres off on one side of it.
    for i, model in finished.items():
        if model.num_reg_images() >= max(_MAX_IMAGES_COLMAP, adjusted.get(i, 0) + 1):
            mapper.begin_reconstruction(model)
            adjust(i)
            mapper.end_reconstruction(False)
    return finished
