"""Uncertainty of a georegistration, and its errors against ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.special import gammaincinv

from spn_data.errors import GeometryError
from spn_data.geometry.least_squares import similarity_jacobian
from spn_data.geometry.pose import Similarity
from spn_data.geometry.rotations import rotation_vectors
from spn_data.georegistration.fit import Estimate, covariance_of
from spn_data.georegistration.georegister_options import (
    BIAS_DRIFT_SHARE,
    BIAS_DRIFT_TIME_S,
    GeoregisterOptions,
)
from spn_data.georegistration.noise import Chains, apply_inverse_covariance, solve
from spn_data.georegistration.observe import Fixes
from spn_data.georegistration.problem import SHARED, Kind, Problem


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Standard uncertainties; twice each value contains the truth in 95 % of cases.

    Attributes
    ----------
    horizontal_m : float
        Radius, at the middle of the area.
    vertical_m : float
        Height, at the middle of the area; infinite if no heights are known.
    tilt_deg : float
        Tilt of the vertical, in any direction.
    heading_deg : float
        Rotation about the vertical.
    scale : float
        Relative error of scale.
    covariance : ndarray, shape (7, 7)
        Of the middle (east, north, up in metres), the world's rotation vector (radians) and the logarithm of
        scale.
    middle_m : ndarray, shape (3,)
        Position of the middle of the area in the world.

    Notes
    -----
    The 95 % hold if the errors follow the noise model of the fit. They include the common bias of all fixes,
    which moves the map as a whole; covariances of labels in the map do not.
    """

    horizontal_m: float
    vertical_m: float
    tilt_deg: float
    heading_deg: float
    scale: float
    covariance: np.ndarray
    middle_m: np.ndarray

    @classmethod
    def from_covariance(cls, covariance: np.ndarray, middle_m: np.ndarray) -> Uncertainty:
        """Derive the values from the covariance (7, 7) at the middle (3,)."""
        sigma = np.sqrt(np.diag(covariance))
        return cls(
            radius_sigma(covariance[:2, :2]),
            float(sigma[2]),
            float(np.rad2deg(radius_sigma(covariance[3:5, 3:5]))),
            float(np.rad2deg(sigma[5])),
            float(sigma[6]),
            covariance,
            middle_m,
        )

    def point_covariance(self, points_m: np.ndarray) -> np.ndarray:
        """Propagate the covariance to world points (N, 3); return (N, 3, 3), due to georegistration alone."""
        jacobian = similarity_jacobian(np.asarray(points_m) - self.middle_m)
        return jacobian @ self.covariance @ jacobian.transpose(0, 2, 1)


def drift_covariance(problem: Problem, result: Estimate) -> np.ndarray:
    """Return the covariance (7, 7) of the similarity due to the slow drift of the fixes' common bias."""
    linear = problem.linearise(result.state, result.offset_sigma_m, result.bias_weight)
    inverse, _ = apply_inverse_covariance(
        problem.chains, result.levels, result.weights, linear.jacobian
    )
    return drift_through(problem, result.covariance[:SHARED] @ inverse.T)


def drift_through(problem: Problem, gain: np.ndarray) -> np.ndarray:
    """Propagate the slow drift of the fixes' common bias through a fit.

    The fit knows a constant bias of each group and errors of about a minute. What lies between, a first-order
    Gauss-Markov process over a group's flights one after the other, is propagated through the fit as it is.

    Parameters
    ----------
    problem : Problem
        It has M observations.
    gain : ndarray, shape (K, M)
        Derivatives of K estimates by the observations.

    Returns
    -------
    ndarray, shape (K, K)
    """
    rows = np.flatnonzero(problem.kind <= Kind.UP)
    kind, frame = problem.kind[rows], problem.frame[rows]
    fixes = problem.fixes
    unit = BIAS_DRIFT_SHARE * fixes.bias_m[frame, kind]
    chains, order = Chains.build(
        fixes.bias_group[frame] * 3 + kind,
        _running_clock(fixes)[frame],
        np.full(len(rows), BIAS_DRIFT_TIME_S),
        np.zeros(len(rows), dtype=np.int64),
        unit,
        np.arange(len(rows)),
    )
    moved = (gain[:, rows[order]] * chains.unit).T
    return moved.T @ cho_solve_banded((cholesky_banded(chains.precision), False), moved)


def _running_clock(fixes: Fixes) -> np.ndarray:
    """Return the times (N,) on a clock that stands still between flights."""
    clock, elapsed_s = np.zeros(len(fixes.flight)), 0.0
    for f in range(len(fixes.flights)):
        mine = fixes.flight == f
        time_s = fixes.time_s[mine]
        clock[mine] = elapsed_s + time_s - time_s.min()
        elapsed_s += float(np.ptp(time_s))
    return clock


def radius_sigma(covariance: np.ndarray) -> float:
    """Return half of the radius that contains a zero-mean normal vector (K,) in 95 % of cases.

    Uses Satterthwaite's scaled chi-square, which is exact in one dimension and for an isotropic distribution.
    """
    values = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    if values.sum() == 0:
        return 0.0
    freedom = values.sum() ** 2 / (values**2).sum()
    # 0.9545 is the probability within two sigma in one dimension.
    square = 2 * gammaincinv(freedom / 2, 0.9544997361) * values.sum() / freedom
    return float(np.sqrt(square) / 2)


def require_determined(problem: Problem, result: Estimate, options: GeoregisterOptions) -> None:
    """Raise GeometryError if fixes and gimbal angles alone leave tilt, heading or scale undetermined."""
    data = problem.without_level()
    linear = data.linearise(result.state, result.offset_sigma_m, result.bias_weight)
    weights = _weights_of(data, problem, result)
    solution = solve(data.chains, problem.conservative_levels(result.levels), weights, linear)
    information = solution.information
    covariance = covariance_of(information + np.diag(np.diag(information)) * 1e-12)[:7, :7]
    values, axes = np.linalg.eigh(covariance[3:5, 3:5])
    tilt = float(np.rad2deg(np.sqrt(values[-1])))
    heading = float(np.rad2deg(np.sqrt(covariance[5, 5])))
    scale = float(np.sqrt(covariance[6, 6]))
    if scale > options.max_scale_sigma:
        raise GeometryError(
            f"the scale is known only to {_percent(scale)}: the extent of the flight is too small compared "
            "with the noise of its fixes; fly further across the area"
        )
    if tilt > options.max_tilt_sigma_deg:
        east, north = axes[:, -1]
        azimuth = np.rad2deg(np.arctan2(east, north)) % 180
        raise GeometryError(
            f"the tilt about the line of azimuth {azimuth:.0f} deg is known only to {_degrees(tilt)} "
            f"(limit {options.max_tilt_sigma_deg:g}): fly a cross leg of at least 20 m, "
            "or give gimbal angles"
        )
    if heading > options.max_heading_sigma_deg:
        raise GeometryError(
            f"the heading is known only to {_degrees(heading)}: fly a horizontal leg of at least 20 m"
        )


def _percent(share: float) -> str:
    return f"{share:.0%}" if share < 1 else "no better than 100%"


def _degrees(angle: float) -> str:
    return f"{angle:.1f} deg" if angle < 90 else "no better than 90 deg"


def _weights_of(part: Problem, problem: Problem, result: Estimate) -> np.ndarray:
    """Return the result's weights in the order of `part`, a problem with a subset of the observations."""
    table = np.ones((len(Kind), len(problem.model)))
    table[problem.kind, problem.frame] = result.weights
    return table[part.kind, part.frame]


def effective_fixes(problem: Problem, result: Estimate) -> float:
    """Return how many independent fixes would determine the middle's east and north equally well."""
    if not problem.fixes.has_fix.any():
        return 0.0
    counts = []
    for kind in (Kind.EAST, Kind.NORTH):
        mine = problem.kind == kind
        # Bias levels of differential and other fixes differ; the median represents them all.
        inverse, _ = apply_inverse_covariance(
            problem.chains, result.levels, result.weights, mine[:, None].astype(np.float64)
        )
        group = problem.chains.group[mine]
        bias, white = np.exp(result.levels.log_bias), np.exp(result.levels.log_white)
        variance = np.median(
            (bias[group] ** 2 + white[group] ** 2) * problem.chains.unit[mine] ** 2
        )
        counts.append(float(inverse[mine, 0].sum() * variance))
    return float(np.mean(counts))


@dataclass(frozen=True)
class GeoErrors:
    """Errors of a georegistration against ground truth, without any alignment."""

    position_m: float  # RMS over the points
    horizontal_m: float  # of the points' mean
    vertical_m: float  # of the points' mean, signed
    tilt_deg: float
    heading_deg: float  # signed
    scale: float  # relative, signed


def georegistration_errors(
    estimated: Similarity, true: Similarity, points: np.ndarray
) -> GeoErrors:
    """Compare world_from_model with ground truth on points (N, 3) of the model."""
    difference = estimated.apply(points) - true.apply(points)
    mean = difference.mean(axis=0)
    turn = np.rad2deg(rotation_vectors(estimated.rotation @ true.rotation.T))
    return GeoErrors(
        float(np.sqrt((difference**2).sum(axis=1).mean())),
        float(np.hypot(mean[0], mean[1])),
        float(mean[2]),
        float(np.hypot(turn[0], turn[1])),
        float(turn[2]),
        estimated.scale / true.scale - 1,
    )
