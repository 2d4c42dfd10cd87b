"""Robust similarity between two sets of corresponding points."""

from __future__ import annotations

import numpy as np

from spn_data.colmap import pycolmap
from spn_data.geometry.pose import Similarity


def robust_similarity(
    source: np.ndarray, target: np.ndarray, *, max_error: float, seed: int = 0
) -> Similarity | None:
    """Fit target_from_source by LO-RANSAC.

    Parameters
    ----------
    source, target : ndarray, shape (N, 3)
        Corresponding points.
    max_error : float
        Maximum distance of an inlier, in the units of `target`.
    seed : int
        Random seed.

    Returns
    -------
    Similarity or None
        None with fewer than three correspondences, or if no similarity has three inliers.
    """
    if len(source) < 3:
        return None
    options = pycolmap.RANSACOptions(max_error=max_error, random_seed=seed)
    options.min_num_trials, options.max_num_trials = 50, 500
    found = pycolmap.estimate_sim3d_robust(source, target, options)
    if found is None:
        return None
    fit = found["tgt_from_src"]
    if not (np.isfinite(fit.scale) and fit.scale > 0):
        return None
    return Similarity(float(fit.scale), fit.rotation.matrix(), np.asarray(fit.translation))
