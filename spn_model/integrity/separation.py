"""Solution separation: the pose without each group of landmarks, and the protection levels that follow.

A wrong match rarely comes alone: a moved car, a repeated window or a wrong part of the map gives a whole
group of landmarks that agree with each other. For each group k, the pose is solved again without it. With the
normal matrix N over all landmarks and the part N_k and gradient g_k of the group at the solution,

    d_k = (N - N_k)^-1 g_k,    C_k = (N - N_k)^-1,    C = N^-1,

d_k is the change of the pose, and C_k - C its covariance if nothing is wrong. A group that changes the pose
by more than that contradicts the rest. If it is the group that is wrong, the pose without it is right, so the
error of the pose is at most |d_k| plus K standard deviations of C_k. The protection level is the largest of
these bounds over all groups.

References
----------
Blanch et al. 2015, "Baseline advanced RAIM user algorithm and possible improvements"; Zhu et al. 2019,
arXiv:1909.08537, for vision.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_TINY = 1e-12


@dataclass(frozen=True, eq=False)
class Separation:
    """Result of the solution separation.

    Attributes
    ----------
    horizontal_m, vertical_m : float
        Protection levels; infinite if the pose depends on one group.
    contradiction : float
        Largest change of the position by one group, in standard deviations of that change.
    """

    horizontal_m: float
    vertical_m: float
    contradiction: float


def groups_of(at: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    """Divide landmarks into groups by region of the image and by part of the scene.

    Parameters
    ----------
    at : ndarray, shape (K, 2)
        Positions in the image, relative to the principal point.
    xyz : ndarray, shape (K, 3)
        Positions in the scene.

    Returns
    -------
    ndarray of bool, shape (G, K)
        Members of each group: halves and quarters of the image at the median of the landmarks, and halves
        and quarters of the scene along its two longest axes.
    """
    centered = xyz - xyz.mean(axis=0)
    axes = np.linalg.svd(centered, full_matrices=False)[2][:2]
    found = []
    for plane in (at, centered @ axes.T):
        left, above = (plane < np.median(plane, axis=0)).T
        quarters = [left & above, left & ~above, ~left & above, ~left & ~above]
        found += [left, ~left, above, ~above, *quarters]
    return np.array(found)


def separate(
    jacobian: np.ndarray,
    residuals: np.ndarray,
    weights: np.ndarray,
    information: np.ndarray,
    groups: np.ndarray,
    *,
    factor: float,
    sigmas: float,
) -> Separation:
    """Compute protection levels and contradictions between groups of landmarks.

    Parameters
    ----------
    jacobian : ndarray, shape (K, 2, D)
        Of the whitened residuals, by the centre (world axes, z up) and other unknowns.
    residuals : ndarray, shape (K, 2)
        Whitened.
    weights : ndarray, shape (K,)
        Robust weights.
    information : ndarray, shape (D, D)
        Normal matrix at the solution, with what else was observed.
    groups : ndarray of bool, shape (G, K)
    factor : float
        Factor on covariances: whitened residuals are correlated, so their number overstates what is known.
    sigmas : float
        K, standard deviations in a protection level.

    Returns
    -------
    Separation
    """
    weighted = weights[:, None, None] * jacobian
    each = weighted.transpose(0, 2, 1) @ jacobian
    gradients = (weighted * residuals[:, :, None]).sum(axis=1)
    members = groups.astype(np.float64)
    normals = (members @ each.reshape(len(each), -1)).reshape(-1, *information.shape)
    covariance = np.linalg.inv(information) * factor
    horizontal, vertical = (sigmas * sigma for sigma in _sigmas(covariance))
    contradiction = 0.0
    for normal, gradient in zip(normals, members @ gradients, strict=True):
        rest = information - normal
        if np.linalg.eigvalsh(rest)[0] <= _TINY * np.trace(rest):
            return Separation(np.inf, np.inf, contradiction)
        inverse = np.linalg.inv(rest)
        change = (inverse @ gradient)[:3]
        without = inverse * factor
        sigma_h, sigma_v = _sigmas(without)
        horizontal = max(horizontal, float(np.hypot(*change[:2])) + sigmas * sigma_h)
        vertical = max(vertical, float(abs(change[2])) + sigmas * sigma_v)
        values, axes = np.linalg.eigh((without - covariance)[:3, :3])
        spread = np.sqrt(np.maximum(values, _TINY))
        contradiction = max(contradiction, float(np.linalg.norm(axes.T @ change / spread)))
    return Separation(horizontal, vertical, contradiction)


def _sigmas(covariance: np.ndarray) -> tuple[float, float]:
    """Return the largest horizontal and the vertical standard deviation of a position."""
    return (
        float(np.sqrt(max(np.linalg.eigvalsh(covariance[:2, :2])[-1], 0))),
        float(np.sqrt(max(covariance[2, 2], 0))),
    )
