"""Judgement of a pose from landmarks: may it be published, with which covariance and protection levels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_model.integrity.separation import groups_of, separate

_LEAST_FACTOR = 0.5  # on a covariance, where residuals are small
_COLUMNS, _ROWS = 8, 5  # of the grid over the image that inliers must spread over


@dataclass(frozen=True, kw_only=True)
class IntegrityLimits:
    """Limits that a pose must keep to be published.

    Attributes
    ----------
    min_inliers : int
        Landmarks that agree with the pose.
    min_cells : int
        Cells of an 8 x 5 grid over the image that contain one.
    min_share : float
        Share of the landmarks found near their projections that agree.
    max_rival : float
        Landmarks that agree with a pose elsewhere, as a share of those that agree with this one.
    max_chi : float
        Root of the mean squared whitened residual of the inliers.
    max_contradiction : float
        Change of the position by a group of landmarks, in standard deviations of that change.
    alarm_m : float
        Largest protection level, horizontally and vertically.
    max_sigma_deg : float
        Standard deviation of the orientation.
    max_tilt_sigmas : float
        Difference from a known vertical, in standard deviations.
    max_height_sigmas : float
        Difference from a known height, in standard deviations.
    focal_sigma : float
        Standard deviation of the stated focal length, relative.
    max_focal_sigmas : float
        Difference between the focal length that the landmarks fit and the stated one, in standard deviations.
    protection_sigmas : float
        Standard deviations in a protection level.
    """

    min_inliers: int = 40
    min_cells: int = 8
    min_share: float = 0.65
    max_rival: float = 0.33
    max_chi: float = 2.0
    max_contradiction: float = 6.0
    alarm_m: float = 0.75
    max_sigma_deg: float = 0.5
    max_tilt_sigmas: float = 5.0
    max_height_sigmas: float = 5.0
    focal_sigma: float = 0.001
    max_focal_sigmas: float = 5.0
    protection_sigmas: float = 4.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Witness:
    """What is known about a pose from landmarks.

    Attributes
    ----------
    at : ndarray, shape (K, 2)
        Where the landmarks were found, as tangents divided by those of half the field of view: -1 to 1.
    xyz : ndarray, shape (K, 3)
        Positions of the landmarks in the world.
    residuals : ndarray, shape (K, 2)
        Whitened.
    jacobian : ndarray, shape (K, 2, 6)
        Of the whitened residuals.
    by_focal : ndarray, shape (K, 2)
        Derivatives of the whitened residuals by the logarithm of the focal length.
    weights : ndarray, shape (K,)
        Robust weights.
    inliers : ndarray of bool, shape (K,)
    information : ndarray, shape (6, 6)
        Normal matrix of the solution.
    tilt_sigmas : float
        Difference from a known vertical, in its standard deviations; 0 without one.
    height_sigmas : float
        Difference from a known height, in its standard deviations; 0 without one.
    rival_inliers : int
        Landmarks that agree with the best pose elsewhere; 0 if there is none.
    focal_change : tuple of float
        Relative change of the focal length that the landmarks fit, and its standard deviation.
    focal_bound : float
        Bound of the relative error of the stated focal length by images before; infinite without any.
    """

    at: np.ndarray
    xyz: np.ndarray
    residuals: np.ndarray
    jacobian: np.ndarray
    by_focal: np.ndarray
    weights: np.ndarray
    inliers: np.ndarray
    information: np.ndarray
    tilt_sigmas: float = 0.0
    height_sigmas: float = 0.0
    rival_inliers: int = 0
    focal_change: tuple[float, float] = (0.0, 1.0)
    focal_bound: float = np.inf


@dataclass(frozen=True, eq=False, kw_only=True)
class Judgement:
    """Verdict on a pose.

    Attributes
    ----------
    reason : str
        Why the pose must not be used; empty if it may be.
    covariance : ndarray, shape (6, 6)
        Over the centre and a rotation vector in the camera frame.
    horizontal_m, vertical_m : float
        Protection levels.
    quality : int
        1 to 100: the share of landmarks that agree.
    inliers : int
    focal_bound : float
        Bound of the relative error of the stated focal length, by this image and those before; infinite
        unless the image passed the limits before the protection levels.
    """

    reason: str
    covariance: np.ndarray
    horizontal_m: float
    vertical_m: float
    quality: int
    inliers: int
    focal_bound: float


def judge(witness: Witness, limits: IntegrityLimits) -> Judgement:
    """Judge a pose.

    Parameters
    ----------
    witness : Witness
    limits : IntegrityLimits

    Returns
    -------
    Judgement
        With the first limit that is not kept as its reason.

    Notes
    -----
    A view of one plane at one distance fits any focal length. The covariance trusts the stated one
    (`focal_sigma`), but the protection levels do not: they include what the largest error that the images
    cannot exclude does to the position.
    """
    inliers = witness.inliers
    count = int(inliers.sum())
    chi = float(np.sqrt((witness.residuals[inliers] ** 2).mean())) if count else np.inf
    factor = max(_LEAST_FACTOR, chi**2)  # residuals larger or smaller than stated
    jacobian, information = _with_focal(witness, factor, limits.focal_sigma)
    focal, focal_sigma = witness.focal_change
    covariance = (np.linalg.inv(information) * factor)[:6, :6]
    share = count / max(len(inliers), 1)
    cells = np.unique(np.floor((witness.at[inliers] + 1) / 2 * [_COLUMNS, _ROWS]), axis=0)
    reason, horizontal, vertical, bound = "", np.inf, np.inf, np.inf
    sigma_deg = float(np.rad2deg(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])))
    if count < limits.min_inliers:
        reason = f"{count} landmarks agree, {limits.min_inliers} are needed"
    elif len(cells) < limits.min_cells:
        parts = f"{len(cells)} of {_COLUMNS * _ROWS} parts of the image"
        reason = f"landmarks in {parts}, {limits.min_cells} are needed"
    elif share < limits.min_share:
        reason = (
            f"{100 * share:.0f} % of the landmarks agree, {100 * limits.min_share:.0f} % are needed"
        )
    elif witness.rival_inliers > limits.max_rival * count:
        reason = f"{count} landmarks agree, but {witness.rival_inliers} with a pose elsewhere"
    elif chi > limits.max_chi:
        reason = (
            f"residuals are {chi:.1f} times as large as expected, {limits.max_chi:g} is allowed"
        )
    elif sigma_deg > limits.max_sigma_deg:
        reason = (
            f"the orientation is known to {sigma_deg:.2f} deg, {limits.max_sigma_deg:g} is needed"
        )
    elif witness.tilt_sigmas > limits.max_tilt_sigmas:
        reason = (
            f"the images contradict the stated attitude by {witness.tilt_sigmas:.1f} standard deviations; "
            "check its time, its mounting and its standard deviation"
        )
    elif witness.height_sigmas > limits.max_height_sigmas:
        reason = (
            f"the images contradict the stated height by {witness.height_sigmas:.1f} standard deviations; "
            "check its time, its zero and its standard deviations"
        )
    elif abs(focal) > limits.max_focal_sigmas * np.hypot(focal_sigma, limits.focal_sigma):
        reason = (
            f"the landmarks fit a focal length that is {100 * focal:+.1f} % from the stated one; "
            "give the camera of these images"
        )
    else:
        separation = separate(
            jacobian[inliers],
            witness.residuals[inliers],
            witness.weights[inliers],
            information,
            groups_of(witness.at[inliers], witness.xyz[inliers]),
            factor=factor,
            sigmas=limits.protection_sigmas,
        )
        known = np.hypot(focal_sigma, limits.focal_sigma)
        bound = min(witness.focal_bound, abs(focal) + limits.protection_sigmas * known)
        moved_by_focal = np.linalg.solve(information[:6, :6], information[:6, 6])[:3]
        moved = np.abs(moved_by_focal) * bound
        horizontal = separation.horizontal_m + float(np.hypot(*moved[:2]))
        vertical = separation.vertical_m + float(moved[2])
        if separation.contradiction > limits.max_contradiction:
            reason = (
                "groups of landmarks contradict each other by "
                f"{separation.contradiction:.1f} standard deviations"
            )
        elif max(horizontal, vertical) > limits.alarm_m:
            reason = (
                f"the position is protected to {horizontal:.2f} m horizontally and {vertical:.2f} m "
                f"vertically, {limits.alarm_m:g} m is needed"
            )
    return Judgement(
        reason=reason,
        covariance=covariance,
        horizontal_m=horizontal,
        vertical_m=vertical,
        quality=int(np.clip(round(100 * share), 1, 100)),
        inliers=count,
        focal_bound=bound,
    )


def _with_focal(witness: Witness, factor: float, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Add the logarithm of the focal length as a seventh unknown, with its standard deviation.

    Returns the Jacobian (K, 2, 7) and the normal matrix (7, 7).
    """
    jacobian = np.concatenate([witness.jacobian, witness.by_focal[:, :, None]], axis=2)
    kept = witness.inliers
    weights, by_focal = witness.weights[kept], witness.by_focal[kept]
    information = np.zeros((7, 7))
    information[:6, :6] = witness.information
    information[6, :6] = information[:6, 6] = np.einsum(
        "n,nij,ni->j", weights, witness.jacobian[kept], by_focal
    )
    information[6, 6] = np.einsum("n,ni,ni->", weights, by_focal, by_focal) + factor / sigma**2
    return jacobian, information
