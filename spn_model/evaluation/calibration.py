"""Whether stated covariances of poses are as large as the errors that are made."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtr, chdtri

DOF = 6  # of a pose
FAR_SHARE = 0.001  # of frames with a right covariance lies farther than "beyond": 22.46
LEVELS = np.round(np.arange(0.05, 1.0, 0.05), 2)  # at which the reliability curve is read


@dataclass(frozen=True)
class Calibration:
    """How stated covariances of one group fit its errors e; d^2 = e^T C^-1 e is chi-squared where they do.

    frames : with a pose and a covariance that can be inverted; unusable : with a pose and a covariance
    that is not positive definite; unknown : with a pose and no covariance (NaN).
    ratio : median d^2 over that of chi-squared with 6 degrees of freedom (5.348). 1 is right; 4 means
        errors twice as large as stated. position_ratio, rotation_ratio : the same of either half (2.366).
    beyond : share of d^2 above 22.46, where a right covariance leaves 0.1 %.
    sigma, sigma_deg : medians of the stated standard deviations (root of the trace of either half).
    expected, observed : the reliability curve: share of frames whose error lies within the ellipsoid
        that should hold the expected share. Where all covariances are right, the two are equal.
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


def squared_distances(errors: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """e^T C^-1 e (N,) of errors (N, D) under covariances (N, D, D).

    NaN where the covariance is unknown or is not positive definite.
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
    """(N,) bool: finite and positive definite, judged on correlations, for metres and radians differ."""
    covariance = np.asarray(covariance, float)
    good = np.isfinite(covariance).all(axis=(1, 2))
    good[good] = np.all(np.einsum("nii->ni", covariance[good]) > 0, axis=1)
    good[good] = np.linalg.eigvalsh(_correlation(covariance[good]))[:, 0] > 1e-10
    return good


def sigmas(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stated standard deviations (N,) of position and, in degrees, of rotation; NaN where unknown."""
    usable = is_covariance(covariance)
    trace = np.full((len(covariance), 2), np.nan)
    trace[usable, 0] = np.einsum("nii->n", covariance[usable, :3, :3])
    trace[usable, 1] = np.einsum("nii->n", covariance[usable, 3:, 3:])
    return np.sqrt(trace[:, 0]), np.rad2deg(np.sqrt(trace[:, 1]))


def calibrate(errors: np.ndarray, covariance: np.ndarray) -> Calibration:
    """Of errors (N, 6) (true minus estimated centre; rotation vector v, R_true = exp(v) R) and covariances.

    NaN in all figures where no frame has a usable covariance.
    """
    usable = is_covariance(covariance)
    unknown = int(np.isnan(covariance).any(axis=(1, 2)).sum())
    e, c = errors[usable], covariance[usable]
    pose = squared_distances(e, c)
    position = squared_distances(e[:, :3], c[:, :3, :3])
    rotation = squared_distances(e[:, 3:], c[:, 3:, 3:])
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
        beyond=float((pose > chdtri(DOF, FAR_SHARE)).mean()) if len(pose) else float("nan"),
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
