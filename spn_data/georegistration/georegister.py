"""Georegistration of a model from its poses and telemetry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from spn_data.errors import GeometryError
from spn_data.geometry.pose import Poses, Similarity
from spn_data.georegistration.control import Control, PointResidual, point_residuals
from spn_data.georegistration.cross_validation import cross_validate, time_blocks
from spn_data.georegistration.fit import FIXED_OFFSET_M, Estimate, estimate
from spn_data.georegistration.fit_notes import fit_notes
from spn_data.georegistration.georegister_options import GeoregisterOptions
from spn_data.georegistration.gravity import Gravity, gravity_from_gimbal, up_from_level_cameras
from spn_data.georegistration.observe import Fixes, observe
from spn_data.georegistration.problem import SHARED, Kind, Problem
from spn_data.georegistration.ransac import RansacResult, extent, ransac_similarity
from spn_data.georegistration.result import FitSummary, GeoFit
from spn_data.georegistration.uncertainty import (
    Uncertainty,
    drift_covariance,
    effective_fixes,
    require_determined,
)
from spn_data.telemetry.track import Telemetry

# A fix is an outlier if its residual exceeds this many sigma of the white noise.
_OUTLIER_SIGMAS = 5.0
_MAX_OUTLIERS = 0.5  # of the fixes; with more of them, the model or the telemetry is wrong


@dataclass(frozen=True, eq=False)
class Fitted:
    """A problem with its solution; centred coordinates are ``(x_model - middle) / size``."""

    problem: Problem
    result: Estimate
    gravity: Gravity
    middle: np.ndarray
    size: float

    @property
    def world_from_model(self) -> Similarity:
        """Similarity from the model's own coordinates to the world."""
        centred = Similarity(1 / self.size, np.eye(3), -self.middle / self.size)
        return self.result.state.similarity @ centred


def georegister(
    model: Poses,
    telemetry: Telemetry,
    sequence: Sequence[str],
    time_s: np.ndarray,
    options: GeoregisterOptions | None = None,
    control: Control | None = None,
) -> GeoFit:
    """Georegister a model from its cameras' fixes, heights and gimbal angles.

    Parameters
    ----------
    model : Poses
        N poses in the gauge of the reconstruction.
    telemetry : Telemetry
        N rows, interpolated at the frames' times (see `align_telemetry`).
    sequence : sequence of str
        Flight of each frame.
    time_s : ndarray, shape (N,)
        Time of each frame within its flight, in seconds.
    options : GeoregisterOptions, optional
        Noise model, robust estimation and acceptance limits.
    control : Control, optional
        Surveyed points. The world has their origin; three or more can do without telemetry.

    Returns
    -------
    GeoFit
        Similarity to the world with its uncertainty, residuals and cross-validation.

    Raises
    ------
    GeometryError
        If fixes and gimbal angles do not determine the similarity; the message states the remedy.
    ValueError
        If `model` and `telemetry` differ in length.

    Notes
    -----
    An initial similarity from RANSAC is refined by robust generalised least squares over fixes, heights and
    gravity, under errors that are correlated in time (Gauss-Markov).
    """
    return _geo_fit(fit_telemetry(model, telemetry, sequence, time_s, options, control))


def fit_telemetry(
    model: Poses,
    telemetry: Telemetry,
    sequence: Sequence[str],
    time_s: np.ndarray,
    options: GeoregisterOptions | None = None,
    control: Control | None = None,
) -> Fitted:
    """Fit a model to its telemetry as `georegister` does, without judging the result by cross-validation."""
    options = options or GeoregisterOptions()
    if len(model) != len(telemetry):
        raise ValueError(
            f"{len(model)} poses and {len(telemetry)} telemetry rows must be equal in number"
        )
    fixes = observe(
        telemetry, sequence, time_s, options, None if control is None else control.origin
    )
    # Normalise: the fit uses centred coordinates of unit size, independent of the gauge.
    known = fixes.has_fix if fixes.has_fix.any() else np.ones(len(model), dtype=bool)
    middle = model.centers[known].mean(axis=0)
    size = float(np.sqrt(((model.centers - middle) ** 2).sum(axis=1).mean()))
    if not size > 0:
        raise GeometryError("all cameras of the model are at one point")
    centers = (model.centers - middle) / size
    rotations = model.rotations
    gravity = gravity_from_gimbal(
        rotations, fixes.up_cam, fixes.flight, fixes.flights, options.gimbal_agreement_deg
    )
    fixes = replace(
        fixes,
        up_cam=np.where(gravity.usable[:, None], fixes.up_cam, np.nan),
        notes=fixes.notes + gravity.notes,
    )
    if control is not None:
        control = control.centred(middle, size)
    fixes, initial = _initial(centers, rotations, fixes, gravity, control, options)
    if initial.sigma_factor > 1:
        note = (
            f"Fixes agree with the model only within {initial.sigma_factor:g} times their stated "
            "sigma."
        )
        fixes = replace(fixes, notes=(*fixes.notes, note))
    use_level = fixes.has_fix & ~gravity.usable
    problem = Problem.build(centers, rotations, fixes, use_level, options, control)
    state = problem.initial_state(initial.world_from_model, initial.inlier)
    result = estimate(problem, state, initial.inlier)
    if control is not None:
        judged = control.judged(result.state.similarity)
        if judged is not control:
            problem = replace(problem, control=judged)
            result = estimate(problem, result.state, initial.inlier)
    require_determined(problem, result, options)
    return Fitted(problem, result, gravity, middle, size)


def _initial(
    centers: np.ndarray,
    rotations: np.ndarray,
    fixes: Fixes,
    gravity: Gravity,
    control: Control | None,
    options: GeoregisterOptions,
) -> tuple[Fixes, RansacResult]:
    """Return the fixes to use and an initial similarity: without fixes if only surveyed points give one."""
    try:
        _require_enough(fixes, options)
        up_model = gravity.direction
        if up_model is None and not fixes.has_heights:
            up_model = _up_of_level_cameras(rotations)
        return fixes, ransac_similarity(centers, fixes, up_model, options)
    except GeometryError as error:
        if control is None:
            raise
        try:
            found = control.initial()
        except GeometryError as other:
            raise GeometryError(
                f"the fixes do not tell where the model is ({error}), and neither does ground control: "
                f"{other}"
            ) from other
        if fixes.has_fix.any():
            note = f"Fixes are not used, only ground control and gimbal angles: {error}."
            fixes = replace(
                fixes,
                enu_m=np.full_like(fixes.enu_m, np.nan),
                has_heights=False,
                notes=(*fixes.notes, note),
            )
        return fixes, RansacResult(found, np.ones(len(centers), dtype=bool), 1.0)


def _require_enough(fixes: Fixes, options: GeoregisterOptions) -> None:
    count = int(fixes.has_fix.sum())
    if count < options.min_fixes:
        raise GeometryError(f"{count} frames have a fix, {options.min_fixes} are needed")
    sigma = float(np.median(fixes.sigma_m[fixes.has_fix, 0]))
    spread = extent(fixes)
    if spread < sigma:
        raise GeometryError(
            f"the fixes spread over only {spread:.2g} m (RMS) at a sigma of {sigma:.2g} m: a hovering drone "
            "determines neither scale nor heading; fly a leg of at least 20 m"
        )


def _up_of_level_cameras(rotations: np.ndarray) -> np.ndarray:
    up, determined = up_from_level_cameras(rotations)
    if determined < 0.05:
        raise GeometryError(
            "the direction of up is undetermined: there are no heights and no gimbal angles, and all cameras "
            "look in the same direction; give heights or gimbal angles"
        )
    return up


def _geo_fit(fitted: Fitted) -> GeoFit:
    problem, result, gravity = fitted.problem, fitted.result, fitted.gravity
    state, fixes, options = result.state, problem.fixes, problem.options
    world_from_model = fitted.world_from_model
    residuals = problem.residuals(state)
    residuals_m = residuals[:3].T
    distance = np.zeros((len(Kind), len(problem.model)))
    distance[problem.kind, problem.frame] = result.distance
    outlier = np.asarray((distance[:3] > _OUTLIER_SIGMAS).any(axis=0))
    count = int(fixes.has_fix.sum())
    if problem.control is None and outlier.sum() > _MAX_OUTLIERS * count:
        raise GeometryError(
            f"{outlier.sum()} of {count} fixes contradict the georegistered model: parts of it may be joined "
            "wrongly, or this may be the telemetry of another flight"
        )
    covariance = result.covariance[:SHARED, :SHARED] + drift_covariance(problem, result)
    # Gravity constrains the cameras' rotations; telemetry cannot show how positions are tilted against them.
    covariance[[3, 4], [3, 4]] += np.deg2rad(options.model_bend_deg) ** 2
    if not fixes.has_heights and problem.control is None:
        covariance[2, :] = covariance[:, 2] = 0.0
        covariance[2, 2] = np.inf
    uncertainty = Uncertainty.from_covariance(covariance, state.center)
    blocks = time_blocks(fixes.flight, fixes.time_s, options.correlation_time_s)
    held_out = [cross_validate(problem, result, fold, ~outlier) for fold in (blocks, fixes.flight)]
    gimbal = {
        name: (float(bias[0]), float(bias[1]), float(bias[2]))
        for f, (name, bias) in enumerate(zip(fixes.flights, state.gimbal_deg, strict=True))
        if (gravity.usable & (fixes.flight == f)).any()
    }
    return GeoFit(
        world_from_model,
        fixes.origin,
        {
            # A tight prior holds the reference flight at zero.
            name: (0.0 if result.offset_sigma_m[f] <= FIXED_OFFSET_M else float(offset))
            - _zero_m(problem, result, f)
            for f, (name, offset) in enumerate(zip(fixes.flights, state.offsets_m, strict=True))
            if np.isfinite(fixes.enu_m[fixes.flight == f, 2]).any()
        },
        residuals_m,
        outlier,
        residuals[[Kind.PITCH, Kind.ROLL]].T,
        gimbal,
        _noise(problem, result),
        uncertainty,
        held_out[0],
        held_out[1],
        _summary(problem, result, residuals, outlier),
        _observations(problem, gravity),
        fixes.notes + fit_notes(problem, result, gravity, outlier, held_out[0]),
        _residuals_of_control(fitted, uncertainty),
    )


def _residuals_of_control(fitted: Fitted, uncertainty: Uncertainty) -> tuple[PointResidual, ...]:
    if fitted.problem.control is None:
        return ()
    world_from_model = fitted.world_from_model
    # Back in the model's own coordinates.
    control = fitted.problem.control.centred(-fitted.middle / fitted.size, 1 / fitted.size)
    covariance = uncertainty.point_covariance(world_from_model.apply(control.model))
    return point_residuals(control, world_from_model, covariance)


def _zero_m(problem: Problem, result: Estimate, flight: int) -> float:
    """Return how far a flight's heights are above the origin's if nothing else relates the two."""
    if not problem.fixes.free_zero:
        return 0.0
    mine = (problem.fixes.flight == flight) & np.isfinite(problem.fixes.enu_m[:, 2])
    bias = problem.fixes.bias_m[mine, 2] * result.state.bias[problem.fixes.bias_group[mine], 2]
    return float(np.median(bias))


def _noise(problem: Problem, result: Estimate) -> dict[str, tuple[float, float]]:
    """Return sigma (bias, white) in metres of each kind of fix, at its median stated sigma."""
    names = ("horizontal", "vertical", "horizontal_rtk", "vertical_rtk")
    noise = {}
    for g, name in enumerate(names):
        mine = problem.chains.group == g
        if mine.any():
            unit = float(np.median(problem.chains.unit[mine]))
            noise[name] = (
                unit * float(np.exp(result.levels.log_bias[g])),
                unit * float(np.exp(result.levels.log_white[g])),
            )
    return noise


def _summary(
    problem: Problem, result: Estimate, residuals: np.ndarray, outlier: np.ndarray
) -> FitSummary:
    fixes = problem.fixes
    horizontal = np.hypot(residuals[0], residuals[1])
    vertical = np.abs(residuals[2])
    gravity = residuals[[Kind.PITCH, Kind.ROLL]]
    return FitSummary(
        frames=len(outlier),
        fixes=int(fixes.has_fix.sum()),
        outliers=int(outlier.sum()),
        effective_fixes=effective_fixes(problem, result),
        horizontal_rmse_m=_rms(horizontal[~outlier]),
        vertical_rmse_m=_rms(vertical[~outlier]),
        ce90_m=_quantile(horizontal, 0.9),
        le90_m=_quantile(vertical, 0.9),
        gravity_rms_deg=_rms(np.hypot(*gravity)),
    )


def _observations(problem: Problem, gravity: Gravity) -> tuple[str, ...]:
    used = ["ground control"] if problem.control is not None and problem.control.used.any() else []
    if problem.fixes.has_fix.any():
        used.append("fixes")
    if problem.fixes.has_heights:
        used.append("heights")
    if gravity.usable.any():
        used.append("gimbal")
    if problem.use_level.any():
        used.append("level cameras")
    return tuple(used)


def _rms(values: np.ndarray) -> float:
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def _quantile(values: np.ndarray, q: float) -> float:
    values = values[np.isfinite(values)]
    return float(np.quantile(values, q)) if len(values) else float("nan")
