"""Calibration of a network's covariances by one factor, from images that it was not trained on."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from spn_data.errors import GeometryError
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotation_vectors
from spn_model.evaluation.calibration import DOF, nees
from spn_model.models.pose_model import PoseEstimates

LEAST_FRAMES = 10


def fit_covariance_scale(estimates: PoseEstimates, truth: Poses) -> float:
    """Fit the factor that makes covariances consistent with the errors.

    Parameters
    ----------
    estimates : PoseEstimates
        Poses and covariances of N images.
    truth : Poses
        N true poses.

    Returns
    -------
    float
        Factor by which the covariances need to grow.

    Raises
    ------
    GeometryError
        If fewer than 10 images have a pose and a covariance.

    Notes
    -----
    With this factor, the median of the squared Mahalanobis distances (NEES) equals that of chi-squared with
    6 degrees of freedom: half of the frames are within the ellipsoid that should contain half of them. The
    median is used because the distances of a few wrong poses have no bound.
    `PoseModel.set_covariance_scale` takes the factor; it must be measured on images that training does not
    draw, because a network is overconfident on the others.
    """
    known = np.isfinite(estimates.poses.centers).all(axis=1)
    errors = np.full((len(known), DOF), np.nan)
    errors[known, :3] = truth.centers[known] - estimates.poses.centers[known]
    turns = truth.rotations[known] @ estimates.poses.rotations[known].swapaxes(1, 2)
    errors[known, 3:] = rotation_vectors(turns)
    squared = nees(errors, np.where(known[:, None, None], estimates.covariance, np.nan))
    squared = squared[np.isfinite(squared)]
    if len(squared) < LEAST_FRAMES:
        raise GeometryError(
            f"{len(squared)} images have a pose with a covariance, at least {LEAST_FRAMES} are needed "
            "to calibrate covariances"
        )
    return float(np.median(squared) / chdtri(DOF, 0.5))
