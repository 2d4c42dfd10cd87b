"""Cross-validation of the georegistration: errors of held-out fixes, by time block or by flight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.georegistration.fit import Estimate
from spn_data.georegistration.noise import solve
from spn_data.georegistration.problem import Kind, Problem


@dataclass(frozen=True)
class HeldOut:
    """Errors of held-out fixes in metres; NaN if nothing could be held out.

    Attributes
    ----------
    folds : int
        Number of refits.
    frames : int
        Number of held-out fixes evaluated, outliers excluded.
    horizontal_rmse_m, horizontal_median_m : float
        Horizontal error.
    vertical_rmse_m, vertical_median_m : float
        Absolute vertical error.
    """

    folds: int
    frames: int
    horizontal_rmse_m: float
    horizontal_median_m: float
    vertical_rmse_m: float
    vertical_median_m: float


def time_blocks(flight: np.ndarray, time_s: np.ndarray, length_s: float) -> np.ndarray:
    """Return the index (N,) of each frame's time block; blocks last `length_s` seconds within a flight."""
    start = np.array([time_s[flight == f].min() for f in range(flight.max() + 1)])[flight]
    block = np.floor((time_s - start) / length_s).astype(np.int64)
    return np.unique(np.column_stack([flight, block]), axis=0, return_inverse=True)[1].ravel()


def cross_validate(
    problem: Problem, result: Estimate, fold: np.ndarray, inlier: np.ndarray
) -> HeldOut:
    """Refit without each fold in turn and evaluate the held-out fixes.

    `fold` (N,) holds the fold index of each frame. A held-out frame loses its fix and gimbal angles but keeps
    its pose in the model. Noise levels and robust weights are those of the fit to all frames. If a whole
    flight is held out, its vertical offset is unknown, so its heights are compared after removing their
    median.
    """
    horizontal, vertical, folds = [], [], 0
    fixes = problem.fixes
    known = fixes.has_fix & inlier
    table = np.ones((len(Kind), len(problem.model)))
    table[problem.kind, problem.frame] = result.weights
    for k in np.unique(fold[known]):
        left_out = fold == k
        if not (known & ~left_out).any():
            continue
        part = problem.on_frames(~left_out)
        if np.count_nonzero(part.kind == 0) < problem.options.min_fixes:
            continue
        state = result.state
        for _ in range(3):
            linear = part.linearise(state, result.offset_sigma_m, result.bias_weight)
            weights = table[part.kind, part.frame]
            state = state.updated(solve(part.chains, result.levels, weights, linear).step)
        error = problem.residuals(state)[:3, left_out & known]
        horizontal.append(np.hypot(error[0], error[1]))
        flight = fixes.flight[left_out & known]
        for f in np.unique(flight):
            up = error[2, flight == f]
            up = up[np.isfinite(up)]
            no_offset = fixes.free_heights and not (known & ~left_out & (fixes.flight == f)).any()
            if len(up):
                vertical.append(np.abs(up - np.median(up) if no_offset else up))
        folds += 1
    h, v = (np.concatenate(e) if e else np.full(0, np.nan) for e in (horizontal, vertical))
    return HeldOut(folds, len(h), _rms(h), _median(h), _rms(v), _median(v))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else float("nan")
