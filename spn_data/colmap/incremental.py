"""COLMAP's incremental mapper, in the child process that `mapping` starts.

Its global bundle adjustments are solved exactly up to a thousand images. Beyond, each takes minutes and
leaves a survey bent: there they are our own, over the longest tracks.
"""

from __future__ import annotations

import contextlib

from spn_data.colmap import pycolmap
from spn_data.colmap.adjust import straighten
from spn_data.colmap.job import MappingJob
from spn_data.work import child

_SOLVED_EXACTLY = 1000  # images, by COLMAP
_GROWTH = 1.35  # of images or points, after which all is adjusted
_CLOSE = 1e-4  # relative decrease of the cost, at which a global bundle adjustment ends
_NEVER = 1_000_000_000


def map_incrementally(job: MappingJob) -> dict[int, pycolmap.Reconstruction]:
    """Models by COLMAP's number; each registered image is told to the parent."""
    options = _pipeline_options(job)
    with contextlib.closing(pycolmap.Database.open(job.database)) as database:
        images = database.num_images()
    run = _map_small if images <= _SOLVED_EXACTLY else _map_large
    return run(job, options)


def _pipeline_options(job: MappingJob) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=job.threads,
        random_seed=job.seed,
        snapshot_path=job.snapshots,
        snapshot_frames_freq=job.snapshot_every,
    )
    options.min_model_size = job.min_model_size
    options.extract_colors = False  # `refine` does, once
    # 127 degrees wide: shorter focal lengths only fit the noise of a weak geometry.
    for part in (options, options.mapper, options.triangulation):
        part.min_focal_length_ratio = 0.25
    if job.hold_intrinsics:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = False
        options.mapper.abs_pose_refine_extra_params = False
    # A last bundle adjustment follows in `refine`: those on the way need not be many, nor converge.
    options.ba_global_frames_ratio = options.ba_global_points_ratio = _GROWTH
    options.ba_global_frames_freq = options.ba_global_points_freq = _NEVER
    options.ba_global_max_refinements = 1
    options.ba_global_max_num_iterations = 30
    options.ba_global_function_tolerance = _CLOSE
    return options


class _Count:
    """Registered images, as the parent is told."""

    def __init__(self, job: MappingJob):
        # The mapper announces an initial pair also where it goes on from a model.
        self._initial = 0 if job.start_from else 2
        self._registered = 0
        if job.start_from:
            self._registered = pycolmap.Reconstruction(job.start_from).num_reg_images()

    def initial(self) -> None:
        self._tell(self._initial)

    def next(self) -> None:
        self._tell(1)

    def _tell(self, new: int) -> None:
        self._registered += new
        child.send({"registered": self._registered})


def _map_small(
    job: MappingJob, options: pycolmap.IncrementalPipelineOptions
) -> dict[int, pycolmap.Reconstruction]:
    count, token = _Count(job), pycolmap.CancellationToken()
    with child.cancel_on_interrupt(token.cancel):
        models: dict[int, pycolmap.Reconstruction] = pycolmap.incremental_mapping(
            job.database,
            job.images,
            job.output,
            options,
            input_path=job.start_from,
            initial_image_pair_callback=count.initial,
            next_image_callback=count.next,
            cancellation_token=token,
        )
    return models


def _map_large(
    job: MappingJob, options: pycolmap.IncrementalPipelineOptions
) -> dict[int, pycolmap.Reconstruction]:
    count, models = _Count(job), pycolmap.ReconstructionManager()
    if job.start_from:
        models.read(job.start_from)
    with contextlib.closing(pycolmap.Database.open(job.database)) as database:
        pipeline = pycolmap.IncrementalPipeline(options, database, models)
    mapper = pycolmap.IncrementalMapper(pipeline.database_cache)
    adjusted: dict[int, int] = {}  # images of a model at its last adjustment
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
        # By now lenses are known, and one distortion term alone would bend what is straight.
        straighten(model, threads=job.threads, refine_intrinsics=False, decrease=_CLOSE)
        mapper.filter_points(options.get_mapper())

    def on_next() -> None:
        count.next()
        if interrupted:
            raise KeyboardInterrupt
        number = models.size() - 1
        images = models.get(number).num_reg_images()
        large = images >= _SOLVED_EXACTLY
        # The pipeline looks at these before each of its own.
        options.ba_global_frames_ratio = options.ba_global_points_ratio = (
            _NEVER if large else _GROWTH
        )
        options.ba_global_max_refinements = 0 if large else 1
        # Before each adjustment, however local, COLMAP goes through the whole model to see that it is valid.
        options.ba_local_max_refinements = 1 if large else local_refinements
        if not large:
            adjusted.pop(number, None)
        elif images >= _GROWTH * adjusted.get(number, 0):
            adjust(number)

    callbacks = pycolmap.IncrementalPipelineCallback
    pipeline.add_callback(int(callbacks.INITIAL_IMAGE_PAIR_REG_CALLBACK), count.initial)
    pipeline.add_callback(int(callbacks.NEXT_IMAGE_REG_CALLBACK), on_next)
    with child.cancel_on_interrupt(interrupt):
        pipeline.reconstruct(mapper, options.get_mapper(), bool(job.start_from))
    made = {i: models.get(i) for i in range(models.size())}
    # The last images may have closed a loop, and lie metres off on one side of it.
    for i, model in made.items():
        if model.num_reg_images() >= max(_SOLVED_EXACTLY, adjusted.get(i, 0) + 1):
            mapper.begin_reconstruction(model)
            adjust(i)
            mapper.end_reconstruction(False)
    return made
