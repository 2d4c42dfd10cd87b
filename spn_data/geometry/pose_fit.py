"""Nonlinear refinement of one camera pose from 2D-3D correspondences."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.geometry.camera import Camera
from spn_data.geometry.least_squares import cauchy_weights, pose_jacobians, projection_jacobians
from spn_data.geometry.pose import Poses, to_camera
from spn_data.geometry.rotations import rotations_from_vectors

_MAX_STEPS = 20
_CONVERGED_PX = 1e-3  # mean change of the projections
_BEHIND_PX = 1e6  # residual of a point behind the camera


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A pose fitted to K points.

    Attributes
    ----------
    poses : Poses
        The one fitted pose.
    residuals_px : ndarray, shape (K, 2)
        Projected minus measured pixels.
    inverse : ndarray, shape (6, 6)
        Inverse of the robust normal matrix over the centre and a rotation vector in the camera frame, for
        residuals of one pixel.
    """

    poses: Poses
    residuals_px: np.ndarray
    inverse: np.ndarray

    def inliers(self, max_error_px: float) -> np.ndarray:
        """Return the mask (K,) of points whose reprojection error is below a limit."""
        return (self.residuals_px**2).sum(axis=1) < max_error_px**2


def fit_pose(
    camera: Camera,
    start: Poses,
    xyz: np.ndarray,
    pixels: np.ndarray,
    *,
    first_px: float,
    last_px: float,
) -> PoseFit | None:
    """Refine a pose by minimising a Cauchy loss of the reprojection errors.

    The scale of the loss shrinks from `first_px` to `last_px`, so that a start that is off by some pixels
    converges and distant outliers have little influence at the end.

    Parameters
    ----------
    camera : Camera
        Camera of the image.
    start : Poses
        One initial pose.
    xyz : ndarray, shape (K, 3)
        Map points in the world frame.
    pixels : ndarray, shape (K, 2)
        Their measurements in the (distorted) image.
    first_px, last_px : float
        Scale of the loss in the first and in the last iterations.

    Returns
    -------
    PoseFit or None
        None if the refinement does not converge.
    """
    center, rotation = start.centers[0], start.rotations[0]
    scale = max(first_px, last_px)
    for _ in range(_MAX_STEPS):
        in_camera = to_camera(xyz, center, rotation)
        ahead = in_camera[:, 2] > 0
        if np.count_nonzero(ahead) < 4:
            return None
        x, residuals = in_camera[ahead], camera.project(in_camera[ahead]) - pixels[ahead]
        weights = cauchy_weights(residuals, scale)
        by_point = projection_jacobians(camera, x)[0]
        by_pose = pose_jacobians(x, by_point, by_point @ rotation).reshape(-1, 6)
        weighted = by_pose * np.repeat(weights, 2)[:, None]
        try:
            inverse = np.linalg.inv(weighted.T @ by_pose)
        except np.linalg.LinAlgError:
            return None
        step = -inverse @ (weighted.T @ residuals.ravel())
        if not np.isfinite(step).all():
            return None
        center = center + step[:3]
        rotation = rotations_from_vectors(step[3:]) @ rotation
        if scale == last_px and np.abs(by_pose @ step).mean() < _CONVERGED_PX:
            break
        scale = max(last_px, scale / 2)
    else:
        return None
    poses = Poses.from_rotations(center[None], rotation[None])
    residuals = camera.project(to_camera(xyz, center, rotation)) - pixels
    return PoseFit(poses, np.nan_to_num(residuals, nan=_BEHIND_PX), inverse)
