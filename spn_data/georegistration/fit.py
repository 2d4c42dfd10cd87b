"""Second step of georegistration: robust generalised least squares over all observations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spn_data.georegistration.noise import (
    LinearSolution,
    NoiseLevels,
    robust_weights,
    solve,
    update_levels,
)
from spn_data.georegistration.problem import SHARED, FitState, Problem

_ROUNDS = 40
_SAME_PLACE_SIGMAS = 3.0
_FREE_OFFSET_M = 1e3
FIXED_OFFSET_M = 1e-4


@dataclass(frozen=True, eq=False)
class Estimate:
    """Result of the iterations.

    weights, distance : (M,) robust weights, and distances in sigma of the white noise; covariance : (P, P) of
    all parameters; offset_sigma_m : (F,) prior sigma of each flight's vertical offset; bias_weight : (F,)
    robust weights of the flights' gimbal biases.
    """

    state: FitState
    levels: NoiseLevels
    weights: np.ndarray
    distance: np.ndarray
    covariance: np.ndarray
    offset_sigma_m: np.ndarray
    bias_weight: np.ndarray


def covariance_of(information: np.ndarray) -> np.ndarray:
    """Invert an information matrix (P, P); undetermined directions get a very large variance."""
    diagonal = np.diag(information)
    size = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(information * size[:, None] * size)
    values = np.maximum(values, 1e-12)
    return (vectors / values) @ vectors.T * size[:, None] * size


def _bias_weights(state: FitState, bias_deg: float, freedom: float = 4.0) -> np.ndarray:
    """Return Student t weights (F,) of the flights' gimbal biases."""
    square = (state.gimbal_deg**2).sum(axis=1) / bias_deg**2
    return np.minimum((freedom + 3) / (freedom + square), 1.0)


def iterate(
    problem: Problem,
    state: FitState,
    inlier: np.ndarray,
    offset_sigma_m: np.ndarray,
    levels: NoiseLevels,
    *,
    rounds: int = _ROUNDS,
) -> Estimate:
    """Alternate Gauss-Newton steps, robust weights and noise levels, starting from the RANSAC inliers (N,).

    The number of rounds is fixed and each round is a smooth function of its input, so rounding differences in
    the input remain rounding differences in the result.
    """
    position = problem.kind < 3
    weights = np.where(position & ~inlier[problem.frame], 1e-4, 1.0)
    bias_weight = np.ones(len(state.offsets_m))
    distance = np.zeros(len(weights))
    solution: LinearSolution | None = None
    for k in range(rounds):
        linear = problem.linearise(state, offset_sigma_m, bias_weight)
        if k >= 2:
            levels = update_levels(problem.chains, levels, weights, linear)
        solution = solve(problem.chains, levels, weights, linear)
        state = state.updated(solution.step)
        weights, distance = robust_weights(problem.chains, levels, solution.white)
        bias_weight = _bias_weights(state, problem.options.gimbal_bias_deg)
    assert solution is not None
    return Estimate(
        state,
        levels,
        weights,
        distance,
        covariance_of(solution.information),
        offset_sigma_m,
        bias_weight,
    )


def estimate(problem: Problem, state: FitState, inlier: np.ndarray) -> Estimate:
    """Fit all frames, with the flights' vertical offsets free or tied depending on the data.

    If a flight's take-off height differs from the first flight's by less than the errors explain, both are
    assumed to have taken off at the same height, so that all flights together determine the vertical.
    """
    f = len(state.offsets_m)
    levels = problem.prior_levels()
    first = _first_flight_with_heights(problem)
    fixed = np.full(f, FIXED_OFFSET_M)
    if not problem.fixes.free_heights or f == 1 or not problem.fixes.has_heights:
        return iterate(problem, _without_offsets(state), inlier, fixed, levels)
    tied = np.full(f, problem.options.same_takeoff_sigma_m)
    tied[first] = FIXED_OFFSET_M
    if problem.options.same_takeoff is True:
        return iterate(problem, _without_offsets(state), inlier, tied, levels)
    free = np.full(f, _FREE_OFFSET_M)
    free[first] = FIXED_OFFSET_M
    shifted = _from_first(state, first)
    result = iterate(problem, shifted, inlier, free, levels, rounds=_ROUNDS // 2)
    if problem.options.same_takeoff is None:
        offsets = result.state.offsets_m
        sigma = np.sqrt(np.diag(result.covariance)[SHARED : SHARED + f])
        kind = problem.fixes.relative == problem.fixes.relative[first]
        same = kind & (np.abs(offsets) < _SAME_PLACE_SIGMAS * sigma)
        free = np.where(same, tied, free)
    return iterate(problem, result.state, inlier, free, levels)


def _first_flight_with_heights(problem: Problem) -> int:
    known = np.isfinite(problem.fixes.enu_m[:, 2])
    return int(problem.fixes.flight[known].min()) if known.any() else 0


def _without_offsets(state: FitState) -> FitState:
    """Return the state with all offsets zero and the first flight's offset moved into the centre's height."""
    return _from_first(state, 0, drop=True)


def _from_first(state: FitState, first: int, *, drop: bool = False) -> FitState:
    """Return the state with offsets relative to one flight's, and the centre's height adjusted to match."""
    offsets = np.zeros_like(state.offsets_m) if drop else state.offsets_m - state.offsets_m[first]
    center = state.center - np.array([0.0, 0.0, state.offsets_m[first]])
    return replace(state, center=center, offsets_m=offsets)
