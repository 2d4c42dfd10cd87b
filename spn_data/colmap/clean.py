"""Detection and removal of outlier measurements by the geometry of a model."""

from __future__ import annotations

import math

import numpy as np

from spn_data.colmap import pycolmap
from spn_data.colmap.model import from_native_camera, registered_images

_VIEW_MARGIN = (
    1.2  # times the distance of the farthest image corner; beyond it a point is out of view
)
_OUTLIER = 5.0  # standard deviations of a residual
_RAYLEIGH_MEDIAN = (
    1.1774  # median length of a residual whose components have a standard deviation of one
)
_SAMPLED_IMAGES = 50  # used to estimate the standard deviation of the residuals
_MIN_ANGLE_DEG = 1.5  # triangulation angle of a point; COLMAP's own limit


def drop_out_of_view(native: pycolmap.Reconstruction) -> int:
    """Delete measurements of points far outside the field of view or behind the camera.

    A polynomial distortion folds back far outside the image: rays at 80 degrees may project into its middle.
    A single wrong match of this kind has enough leverage to determine the distortion of the lens on its own.

    Returns
    -------
    int
        Number of deleted measurements.
    """
    dropped = 0
    for image in registered_images(native):
        camera = from_native_camera(native.cameras[image.camera_id])
        w, h = camera.width, camera.height
        corners = camera.unproject(np.array([[0, 0], [w, 0], [0, h], [w, h]]))
        max_reach = _VIEW_MARGIN * float(np.linalg.norm(corners, axis=1).max())
        seen, in_camera, _ = _measured(native, image)
        reach = np.linalg.norm(in_camera[:, :2], axis=1)
        for k in np.flatnonzero(reach > max_reach * in_camera[:, 2]).tolist():
            # COLMAP deletes a point together with its second last measurement.
            if image.points2D[seen[k]].has_point3D():
                native.delete_observation(image.image_id, seen[k])
                dropped += 1
    return dropped


def drop_outliers(native: pycolmap.Reconstruction) -> int:
    """Delete measurements with residuals above five standard deviations, and points without depth.

    Least squares distorts a model to fit wrong matches: 1 % of the tracks of a good flight cause most of its
    error. The standard deviation is computed from the median residual, which outliers do not affect.

    Returns
    -------
    int
        Number of deleted measurements.
    """
    return _filter(native, _OUTLIER * residual_sigma_px(native))


def residual_sigma_px(native: pycolmap.Reconstruction) -> float:
    """Return the standard deviation of one residual component in pixels.

    It is computed robustly from the median residual length in at most 50 images.
    """
    lengths = []
    images = registered_images(native)
    for image in images[:: math.ceil(len(images) / _SAMPLED_IMAGES)]:
        camera = from_native_camera(native.cameras[image.camera_id])
        _, in_camera, pixels = _measured(native, image)
        lengths.append(np.linalg.norm(camera.project(in_camera) - pixels, axis=1))
    return float(np.nanmedian(np.concatenate(lengths))) / _RAYLEIGH_MEDIAN


def drop_without_depth(native: pycolmap.Reconstruction) -> int:
    """Delete points with triangulation angles below 1.5 degrees; return their number of measurements."""
    return _filter(native, 1e9)


def _filter(native: pycolmap.Reconstruction, max_error_px: float) -> int:
    manager = pycolmap.ObservationManager(native)
    return int(manager.filter_all_points3D(max_error_px, _MIN_ANGLE_DEG))


def _measured(
    native: pycolmap.Reconstruction, image: pycolmap.Image
) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Return the triangulated features of an image.

    These are the feature indices (K), their points in the camera frame (K, 3) and their pixels (K, 2).
    """
    # Each access to these attributes creates a new Python object.
    points_2d, points_3d = image.points2D, native.points3D
    seen = list(image.get_observation_point2D_idxs())
    observed = [points_2d[k] for k in seen]
    points = np.array([points_3d[p.point3D_id].xyz for p in observed]).reshape(-1, 3)
    rigid = image.cam_from_world()
    in_camera = points @ rigid.rotation.matrix().T + rigid.translation
    return seen, in_camera, np.array([p.xy for p in observed]).reshape(-1, 2)
