"""What the fixes of the flights say about the focal lengths of their cameras.

A wrong focal length bends a model: views that are tilted to opposite sides move apart, and flights at two
heights come too close to each other. The fixes show that as far as their errors, which change slowly and are
partly the same in a whole flight, allow. Focal lengths are estimated together with the georegistration, in
one step from its solution: poses are taken as linear functions of them, which agrees with adjustments at
fixed focal lengths over several percent.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_vectors
from spn_data.georegistration.fit import covariance_of
from spn_data.georegistration.georegister import Fitted
from spn_data.georegistration.noise import apply_inverse_covariance, solve
from spn_data.georegistration.uncertainty import drift_through

# What fixes have besides the errors that the fit knows, chosen as typical and not measured.
_ANTENNA_M = 0.15  # distance of the antenna from the camera, along and across the heading
_CLOCK_S = 0.2  # between fixes and images
_STEEP = (
    0.7  # vertical component of a viewing direction, above which the image's top is the heading
)
_STEP = 1e-3  # of numerical derivatives, in sizes of the model and in radians


@dataclass(frozen=True)
class FocalByFixes:
    """What fixes say about a focal length.

    Attributes
    ----------
    shift_px : float
        Their value minus the current one.
    sigma_px : float
        Its standard deviation.
    """

    shift_px: float
    sigma_px: float


def focal_lengths_by_fixes(
    model: Poses,
    fitted: Fitted,
    by_focal: Mapping[str, np.ndarray],
    by_lens_errors: np.ndarray,
    prior_px: Mapping[str, float],
    clock_s: Mapping[str, float],
) -> dict[str, FocalByFixes]:
    """Estimate focal lengths from telemetry, with errors that fixes usually have besides noise.

    Noise is not taken as smaller than what consumer receivers have: fixes that were filtered agree too well.

    Parameters
    ----------
    model : Poses
        N poses in the gauge of the reconstruction.
    fitted : Fitted
        Their georegistration.
    by_focal : mapping of str to ndarray, shape (N, 6)
        Change of the poses per pixel of each focal length.
    by_lens_errors : ndarray, shape (N, 6, t)
        Change of the poses by t independent errors of unit variance.
    prior_px : mapping of str to float
        Sigma of each focal length about its current value: so wide that it says hardly anything.
    clock_s : mapping of str to float
        Sigma of the time offset of each flight; those of photos with their own fixes may be missing.

    Returns
    -------
    dict of str to FocalByFixes
        By the names of `by_focal`.
    """
    problem, result = fitted.problem, fitted.result
    nuisances, nuisance_sigma = _errors_of_fixes(model, fitted, clock_s)
    changes = np.concatenate(
        [np.stack(list(by_focal.values()), axis=2), by_lens_errors, nuisances], axis=2
    )
    sigma = np.concatenate(
        [[prior_px[name] for name in by_focal], np.ones(by_lens_errors.shape[2]), nuisance_sigma]
    )
    linear = problem.linearise(result.state, result.offset_sigma_m, result.bias_weight)
    jacobian = np.concatenate([linear.jacobian, _derivatives(model, fitted, changes)], axis=1)
    extended = replace(
        linear,
        jacobian=jacobian,
        prior_precision=np.concatenate([linear.prior_precision, 1 / sigma**2]),
        value=np.concatenate([linear.value, np.zeros(len(sigma))]),
    )
    levels = problem.conservative_levels(result.levels)
    solution = solve(problem.chains, levels, result.weights, extended)
    first = linear.jacobian.shape[1]
    rows = slice(first, first + len(by_focal))
    covariance = covariance_of(solution.information)
    inverse, _ = apply_inverse_covariance(problem.chains, levels, result.weights, jacobian)
    drift = drift_through(problem, covariance[rows] @ inverse.T)
    variance = np.diag(covariance[rows, rows]) + np.diag(drift)
    return {
        name: FocalByFixes(float(shift), float(np.sqrt(square)))
        for name, shift, square in zip(by_focal, solution.step[rows], variance, strict=True)
    }


def _errors_of_fixes(
    model: Poses, fitted: Fitted, clock_s: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return changes (N, 6, 3 F) of the poses that look like errors of F flights' fixes, and their sigma.

    They are the position of the antenna on the drone, and the clock.
    """
    fixes, world_from_model = fitted.problem.fixes, fitted.world_from_model
    axes = model.rotations @ world_from_model.rotation.T
    look, top = axes[:, 2], -axes[:, 1]
    ahead = np.where(np.abs(look[:, 2:]) > _STEEP, top, look) * [1.0, 1.0, 0.0]
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    antenna = [axis @ world_from_model.rotation / world_from_model.scale for axis in (ahead, right)]
    flights = len(fixes.flights)
    changes: np.ndarray = np.zeros((len(model), 6, 3 * flights))
    for f in range(flights):
        mine = np.flatnonzero(fixes.flight == f)
        mine = mine[np.argsort(fixes.time_s[mine], kind="stable")]
        for k, moved in enumerate(antenna):
            changes[mine, :3, 3 * f + k] = moved[mine]
        changes[mine, :3, 3 * f + 2] = _velocity(model.centers[mine], fixes.time_s[mine])
    clocks = [float(np.hypot(_CLOCK_S, clock_s.get(name, 0.0))) for name in fixes.flights]
    return changes, np.ravel([(_ANTENNA_M, _ANTENNA_M, clock) for clock in clocks])


def _velocity(centers: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """Return the velocity (M, 3) between the neighbours of each centre; zeros without different times."""
    before, after = np.maximum(np.arange(len(time_s)) - 1, 0), np.arange(len(time_s)) + 1
    after = np.minimum(after, len(time_s) - 1)
    seconds = time_s[after] - time_s[before]
    moved = centers[after] - centers[before]
    return np.where(seconds[:, None] > 0, moved / np.maximum(seconds, 1e-3)[:, None], 0.0)


def _derivatives(model: Poses, fitted: Fitted, changes: np.ndarray) -> np.ndarray:
    """Return minus the derivatives (M, K) of all residuals by K changes of the poses (N, 6, K)."""
    problem, state = fitted.problem, fitted.result.state
    rows = problem.kind, problem.frame
    before = problem.residuals(state)[rows]
    found = np.empty((len(before), changes.shape[2]))
    for k in range(changes.shape[2]):
        change = changes[:, :, k]
        largest = max(np.abs(change[:, :3]).max() / fitted.size, np.abs(change[:, 3:]).max())
        step = _STEP / largest if largest > 0 else 1.0
        centers = (model.centers + step * change[:, :3] - fitted.middle) / fitted.size
        rotations = rotations_from_vectors(step * change[:, 3:]) @ model.rotations
        found[:, k] = (before - problem.moved(centers, rotations).residuals(state)[rows]) / step
    return found
