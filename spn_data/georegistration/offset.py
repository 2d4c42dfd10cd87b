"""Time offset between a flight's telemetry and its video, estimated from the camera motion in the model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spn_data.errors import GeometryError
from spn_data.geometry.pose import Poses, Similarity
from spn_data.geometry.rotations import rotation_vectors, rotations_from_angles
from spn_data.georegistration.fit import covariance_of
from spn_data.georegistration.georegister_options import GeoregisterOptions
from spn_data.georegistration.noise import (
    LinearSystem,
    robust_cost,
    robust_weights,
    solve,
    update_levels,
)
from spn_data.georegistration.observe import Fixes, observe
from spn_data.georegistration.problem import FitState, Kind, Problem
from spn_data.telemetry.track import Telemetry

_MIN_FRAMES = 12
_ROUNDS = 20
_STARTS = 4
_NO_OFFSET_M = 1e-4  # sigma that fixes the vertical offset, which a single flight does not have
_WEAK_PRECISION = (
    1e-4  # of the time offset: keeps the normal equations regular if it is undetermined
)
# Two offsets are ambiguous if their costs differ by less than this (9 is three sigma).
_AMBIGUOUS_COST = 9.0
_LARGE_SIGMAS = 8.0


@dataclass(frozen=True, kw_only=True)
class OffsetOptions:
    """Search range and acceptance limits of the time offset.

    Attributes
    ----------
    max_offset_s : float
        Search range, on both sides of zero.
    max_sigma_s : float
        An offset with a larger sigma is undetermined.
    large_sigma_s : float
        Limit used instead of `max_sigma_s` for an offset more than eight sigma from zero, for which an
        uncertain correction is better than none.
    step_s : float
        Step of the grid search.
    """

    max_offset_s: float = 5.0
    max_sigma_s: float = 0.1
    large_sigma_s: float = 0.3
    step_s: float = 0.1


@dataclass(frozen=True)
class TimeOffset:
    """Offset to add to telemetry times to obtain video times (see `Telemetry.shifted`).

    Attributes
    ----------
    offset_s : float or None
        Offset in seconds, None if undetermined.
    sigma_s : float
        Its sigma in seconds, infinite if nothing was estimated.
    reason : str
        Why the offset is undetermined; empty if it is determined.
    """

    offset_s: float | None
    sigma_s: float
    reason: str = ""

    @property
    def applied_s(self) -> float:
        """The offset in seconds, or zero if undetermined."""
        return 0.0 if self.offset_s is None else self.offset_s

    def describe(self, name: str) -> str:
        """Return a sentence on the offset of flight `name` for the user."""
        if self.offset_s is None:
            return (
                f"{name}: time offset of the telemetry undetermined ({self.reason}); 0 s is used."
            )
        return f"{name}: time offset of the telemetry {self.offset_s:+.2f} s (sigma {self.sigma_s:.2f} s)."


def estimate_time_offset(
    model: Poses,
    time_s: np.ndarray,
    telemetry: Telemetry,
    options: GeoregisterOptions | None = None,
    search: OffsetOptions | None = None,
) -> TimeOffset:
    """Estimate the time offset between the telemetry and the video of one flight.

    Parameters
    ----------
    model : Poses
        Poses of the flight's N frames in the model.
    time_s : ndarray, shape (N,)
        Times of the frames in seconds.
    telemetry : Telemetry
        The flight's telemetry as read, not yet interpolated.
    options : GeoregisterOptions, optional
        Noise model of the observations.
    search : OffsetOptions, optional
        Search range and acceptance limits.

    Returns
    -------
    TimeOffset
        Undetermined if its sigma exceeds the limit in `search`, or if two offsets fit equally well.

    Notes ----- Positions and, if known, gimbal angles are fitted with the offset as an additional unknown,
    under errors correlated in time. Motion that a drifting GNSS bias could also explain therefore carries no
    information on the offset. The search range is at most a quarter of the flight's duration.
    """
    options = options or GeoregisterOptions()
    search = search or OffsetOptions()
    order = np.argsort(time_s, kind="stable")
    model, time_s = model[order], np.asarray(time_s, dtype=np.float64)[order]
    if len(model) < _MIN_FRAMES or not telemetry.has_fix.any():
        return _undetermined(
            f"{len(model)} frames and {int(telemetry.has_fix.sum())} fixes are too few"
        )
    window_s = min(search.max_offset_s, float(time_s[-1] - time_s[0]) / 4)
    if window_s < search.step_s:
        return _undetermined(f"the flight lasts only {time_s[-1] - time_s[0]:.1f} s")
    origin = observe(telemetry, [""] * len(telemetry), telemetry.time_s, options).origin
    flight = _Flight(model, time_s, telemetry, replace(options, origin=origin, same_takeoff=True))
    steps = int(window_s / search.step_s)
    grid = np.arange(-steps, steps + 1) * search.step_s
    flight = flight.only(flight.known_at(grid))
    if len(flight.time_s) < _MIN_FRAMES:
        return _undetermined(f"only {len(flight.time_s)} frames have a fix at all offsets")
    try:
        coarse = [flight.coarse_fit(offset_s) for offset_s in grid]
    except GeometryError as error:
        return _undetermined(str(error))
    cost = np.array([c[0] for c in coarse])
    padded = np.concatenate([[np.inf], cost, [np.inf]])
    minima = np.flatnonzero((cost <= padded[:-2]) & (cost <= padded[2:]))
    minima = minima[np.argsort(cost[minima], kind="stable")][:_STARTS]
    limit_s = window_s + search.step_s
    refined = [flight.refine(coarse[k][1], float(grid[k]), limit_s) for k in minima]
    candidates = [candidate for candidate in refined if candidate is not None]
    if not candidates:
        return _undetermined(f"the best offset is outside the search range of {window_s:.1f} s")
    best = min(candidates, key=lambda candidate: candidate.cost)
    large = abs(best.offset_s) > _LARGE_SIGMAS * best.sigma_s
    if best.sigma_s > (search.large_sigma_s if large else search.max_sigma_s):
        return TimeOffset(
            None,
            best.sigma_s,
            "the flight's motion is too uniform, or too small compared with its errors",
        )
    for other in candidates:
        far = abs(other.offset_s - best.offset_s) > 5 * best.sigma_s + search.step_s
        if far and other.cost - best.cost < _AMBIGUOUS_COST:
            return TimeOffset(
                None,
                best.sigma_s,
                f"{best.offset_s:+.2f} s and {other.offset_s:+.2f} s fit equally well",
            )
    return TimeOffset(best.offset_s, best.sigma_s)


def _undetermined(reason: str) -> TimeOffset:
    return TimeOffset(None, float("inf"), reason)


@dataclass(frozen=True)
class _Candidate:
    offset_s: float
    sigma_s: float
    cost: float


@dataclass(frozen=True, eq=False)
class _Flight:
    """One flight's frames, sorted by time, and its telemetry."""

    model: Poses
    time_s: np.ndarray
    telemetry: Telemetry
    options: GeoregisterOptions

    def only(self, mask: np.ndarray) -> _Flight:
        return replace(self, model=self.model[mask], time_s=self.time_s[mask])

    def fixes(self, offset_s: float) -> Fixes:
        """Return the frames' observations for a given offset, including the gimbal's heading."""
        rows = self.telemetry.shifted(offset_s).at(self.time_s)
        fixes = observe(rows, [""] * len(rows), self.time_s, self.options)
        if not self.options.use_gimbal:
            return fixes
        return replace(fixes, attitude=rotations_from_angles(rows.gimbal_deg))

    def known_at(self, grid: np.ndarray) -> np.ndarray:
        """Return a mask (N,) of frames with a fix (and gimbal angles, if mostly available) at all offsets."""
        known = np.ones(len(self.time_s), dtype=bool)
        gimbal = known.copy()
        for offset_s in grid[:: max(1, len(grid) // 20)]:
            rows = self.telemetry.shifted(offset_s).at(self.time_s)
            known &= rows.has_fix
            gimbal &= np.isfinite(rows.gimbal_deg).all(axis=1)
        return known & gimbal if np.mean(known & gimbal) > 0.5 * np.mean(known) else known

    def _centred(self) -> np.ndarray:
        centers = self.model.centers - self.model.centers.mean(axis=0)
        return centers / np.sqrt((centers**2).sum(axis=1).mean())

    def coarse_fit(self, offset_s: float) -> tuple[float, Similarity]:
        """Return the approximate robust cost of an offset and the corresponding similarity."""
        fixes, centers = self.fixes(offset_s), self._centred()
        rotations = self.model.rotations
        gimbal = np.isfinite(fixes.attitude).all(axis=(1, 2))
        enu = np.where(np.isfinite(fixes.enu_m), fixes.enu_m, 0.0)
        weights = np.ones(len(enu))
        sigma = fixes.sigma_m.mean(axis=1)
        cost, rotation = 0.0, None
        if gimbal.sum() >= _MIN_FRAMES:
            each = fixes.attitude[gimbal].transpose(0, 2, 1) @ rotations[gimbal]
            rotation, turn_deg = _mean_rotation(each)
            cost += float(np.log1p((turn_deg / 1.0) ** 2).sum())
        elif not fixes.has_heights:
            raise GeometryError("neither gimbal angles nor heights")
        similarity = Similarity.identity()
        for _ in range(8):
            if rotation is None:
                similarity = Similarity.fit(centers, enu, weights)
            else:
                similarity = _scale_and_shift(centers @ rotation.T, rotation, enu, weights)
            square = (((enu - similarity.apply(centers)) / sigma[:, None]) ** 2).sum(axis=1)
            weights = 1 / (1 + square)
        return cost + float(np.log1p(square).sum()), similarity

    def refine(self, similarity: Similarity, offset_s: float, limit_s: float) -> _Candidate | None:
        """Refine similarity, biases and offset jointly from a coarse fit; None if it leaves the range."""
        centers, rotations = self._centred(), self.model.rotations
        level = np.zeros(len(centers), dtype=bool)
        problem = Problem.build(centers, rotations, self.fixes(offset_s), level, self.options)
        state = replace(problem.initial_state(similarity, ~level), offsets_m=np.zeros(1))
        levels = problem.prior_levels()
        # Indexed by kind and frame, because the set of observations changes with the offset.
        weight = np.ones((len(Kind), len(centers)))
        for k in range(_ROUNDS):
            linear = self._linear(problem, state)
            weights = weight[problem.kind, problem.frame]
            if k >= 4:
                levels = update_levels(problem.chains, levels, weights, linear)
            solution = solve(problem.chains, levels, weights, linear)
            weights, _ = robust_weights(problem.chains, levels, solution.white)
            weight[problem.kind, problem.frame] = weights
            state = state.updated(solution.step[:-1])
            offset_s += float(np.clip(solution.step[-1], -1.0, 1.0))
            if not abs(offset_s) <= limit_s:
                return None
            problem = Problem.build(centers, rotations, self.fixes(offset_s), level, self.options)
        linear = self._linear(problem, state)
        weights = weight[problem.kind, problem.frame]
        cost = robust_cost(problem.chains, levels, linear.residual, weights)
        solution = solve(problem.chains, problem.conservative_levels(levels), weights, linear)
        sigma_s = float(np.sqrt(covariance_of(solution.information)[-1, -1]))
        return _Candidate(offset_s, sigma_s, cost)

    def _linear(self, problem: Problem, state: FitState) -> LinearSystem:
        """Return the linearised fit with the time offset as the last parameter."""
        linear = problem.linearise(state, np.full(1, _NO_OFFSET_M), np.ones(1))
        return LinearSystem(
            linear.residual,
            np.column_stack([linear.jacobian, -self._residual_rates(problem, state)]),
            np.append(linear.prior_precision, _WEAK_PRECISION),
            np.append(linear.value, 0.0),
        )

    def _residual_rates(self, problem: Problem, state: FitState) -> np.ndarray:
        """Return the change (M,) of each residual per second of offset, by finite differences of the model.

        The telemetry is not used for this, because its noise would be taken for motion.
        """
        n = len(self.time_s)
        # Differences over two frames to each side reduce the effect of the model's noise.
        after, before = np.minimum(np.arange(n) + 2, n - 1), np.maximum(np.arange(n) - 2, 0)
        moved = []
        for index in (after, before):
            shifted = replace(
                problem, model=problem.model[index], cam_from_model=problem.cam_from_model[index]
            )
            moved.append(shifted.residuals(state))
        change = moved[0] - moved[1]
        change[Kind.HEADING] = (change[Kind.HEADING] + 180.0) % 360.0 - 180.0
        elapsed = np.maximum(self.time_s[after] - self.time_s[before], 1e-3)
        return (change / elapsed)[problem.kind, problem.frame]


def _mean_rotation(rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the robust mean (3, 3) of rotations (N, 3, 3) and their angles (N,) in degrees from it."""
    weights = np.ones(len(rotations))
    for _ in range(8):
        u, _, vt = np.linalg.svd(np.einsum("n,nij->ij", weights, rotations))
        mean = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        angle = np.rad2deg(np.linalg.norm(rotation_vectors(rotations @ mean.T), axis=1))
        weights = 1 / (1 + (angle / 2.0) ** 2)
    return mean, angle


def _scale_and_shift(
    turned: np.ndarray, rotation: np.ndarray, enu: np.ndarray, weights: np.ndarray
) -> Similarity:
    """Fit scale and translation to a known rotation by weighted least squares."""
    w = weights / weights.sum()
    a, b = turned - w @ turned, enu - w @ enu
    scale = float((w @ (a * b).sum(axis=1)) / (w @ (a * a).sum(axis=1)))
    # A negative scale would mirror the flight; it occurs if the offset is far off.
    scale = max(scale, 1e-3 * float(np.sqrt((b * b).sum() / (a * a).sum())))
    return Similarity(scale, rotation, w @ enu - scale * w @ turned)
