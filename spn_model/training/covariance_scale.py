"""One factor that makes stated covariances as large as the errors on images that a network has not seen."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from spn_data.errors import GeometryError
from spn_data.geometry.pose import Poses, rotation_vectors
from spn_model.evaluation.calibration import DOF, nees
from spn_model.models.pose_model import PoseEstimates

LEAST_FRAMES = 10


def fit_covariance_scale(estimates: PoseEstimates, truth: Poses) -> float:
    """Factor by which the covariances of these estimates have to grow, from the true poses (N).

    The median of the errors' squared Mahalanobis distances becomes that of chi-squared with 6 degrees of
    freedom: half of the frames lie within the ellipsoid that should hold half of them. The median, because a
    few wrong poses have distances without bound. `Member.set_covariance_scale` takes the factor from images
    that training does not draw, for a network knows too much of the others. Raises GeometryError where fewer
    than 10 frames have a pose and a covariance.
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
            f"{len(squared)} images have a pose with a covariance, need {LEAST_FRAMES} to "
            "measure how large covariances are"
        )
    return float(np.median(squared) / chdtri(DOF, 0.5))
