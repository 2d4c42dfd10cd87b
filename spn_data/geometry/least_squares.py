"""What every least squares over images is made of: derivatives of pixels, robust weights, sparse rows.

A change of a pose is a move of its centre along the world's axes, then a rotation vector v in the camera
frame with R_changed = exp(v) R: the order of every covariance of ours.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from spn_data.geometry.camera import Camera

POSE = 6
LENS = 8  # fx, fy, cx, cy, k1, k2, p1, p2
# What each parameter of a lens moves of these.
_OF_LENS = {
    **{"f": (0, 1), "fx": (0,), "fy": (1,), "cx": (2,), "cy": (3,)},
    **{"k1": (4,), "k2": (5,), "p1": (6,), "p2": (7,)},
}


def projection_jacobians(camera: Camera, points_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of pixels by points in the camera frame (M, 2, 3) and by the lens (M, 2, 8)."""
    fx, fy = camera.focal_px
    k1, k2, p1, p2 = camera.opencv_distortion
    z = points_cam[:, 2]
    x, y = points_cam[:, 0] / z, points_cam[:, 1] / z
    r2 = x * x + y * y
    radial, slope = 1 + k1 * r2 + k2 * r2 * r2, 2 * (k1 + 2 * k2 * r2)
    by_xy = np.empty((len(z), 2, 2))
    by_xy[:, 0, 0] = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    by_xy[:, 0, 1] = by_xy[:, 1, 0] = slope * x * y + 2 * p1 * x + 2 * p2 * y
    by_xy[:, 1, 1] = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    focal = np.array([fx, fy])
    by_xy *= focal[:, None]
    zero = np.zeros_like(x)
    xy_by_point = np.stack(
        [np.stack([1 / z, zero, -x / z], axis=-1), np.stack([zero, 1 / z, -y / z], axis=-1)], axis=1
    )
    distorted = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
        ],
        axis=1,
    )
    one = np.ones_like(x)
    by_lens = np.zeros((len(z), 2, LENS))
    by_lens[:, 0, 0], by_lens[:, 1, 1] = distorted[:, 0], distorted[:, 1]
    by_lens[:, 0, 2], by_lens[:, 1, 3] = one, one
    by_lens[:, :, 4] = focal * np.stack([x * r2, y * r2], axis=1)
    by_lens[:, :, 5] = focal * np.stack([x * r2 * r2, y * r2 * r2], axis=1)
    by_lens[:, :, 6] = focal * np.stack([2 * x * y, r2 + 2 * y * y], axis=1)
    by_lens[:, :, 7] = focal * np.stack([r2 + 2 * x * x, 2 * x * y], axis=1)
    return by_xy @ xy_by_point, by_lens


def pose_jacobians(
    points_cam: np.ndarray, by_point_cam: np.ndarray, by_point: np.ndarray
) -> np.ndarray:
    """Derivatives (M, 2, 6) by poses, from those (M, 2, 3) by points (M, 3) along camera and world axes."""
    return np.concatenate([-by_point, np.cross(points_cam[:, None], by_point_cam)], axis=2)


def lens_parameter_jacobian(parameters: Sequence[str]) -> np.ndarray:
    """(8, L) from L parameters, by their names in COLMAP's models, to fx, fy, cx, cy, k1, k2, p1, p2."""
    mixing = np.zeros((LENS, len(parameters)))
    for k, name in enumerate(parameters):
        mixing[list(_OF_LENS[name]), k] = 1.0
    return mixing


def cauchy_weights(residuals_px: np.ndarray, scale_px: float) -> np.ndarray:
    """(M,) of residuals (M, 2)."""
    return 1 / (1 + (residuals_px**2).sum(axis=1) / scale_px**2)


def rows_to_sparse(values: np.ndarray, columns: np.ndarray, width: int) -> sparse.csr_matrix:
    """(2 M, width) from blocks (M, 2, n) whose both rows have the columns (M, n)."""
    m, two, n = values.shape
    pointers = n * np.arange(two * m + 1)
    return sparse.csr_matrix(
        (values.ravel(), np.repeat(columns, two, axis=0).ravel(), pointers), (two * m, width)
    )


def point_whitening(
    by_point: np.ndarray, point: np.ndarray, count: int, *, ridge: float
) -> np.ndarray:
    """(P, 3, 3) Q with Q^T Q = V^-1, where V is the information on each point.

    by_point : (M, 2, 3) derivatives; point : (M,) 0..P-1; ridge : added to V, as a share of its trace.
    """
    information = np.zeros((count, 3, 3))
    np.add.at(information, point, np.einsum("mki,mkj->mij", by_point, by_point))
    trace = np.trace(information, axis1=1, axis2=2)
    information += (ridge * trace + 1e-300)[:, None, None] * np.eye(3)
    return np.linalg.inv(np.linalg.cholesky(information))


def cluster_scores(
    residuals: np.ndarray, cluster: np.ndarray, design: sparse.csr_matrix
) -> sparse.csr_matrix:
    """(C, n) pull of each cluster's residuals together on the unknowns of a design (2 M, n).

    residuals : (2 M,); cluster : (M,) 0..C-1 of each measurement.
    """
    m = len(residuals)
    gather = sparse.csr_matrix(
        (residuals, (np.repeat(cluster, 2), np.arange(m))), (int(cluster.max()) + 1, m)
    )
    return (gather @ design).tocsr()
