"""Zoom, shear and stretch of single frames, as electronic stabilisation causes them."""

from __future__ import annotations

import numpy as np

from spn_data.geometry.least_squares import POSE
from spn_data.reconstruction.residual_fit import (
    FRAME_EFFECTS,
    LensObservations,
    Partialled,
    solve_spd,
)

_LENS_SIGMA = 0.02  # prior of the zoom, shear or stretch that all frames share
_MISFIT = 2.5  # factor of the noise due to lens model and matches, measured on real models
_MAX_SIGMA = 1.5e-3  # of the combinations of frames' zooms, shears or stretches that are used


def frame_jitter(
    blocks: list[tuple[LensObservations, Partialled]], readout_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the scatter (3,) between frames of zoom, shear and stretch, and its significance (3,).

    The significance is in sigmas. Each kind is estimated jointly with the others, poses and points, so its
    errors are correlated between frames and very unequal. The scatter is the maximum-likelihood estimate
    given their covariance.
    """
    modes: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in range(FRAME_EFFECTS)]
    for block, partialled in blocks:
        frames = len(block.frames)
        left = partialled.residuals_px + partialled.effects[:, :, 0] * readout_s
        variance = float(block.weights @ (left**2).sum(axis=1)) / block.degrees_of_freedom
        readout_column = len(block.normal) - 1 - block.effects.shape[2]
        columns = np.arange(readout_column)
        normal = block.normal[np.ix_(columns, columns)].copy()
        own = block.frame_columns[:, POSE:].ravel()
        # The part that all frames share belongs to the lens: constrain it weakly.
        normal[own, own] += variance / _LENS_SIGMA**2
        right = np.zeros((len(columns), len(own) + 1))
        right[own, np.arange(len(own))] = 1
        right[:, -1] = (
            -block.normal[columns, -1] - readout_s * block.normal[columns, readout_column]
        )
        solved = solve_spd(normal, right)[own]
        for k in range(FRAME_EFFECTS):
            kind = np.arange(frames) * FRAME_EFFECTS + k
            values, vectors = np.linalg.eigh(variance * solved[np.ix_(kind, kind)])
            modes[k].append((np.maximum(values, 0.0), vectors.T @ solved[kind, -1]))
    fits = [
        most_likely_scatter(
            np.concatenate([v for v, _ in of_kind]), np.concatenate([e for _, e in of_kind])
        )
        for of_kind in modes
    ]
    return np.array([f[0] for f in fits]), np.array([f[1] for f in fits])


def most_likely_scatter(noise: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """Return the maximum-likelihood scatter beyond noise, and its significance in sigmas.

    The values (n,) are independent, with noise variances (n,). The scatter is NaN if too few are known well.
    """
    known = (noise > 0) & (noise < _MAX_SIGMA**2)
    if known.sum() < max(5, len(noise) / 2):
        return float("nan"), 0.0
    noise, values = _MISFIT**2 * noise[known], values[known]
    beyond = np.concatenate([[0.0], np.geomspace(1e-5, 0.1, 200)]) ** 2
    total = noise + beyond[:, None]
    likelihood = -0.5 * (np.log(total) + values**2 / total).sum(axis=1)
    best = int(np.argmax(likelihood))
    return float(np.sqrt(beyond[best])), float(np.sqrt(2 * (likelihood[best] - likelihood[0])))
