"""Epipolar geometry of two posed images (Hartley & Zisserman 2004, chapters 9 and 11)."""

from __future__ import annotations

import numpy as np

from spn_data.geometry.pose import Poses


def essential_matrix(poses: Poses, a: int, b: int) -> np.ndarray:
    """(3, 3), x_b' E x_a = 0 for rays in the camera frames of two poses; its baseline has length one."""
    rotations, centers = poses.rotations, poses.centers
    baseline = rotations[b] @ (centers[a] - centers[b])
    x, y, z = baseline / max(float(np.linalg.norm(baseline)), 1e-12)
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(across @ rotations[b] @ rotations[a].T)


def sampson_errors(a: np.ndarray, b: np.ndarray, essential: np.ndarray) -> np.ndarray:
    """First-order distance (K,) of matches from their epipolar lines, in units of the focal length.

    a, b : (K, 2) undistorted, on the plane at distance one.
    """
    a, b = _homogeneous(a), _homogeneous(b)
    line_b, line_a = a @ essential.T, b @ essential
    slope = (line_b[:, :2] ** 2).sum(axis=1) + (line_a[:, :2] ** 2).sum(axis=1)
    return np.asarray(np.abs((b * line_b).sum(axis=1)) / np.sqrt(np.maximum(slope, 1e-30)))


def _homogeneous(xy: np.ndarray) -> np.ndarray:
    return np.column_stack([xy, np.ones(len(xy))])
