"""Bundle adjustment of a whole model: first cameras from few long tracks, then everything from all inliers.

Many cheap iterations over a twelfth of the measurements remove the doming of a large model, so that the
expensive iterations over all measurements start close to the solution.
"""

from __future__ import annotations

from collections.abc import Mapping

from spn_data.colmap import pycolmap
from spn_data.colmap.clean import drop_out_of_view, drop_outliers, residual_sigma_px
from spn_data.geometry.initial_lens import Hold

_LONG_TRACKS = 100  # per image, used to adjust the cameras first
# Ceres starts with a radius of 1e4. With that damping, the doming of a model hardly changes per iteration: a
# survey of 1,000 images takes nearly twice as many iterations, and the cost may decrease so slowly that the
# adjustment appears converged.
_LARGE_RADIUS = 1e10  # of the trust region
_SMALL_RADIUS = (
    1e4  # for points alone: undamped, points with nearly parallel rays diverge to infinity
)
# COLMAP's limit is 1,000; above it, COLMAP solves the normal equations iteratively, which is too inexact to
# remove doming.
_MAX_IMAGES_DIRECT_SOLVER = 20_000
_MAX_ITERATIONS = 300
_MAX_OUT_OF_VIEW = 0.05  # share of the measurements; with more, the step was too long
# Scale of the Cauchy loss in standard deviations: 95 % efficient for normal errors (Holland & Welsch 1977,
# "Robust regression using iteratively reweighted least-squares").
_CAUCHY = 2.385
_INITIAL_SCALE_PX = 1.0  # of the loss, before the standard deviation of the measurements is known
_MOVED_SCALE_PX = 20.0  # of the loss, when the cameras have moved but the points have not yet
# Relative decrease of the cost at which an adjustment stops.
_CONVERGED = 1e-6  # cameras from long tracks
_CONVERGED_POINTS = 1e-2  # points alone: good enough to detect outliers
_CONVERGED_ALL = 3e-5  # all measurements


def adjust(
    native: pycolmap.Reconstruction,
    *,
    refine_principal_point: bool,
    threads: int,
    held: Mapping[int, Hold] | None = None,
) -> int:
    """Refine cameras, poses and points in place.

    Parameters
    ----------
    native : pycolmap.Reconstruction
    refine_principal_point : bool
        Whether to estimate the principal points too.
    threads : int
        Number of solver threads.
    held : mapping of int to Hold, optional
        What is not changed of a camera, by COLMAP's id.

    Returns
    -------
    int
        Number of measurements that were deleted as outliers.
    """
    dropped = drop_out_of_view(native)
    adjust_long_tracks(
        native, threads=threads, refine_principal_point=refine_principal_point, held=held
    )
    dropped += drop_out_of_view(native) + drop_outliers(native)
    # Keep the remaining outliers from bending the model.
    options = _options(threads, _CAUCHY * residual_sigma_px(native), _CONVERGED_ALL)
    options.refine_principal_point = refine_principal_point
    _solve(native, options, held or {})
    return dropped


def adjust_long_tracks(
    native: pycolmap.Reconstruction,
    *,
    threads: int,
    refine_intrinsics: bool = True,
    refine_principal_point: bool = False,
    cost_tolerance: float = _CONVERGED,
    held: Mapping[int, Hold] | None = None,
) -> None:
    """Refine cameras and poses in place from the longest tracks only, then adjust the points.

    Parameters
    ----------
    native : pycolmap.Reconstruction
    threads : int
        Number of solver threads.
    refine_intrinsics, refine_principal_point : bool
        Which intrinsics to estimate: focal length and distortion, principal point.
    cost_tolerance : float
        Relative decrease of the cost at which the adjustment of the cameras stops.
    held : mapping of int to Hold, optional
        What is not changed of a camera, by COLMAP's id.
    """
    for radius in (_LARGE_RADIUS, _SMALL_RADIUS):
        few = _with_long_tracks(native)
        options = _options(threads, _INITIAL_SCALE_PX, cost_tolerance)
        options.ceres.solver_options.initial_trust_region_radius = radius
        options.refine_focal_length = options.refine_extra_params = refine_intrinsics
        options.refine_principal_point = refine_principal_point
        _solve(few, options, held or {})
        # Points behind a camera do not contribute to the cost: too long a step may move all of them there.
        if drop_out_of_view(few) < _MAX_OUT_OF_VIEW * few.compute_num_observations():
            _copy_cameras(few, native)
            break
    del few
    _adjust_points(native, threads)


def _solve(
    native: pycolmap.Reconstruction,
    options: pycolmap.BundleAdjustmentOptions,
    held: Mapping[int, Hold],
) -> None:
    """Run one bundle adjustment that keeps what is held.

    COLMAP holds the focal length of all cameras or of none. If some are free, distortion of those whose focal
    length is held is estimated first, with all focal lengths held.
    """
    focal = {i for i, hold in held.items() if hold is Hold.FOCAL}
    lens = {i for i, hold in held.items() if hold is Hold.LENS}
    if focal and options.refine_focal_length:
        options.refine_focal_length = False
        _run(native, options, lens)
        options.refine_focal_length = True
        if not set(native.cameras) - held.keys():
            return
    _run(native, options, lens | focal)


def _run(
    native: pycolmap.Reconstruction, options: pycolmap.BundleAdjustmentOptions, constant: set[int]
) -> None:
    """Run one bundle adjustment in which the intrinsics of some cameras are constant."""
    if not constant:
        pycolmap.bundle_adjustment(native, options)
        return
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in native.reg_image_ids():
        config.add_image(image_id)
    for camera_id in constant & set(native.cameras):
        config.set_constant_cam_intrinsics(camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_ceres_bundle_adjuster(options, config, native).solve()


def _options(
    threads: int, scale_px: float, cost_tolerance: float
) -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = scale_px
    options.ceres.max_num_images_direct_sparse_cpu_solver = _MAX_IMAGES_DIRECT_SOLVER
    solver = options.ceres.solver_options
    solver.num_threads = threads
    solver.max_num_iterations = _MAX_ITERATIONS
    solver.function_tolerance = cost_tolerance
    solver.initial_trust_region_radius = _LARGE_RADIUS
    return options


def _with_long_tracks(native: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Copy a model with its longest tracks only: enough for 100 per image, if it has that many."""
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


def _copy_cameras(source: pycolmap.Reconstruction, target: pycolmap.Reconstruction) -> None:
    for camera_id, camera in source.cameras.items():
        target.cameras[camera_id].params = camera.params
    for frame_id in source.reg_frame_ids():
        target.frames[frame_id].rig_from_world = source.frames[frame_id].rig_from_world


def _adjust_points(native: pycolmap.Reconstruction, threads: int) -> None:
    options = _options(threads, _MOVED_SCALE_PX, _CONVERGED_POINTS)
    options.refine_focal_length = options.refine_extra_params = False
    options.refine_rig_from_world = False
    options.ceres.solver_options.initial_trust_region_radius = _SMALL_RADIUS
    pycolmap.bundle_adjustment(native, options)
