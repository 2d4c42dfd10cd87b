"""Wrong measurements of a model, found in its geometry; they are few and decide much."""

from __future__ import annotations

import math

import numpy as np

from spn_data.colmap import pycolmap
from spn_data.colmap.model import from_native_camera, registered_images

_BEYOND_RIM = 1.2  # of the image's farthest corner, from where a point can't be in view
_OUTLIER = 5.0  # standard deviations of a residual
_MEDIAN_LENGTH = 1.1774  # of a residual whose two components have a deviation of one
_TELLING_IMAGES = 50  # whose residuals tell the deviation of all
_MIN_ANGLE_DEG = 1.5  # at which a point's rays meet; COLMAP's own limit


def drop_out_of_view(native: pycolmap.Reconstruction) -> int:
    """Delete measurements of points far beyond the image's rim or behind the camera; how many there were.

    A polynomial distortion folds far outside the image: rays at 80 degrees may land in its middle. One wrong
    match that does so has such leverage that it alone decides the distortion of the lens.
    """
    dropped = 0
    for image in registered_images(native):
        camera = from_native_camera(native.cameras[image.camera_id])
        w, h = camera.width, camera.height
        corners = camera.unproject(np.array([[0, 0], [w, 0], [0, h], [w, h]]))
        rim = _BEYOND_RIM * float(np.linalg.norm(corners, axis=1).max())
        seen, in_camera, _ = _measured(native, image)
        reach = np.linalg.norm(in_camera[:, :2], axis=1)
        for k in np.flatnonzero(reach > rim * in_camera[:, 2]).tolist():
            # A point goes with the second last of its measurements.
            if image.points2D[seen[k]].has_point3D():
                native.delete_observation(image.image_id, seen[k])
                dropped += 1
    return dropped


def drop_outliers(native: pycolmap.Reconstruction) -> int:
    """Delete measurements five deviations beside their point, and points without depth; how many there were.

    Least squares bends a model to where wrong matches want it: a hundredth of the tracks of a good flight
    carry most of its error. The deviation is told by the median, which they do not move.
    """
    return _filter(native, _OUTLIER * residual_sigma_px(native))


def residual_sigma_px(native: pycolmap.Reconstruction) -> float:
    """Deviation of a residual's component, as its median tells it, in at most 50 images."""
    lengths = []
    images = registered_images(native)
    for image in images[:: math.ceil(len(images) / _TELLING_IMAGES)]:
        camera = from_native_camera(native.cameras[image.camera_id])
        _, in_camera, pixels = _measured(native, image)
        lengths.append(np.linalg.norm(camera.project(in_camera) - pixels, axis=1))
    return float(np.nanmedian(np.concatenate(lengths))) / _MEDIAN_LENGTH


def drop_without_depth(native: pycolmap.Reconstruction) -> int:
    """Delete points whose rays meet at less than 1.5 degrees; how many measurements they had."""
    return _filter(native, 1e9)


def _filter(native: pycolmap.Reconstruction, max_error_px: float) -> int:
    manager = pycolmap.ObservationManager(native)
    return int(manager.filter_all_points3D(max_error_px, _MIN_ANGLE_DEG))


def _measured(
    native: pycolmap.Reconstruction, image: pycolmap.Image
) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Features (K) of an image that are points, these points in the camera frame (K, 3), pixels (K, 2)."""
    # Each look at these attributes makes an object anew.
    points_2d, points_3d = image.points2D, native.points3D
    seen = list(image.get_observation_point2D_idxs())
    observed = [points_2d[k] for k in seen]
    points = np.array([points_3d[p.point3D_id].xyz for p in observed]).reshape(-1, 3)
    rigid = image.cam_from_world()
    in_camera = points @ rigid.rotation.matrix().T + rigid.translation
    return seen, in_camera, np.array([p.xy for p in observed]).reshape(-1, 2)
