"""Resection: pose of one image from 2D-3D correspondences with the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.colmap import pycolmap
from spn_data.colmap.model import from_native_camera
from spn_data.colmap.verify import native_camera
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses


@dataclass(frozen=True, eq=False)
class Resection:
    """Result of a resection from M correspondences.

    Attributes
    ----------
    pose : Poses
        One pose, in the map's frame.
    inliers : ndarray, shape (M,), bool
        Correspondences that agree with the pose.
    camera : Camera
        Intrinsics; includes the focal length if it was estimated.
    """

    pose: Poses
    inliers: np.ndarray
    camera: Camera


def resect(
    pixels: np.ndarray,
    points: np.ndarray,
    camera: Camera,
    *,
    max_error_px: float,
    find_focal: bool = False,
    seed: int = 0,
) -> Resection | None:
    """Estimate a camera pose by LO-RANSAC, refined by least squares on the inliers.

    Parameters
    ----------
    pixels : ndarray, shape (M, 2)
        Measured image points.
    points : ndarray, shape (M, 3)
        Corresponding points in the map's frame.
    camera : Camera
        Intrinsics.
    max_error_px : float
        Maximum reprojection error of an inlier.
    find_focal : bool
        Estimate the focal length too, from samples of four points.
    seed : int
        Random seed.

    Returns
    -------
    Resection or None
        None with fewer than four correspondences or if no finite pose is found.
    """
    if len(pixels) < 4:
        return None
    native = native_camera(camera, focal_is_known=not find_focal)
    estimation = pycolmap.AbsolutePoseEstimationOptions(estimate_focal_length=find_focal)
    estimation.ransac.max_error = max_error_px
    estimation.ransac.random_seed = seed
    refinement = pycolmap.AbsolutePoseRefinementOptions(refine_focal_length=find_focal)
    estimate = pycolmap.estimate_and_refine_absolute_pose(
        pixels, points, native, estimation, refinement
    )
    if estimate is None:
        return None
    rigid = estimate["cam_from_world"]
    pose = Poses.from_cam_from_world(rigid.rotation.quat[None], rigid.translation[None])
    if not (np.isfinite(pose.centers).all() and np.isfinite(native.params).all()):
        return None
    return Resection(pose, np.asarray(estimate["inlier_mask"], bool), from_native_camera(native))
