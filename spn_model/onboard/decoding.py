"""Camera pose from scene coordinates by P3P, RANSAC and robust refinement, with NumPy and OpenCV only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.errors import GeometryError
from spn_data.geometry.pinhole import residuals_and_jacobian
from spn_data.geometry.pose import Poses, to_camera
from spn_data.geometry.rotations import rotations_from_vectors
from spn_model.landmarks.aids import (
    KnownHeight,
    KnownVertical,
    aid_terms,
    height_sigmas,
    tilt_sigmas,
)
from spn_model.landmarks.solver import pose_by_ransac

# Width of the robust weight in each iteration, relative to the final one: an initial pose that is off by a
# few pixels still converges.
_ROBUST_SCALES = (4.0, 2.0, *[1.0] * 10)
_CONVERGED_PX = 1e-3
_MAX_AID_SIGMAS = 5.0  # between a known vertical or height and the network
_MIN_SLOPE = 0.2  # bounds the growth of the covariance (1 / slope^2) if cells contradict each other


@dataclass(frozen=True, kw_only=True)
class DecodingOptions:
    """Options of pose estimation from scene coordinates, of which many may be wrong.

    Attributes
    ----------
    cells : int
        Number of cells to use, those with the smallest scale.
    ransac_px : float
        Inlier threshold of RANSAC: reprojection error in pixels.
    ransac_iterations : int
        Maximum number of RANSAC iterations.
    min_inliers : int
        Minimum number of inliers.
    floor_px : float
        Standard deviation of a perfect cell in pixels.
    robust : float
        Residual, in standard deviations, at which the weight of a cell drops to a quarter.
    cells_per_observation : float
        Number of cells that carry as much information as one independent observation, because the errors of
        neighbouring cells are correlated.
    largest_scale : float
        Maximum scale of a cell in the world's unit; cells above it are not used. 0 disables the limit.
    """

    cells: int = 700
    ransac_px: float = 10.0
    ransac_iterations: int = 200
    min_inliers: int = 12
    floor_px: float = 1.0
    robust: float = 3.0
    cells_per_observation: float = 16.0
    largest_scale: float = 0.0


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """Pose estimated from scene coordinates.

    Attributes
    ----------
    poses : Poses
        One pose.
    covariance : ndarray, shape (6, 6)
        Over the centre (metres) and a rotation vector in the camera frame (radians), R_true = exp(v) @ R.
    inliers : int
        Cells that agree with the pose.
    used : int
        Cells that were used.
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
    vertical: KnownVertical | None = None,
    height: KnownHeight | None = None,
) -> PoseEstimate:
    """Estimate a camera pose from scene coordinates.

    P3P in RANSAC on the cells with the smallest scale, then iteratively reweighted least squares over all of
    them. The weight of a cell depends on its own scale and on its residual (Geman-McClure).

    Parameters
    ----------
    coordinates : ndarray, shape (3, h, w)
        Point in the world for each cell.
    log_scale : ndarray, shape (h, w)
        Logarithm of the scale of its isotropic Laplace error, in the world's unit.
    matrix : ndarray, shape (3, 3)
        Camera matrix K of the pinhole.
    first_px : float
        Centre of the first cell along both axes, in COLMAP's pixels, as K.
    stride_px : float
        Distance between cells in pixels.
    options : DecodingOptions, optional
        Options of the estimation.
    vertical : KnownVertical, optional
        Up in the camera, one more observation in the least squares.
    height : KnownHeight, optional
        Another one, in the world of the cells.

    Returns
    -------
    PoseEstimate

    Raises
    ------
    GeometryError
        If too few cells agree on any pose, or they contradict the known vertical or height.

    Notes
    -----
    The covariance is the sandwich estimator of the last step (Huber 1967): it uses the scatter of the
    residuals rather than the scales of the cells, times `cells_per_observation`. A known vertical or height
    has the weight of that many cells' observations, and its stated variance in the covariance. First, the
    pose of the cells alone is compared with it: cells that disagree would lose their weights and be silent.

    References
    ----------
    Geman, McClure 1987, "Statistical methods for tomographic image reconstruction".
    """
    options = options or DecodingOptions()
    columns = log_scale.shape[1]
    selected = np.argsort(log_scale, axis=None)[: options.cells]
    xyz = coordinates.reshape(3, -1).T[selected].astype(np.float64)
    # An isotropic 3D Laplace distribution has a standard deviation of twice its scale along each axis.
    sigma_m = 2 * np.exp(log_scale.ravel()[selected].astype(np.float64))
    at = np.stack([selected % columns, selected // columns], axis=1) * stride_px + first_px
    finite = np.isfinite(xyz).all(axis=1) & np.isfinite(sigma_m)
    if options.largest_scale:
        finite &= sigma_m <= 2 * options.largest_scale
    xyz, sigma_m, at = xyz[finite], sigma_m[finite], at[finite]
    if len(xyz) < options.min_inliers:
        raise GeometryError(f"only {len(xyz)} cells are confident, need {options.min_inliers}")
    first = _first_pose(xyz, at, matrix, options)
    found = _refined(xyz, sigma_m, at, matrix, *first, options)
    if vertical is None and height is None:
        return found
    _check_aids(found.poses, found.covariance, vertical, height)
    return _refined(xyz, sigma_m, at, matrix, *first, options, vertical, height)


def _refined(
    xyz: np.ndarray,
    sigma_m: np.ndarray,
    at: np.ndarray,
    matrix: np.ndarray,
    center: np.ndarray,
    rotation: np.ndarray,
    options: DecodingOptions,
    vertical: KnownVertical | None = None,
    height: KnownHeight | None = None,
) -> PoseEstimate:
    """Refine a pose by iteratively reweighted least squares over cells and what is known beside them."""
    count = options.cells_per_observation
    focal_px = np.sqrt(matrix[0, 0] * matrix[1, 1])
    for width in options.robust * np.array(_ROBUST_SCALES):
        in_camera = to_camera(xyz, center, rotation)
        ahead = in_camera[:, 2] > 0
        x = in_camera[ahead]
        if len(x) < options.min_inliers:
            raise GeometryError(
                f"only {len(x)} cells are in front of the camera, need {options.min_inliers}"
            )
        residuals, jacobian = residuals_and_jacobian(x, at[ahead], matrix, rotation)
        sigma_px = np.hypot(options.floor_px, focal_px * sigma_m[ahead] / x[:, 2])
        normalised_sq = (residuals**2).sum(axis=1) / (sigma_px * width) ** 2
        weights = (1 + normalised_sq) ** -2 / sigma_px**2
        gradients = np.einsum("nij,ni->nj", jacobian, residuals) * weights[:, None]
        information = np.einsum("n,nij,nik->jk", weights, jacobian, jacobian)
        gradient = gradients.sum(axis=0)
        by, off = aid_terms(vertical, height, center, rotation)
        known = count * by.T @ by
        gradient += count * by.T @ off
        step = -_inverse(information + known) @ gradient
        center = center + step[:3]
        rotation = rotations_from_vectors(step[None, 3:])[0] @ rotation
        if width == options.robust and np.abs(jacobian @ step).mean() < _CONVERGED_PX:
            break
    inliers = int(np.count_nonzero(normalised_sq < 1))
    if inliers < options.min_inliers or not np.isfinite(center).all():
        raise GeometryError(
            f"{inliers} of {len(xyz)} cells agree on a pose, need {options.min_inliers}"
        )
    # Sandwich covariance (Huber 1967): from the scatter of the residuals, not from the stated scales. The
    # slope of the influence function is smaller than the weight, because the weight decreases with the
    # residual.
    slope = ((1 + normalised_sq) ** -3 * (1 - normalised_sq) / sigma_px**2).sum() / weights.sum()
    inverse = _inverse(max(slope, _MIN_SLOPE) * information + known)
    covariance = inverse @ (gradients.T @ gradients + known) @ inverse * count
    return PoseEstimate(
        Poses.from_rotations(center[None], rotation[None]),
        (covariance + covariance.T) / 2,
        inliers,
        len(xyz),
    )


def with_aids(
    poses: Poses,
    covariance: np.ndarray,
    vertical: KnownVertical | None,
    height: KnownHeight | None = None,
) -> tuple[Poses, np.ndarray]:
    """Add a known vertical and height to a pose that a network regressed, to first order.

    Parameters
    ----------
    poses : Poses
        One pose.
    covariance : ndarray, shape (6, 6)
        As that of a `PoseEstimate`.
    vertical : KnownVertical or None
    height : KnownHeight, optional

    Returns
    -------
    poses : Poses
    covariance : ndarray, shape (6, 6)

    Raises
    ------
    GeometryError
        If the pose contradicts them.
    """
    _check_aids(poses, covariance, vertical, height)
    by, off = aid_terms(vertical, height, poses.centers[0], poses.rotations[0])
    gain = np.linalg.solve(np.eye(len(off)) + by @ covariance @ by.T, by @ covariance).T
    step = -gain @ off
    rotation = rotations_from_vectors(step[None, 3:])[0] @ poses.rotations[0]
    moved = Poses.from_rotations(poses.centers + step[:3], rotation[None])
    return moved, covariance - gain @ by @ covariance


def _check_aids(
    poses: Poses,
    covariance: np.ndarray,
    vertical: KnownVertical | None,
    height: KnownHeight | None,
) -> None:
    tilt = 0.0 if vertical is None else tilt_sigmas(vertical, poses.rotations[0], covariance)
    if tilt > _MAX_AID_SIGMAS:
        raise GeometryError(
            f"the network contradicts the stated attitude by {tilt:.1f} standard deviations"
        )
    off = 0.0 if height is None else height_sigmas(height, poses.centers[0], covariance)
    if off > _MAX_AID_SIGMAS:
        raise GeometryError(
            f"the network contradicts the stated height by {off:.1f} standard deviations"
        )


def _inverse(information: np.ndarray) -> np.ndarray:
    try:
        return np.linalg.inv(information)
    except np.linalg.LinAlgError as error:
        raise GeometryError("the scene coordinates do not determine a pose") from error


def _first_pose(
    xyz: np.ndarray, at: np.ndarray, matrix: np.ndarray, options: DecodingOptions
) -> tuple[np.ndarray, np.ndarray]:
    """Return centre and rotation of the pose with most inliers."""
    # K and pixels share the origin of pixels, so OpenCV needs no half-pixel shift.
    found = pose_by_ransac(xyz, at, matrix, options.ransac_px, options.ransac_iterations)
    if found is None or found[2] < options.min_inliers:
        raise GeometryError(
            f"{0 if found is None else found[2]} of {len(xyz)} cells agree on a pose, need "
            f"{options.min_inliers}"
        )
    return found[:2]
