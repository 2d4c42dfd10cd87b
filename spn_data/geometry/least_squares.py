"""Building blocks of least squares over images: projection Jacobians, robust weights, sparse rows.

A pose is updated by a translation of its centre along the world axes, followed by a rotation vector v in the
camera frame with R_new = exp(v) R. All 6 x 6 pose covariances of this package use this parameterisation.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from spn_data.geometry.camera import Camera

POSE = 6
LENS = 8  # fx, fy, cx, cy, k1, k2, p1, p2
# Indices of the lens terms that each parameter of a camera model sets.
_LENS_TERMS_OF = {
    **{"f": (0, 1), "fx": (0,), "fy": (1,), "cx": (2,), "cy": (3,)},
    **{"k1": (4,), "k2": (5,), "p1": (6,), "p2": (7,)},
}


def projection_jacobians(camera: Camera, points_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the Jacobians of pixels with respect to points and intrinsics.

    Parameters
    ----------
    camera : Camera
        The camera that the points are projected with.
    points_cam : ndarray, shape (M, 3)
        Points in the camera frame.

    Returns
    -------
    by_point_cam : ndarray, shape (M, 2, 3)
        Derivatives by the points in the camera frame.
    by_lens : ndarray, shape (M, 2, 8)
        Derivatives by fx, fy, cx, cy, k1, k2, p1, p2.
    """
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
    distorted = camera.distort(np.column_stack([x, y]))
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
    """Return the Jacobians of pixels with respect to poses (translation, then rotation vector; see above).

    Parameters
    ----------
    points_cam : ndarray, shape (M, 3)
        Points in the camera frame.
    by_point_cam, by_point : ndarray, shape (M, 2, 3)
        Derivatives of the pixels by the points along camera axes and along world axes.

    Returns
    -------
    ndarray, shape (M, 2, 6)
        Derivatives by the poses.
    """
    return np.concatenate([-by_point, np.cross(points_cam[:, None], by_point_cam)], axis=2)


def lens_parameter_jacobian(parameters: Sequence[str]) -> np.ndarray:
    """Return the Jacobian of the eight lens terms with respect to the parameters of a camera model.

    Parameters
    ----------
    parameters : sequence of str
        Names of L parameters as in COLMAP's models.

    Returns
    -------
    ndarray, shape (8, L)
        Derivatives of fx, fy, cx, cy, k1, k2, p1, p2.
    """
    jacobian = np.zeros((LENS, len(parameters)))
    for k, name in enumerate(parameters):
        jacobian[list(_LENS_TERMS_OF[name]), k] = 1.0
    return jacobian


def cauchy_weights(residuals_px: np.ndarray, scale_px: float) -> np.ndarray:
    """Return the weights of a Cauchy loss.

    Parameters
    ----------
    residuals_px : ndarray, shape (M, 2)
        Reprojection residuals.
    scale_px : float
        Scale of the loss.

    Returns
    -------
    ndarray, shape (M,)
        Weights in (0, 1].
    """
    return 1 / (1 + (residuals_px**2).sum(axis=1) / scale_px**2)


def rows_to_sparse(values: np.ndarray, columns: np.ndarray, width: int) -> sparse.csr_matrix:
    """Assemble a sparse design matrix from dense 2 x n blocks.

    Parameters
    ----------
    values : ndarray, shape (M, 2, n)
        Blocks of two rows.
    columns : ndarray, shape (M, n)
        Columns of both rows of each block.
    width : int
        Number of columns of the matrix.

    Returns
    -------
    csr_matrix, shape (2 M, width)
        The two rows of each block, in order.
    """
    m, two, n = values.shape
    pointers = n * np.arange(two * m + 1)
    return sparse.csr_matrix(
        (values.ravel(), np.repeat(columns, two, axis=0).ravel(), pointers), (two * m, width)
    )


def point_whitening(
    by_point: np.ndarray, point: np.ndarray, count: int, *, ridge: float
) -> np.ndarray:
    """Return the whitening of each point: a square root of the inverse of its normal matrix.

    Parameters
    ----------
    by_point : ndarray, shape (M, 2, 3)
        Derivatives of the measurements by their points.
    point : ndarray, shape (M,)
        Point of each measurement, 0..P-1.
    count : int
        Number of points P.
    ridge : float
        Regularisation added to the diagonal of the normal matrix V, as a share of its trace.

    Returns
    -------
    ndarray, shape (P, 3, 3)
        Q with Q^T Q = V^-1.
    """
    information = np.zeros((count, 3, 3))
    np.add.at(information, point, np.einsum("mki,mkj->mij", by_point, by_point))
    trace = np.trace(information, axis1=1, axis2=2)
    information += (ridge * trace + 1e-300)[:, None, None] * np.eye(3)
    return np.linalg.inv(np.linalg.cholesky(information))


def cluster_scores(
    residuals: np.ndarray, cluster: np.ndarray, design: sparse.csr_matrix
) -> sparse.csr_matrix:
    """Return the score (gradient contribution) of each cluster of measurements.

    The outer products of the scores are the meat of a cluster-robust (sandwich) covariance.

    Parameters
    ----------
    residuals : ndarray, shape (2 M,)
        Residuals of the measurements.
    cluster : ndarray, shape (M,)
        Cluster of each measurement, 0..C-1.
    design : csr_matrix, shape (2 M, n)
        Derivatives of the residuals by the unknowns.

    Returns
    -------
    csr_matrix, shape (C, n)
        Sum of design^T residuals over each cluster.
    """
    m = len(residuals)
    gather = sparse.csr_matrix(
        (residuals, (np.repeat(cluster, 2), np.arange(m))), (int(cluster.max()) + 1, m)
    )
    return (gather @ design).tocsr()


def similarity_jacobian(lever: np.ndarray) -> np.ndarray:
    """Return the derivatives (N, 3, 7) of points with a lever (N, 3) from a similarity's centre.

    The parameters are the centre, the rotation vector in the target frame and the logarithm of scale.
    """
    jacobian = np.zeros((len(lever), 3, 7))
    jacobian[:, :, :3] = np.eye(3)
    # omega x lever
    x, y, z = lever.T
    jacobian[:, 0, 4], jacobian[:, 0, 5] = z, -y
    jacobian[:, 1, 3], jacobian[:, 1, 5] = -z, x
    jacobian[:, 2, 3], jacobian[:, 2, 4] = y, -x
    jacobian[:, :, 6] = lever
    return jacobian
