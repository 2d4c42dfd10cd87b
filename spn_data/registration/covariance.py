"""How uncertain the poses of a sequence are, relative to the map.

Three things make them so, and all are in one least squares: the noise of the sequence's own measurements,
the lens and the points that its frames share, and the errors of the map's points, which are alike for points
seen by the same mapping frames. With S the information of poses and lens (own points eliminated) and N the
pull of the map points on them, the errors are S^-1 (noise - N dX): the covariance is the sum of
s^2 k S^-1 and b S^-1 N Cov(X) N^T S^-1. s^2 is the variance of the residuals themselves, k (at least 1) by
how much the measurements of one spot of an image pull together (the design effect of clusters), b (at
least 1) by how much worse the sequence fits the map than sequences usually do.
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
# Residuals of a sequence are usually a fifth larger than the map's own. Where they are more than half as
# large again, the map is bent, and its points are off by more than their covariance says.
_USUAL_MISFIT = 1.5
_CELL_PX = 16.0  # measurements of one such cell of a frame are not independent


@dataclass(frozen=True, eq=False)
class SequenceCovariance:
    """poses : (N, 6, 6) as in Labels; lens : (L, L) over `lens_names`; sigma_px : deviation of one residual
    component; design_effect : k; residuals_px : (M, 2).
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
    """Of a sequence at its solution.

    point_rows : (M,) rows of the map points, -1 for own points; lens : the intrinsics that were estimated.
    """
    n = len(state.poses)
    linearized = linearize(state, observations, lens)
    weights = cauchy_weights(linearized.residuals_px, SCALE_PX)
    normal = normal_equations(linearized, observations, n, len(state.own_points), weights)
    diagonal = normal.matrix.diagonal()
    factor = splu((normal.matrix + sparse.diags(1e-12 * diagonal)).tocsc())
    by_unknown = jacobian(linearized, observations.frame, n, weights)
    sigma_px = _sigma_px(linearized.residuals_px, weights, n, len(lens), len(state.own_points))
    bent = bend_factor(sigma_px, map_covariance)
    effect = _design_effect(by_unknown, linearized.residuals_px, weights, observations)
    used, columns = np.unique(point_rows[point_rows >= 0], return_inverse=True)
    pull = _pull(linearized, observations, weights, by_unknown, columns, len(used))
    poses = np.empty((n, POSE, POSE))
    blocks = [np.arange(POSE * k, POSE * (k + 1)) for k in range(n)]
    blocks.append(np.arange(POSE * n, POSE * n + len(lens)))
    found = []
    for first in range(0, len(blocks), _FRAMES_AT_ONCE):
        some = blocks[first : first + _FRAMES_AT_ONCE]
        rows = np.concatenate(some)
        right = np.zeros((len(diagonal), len(rows)))
        right[rows, np.arange(len(rows))] = 1.0
        solved = factor.solve(right)
        by_points = (pull.T @ solved).T
        ends = np.cumsum([0, *map(len, some)])
        functionals = [
            Functional(used, by_points[a:b].reshape(b - a, len(used), 3))
            for a, b in pairwise(ends.tolist())
        ]
        of_map = map_covariance.functional_covariances(functionals)
        for k, block in enumerate(some):
            noise = sigma_px**2 * effect * solved[block, ends[k] : ends[k + 1]]
            both = noise + bent * of_map[k]
            found.append(0.5 * (both + both.T))
    poses[:] = found[:n]
    return SequenceCovariance(poses, found[n], lens, sigma_px, effect, linearized.residuals_px)


def bend_factor(sigma_px: float, map_covariance: MapCovariance) -> float:
    """By what the covariance of the map's points is too small, at least 1, by a frame's residuals."""
    return max(1.0, (sigma_px / (_USUAL_MISFIT * map_covariance.sigma_px)) ** 2)


def _sigma_px(
    residuals_px: np.ndarray, weights: np.ndarray, frames: int, lens: int, own_points: int
) -> float:
    """Of one component; every unknown takes its share of the freedom."""
    freedom = 2 * weights.sum() - POSE * frames - lens - 3 * own_points
    squared = float((weights * (residuals_px**2).sum(axis=1)).sum())
    return float(np.sqrt(squared / max(freedom, 1.0)))


def _design_effect(
    by_unknown: sparse.csr_matrix,
    residuals_px: np.ndarray,
    weights: np.ndarray,
    observations: SequenceObservations,
) -> float:
    """Median ratio of the squared pull of clusters of measurements to that of each by itself, at least 1."""
    cells = np.floor(observations.pixels / _CELL_PX).astype(np.int64)
    where = np.column_stack([observations.frame, cells])
    cluster = np.unique(where, axis=0, return_inverse=True)[1].ravel()
    residuals = (residuals_px * np.sqrt(weights)[:, None]).ravel()

    def squared_pull(group: np.ndarray) -> np.ndarray:
        pull = cluster_scores(residuals, group, by_unknown)
        return np.asarray(pull.multiply(pull).sum(axis=0)).ravel()

    single = squared_pull(np.arange(len(residuals_px)))
    known = single > 0
    return max(1.0, float(np.median(squared_pull(cluster)[known] / single[known])))


def _pull(
    linearized: Linearized,
    observations: SequenceObservations,
    weights: np.ndarray,
    by_unknown: sparse.csr_matrix,
    columns: np.ndarray,
    points: int,
) -> sparse.csr_matrix:
    """Sparse (6N+L, 3K): change of the right side by the places of K map points."""
    of_map = np.flatnonzero(observations.own < 0)
    root = np.sqrt(weights[of_map])[:, None, None]
    by_point = linearized.by_point[of_map] * root
    by_places = rows_to_sparse(by_point, 3 * columns[:, None] + np.arange(3), 3 * points)
    rows = (2 * of_map[:, None] + np.arange(2)).ravel()
    return (by_unknown[rows].T @ by_places).tocsr()
