"""Generalised least squares and likelihood for errors correlated in time (Gauss-Markov chains).

An observation error is the sum of a slowly changing bias, modelled as a first-order Gauss-Markov
(Ornstein-Uhlenbeck) process along its chain, and white noise. The inverse covariance of such a process is
tridiagonal, so the cost of least squares is linear in the number of observations (Woodbury identity).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

# Lower limit of the time between two observations of a chain, as a fraction of the correlation time.
_MIN_STEP = 1e-3
# Contaminated normal distribution of the white noise: share of outliers, and their range in sigma.
_OUTLIERS = 0.03
_OUTLIER_WIDTH = 20.0


@dataclass(frozen=True, eq=False)
class Chains:
    """Chains of M observations, sorted by chain and time.

    group : (M,) index of the noise level; unit : (M,) sigma, in the observation's unit, that the group's
    factors multiply; twin : (M,) index of the set of observations that are outliers together; twin_sizes :
    size of each set; precision : (2, M) tridiagonal inverse covariance of the unit-variance processes (row 0
    above the diagonal, as in scipy); log_innovation : (M,) logarithm of their variance given the predecessor.
    """

    group: np.ndarray
    unit: np.ndarray
    twin: np.ndarray
    twin_sizes: np.ndarray
    precision: np.ndarray
    log_innovation: np.ndarray

    @classmethod
    def build(
        cls,
        chain: np.ndarray,
        time_s: np.ndarray,
        correlation_s: np.ndarray,
        group: np.ndarray,
        unit: np.ndarray,
        twin: np.ndarray,
    ) -> tuple[Chains, np.ndarray]:
        """Build chains from observations in any order; also return the sorting order (M,)."""
        order = np.lexsort((time_s, chain))
        chain, time_s, correlation_s = chain[order], time_s[order], correlation_s[order]
        same = chain[1:] == chain[:-1]
        steps = np.maximum(np.diff(time_s) / correlation_s[1:], _MIN_STEP)
        rho = np.where(same, np.exp(-steps), 0.0)
        innovation = np.ones(len(order))
        innovation[1:] = np.where(same, -np.expm1(-2 * steps), 1.0)
        precision = np.zeros((2, len(order)))
        precision[1] = 1 / innovation
        precision[1, :-1] += rho**2 / innovation[1:]
        precision[0, 1:] = -rho / innovation[1:]
        _, twin = np.unique(twin[order], return_inverse=True)
        sizes = np.bincount(twin).astype(np.float64)
        return cls(group[order], unit[order], twin, sizes, precision, np.log(innovation)), order

    def part(self, mask: np.ndarray) -> Chains:
        """Select whole chains by a mask (M,) of their observations; twin indices are kept."""
        return replace(
            self,
            group=self.group[mask],
            unit=self.unit[mask],
            twin=self.twin[mask],
            precision=self.precision[:, mask],
            log_innovation=self.log_innovation[mask],
        )


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """Noise levels of G groups, as factors of the observations' own sigma.

    log_bias, log_white : (G,) natural logarithms; *_center, *_spread : (G,) mean and sigma of their priors; a
    spread of 0 fixes the level.
    """

    log_bias: np.ndarray
    log_white: np.ndarray
    bias_center: np.ndarray
    bias_spread: np.ndarray
    white_center: np.ndarray
    white_spread: np.ndarray

    @classmethod
    def from_table(cls, table: list[tuple[float, float, float, float]]) -> NoiseLevels:
        """Build from one row (bias, spread of its logarithm, white, spread of its logarithm) per group."""
        bias, bias_spread, white, white_spread = np.array(table, dtype=np.float64).T
        return cls(
            np.log(bias), np.log(white), np.log(bias), bias_spread, np.log(white), white_spread
        )

    def moved(self, name: str, group: int, delta: float) -> NoiseLevels:
        """Return the levels with one element of `log_bias` or `log_white` changed by `delta`."""
        values = getattr(self, name).copy()
        values[group] += delta
        return replace(self, **{name: values})

    def log_prior(self) -> float:
        """Return the log prior density of the free levels, up to a constant."""
        total = 0.0
        for value, center, spread in (
            (self.log_bias, self.bias_center, self.bias_spread),
            (self.log_white, self.white_center, self.white_spread),
        ):
            free = spread > 0
            total -= 0.5 * float((((value - center)[free] / spread[free]) ** 2).sum())
        return total

    def at_least(self, bias: np.ndarray, white: np.ndarray) -> NoiseLevels:
        """Return the levels with lower limits (G,) applied to the factors."""
        return replace(
            self,
            log_bias=np.log(np.maximum(np.exp(self.log_bias), bias)),
            log_white=np.log(np.maximum(np.exp(self.log_white), white)),
        )


def apply_inverse_covariance(
    chains: Chains, levels: NoiseLevels, weights: np.ndarray, columns: np.ndarray
) -> tuple[np.ndarray, float]:
    """Multiply columns (M, K) by the inverse covariance; also return the covariance's log determinant.

    weights : (M,) robust weights, which divide the variance of the white noise.
    """
    if not len(columns):
        return columns, 0.0
    white_var = (np.exp(levels.log_white)[chains.group] * chains.unit) ** 2 / weights
    amplitude = np.exp(levels.log_bias)[chains.group] * chains.unit
    banded = chains.precision.copy()
    banded[1] += amplitude**2 / white_var
    factor = cholesky_banded(banded, check_finite=False)
    scaled = columns / white_var[:, None]
    smooth = cho_solve_banded((factor, False), amplitude[:, None] * scaled, check_finite=False)
    log_det = np.log(white_var).sum() + 2 * np.log(factor[1]).sum() + chains.log_innovation.sum()
    return scaled - (amplitude / white_var)[:, None] * smooth, float(log_det)


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """Linearised observations ``residual = jacobian @ step + noise`` with a prior on the parameters.

    residual : (M,); jacobian : (M, P); prior_precision : (P,) of a zero-mean prior; value : (P,) current
    values; control : (C, P + 1) jacobian and residual of further observations with independent errors of
    unit variance.
    """

    residual: np.ndarray
    jacobian: np.ndarray
    prior_precision: np.ndarray
    value: np.ndarray
    control: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class LinearSolution:
    """Solution of the linear problem: step (P,), information (P, P), white residuals (M,) after the step."""

    step: np.ndarray
    information: np.ndarray
    white: np.ndarray


def _normal(matrix: np.ndarray, linear: LinearSystem) -> tuple[np.ndarray, np.ndarray, float]:
    """Return information (P, P), gradient (P,) and squared residual, prior included (normal equations).

    matrix : (P + 1, P + 1) products of (jacobian, residual) under the inverse covariance.
    """
    if linear.control is not None:
        matrix = matrix + linear.control.T @ linear.control
    pull = linear.prior_precision * linear.value
    information = matrix[:-1, :-1] + np.diag(linear.prior_precision)
    return (
        (information + information.T) / 2,
        matrix[:-1, -1] - pull,
        float(matrix[-1, -1] + linear.value @ pull),
    )


def _step(information: np.ndarray, gradient: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the least-squares step (P,) and the information's log determinant."""
    # The parameters have very different units; scaling keeps the factorisation well conditioned.
    size = 1 / np.sqrt(np.diag(information))
    scaled = information * size[:, None] * size
    step = size * np.linalg.solve(scaled, size * gradient)
    return step, float(np.linalg.slogdet(scaled)[1] - 2 * np.log(size).sum())


def solve(
    chains: Chains, levels: NoiseLevels, weights: np.ndarray, linear: LinearSystem
) -> LinearSolution:
    """Solve generalised least squares under the chains' covariance."""
    columns = np.column_stack([linear.jacobian, linear.residual])
    inverse, _ = apply_inverse_covariance(chains, levels, weights, columns)
    information, gradient, _ = _normal(columns.T @ inverse, linear)
    step, _ = _step(information, gradient)
    white_var = (np.exp(levels.log_white)[chains.group] * chains.unit) ** 2 / weights
    return LinearSolution(step, information, white_var * (inverse[:, -1] - inverse[:, :-1] @ step))


def robust_weights(
    chains: Chains, levels: NoiseLevels, white: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return robust weights (M,) of white residuals (M,) and their distances in sigma (M,).

    White noise is a contaminated normal (Tukey 1960): a share `_OUTLIERS` can be anything up to
    `_OUTLIER_WIDTH` sigma. Each outlier has its own variance, so it carries no information about the others.
    Twins (east and north of one fix) are weighted together by the root mean square of their distances.
    """
    square = _squares(chains, levels, white)
    # Distances are capped at 50 sigma: anything beyond is equally certain to be an outlier.
    normal = np.exp(-np.minimum(square, 2500.0) / 2)
    good = normal / (normal + _OUTLIERS * _OUTLIER_WIDTH**-chains.twin_sizes)
    weights = good + (1 - good) * chains.twin_sizes / (chains.twin_sizes + square)
    return weights[chains.twin], np.sqrt(square / chains.twin_sizes)[chains.twin]


def robust_cost(
    chains: Chains, levels: NoiseLevels, residual: np.ndarray, weights: np.ndarray
) -> float:
    """Return the negative log density of residuals (M,) under a contaminated normal, given its weights (M,).

    The bias is set to its most probable values instead of being integrated out, which is sufficient for
    comparing fits of one flight.
    """
    inverse, _ = apply_inverse_covariance(chains, levels, weights, residual[:, None])
    sigma = np.exp(levels.log_white)[chains.group] * chains.unit
    white = sigma**2 / weights * inverse[:, 0]
    bias_cost = residual @ inverse[:, 0] - (weights * (white / sigma) ** 2).sum()
    square = _squares(chains, levels, white)
    tails = -np.log(np.exp(-square / 2) + _OUTLIERS * _OUTLIER_WIDTH**-chains.twin_sizes)
    _, log_det = apply_inverse_covariance(chains, levels, np.ones_like(weights), residual[:, None])
    return float(0.5 * bias_cost + tails.sum() + 0.5 * log_det)


def _squares(chains: Chains, levels: NoiseLevels, white: np.ndarray) -> np.ndarray:
    """Return the squared distance in sigma of each set of twins."""
    standard = white / (np.exp(levels.log_white)[chains.group] * chains.unit)
    return np.bincount(chains.twin, standard**2, minlength=len(chains.twin_sizes))


def update_levels(
    chains: Chains,
    levels: NoiseLevels,
    weights: np.ndarray,
    linear: LinearSystem,
    *,
    max_step: float = 0.7,
) -> NoiseLevels:
    """Take one Newton step of each free level towards the maximum of the posterior.

    The posterior is the restricted likelihood (Harville 1977: parameters integrated out) times the prior.
    Each step is a smooth function of its input, so rounding differences in the observations remain small.
    """
    columns = np.column_stack([linear.jacobian, linear.residual])
    groups = [g for g in range(len(levels.log_bias)) if (chains.group == g).any()]
    rows = {g: chains.group == g for g in groups}
    parts = {g: chains.part(rows[g]) for g in groups}

    def products(g: int, candidate: NoiseLevels) -> tuple[np.ndarray, float]:
        mine = columns[rows[g]]
        inverse, log_det = apply_inverse_covariance(parts[g], candidate, weights[rows[g]], mine)
        return mine.T @ inverse, log_det

    # No chain belongs to two groups, so only the group whose level changes is recomputed.
    current = {g: products(g, levels) for g in groups}

    def objective(g: int, candidate: NoiseLevels, own: tuple[np.ndarray, float]) -> float:
        all_products = [own if k == g else current[k] for k in groups]
        matrix = np.sum(np.stack([p[0] for p in all_products]), axis=0)
        information, gradient, quadratic = _normal(matrix, linear)
        step, log_det = _step(information, gradient)
        log_det += sum(p[1] for p in all_products)
        return -0.5 * (log_det + quadratic - gradient @ step) + candidate.log_prior()

    h = 0.1
    for name, spread in (("log_white", levels.white_spread), ("log_bias", levels.bias_spread)):
        for g in (g for g in groups if spread[g] > 0):
            values = []
            for delta in (-h, 0.0, h):
                candidate = levels.moved(name, g, delta)
                own = products(g, candidate) if delta else current[g]
                values.append(objective(g, candidate, own))
            slope = (values[2] - values[0]) / (2 * h)
            curvature = -(values[2] - 2 * values[1] + values[0]) / h**2
            # If the likelihood is not concave, the prior's curvature determines the step.
            curvature = max(curvature, 1 / spread[g] ** 2)
            levels = levels.moved(name, g, float(np.clip(slope / curvature, -max_step, max_step)))
            current[g] = products(g, levels)
    return levels
