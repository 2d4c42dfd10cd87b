"""Pose of one image from points whose place in the map is known."""

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
    """What agrees best with M correspondences.

    pose : (1) in the map's frame; inliers : (M,) bool; camera : with the focal length that was estimated.
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
    """LO-RANSAC over pixels (M, 2) and points (M, 3), then least squares on the inliers; None without any.

    find_focal : also estimates the focal length, from four points a sample.
    """
    if len(pixels) < 4:
        return None
    native = native_camera(camera, focal_is_known=not find_focal)
    estimation = pycolmap.AbsolutePoseEstimationOptions(estimate_focal_length=find_focal)
    estimation.ransac.max_error = max_error_px
    estimation.ransac.random_seed = seed
    refinement = pycolmap.AbsolutePoseRefinementOptions(refine_focal_length=find_focal)
    found = pycolmap.estimate_and_refine_absolute_pose(
        pixels, points, native, estimation, refinement
    )
    if found is None:
        return None
    rigid = found["cam_from_world"]
    pose = Poses.from_cam_from_world(rigid.rotation.quat[None], rigid.translation[None])
    if not (np.isfinite(pose.centers).all() and np.isfinite(native.params).all()):
        return None
    return Resection(pose, np.asarray(found["inlier_mask"], bool), from_native_camera(native))
