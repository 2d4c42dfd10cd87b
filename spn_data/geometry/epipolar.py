"""Epipolar geometry of two posed images (Hartley & Zisserman 2004, chapters 9 and 11)."""

from __future__ import annotations

import numpy as np

from spn_data.geometry.pose import Poses


def essential_matrix(poses: Poses, a: int, b: int) -> np.ndarray:
    """Return the essential matrix of two posed images.

    Parameters
    ----------
    poses : Poses
        Poses that include the two images.
    a, b : int
        Rows of the two images in `poses`.

    Returns
    -------
    ndarray, shape (3, 3)
        E with x_b' E x_a = 0 for rays in the two camera frames; the baseline is scaled to unit length.
    """
    rotations, centers = poses.rotations, poses.centers
    baseline = rotations[b] @ (centers[a] - centers[b])
    x, y, z = baseline / max(float(np.linalg.norm(baseline)), 1e-12)
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(across @ rotations[b] @ rotations[a].T)


def sampson_errors(a: np.ndarray, b: np.ndarray, essential: np.ndarray) -> np.ndarray:
    """Return the Sampson distances of matches: the first-order distance from their epipolar lines.

    Parameters
    ----------
    a, b : ndarray, shape (K, 2)
        Matched points in undistorted normalised image coordinates.
    essential : ndarray, shape (3, 3)
        Essential matrix with x_b' E x_a = 0.

    Returns
    -------
    ndarray, shape (K,)
        Distances in units of the focal length.
    """
    a, b = _homogeneous(a), _homogeneous(b)
    line_b, line_a = a @ essential.T, b @ essential
    slope = (line_b[:, :2] ** 2).sum(axis=1) + (line_a[:, :2] ** 2).sum(axis=1)
    return np.asarray(np.abs((b * line_b).sum(axis=1)) / np.sqrt(np.maximum(slope, 1e-30)))


def _homogeneous(xy: np.ndarray) -> np.ndarray:
    return np.column_stack([xy, np.ones(len(xy))])
