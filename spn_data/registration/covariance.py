"""Covariance of the poses of a sequence relative to the map.

Three causes of errors enter one least-squares problem: the noise of the sequence's own measurements, the lens
and the points that its frames share, and the errors of the map points, which are correlated for points
observed in the same mapping frames. Let S be the normal matrix of poses and lens (own points eliminated) and
N the coupling between them and the map points. The errors are S^-1 (noise - N dX), and the covariance is the
sum of s^2 k S^-1, b S^-1 N Cov(X) N^T S^-1, and what the fields of the lenses change, which no number of
frames averages out (`uncertainty.lens_errors`). s^2 is the variance of the residuals; k (at least 1) is the
design effect of clusters: how much the measurements of one image region are correlated; b (at least 1) is how
much worse the sequence fits the map than sequences usually do.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from spn_data.geometry.camera import MODELS
from spn_data.geometry.least_squares import POSE, cauchy_weights, cluster_scores, rows_to_sparse
from spn_data.registration.adjustment import (
    Linearized,
    NormalEquations,
    SequenceObservations,
    SequenceState,
    jacobian,
    linearize,
    normal_equations,
    principal_point_prior,
)
from spn_data.registration.solution import SCALE_PX
from spn_data.uncertainty.lens_errors import BLOCKS, TERMS, estimate_field, field_values
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
    measured : ndarray, shape (N, 6, 6)
        The part of it that is due to the errors of measurements: how well the frame is determined in the map.
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
    measured: np.ndarray
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
    prior = principal_point_prior(state, lens, SCALE_PX)
    normal = normal_equations(linearized, observations, n, len(state.own_points), weights, prior)
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
    fields = _effects_of_fields(
        state,
        observations,
        point_rows,
        linearized,
        weights,
        weighted_jacobian,
        normal,
        factor,
        sigma_px**2 * effect,
    )
    blocks = [np.arange(POSE * k, POSE * (k + 1)) for k in range(n)]
    blocks.append(np.arange(POSE * n, POSE * n + len(lens)))
    totals, measured = [], []
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
            both = noise + misfit * of_map[k].measured
            measured.append(0.5 * (both + both.T))
            shared = of_map[k].shared + fields[block] @ fields[block].T
            totals.append(measured[-1] + 0.5 * (shared + shared.T))
    return SequenceCovariance(
        np.stack(totals[:n]),
        np.stack(measured[:n]),
        totals[n],
        lens,
        sigma_px,
        effect,
        linearized.residuals_px,
    )


def _effects_of_fields(
    state: SequenceState,
    observations: SequenceObservations,
    point_rows: np.ndarray,
    linearized: Linearized,
    weights: np.ndarray,
    weighted_jacobian: sparse.csr_matrix,
    normal: NormalEquations,
    factor: SuperLU,
    variance: float,
) -> np.ndarray:
    """Return the changes (6N+L, t) of poses and lens by t independent errors of the sequence's own lens.

    These are its fields, and the focal length if it is not estimated. `variance` is that of a residual
    component, with the design effect.
    """
    own = observations.own >= 0
    count = len(state.own_points)
    root = np.sqrt(weights)
    by_own = linearized.by_point[own] * root[own][:, None, None]
    of_own = rows_to_sparse(by_own, 3 * observations.own[own][:, None] + np.arange(3), 3 * count)

    def without_points(values: np.ndarray) -> np.ndarray:
        """Return weighted fields (2 M, t) with the own points projected out."""
        if not count:
            return values
        lines = np.repeat(own, 2)
        through = (of_own.T @ values[lines]).reshape(count, 3, -1)
        moved = np.einsum("pij,pjt->pit", normal.point_inverse, through).reshape(3 * count, -1)
        left = values.copy()
        left[lines] -= of_own @ moved
        return left

    camera = state.camera
    values = field_values(camera, observations.pixels) * root[:, None]
    both = np.zeros((2 * len(values), TERMS))
    both[0::2, : values.shape[1]] = both[1::2, values.shape[1] :] = values
    response = factor.solve(weighted_jacobian.T @ without_points(both))
    fields = without_points(both - weighted_jacobian @ response)
    residuals = (linearized.residuals_px * root[:, None]).ravel()
    block = np.repeat(_blocks_of_points(observations, point_rows), 2)
    parts = [(fields[block == b], residuals[block == b]) for b in range(BLOCKS)]
    estimate = estimate_field(
        camera,
        np.stack([part.T @ part for part, _ in parts]),
        np.stack([-part.T @ left for part, left in parts]),
        variance,
        principal_point_is_estimated="cx" in linearized.lens,
    )
    effects = [-response @ estimate.root]
    if not linearized.lens:
        focal = tuple(name for name in MODELS[camera.model] if name in ("f", "fx", "fy"))
        by_focal = linearize(state, observations, focal).by_lens.sum(axis=2).reshape(-1, 1)
        sigma_px = state.expected.focal_sigma * float(np.mean(camera.focal_px))
        by_focal = without_points(by_focal * np.repeat(root, 2)[:, None])
        effects.append(-sigma_px * factor.solve(weighted_jacobian.T @ by_focal))
    return np.concatenate(effects, axis=1)


def _blocks_of_points(observations: SequenceObservations, point_rows: np.ndarray) -> np.ndarray:
    """Return the block (M,) of each measurement, 0..BLOCKS-1: whole points, in order of their first frame."""
    point = np.where(observations.own >= 0, -1 - observations.own, point_rows)
    _, first, index = np.unique(point, return_index=True, return_inverse=True)
    order = np.argsort(first)
    ends = np.cumsum(np.bincount(index)[order])
    block = np.empty(len(first), dtype=np.int64)
    block[order] = (ends - 1) * BLOCKS // len(point)
    return np.asarray(block[index])


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
