"""The pose of a camera from scene coordinates: NumPy and OpenCV alone, as on board."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spn_data.errors import GeometryError
from spn_data.geometry.pose import Poses, rotations_from_vectors

# Of the robust weight in each step, in units of its last: a start some pixels off finds its way.
_REACH = (4.0, 2.0, *[1.0] * 10)
_CONVERGED_PX = 1e-3
_LEAST_SLOPE = 0.2  # where cells contradict each other, the covariance grows at most by its square


@dataclass(frozen=True, kw_only=True)
class DecodingOptions:
    """How a pose is found among cells of which many are wrong."""

    cells: int = 700  # the surest ones, which are used
    ransac_px: float = 10.0  # distance beyond which a cell disagrees with a first pose
    ransac_iterations: int = 200  # at most
    min_inliers: int = 12
    floor_px: float = 1.0  # standard deviation of a perfect cell
    robust: float = 3.0  # residual, in standard deviations, at which a cell counts a quarter
    # Errors of neighbouring cells are alike: as many of them tell as much as one by itself.
    cells_per_observation: float = 16.0
    largest_scale: float = (
        0.0  # in the world's unit; a cell that is less sure is not used; 0: any is
    )


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """poses : (1,); covariance : (6, 6) over the centre (metres) and a rotation vector in the camera frame
    (radians), R_true = exp(v) @ R; inliers : cells of those used that agree with it; used : cells tried.
    """

    poses: Poses
    covariance: np.ndarray
    inliers: int
    used: int


def decode(
    coordinates: np.ndarray,
    log_scale: np.ndarray,
    matrix: np.ndarray,
    *,
    first_px: float,
    stride_px: float,
    options: DecodingOptions | None = None,
) -> PoseEstimate:
    """From coordinates (3, h, w) and log scales (h, w) of cells, seen by a pinhole of K (3, 3).

    The centre of the first cell lies at (first_px, first_px), the next ones stride_px on, in COLMAP's
    pixels, as K is. P3P in RANSAC on the surest cells, then least squares over all of them, each weighted
    by its own certainty and by its residual (Geman and McClure 1987). Raises GeometryError where too few
    cells agree on any pose.
    """
    options = options or DecodingOptions()
    columns = log_scale.shape[1]
    surest = np.argsort(log_scale, axis=None)[: options.cells]
    xyz = coordinates.reshape(3, -1).T[surest].astype(np.float64)
    # Along each axis, an isotropic Laplace distribution in three dimensions varies by twice its scale.
    sigma_m = 2 * np.exp(log_scale.ravel()[surest].astype(np.float64))
    at = np.stack([surest % columns, surest // columns], axis=1) * stride_px + first_px
    finite = np.isfinite(xyz).all(axis=1) & np.isfinite(sigma_m)
    if options.largest_scale:
        finite &= sigma_m <= 2 * options.largest_scale
    xyz, sigma_m, at = xyz[finite], sigma_m[finite], at[finite]
    if len(xyz) < options.min_inliers:
        raise GeometryError(
            f"{len(xyz)} cells are sure of what they show, need {options.min_inliers}"
        )
    center, rotation = _first_pose(xyz, at, matrix, options)
    focal_px = np.sqrt(matrix[0, 0] * matrix[1, 1])
    for reach in options.robust * np.array(_REACH):
        in_camera = (xyz - center) @ rotation.T
        ahead = in_camera[:, 2] > 0
        x = in_camera[ahead]
        if len(x) < options.min_inliers:
            raise GeometryError(f"{len(x)} cells lie before the camera, need {options.min_inliers}")
        residuals, by_pose = _linearised(x, at[ahead], matrix, rotation)
        sigma_px = np.hypot(options.floor_px, focal_px * sigma_m[ahead] / x[:, 2])
        far = (residuals**2).sum(axis=1) / (sigma_px * reach) ** 2
        weights = (1 + far) ** -2 / sigma_px**2
        gradients = np.einsum("nij,ni->nj", by_pose, residuals) * weights[:, None]
        try:
            inverse = np.linalg.inv(np.einsum("n,nij,nik->jk", weights, by_pose, by_pose))
        except np.linalg.LinAlgError as error:
            raise GeometryError("the scene coordinates do not determine a pose") from error
        step = -inverse @ gradients.sum(axis=0)
        center = center + step[:3]
        rotation = rotations_from_vectors(step[None, 3:])[0] @ rotation
        if reach == options.robust and np.abs(by_pose @ step).mean() < _CONVERGED_PX:
            break
    inliers = int(np.count_nonzero(far < 1))
    if inliers < options.min_inliers or not np.isfinite(center).all():
        raise GeometryError(
            f"{inliers} of {len(xyz)} cells agree on a pose, need {options.min_inliers}"
        )
    # Huber 1967's sandwich: by what the cells scatter, not by what they say of themselves. The slope of a
    # cell's pull is less than its weight, for the weight falls as it moves away.
    slope = ((1 + far) ** -3 * (1 - far) / sigma_px**2).sum() / weights.sum()
    covariance = inverse @ (gradients.T @ gradients) @ inverse / max(slope, _LEAST_SLOPE) ** 2
    covariance = (covariance + covariance.T) / 2 * options.cells_per_observation
    return PoseEstimate(
        Poses.from_rotations(center[None], rotation[None]), covariance, inliers, len(xyz)
    )


def _first_pose(
    xyz: np.ndarray, at: np.ndarray, matrix: np.ndarray, options: DecodingOptions
) -> tuple[np.ndarray, np.ndarray]:
    """Centre and rotation on which most cells agree."""
    middle = np.median(xyz, axis=0)
    # The same camera and pixels, both shifted by half a pixel: cv2 does not see which origin they have.
    found, turn, move, inliers = cv2.solvePnPRansac(
        xyz - middle,
        at,
        matrix,
        None,
        iterationsCount=options.ransac_iterations,
        reprojectionError=options.ransac_px,
        confidence=0.9999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or inliers is None or len(inliers) < options.min_inliers:
        count = 0 if inliers is None else len(inliers)
        raise GeometryError(
            f"{count} of {len(xyz)} cells agree on a pose, need {options.min_inliers}"
        )
    rotation = rotations_from_vectors(turn.reshape(1, 3))[0]
    return middle - rotation.T @ move.ravel(), rotation


def _linearised(
    x: np.ndarray, at: np.ndarray, matrix: np.ndarray, rotation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (N, 2), projected minus seen, of points x (N, 3) in the camera; change by the pose (N, 2, 6).

    A turn exp(v) moves a point x by v x x; a move of the centre, by -R of it.
    """
    projected = x @ matrix.T
    pixels = projected[:, :2] / projected[:, 2:]
    by_point = (matrix[None, :2] - pixels[:, :, None] * matrix[None, 2:]) / projected[:, 2:, None]
    by_pose = np.concatenate([-by_point @ rotation, np.cross(x[:, None, :], by_point)], axis=2)
    return pixels - at, by_pose
