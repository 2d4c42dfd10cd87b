"""Pose of one image from matched landmarks: P3P in RANSAC, then robust least squares."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spn_data.geometry.pinhole import residuals_and_jacobian
from spn_data.geometry.pose import to_camera
from spn_data.geometry.rotations import rotations_from_vectors

_RANSAC_ITERATIONS = 1000
_FEWEST = 4  # P3P needs three points and a fourth to disambiguate
_STEPS = 12
_CONVERGED = (
    1e-3  # mean change of the whitened projections; a step larger than the next is no solution
)
_MAX_LAST = 0.1
GATE = 3.5  # whitened residual up to which a landmark is an inlier
_FOCAL_SCALES = (8.0, 8.0, 6.0, 4.0, 3.0, 2.0, 1.5, 1.0, 1.0, 1.0)
_SCALES = (
    4.0,
    2.0,
    *[1.0] * _STEPS,
)  # of the loss, relative to the last one: a start off by pixels converges


@dataclass(frozen=True, eq=False, kw_only=True)
class Sightings:
    """K landmarks with their measurements in an image, in the pinhole of focal length `focal_px`.

    Attributes
    ----------
    landmarks : ndarray, shape (K,)
        Rows in the landmark map.
    features : ndarray, shape (K,)
        Rows of the features of the image.
    xyz : ndarray, shape (K, 3)
        Positions in the world.
    covariance : ndarray, shape (K, 3, 3)
        Of the positions.
    at : ndarray, shape (K, 2)
        Measured position, relative to the principal point and without distortion, in pixels.
    sigma_px : ndarray, shape (K,)
        Standard deviation of the measurement along one axis.
    focal_px : float
    """

    landmarks: np.ndarray
    features: np.ndarray
    xyz: np.ndarray
    covariance: np.ndarray
    at: np.ndarray
    sigma_px: np.ndarray
    focal_px: float

    def __len__(self) -> int:
        return len(self.xyz)

    def select(self, kept: np.ndarray) -> Sightings:
        """Return the sightings with these rows or of this mask."""
        return Sightings(
            landmarks=self.landmarks[kept],
            features=self.features[kept],
            xyz=self.xyz[kept],
            covariance=self.covariance[kept],
            at=self.at[kept],
            sigma_px=self.sigma_px[kept],
            focal_px=self.focal_px,
        )

    def followed_by(self, more: Sightings) -> Sightings:
        """Return these sightings and others of the same image."""
        return Sightings(
            landmarks=np.concatenate([self.landmarks, more.landmarks]),
            features=np.concatenate([self.features, more.features]),
            xyz=np.concatenate([self.xyz, more.xyz]),
            covariance=np.concatenate([self.covariance, more.covariance]),
            at=np.concatenate([self.at, more.at]),
            sigma_px=np.concatenate([self.sigma_px, more.sigma_px]),
            focal_px=self.focal_px,
        )


@dataclass(frozen=True, eq=False)
class SolvedPose:
    """A pose with its whitened observations.

    Attributes
    ----------
    center : ndarray, shape (3,)
    rotation : ndarray, shape (3, 3)
        World to camera.
    information : ndarray, shape (6, 6)
        Robust normal matrix over the centre and a rotation vector in the camera frame.
    residuals : ndarray, shape (K, 2)
        Whitened: of unit variance where the stated noise is true.
    jacobian : ndarray, shape (K, 2, 6)
        Of the whitened residuals.
    by_focal : ndarray, shape (K, 2)
        Derivatives of the whitened residuals by the logarithm of the focal length.
    weights : ndarray, shape (K,)
        Robust weights, at most 1.
    """

    center: np.ndarray
    rotation: np.ndarray
    information: np.ndarray
    residuals: np.ndarray
    jacobian: np.ndarray
    by_focal: np.ndarray
    weights: np.ndarray

    @property
    def inliers(self) -> np.ndarray:
        """Mask (K,) of the sightings that agree with the pose."""
        found: np.ndarray = (self.residuals**2).sum(axis=1) < GATE**2
        return found

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (6, 6) for the stated noise."""
        return np.linalg.inv(self.information)


def first_pose(
    seen: Sightings, threshold_px: float, min_inliers: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return centre and rotation of the pose that most sightings agree with, or None."""
    if len(seen) < min_inliers:
        return None
    threshold, rays = threshold_px / seen.focal_px, seen.at / seen.focal_px
    found = pose_by_ransac(seen.xyz, rays, np.eye(3), threshold, _RANSAC_ITERATIONS)
    return None if found is None or found[2] < min_inliers else found[:2]


def pose_by_ransac(
    xyz: np.ndarray, at: np.ndarray, matrix: np.ndarray, threshold: float, iterations: int
) -> tuple[np.ndarray, np.ndarray, int] | None:
    """Find the pose that most points agree with: P3P in RANSAC, then SQPnP of the points that agree.

    Parameters
    ----------
    xyz : ndarray, shape (K, 3)
        Points in the world.
    at : ndarray, shape (K, 2)
        Their pixels.
    matrix : ndarray, shape (3, 3)
        Camera matrix, with the same origin of pixels.
    threshold : float
        Distance in the image up to which a point agrees, in pixels.
    iterations : int
        Most iterations of RANSAC.

    Returns
    -------
    tuple or None
        Centre (3,), rotation (3, 3) and number of points that agree; None if there is no pose.
    """
    if len(xyz) < _FEWEST:
        return None
    middle = np.median(xyz, axis=0)
    options = cv2.UsacParams()  # a tenth of the time of OpenCV's first RANSAC, and equal inliers
    options.maxIterations, options.confidence = iterations, 0.9999
    options.threshold = threshold
    options.score, options.loMethod = cv2.SCORE_METHOD_RANSAC, cv2.LOCAL_OPTIM_NULL
    options.final_polisher = cv2.NONE_POLISHER
    found, _, _, _, inliers = cv2.solvePnPRansac(xyz - middle, at, matrix, None, params=options)
    if not found or inliers is None or len(inliers) < _FEWEST:
        return None
    # SQPnP instead of a polisher: EPnP is metres off where points are nearly on a plane.
    kept = inliers.ravel()
    found, turn, move = cv2.solvePnP(
        (xyz - middle)[kept], at[kept], matrix, None, flags=cv2.SOLVEPNP_SQPNP
    )
    if not found or not np.isfinite(turn).all() or not np.isfinite(move).all():
        return None
    rotation = rotations_from_vectors(turn.reshape(1, 3))[0]
    return middle - rotation.T @ move.ravel(), rotation, len(kept)


def solve(seen: Sightings, center: np.ndarray, rotation: np.ndarray) -> SolvedPose | None:
    """Refine a pose by robust least squares over all sightings (Cauchy loss).

    Parameters
    ----------
    seen : Sightings
        Some may be wrong.
    center : ndarray, shape (3,)
    rotation : ndarray, shape (3, 3)
        The pose to start from; a few pixels off.

    Returns
    -------
    SolvedPose or None
        None if the sightings determine no pose.
    """
    sigma = _sigma_px(seen, center, rotation)
    for scale in 2.0 * np.array(_SCALES):
        step = _step(seen, sigma, center, rotation, scale)
        if np.count_nonzero(step.weights) < 4:
            return None
        try:
            change = -np.linalg.solve(step.normal[:6, :6], step.gradient[:6])
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(change).all():
            return None
        center = center + change[:3]
        rotation = rotations_from_vectors(change[None, 3:])[0] @ rotation
        moved = np.abs(step.jacobian[:, :, :6] @ change).mean()
        if scale == 2.0 and moved < _CONVERGED:
            break
    if moved > _MAX_LAST:
        return None
    return SolvedPose(
        center,
        rotation,
        step.normal[:6, :6],
        step.residuals,
        step.jacobian[:, :, :6],
        step.jacobian[:, :, 6],
        step.weights,
    )


def fit_focal_length(seen: Sightings, pose: SolvedPose) -> tuple[float, float]:
    """Fit pose and focal length together, starting from a pose with the stated focal length.

    Parameters
    ----------
    seen : Sightings
    pose : SolvedPose

    Returns
    -------
    change : float
        Relative change of the focal length.
    sigma : float
        Its standard deviation for the stated noise, or larger where residuals are. 1, as assumed before, if
        the sightings do not determine it.
    """
    center, rotation, factor = pose.center, pose.rotation, 1.0
    sigma = _sigma_px(seen, center, rotation)
    for scale in 2.0 * np.array(_FOCAL_SCALES):
        step = _step(seen, sigma, center, rotation, scale, factor)
        step.normal[6, 6] += 1.0  # without it, points at one distance determine no focal length
        try:
            change = -np.linalg.solve(step.normal, step.gradient)
        except np.linalg.LinAlgError:  # few landmarks, and the fit left them behind the camera
            return 0.0, 1.0
        center = center + change[:3]
        rotation = rotations_from_vectors(change[None, 3:6])[0] @ rotation
        factor *= float(np.exp(np.clip(change[6], -0.1, 0.1)))
    inliers = (step.residuals**2).sum(axis=1) < GATE**2
    chi_sq = max(1.0, float((step.residuals[inliers] ** 2).mean())) if inliers.any() else np.inf
    return factor - 1, float(np.sqrt(np.linalg.inv(step.normal)[6, 6] * chi_sq))


@dataclass(frozen=True, eq=False)
class _Step:
    """Observations linearised at a pose, whitened: pose and logarithm of the focal length are unknown."""

    residuals: np.ndarray  # (K, 2)
    jacobian: np.ndarray  # (K, 2, 7)
    weights: np.ndarray  # (K,)
    normal: np.ndarray  # (7, 7)
    gradient: np.ndarray  # (7,)


def _step(
    seen: Sightings,
    sigma: np.ndarray,
    center: np.ndarray,
    rotation: np.ndarray,
    scale: float,
    factor: float = 1.0,
) -> _Step:
    """Linearise at a pose, with a Cauchy loss of this scale; points behind it have no weight.

    `factor` is that of the focal length, `sigma` (K,) the standard deviation of each sighting.
    """
    x = to_camera(seen.xyz, center, rotation)
    behind = x[:, 2] <= 0
    x[behind] = [0.0, 0.0, 1.0]
    matrix = np.diag([seen.focal_px * factor, seen.focal_px * factor, 1.0])
    residuals, by_pose = residuals_and_jacobian(x, seen.at, matrix, rotation)
    jacobian = np.concatenate([by_pose, (residuals + seen.at)[:, :, None]], axis=2)
    residuals /= sigma[:, None]
    jacobian /= sigma[:, None, None]
    weights = 1 / (1 + (residuals**2).sum(axis=1) / scale**2)
    weights[behind] = 0
    flat = jacobian.reshape(-1, 7)
    weighted = flat * np.repeat(weights, 2)[:, None]
    return _Step(residuals, jacobian, weights, weighted.T @ flat, weighted.T @ residuals.ravel())


def _sigma_px(seen: Sightings, center: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return the standard deviation (K,) of each sighting along one axis.

    The covariance of a landmark is projected into the image and added to that of the measurement; its larger
    axis counts. It hardly changes while a pose is refined.
    """
    x = to_camera(seen.xyz, center, rotation)
    x[x[:, 2] <= 0] = [0.0, 0.0, 1.0]
    matrix = np.diag([seen.focal_px, seen.focal_px, 1.0])
    # A shift of the camera moves a point the other way; the sign does not matter here.
    by_point = residuals_and_jacobian(x, seen.at, matrix, rotation)[1][:, :, :3]
    projected = by_point @ seen.covariance @ by_point.transpose(0, 2, 1)
    a, b, c = projected[:, 0, 0], projected[:, 0, 1], projected[:, 1, 1]
    largest = (a + c) / 2 + np.sqrt((a - c) ** 2 / 4 + b**2)
    return np.sqrt(seen.sigma_px**2 + largest)
