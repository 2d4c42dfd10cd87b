"""Pose of one image from matched landmarks: P3P in RANSAC, then robust least squares."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spn_data.geometry.pinhole import residuals_and_jacobian
from spn_data.geometry.pose import to_camera
from spn_data.geometry.rotations import rotations_from_vectors

_RANSAC_ITERATIONS = 1000
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


@dataclass(frozen=True, kw_only=True)
class KnownVertical:
    """Direction of up in the camera, from an IMU or a gimbal.

    Attributes
    ----------
    up : tuple of float
        Unit vector in the camera frame.
    sigma_deg : float
        Standard deviation of its direction along each of two axes.
    """

    up: tuple[float, float, float]
    sigma_deg: float


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
    """Return centre and rotation of the pose that most sightings agree with, or None (AP3P in RANSAC)."""
    if len(seen) < max(4, min_inliers):
        return None
    middle, rays = np.median(seen.xyz, axis=0), seen.at / seen.focal_px
    found, turn, move, inliers = cv2.solvePnPRansac(
        seen.xyz - middle,
        rays,
        np.eye(3),
        None,
        iterationsCount=_RANSAC_ITERATIONS,
        reprojectionError=threshold_px / seen.focal_px,
        confidence=0.9999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or inliers is None or len(inliers) < min_inliers:
        return None
    # OpenCV solves for all inliers by EPnP, which is metres off where points are nearly on a plane.
    kept = inliers.ravel()
    found, turn, move = cv2.solvePnP(
        (seen.xyz - middle)[kept], rays[kept], np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
    )
    if not found or not np.isfinite(turn).all() or not np.isfinite(move).all():
        return None
    rotation = rotations_from_vectors(turn.reshape(1, 3))[0]
    return middle - rotation.T @ move.ravel(), rotation


def solve(
    seen: Sightings,
    center: np.ndarray,
    rotation: np.ndarray,
    vertical: KnownVertical | None = None,
) -> SolvedPose | None:
    """Refine a pose by robust least squares over all sightings (Cauchy loss).

    Parameters
    ----------
    seen : Sightings
        Some may be wrong.
    center : ndarray, shape (3,)
    rotation : ndarray, shape (3, 3)
        The pose to start from; a few pixels off.
    vertical : KnownVertical, optional
        Observation of up, with the weight of its sigma.

    Returns
    -------
    SolvedPose or None
        None if the sightings determine no pose.
    """
    matrix = np.diag([seen.focal_px, seen.focal_px, 1.0])
    for scale in 2.0 * np.array(_SCALES):
        x = to_camera(seen.xyz, center, rotation)
        if np.count_nonzero(x[:, 2] > 0) < 4:
            return None
        residuals, jacobian, by_focal = _whitened(seen, x, matrix, rotation)
        weights = 1 / (1 + (residuals**2).sum(axis=1) / scale**2)
        weights[x[:, 2] <= 0] = 0
        information = np.einsum("n,nij,nik->jk", weights, jacobian, jacobian)
        gradient = np.einsum("n,nij,ni->j", weights, jacobian, residuals)
        if vertical is not None:
            by, off = vertical_terms(vertical, rotation)
            information += by.T @ by
            gradient += by.T @ off
        try:
            step = -np.linalg.solve(information, gradient)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all():
            return None
        center = center + step[:3]
        rotation = rotations_from_vectors(step[None, 3:])[0] @ rotation
        moved = np.abs(jacobian @ step).mean()
        if scale == 2.0 and moved < _CONVERGED:
            break
    if moved > _MAX_LAST:
        return None
    return SolvedPose(center, rotation, information, residuals, jacobian, by_focal, weights)


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
    for scale in 2.0 * np.array(_FOCAL_SCALES):
        x = to_camera(seen.xyz, center, rotation)
        matrix = np.diag([seen.focal_px * factor, seen.focal_px * factor, 1.0])
        residuals, jacobian, by_focal = _whitened(seen, x, matrix, rotation)
        by = np.concatenate([jacobian, by_focal[:, :, None]], axis=2)
        weights = 1 / (1 + (residuals**2).sum(axis=1) / scale**2)
        weights[x[:, 2] <= 0] = 0
        information = np.einsum("n,nij,nik->jk", weights, by, by) + np.diag([0.0] * 6 + [1.0])
        try:
            step = -np.linalg.solve(information, np.einsum("n,nij,ni->j", weights, by, residuals))
        except np.linalg.LinAlgError:  # few landmarks, and the fit left them behind the camera
            return 0.0, 1.0
        center = center + step[:3]
        rotation = rotations_from_vectors(step[None, 3:6])[0] @ rotation
        factor *= float(np.exp(np.clip(step[6], -0.1, 0.1)))
    inliers = (residuals**2).sum(axis=1) < GATE**2
    chi_sq = max(1.0, float((residuals[inliers] ** 2).mean())) if inliers.any() else np.inf
    return factor - 1, float(np.sqrt(np.linalg.inv(information)[6, 6] * chi_sq))


def vertical_terms(vertical: KnownVertical, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Jacobian (3, 6) and residual (3,) of a known vertical, whitened.

    The residual is R e_z - up. A rotation by exp(v) moves R e_z by v x R e_z.
    """
    weight = 1 / np.deg2rad(vertical.sigma_deg)
    ours = rotation[:, 2]
    by = np.zeros((3, 6))
    by[:, 3:] = np.cross(np.eye(3), ours).T * weight
    return by, (ours - np.array(vertical.up)) * weight


def _whitened(
    seen: Sightings, x: np.ndarray, matrix: np.ndarray, rotation: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return residuals (K, 2), Jacobian (K, 2, 6), derivatives by the logarithm of the focal length (K, 2).

    They are divided by the standard deviation of each sighting.

    The covariance of a landmark is projected into the image and added to that of the measurement; its larger
    axis counts.
    """
    safe = np.where(x[:, 2:] > 0, x, [[0.0, 0.0, 1.0]])
    residuals, jacobian = residuals_and_jacobian(safe, seen.at, matrix, rotation)
    by_point = -jacobian[:, :, :3]  # a shift of the camera moves a point the other way
    projected = by_point @ seen.covariance @ by_point.transpose(0, 2, 1)
    a, b, c = projected[:, 0, 0], projected[:, 0, 1], projected[:, 1, 1]
    largest = (a + c) / 2 + np.sqrt((a - c) ** 2 / 4 + b**2)
    sigma = np.sqrt(seen.sigma_px**2 + largest)
    projected_px = residuals + seen.at
    return (
        residuals / sigma[:, None],
        jacobian / sigma[:, None, None],
        projected_px / sigma[:, None],
    )
