"""What is known of a pose beside its image: the vertical and the height, with their standard deviations."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


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


@dataclass(frozen=True, kw_only=True)
class KnownHeight:
    """Height of the camera, from a barometer.

    Attributes
    ----------
    up_m : float
        Up in the world.
    sigma_m : float
    """

    up_m: float
    sigma_m: float


def vertical_terms(vertical: KnownVertical, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Jacobian (3, 6) and residual (3,) of a known vertical, whitened.

    The residual is R e_z - up. A rotation by exp(v) moves R e_z by v x R e_z.
    """
    weight = 1 / np.deg2rad(vertical.sigma_deg)
    ours = rotation[:, 2]
    by = np.zeros((3, 6))
    by[:, 3:] = np.cross(np.eye(3), ours).T * weight
    return by, (ours - np.array(vertical.up)) * weight


def height_sigmas(height: KnownHeight, center: np.ndarray, covariance: np.ndarray) -> float:
    """Return how far a pose from images alone is from a known height, in standard deviations."""
    off_m = abs(float(center[2]) - height.up_m)
    return off_m / math.hypot(height.sigma_m, math.sqrt(max(0.0, float(covariance[2, 2]))))


def aid_terms(
    vertical: KnownVertical | None,
    height: KnownHeight | None,
    center: np.ndarray,
    rotation: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return Jacobian (K, 6) and residuals (K,) of what is known beside the image, whitened; K may be 0."""
    by, off = np.zeros((0, 6)), np.zeros(0)
    if vertical is not None:
        by, off = vertical_terms(vertical, rotation)
    if height is not None:
        by = np.vstack([by, np.eye(6)[2:3] / height.sigma_m])
        off = np.append(off, (center[2] - height.up_m) / height.sigma_m)
    return by, off


def tilt_sigmas(vertical: KnownVertical, rotation: np.ndarray, covariance: np.ndarray) -> float:
    """Return how far a pose from images alone is from a known vertical.

    Parameters
    ----------
    vertical : KnownVertical
    rotation : ndarray, shape (3, 3)
        World to camera.
    covariance : ndarray, shape (6, 6)
        Of the pose, over the centre and a rotation vector in the camera frame.

    Returns
    -------
    float
        The difference in its standard deviations: root of a value that is distributed as chi-squared with
        two degrees of freedom.
    """
    by, off = vertical_terms(vertical, rotation)
    return float(np.sqrt(off @ np.linalg.solve(np.eye(3) + by @ covariance @ by.T, off)))
