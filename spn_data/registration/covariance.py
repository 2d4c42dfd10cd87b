"""Covariance of the poses of a sequence relative to the map.

Three causes of errors enter one least-squares problem: the noise of the sequence's own measurements, the lens
and the points that its frames share, and the errors of the map points, which are correlated for points
observed in the same mapping frames. Let S be the normal matrix of poses and lens (own points eliminated) and
N the coupling between them and the map points. The errors are S^-1 (noise - N dX), and the covariance is the
sum of s^2 k S^-1 and b S^-1 N Cov(X) N^T S^-1. s^2 is the variance of the residuals; k (at least 1) is the
design effect of clusters: how much the measurements of one image region are correlated; b (at least 1) is how
much worse the sequence fits the map than sequences usually do.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from spn_data.geometry.least_squares import POSE, cauchy_weights, cluster_scores, rows_to_sparse
from spn_data.registration.adjustment import (
    Linearized,
    SequenceObservations,
    SequenceState,
    jacobian,
    linearize,
    normal_equations,
)
from spn_data.registration.solution import SCALE_PX
from spn_data.uncertainty.map_covariance import Functional, MapCovariance

_FRAMES_AT_ONCE = 8
# Residuals of a sequence are usually 20 % larger than the map's own. If they are more than 50 % larger, the
# map is deformed, and its points have larger errors than their covariance states.
_USUAL_MISFIT = 1.5
_CELL_PX = 16.0  # measurements within one cell of a frame are not independent


@dataclass(frozen=True, eq=False)
class SequenceCovariance:
    """Covariance of a sequence.

    Attributes
    ----------
    poses : ndarray, shape (N, 6, 6)
        As in Labels.
    lens : ndarray, shape (L, L)
        Of the intrinsics in `lens_names`.
    lens_names : tuple of str
    sigma_px : float
        Standard deviation of one residual component.
    design_effect : float
        Factor k of the noise.
    residuals_px : ndarray, shape (M, 2)
    """

    poses: np.ndarray
    lens: np.ndarray
    lens_names: tuple[str, ...]
    sigma_px: float
    design_effect: float
    residuals_px: np.ndarray


def sequence_covariance(
    state: SequenceState,
    observations: SequenceObservations,
    point_rows: np.ndarray,
    map_covariance: MapCovariance,
    lens: tuple[str, ...],
) -> SequenceCovariance:
    """Compute the covariance of a sequence at its solution.

    `point_rows` (M,) are the rows of the map points, -1 for own points; `lens` names the estimated
    intrinsics.
    """
    n = len(state.poses)
    linearized = linearize(state, observations, lens)
    weights = cauchy_weights(linearized.residuals_px, SCALE_PX)
    normal = normal_equations(linearized, observations, n, len(state.own_points), weights)
    diagonal = normal.matrix.diagonal()
    factor = splu((normal.matrix + sparse.diags(1e-12 * diagonal)).tocsc())
    weighted_jacobian = jacobian(linearized, observations.frame, n, weights)
    sigma_px = _sigma_px(linearized.residuals_px, weights, n, len(lens), len(state.own_points))
    misfit = misfit_factor(sigma_px, map_covariance)
    effect = _design_effect(weighted_jacobian, linearized.residuals_px, weights, observations)
    used, columns = np.unique(point_rows[point_rows >= 0], return_inverse=True)
    coupling = _map_point_coupling(
        linearized, observations, weights, weighted_jacobian, columns, len(used)
    )
    poses = np.empty((n, POSE, POSE))
    blocks = [np.arange(POSE * k, POSE * (k + 1)) for k in range(n)]
    blocks.append(np.arange(POSE * n, POSE * n + len(lens)))
    covariances = []
    for first in range(0, len(blocks), _FRAMES_AT_ONCE):
        some = blocks[first : first + _FRAMES_AT_ONCE]
        rows = np.concatenate(some)
        right = np.zeros((len(diagonal), len(rows)))
        right[rows, np.arange(len(rows))] = 1.0
        solved = factor.solve(right)
        by_points = (coupling.T @ solved).T
        ends = np.cumsum([0, *map(len, some)])
        functionals = [
            Functional(used, by_points[a:b].reshape(b - a, len(used), 3))
            for a, b in pairwise(ends.tolist())
        ]
        of_map = map_covariance.functional_covariances(functionals)
        for k, block in enumerate(some):
            noise = sigma_px**2 * effect * solved[block, ends[k] : ends[k + 1]]
            both = noise + misfit * of_map[k]
            covariances.append(0.5 * (both + both.T))
    poses[:] = covariances[:n]
    return SequenceCovariance(
        poses, covariances[n], lens, sigma_px, effect, linearized.residuals_px
    )


def misfit_factor(sigma_px: float, map_covariance: MapCovariance) -> float:
    """Return the factor (at least 1) for the covariance of the map points, from a frame's residuals."""
    return max(1.0, (sigma_px / (_USUAL_MISFIT * map_covariance.sigma_px)) ** 2)


def _sigma_px(
    residuals_px: np.ndarray, weights: np.ndarray, frames: int, lens: int, own_points: int
) -> float:
    """Return the standard deviation of one residual component, with a degree of freedom less per unknown."""
    freedom = 2 * weights.sum() - POSE * frames - lens - 3 * own_points
    squared = float((weights * (residuals_px**2).sum(axis=1)).sum())
    return float(np.sqrt(squared / max(freedom, 1.0)))


def _design_effect(
    weighted_jacobian: sparse.csr_matrix,
    residuals_px: np.ndarray,
    weights: np.ndarray,
    observations: SequenceObservations,
) -> float:
    """Return the cluster-robust design effect, at least 1.

    It is the median ratio of the squared scores of clusters of measurements to those of single measurements.
    """
    cells = np.floor(observations.pixels / _CELL_PX).astype(np.int64)
    where = np.column_stack([observations.frame, cells])
    cluster = np.unique(where, axis=0, return_inverse=True)[1].ravel()
    residuals = (residuals_px * np.sqrt(weights)[:, None]).ravel()

    def squared_scores(group: np.ndarray) -> np.ndarray:
        scores = cluster_scores(residuals, group, weighted_jacobian)
        return np.asarray(scores.multiply(scores).sum(axis=0)).ravel()

    single = squared_scores(np.arange(len(residuals_px)))
    known = single > 0
    return max(1.0, float(np.median(squared_scores(cluster)[known] / single[known])))


def _map_point_coupling(
    linearized: Linearized,
    observations: SequenceObservations,
    weights: np.ndarray,
    weighted_jacobian: sparse.csr_matrix,
    columns: np.ndarray,
    points: int,
) -> sparse.csr_matrix:
    """Return the change of the right-hand side by the positions of K map points, sparse (6N+L, 3K)."""
    of_map = np.flatnonzero(observations.own < 0)
    root = np.sqrt(weights[of_map])[:, None, None]
    by_point = linearized.by_point[of_map] * root
    by_places = rows_to_sparse(by_point, 3 * columns[:, None] + np.arange(3), 3 * points)
    rows = (2 * of_map[:, None] + np.arange(2)).ravel()
    return (weighted_jacobian[rows].T @ by_places).tocsr()
