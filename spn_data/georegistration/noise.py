"""Errors that are correlated in time: Gauss-Markov chains, their likelihood and least squares under them.

An observation's error is the sum of a slowly changing bias, a first-order Gauss-Markov (Ornstein-Uhlenbeck)
process along its chain, and of white noise. The inverse covariance of such a process is tridiagonal, so that
least squares under it costs time in proportion to the number of observations (Woodbury's identity).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

# Two observations of one chain are never treated as closer than this part of the correlation time.
_MIN_STEP = 1e-3
# White errors that are no part of the normal distribution: their share, and how far they reach in sigma.
_OUTLIERS = 0.03
_OUTLIER_WIDTH = 20.0


@dataclass(frozen=True, eq=False)
class Chains:
    """Which of M observations share a chain, in the order of chain and time.

    group : (M,) index of the noise level; unit : (M,) sigma that the group's factors multiply, in the
    observation's unit; twin : (M,) index of the set whose members are outliers together;
    precision : (2, M) tridiagonal inverse covariance of the unit-variance processes (row 0 above the
    diagonal, as scipy has it); log_innovation : (M,) logarithm of their variance given what came before.
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
        """Chains of observations in any order, and the order (M,) that they have to be brought into."""
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
        """Some whole chains, by a mask (M,) of their observations; twins keep their numbers."""
        return replace(
            self,
            group=self.group[mask],
            unit=self.unit[mask],
            twin=self.twin[mask],
            precision=self.precision[:, mask],
            log_innovation=self.log_innovation[mask],
        )


@dataclass(frozen=True, eq=False)
class Levels:
    """Noise levels of G groups, as factors of the observations' own sigma.

    log_bias, log_white : (G,) natural logarithms; *_center, *_spread : (G,) what they are believed to be
    before the data, a spread of 0 being fixed.
    """

    log_bias: np.ndarray
    log_white: np.ndarray
    bias_center: np.ndarray
    bias_spread: np.ndarray
    white_center: np.ndarray
    white_spread: np.ndarray

    @classmethod
    def from_table(cls, table: list[tuple[float, float, float, float]]) -> Levels:
        """From (bias, its spread in log, white, its spread in log) of each group."""
        bias, bias_spread, white, white_spread = np.array(table, dtype=np.float64).T
        return cls(
            np.log(bias), np.log(white), np.log(bias), bias_spread, np.log(white), white_spread
        )

    def moved(self, name: str, group: int, delta: float) -> Levels:
        """The same levels with one of `log_bias` or `log_white` changed."""
        values = getattr(self, name).copy()
        values[group] += delta
        return replace(self, **{name: values})

    def log_prior(self) -> float:
        """Logarithm of the density of the free levels, up to a constant."""
        total = 0.0
        for value, center, spread in (
            (self.log_bias, self.bias_center, self.bias_spread),
            (self.log_white, self.white_center, self.white_spread),
        ):
            free = spread > 0
            total -= 0.5 * float((((value - center)[free] / spread[free]) ** 2).sum())
        return total

    def at_least(self, bias: np.ndarray, white: np.ndarray) -> Levels:
        """The same levels with lower limits (G,) of the factors."""
        return replace(
            self,
            log_bias=np.log(np.maximum(np.exp(self.log_bias), bias)),
            log_white=np.log(np.maximum(np.exp(self.log_white), white)),
        )


def inverse_times(
    chains: Chains, levels: Levels, weights: np.ndarray, columns: np.ndarray
) -> tuple[np.ndarray, float]:
    """Inverse covariance of the observations times columns (M, K), and the covariance's log determinant.

    weights : (M,) robust weights, that divide the variance of the white part.
    """
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
class Linear:
    """Observations linearised: ``residual = jacobian @ step + noise``, and what is known of the parameters.

    residual (M,), jacobian (M, P); prior_precision (P,) about the value 0 of parameters now at `value` (P,).
    """

    residual: np.ndarray
    jacobian: np.ndarray
    prior_precision: np.ndarray
    value: np.ndarray


@dataclass(frozen=True, eq=False)
class LinearSolution:
    """Of the linear problem: step (P,), information (P, P), residuals' white part (M,) after the step."""

    step: np.ndarray
    information: np.ndarray
    white: np.ndarray


def _normal(matrix: np.ndarray, linear: Linear) -> tuple[np.ndarray, np.ndarray, float]:
    """Information (P, P), gradient (P,) and squared residual of observations and prior together.

    matrix : (P + 1, P + 1) products of (jacobian, residual) under the inverse covariance.
    """
    pull = linear.prior_precision * linear.value
    information = matrix[:-1, :-1] + np.diag(linear.prior_precision)
    return (
        (information + information.T) / 2,
        matrix[:-1, -1] - pull,
        float(matrix[-1, -1] + linear.value @ pull),
    )


def _step(information: np.ndarray, gradient: np.ndarray) -> tuple[np.ndarray, float]:
    """Least-squares step (P,) and the information's log determinant."""
    # Parameters of very different units: the scaling keeps the factorisation well conditioned.
    size = 1 / np.sqrt(np.diag(information))
    scaled = information * size[:, None] * size
    step = size * np.linalg.solve(scaled, size * gradient)
    return step, float(np.linalg.slogdet(scaled)[1] - 2 * np.log(size).sum())


def solve(chains: Chains, levels: Levels, weights: np.ndarray, linear: Linear) -> LinearSolution:
    """Generalised least squares under the chains' covariance."""
    columns = np.column_stack([linear.jacobian, linear.residual])
    inverse, _ = inverse_times(chains, levels, weights, columns)
    information, gradient, _ = _normal(columns.T @ inverse, linear)
    step, _ = _step(information, gradient)
    white_var = (np.exp(levels.log_white)[chains.group] * chains.unit) ** 2 / weights
    return LinearSolution(step, information, white_var * (inverse[:, -1] - inverse[:, :-1] @ step))


def robust_weights(
    chains: Chains, levels: Levels, white: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Weights (M,) of the white parts (M,) under a contaminated normal, and their distances in sigma (M,).

    A white error is normal, or, in a share `_OUTLIERS`, anything up to `_OUTLIER_WIDTH` sigma (Tukey 1960);
    each outlier has a variance of its own, so that it says nothing of the others'. Twins (east and north of
    one fix) are judged by their common distance, the root of their mean square.
    """
    square = _squares(chains, levels, white)
    # A huge distance is as sure an outlier as one of 50 sigma.
    normal = np.exp(-np.minimum(square, 2500.0) / 2)
    good = normal / (normal + _OUTLIERS * _OUTLIER_WIDTH**-chains.twin_sizes)
    weights = good + (1 - good) * chains.twin_sizes / (chains.twin_sizes + square)
    return weights[chains.twin], np.sqrt(square / chains.twin_sizes)[chains.twin]


def robust_cost(chains: Chains, levels: Levels, residual: np.ndarray, weights: np.ndarray) -> float:
    """Negative logarithm of the density of residuals (M,) under a contaminated normal, at its weights (M,).

    The bias is at its most probable course rather than integrated out: good for comparing fits of one flight.
    """
    inverse, _ = inverse_times(chains, levels, weights, residual[:, None])
    sigma = np.exp(levels.log_white)[chains.group] * chains.unit
    white = sigma**2 / weights * inverse[:, 0]
    bias_cost = residual @ inverse[:, 0] - (weights * (white / sigma) ** 2).sum()
    square = _squares(chains, levels, white)
    tails = -np.log(np.exp(-square / 2) + _OUTLIERS * _OUTLIER_WIDTH**-chains.twin_sizes)
    _, log_det = inverse_times(chains, levels, np.ones_like(weights), residual[:, None])
    return float(0.5 * bias_cost + tails.sum() + 0.5 * log_det)


def _squares(chains: Chains, levels: Levels, white: np.ndarray) -> np.ndarray:
    """Squared distances in sigma of each set of twins."""
    standard = white / (np.exp(levels.log_white)[chains.group] * chains.unit)
    return np.bincount(chains.twin, standard**2, minlength=len(chains.twin_sizes))


def improve_levels(
    chains: Chains, levels: Levels, weights: np.ndarray, linear: Linear, *, max_step: float = 0.7
) -> Levels:
    """One Newton step of each free level towards the most probable one.

    Probability is the restricted likelihood (Harville 1977: parameters integrated out) times the prior.
    Every step is a smooth function of its input, so that rounding in the observations stays rounding.
    """
    columns = np.column_stack([linear.jacobian, linear.residual])
    groups = [g for g in range(len(levels.log_bias)) if (chains.group == g).any()]
    rows = {g: chains.group == g for g in groups}
    parts = {g: chains.part(rows[g]) for g in groups}

    def products(g: int, candidate: Levels) -> tuple[np.ndarray, float]:
        mine = columns[rows[g]]
        inverse, log_det = inverse_times(parts[g], candidate, weights[rows[g]], mine)
        return mine.T @ inverse, log_det

    # Groups have chains of their own: only that whose level moves is computed anew.
    current = {g: products(g, levels) for g in groups}

    def objective(g: int, candidate: Levels, own: tuple[np.ndarray, float]) -> float:
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
            # Where the likelihood is not concave the prior's curvature sets the step.
            curvature = max(curvature, 1 / spread[g] ** 2)
            levels = levels.moved(name, g, float(np.clip(slope / curvature, -max_step, max_step)))
            current[g] = products(g, levels)
    return levels
