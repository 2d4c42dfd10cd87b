"""Calibration of pose covariances: whether stated covariances match the actual errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtr, chdtri

DOF = 6  # degrees of freedom of a pose
TAIL_SHARE = 0.001  # of frames have a NEES above 22.46 if the covariance is right: "beyond"
LEVELS = np.round(np.arange(0.05, 1.0, 0.05), 2)  # confidence levels of the reliability curve


@dataclass(frozen=True)
class Calibration:
    """How well the stated covariances C of one group match its errors e.

    NEES = e^T C^-1 e follows a chi-squared distribution with 6 degrees of freedom if C is right. All figures
    are NaN if no frame has a usable covariance.

    Attributes
    ----------
    frames : int
        Frames with a pose and a positive definite covariance.
    unusable : int
        Frames with a pose and a covariance that is not positive definite.
    unknown : int
        Frames with a pose and without a covariance (NaN).
    ratio : float
        Median NEES divided by the median of chi-squared with 6 degrees of freedom (5.348). The ideal value is
        1; 4 means that errors are twice as large as stated.
    position_ratio, rotation_ratio : float
        The same for position or rotation alone (3 degrees of freedom, median 2.366).
    beyond : float
        Share of frames with a NEES above 22.46, which a right covariance exceeds in 0.1 % of frames.
    sigma, sigma_deg : float
        Medians of the stated standard deviations of position and rotation (root of the trace of the block).
    expected, observed : tuple of float
        Reliability curve: the share of frames whose error is expected to be, and is, within the confidence
        ellipsoid. Both are equal if all covariances are right.
    """

    frames: int
    unusable: int
    unknown: int
    ratio: float
    position_ratio: float
    rotation_ratio: float
    beyond: float
    sigma: float
    sigma_deg: float
    expected: tuple[float, ...]
    observed: tuple[float, ...]


def nees(errors: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the normalised estimation error squared (NEES) e^T C^-1 e of each frame.

    Parameters
    ----------
    errors : ndarray, shape (N, D)
        Errors e.
    covariance : ndarray, shape (N, D, D)
        Stated covariances C.

    Returns
    -------
    ndarray, shape (N,)
        NaN where the covariance is unknown or not positive definite.

    References
    ----------
    Bar-Shalom, Li, Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation", section 5.4.
    """
    errors, covariance = np.asarray(errors, float), np.asarray(covariance, float)
    squared = np.full(len(errors), np.nan)
    rows = np.flatnonzero(is_covariance(covariance))
    if len(rows):
        scale = np.sqrt(np.einsum("nii->ni", covariance[rows]))
        whitened = np.linalg.solve(
            _correlation(covariance[rows]), (errors[rows] / scale)[..., None]
        )
        squared[rows] = np.einsum("ni,ni->n", errors[rows] / scale, whitened[..., 0])
    return squared


def is_covariance(covariance: np.ndarray) -> np.ndarray:
    """Return which covariances (N, D, D) are finite and positive definite, (N,) bool.

    The test uses correlations, because positions in metres and rotations in radians have different scales.
    """
    covariance = np.asarray(covariance, float)
    good = np.isfinite(covariance).all(axis=(1, 2))
    good[good] = np.all(np.einsum("nii->ni", covariance[good]) > 0, axis=1)
    good[good] = np.linalg.eigvalsh(_correlation(covariance[good]))[:, 0] > 1e-10
    return good


def sigmas(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return stated standard deviations (N,) of position and of rotation (degrees); NaN where unknown."""
    usable = is_covariance(covariance)
    trace = np.full((len(covariance), 2), np.nan)
    trace[usable, 0] = np.einsum("nii->n", covariance[usable, :3, :3])
    trace[usable, 1] = np.einsum("nii->n", covariance[usable, 3:, 3:])
    return np.sqrt(trace[:, 0]), np.rad2deg(np.sqrt(trace[:, 1]))


def calibrate(errors: np.ndarray, covariance: np.ndarray) -> Calibration:
    """Compare errors with their stated covariances.

    Parameters
    ----------
    errors : ndarray, shape (N, 6)
        True minus estimated centre, then the rotation vector v with R_true = exp(v) R.
    covariance : ndarray, shape (N, 6, 6)
        Stated covariances; NaN where unknown.

    Returns
    -------
    Calibration
        Its figures are NaN if no frame has a usable covariance.
    """
    usable = is_covariance(covariance)
    unknown = int(np.isnan(covariance).any(axis=(1, 2)).sum())
    e, c = errors[usable], covariance[usable]
    pose = nees(e, c)
    position = nees(e[:, :3], c[:, :3, :3])
    rotation = nees(e[:, 3:], c[:, 3:, 3:])
    sigma, sigma_deg = sigmas(c)
    inside = np.sort(chdtr(DOF, pose))
    observed = np.searchsorted(inside, LEVELS, side="right") / max(len(pose), 1)
    return Calibration(
        frames=len(pose),
        unusable=len(usable) - len(pose) - unknown,
        unknown=unknown,
        ratio=_median(pose) / float(chdtri(DOF, 0.5)),
        position_ratio=_median(position) / float(chdtri(3, 0.5)),
        rotation_ratio=_median(rotation) / float(chdtri(3, 0.5)),
        beyond=float((pose > chdtri(DOF, TAIL_SHARE)).mean()) if len(pose) else float("nan"),
        sigma=_median(sigma),
        sigma_deg=_median(sigma_deg),
        expected=tuple(LEVELS.tolist()),
        observed=tuple(observed.tolist()) if len(pose) else (float("nan"),) * len(LEVELS),
    )


def _correlation(covariance: np.ndarray) -> np.ndarray:
    scale = np.sqrt(np.einsum("nii->ni", covariance))
    return covariance / (scale[:, :, None] * scale[:, None, :])


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else float("nan")
