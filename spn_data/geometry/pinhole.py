"""Reprojection residuals of a pinhole camera and their Jacobian by its pose."""

from __future__ import annotations

import numpy as np


def residuals_and_jacobian(
    points_cam: np.ndarray, at: np.ndarray, matrix: np.ndarray, rotation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return reprojection residuals and their Jacobian by the pose.

    A rotation by exp(v) moves a point x by v x x, and a shift d of the centre moves it by -R d.

    Parameters
    ----------
    points_cam : ndarray, shape (N, 3)
        Points in the camera frame, in front of it.
    at : ndarray, shape (N, 2)
        Measured pixels.
    matrix : ndarray, shape (3, 3)
        Camera matrix K.
    rotation : ndarray, shape (3, 3)
        World to camera.

    Returns
    -------
    residuals : ndarray, shape (N, 2)
        Projected minus measured.
    jacobian : ndarray, shape (N, 2, 6)
        By the centre (world axes) and a rotation vector in the camera frame.
    """
    projected = points_cam @ matrix.T
    pixels = projected[:, :2] / projected[:, 2:]
    by_point = (matrix[None, :2] - pixels[:, :, None] * matrix[None, 2:]) / projected[:, 2:, None]
    jacobian = np.empty((len(pixels), 2, 6))
    jacobian[:, :, :3] = (by_point.reshape(-1, 3) @ -rotation).reshape(-1, 2, 3)
    x, y, z = points_cam.T[:, :, None]
    by_x, by_y, by_z = np.moveaxis(by_point, 2, 0)
    jacobian[:, :, 3] = y * by_z - z * by_y  # np.cross takes five times as long
    jacobian[:, :, 4] = z * by_x - x * by_z
    jacobian[:, :, 5] = x * by_y - y * by_x
    return pixels - at, jacobian
