"""Bundle adjustment of a whole model: cameras from few long tracks first, then from all that is right.

Many cheap iterations over a twelfth of the measurements take out what bends a large model; the dear ones over
all of them start next to their end.
"""

from __future__ import annotations

from spn_data.colmap import pycolmap
from spn_data.colmap.clean import drop_out_of_view, drop_outliers, residual_sigma_px

_LONG_TRACKS = 100  # of each image, from which cameras are found first
# Ceres begins at 1e4. Damped like that, what bends a model hardly changes in an iteration: a survey of 1,000
# images takes nearly twice as many, and the cost may decrease so little that it passes for converged.
_LONG_STEPS = 1e10  # radius of the trust region
_DAMPED = 1e4  # for points alone: undamped, those that near rays meet in are thrown to infinity
# COLMAP's limit is 1,000; beyond, it solves inexactly what a bent model needs exactly.
_MOST_IMAGES_SOLVED_EXACTLY = 20_000
_ITERATIONS = 300
_TURNED_OVER = 0.05  # of the measurements, out of view
# Deviations at which Cauchy's loss begins to bend: 95 % efficient for normal errors (Holland & Welsch
# 1977, "Robust regression using iteratively reweighted least-squares").
_CAUCHY = 2.385
_FIRST_SCALE_PX = 1.0  # of the loss, while the deviation of measurements is not known yet
_MOVED_SCALE_PX = 20.0  # where points lie as before while the cameras have moved
# Relative decreases of the cost at which an adjustment ends.
_CONVERGED = 1e-6  # of long tracks
_CLOSE = 1e-2  # of points alone, as far as it takes to tell wrong measurements
_UNCHANGED = 3e-5  # of all


def adjust(native: pycolmap.Reconstruction, *, refine_principal_point: bool, threads: int) -> int:
    """Refine cameras, poses and points in place; how many measurements were found wrong and deleted."""
    dropped = drop_out_of_view(native)
    straighten(native, threads=threads, refine_principal_point=refine_principal_point)
    dropped += drop_out_of_view(native) + drop_outliers(native)
    # What is left of wrong matches shall not bend the model either.
    options = _options(threads, _CAUCHY * residual_sigma_px(native), _UNCHANGED)
    options.refine_principal_point = refine_principal_point
    pycolmap.bundle_adjustment(native, options)
    return dropped


def straighten(
    native: pycolmap.Reconstruction,
    *,
    threads: int,
    refine_intrinsics: bool = True,
    refine_principal_point: bool = False,
    decrease: float = _CONVERGED,
) -> None:
    """Refine cameras and poses in place by the longest tracks alone, and then points.

    decrease : of the cost, relative, at which cameras are as they shall be.
    """
    for radius in (_LONG_STEPS, _DAMPED):
        few = _with_long_tracks(native)
        options = _options(threads, _FIRST_SCALE_PX, decrease)
        options.ceres.solver_options.initial_trust_region_radius = radius
        options.refine_focal_length = options.refine_extra_params = refine_intrinsics
        options.refine_principal_point = refine_principal_point
        pycolmap.bundle_adjustment(few, options)
        # What lies behind a camera costs nothing: a step too long may end with all of it there.
        if drop_out_of_view(few) < _TURNED_OVER * few.compute_num_observations():
            _take_cameras(native, few)
            break
    del few
    _adjust_points(native, threads)


def _options(threads: int, scale_px: float, decrease: float) -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = scale_px
    options.ceres.max_num_images_direct_sparse_cpu_solver = _MOST_IMAGES_SOLVED_EXACTLY
    solver = options.ceres.solver_options
    solver.num_threads = threads
    solver.max_num_iterations = _ITERATIONS
    solver.function_tolerance = decrease
    solver.initial_trust_region_radius = _LONG_STEPS
    return options


def _with_long_tracks(native: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A copy with the longest tracks alone: as many as give each image a hundred, where it has them."""
    tracks = {
        point_id: [element.image_id for element in point.track.elements]
        for point_id, point in native.points3D.items()
    }
    seen = dict.fromkeys(native.reg_image_ids(), 0)
    few = pycolmap.Reconstruction(native)
    for point_id in sorted(tracks, key=lambda i: (-len(tracks[i]), i)):
        images = tracks[point_id]
        if min(seen[i] for i in images) >= _LONG_TRACKS:
            few.delete_point3D(point_id)
            continue
        for i in images:
            seen[i] += 1
    return few


def _take_cameras(native: pycolmap.Reconstruction, other: pycolmap.Reconstruction) -> None:
    for camera_id, camera in other.cameras.items():
        native.cameras[camera_id].params = camera.params
    for frame_id in other.reg_frame_ids():
        native.frames[frame_id].rig_from_world = other.frames[frame_id].rig_from_world


def _adjust_points(native: pycolmap.Reconstruction, threads: int) -> None:
    options = _options(threads, _MOVED_SCALE_PX, _CLOSE)
    options.refine_focal_length = options.refine_extra_params = False
    options.refine_rig_from_world = False
    options.ceres.solver_options.initial_trust_region_radius = _DAMPED
    pycolmap.bundle_adjustment(native, options)
