"""Sentences for the user on the quality of a georegistration."""

from __future__ import annotations

import numpy as np

from spn_data.georegistration.cross_validation import HeldOut
from spn_data.georegistration.fit import Estimate
from spn_data.georegistration.georegister_options import BIAS_DRIFT_SHARE
from spn_data.georegistration.gravity import Gravity
from spn_data.georegistration.problem import Problem

# A constant gimbal error above this many sigma is reported to the user.
_GIMBAL_BIAS_SIGMAS = 4.0
# GNSS and ground control contradict each other beyond this many sigma of the receiver's bias.
_CONTRADICTION_SIGMAS = 3.0
_LEAST_M = 0.1  # a smaller difference is no contradiction, whatever is stated
_WIDENED = 1.5  # sigma of ground control from its residuals, as a factor of what is stated


def fit_notes(
    problem: Problem, result: Estimate, gravity: Gravity, outlier: np.ndarray, held_out: HeldOut
) -> tuple[str, ...]:
    """Return sentences on the quality of the fit for the user."""
    fixes, state, options = problem.fixes, result.state, problem.options
    notes = []
    if not gravity.usable.any() and fixes.has_fix.any():
        notes.append(
            "No gimbal angles: up is estimated from the fixes and from the assumption that cameras fly level "
            f"on average (sigma {options.level_camera_sigma_deg:g} deg)."
        )
    for f, name in enumerate(fixes.flights):
        mine = fixes.has_fix & (fixes.flight == f)
        if not mine.any():
            through = "the other flights" if fixes.has_fix.any() else "ground control"
            notes.append(f"{name}: no frame has a fix; it is georegistered through {through} only.")
        elif np.mean(outlier[mine]) > 0.3:
            notes.append(
                f"{name}: {np.mean(outlier[mine]):.0%} of its fixes are outliers: this may be the "
                "telemetry of another flight, or its clock may be off."
            )
        if result.offset_sigma_m[f] > 10:
            notes.append(
                f"{name}: its heights are offset by {state.offsets_m[f]:+.1f} m from the first flight's."
            )
        bias = float(np.linalg.norm(state.gimbal_deg[f]))
        if bias > _GIMBAL_BIAS_SIGMAS * options.gimbal_bias_deg:
            notes.append(f"{name}: its gimbal angles have a constant error of {bias:.1f} deg.")
    for group, name in enumerate(("horizontal", "vertical")):
        level = float(
            np.hypot(*np.exp([result.levels.log_bias[group], result.levels.log_white[group]]))
        )
        if level > 2 and (problem.chains.group == group).any():
            notes.append(f"The {name} errors of the fixes are {level:.1f} times the stated sigma.")
    if problem.control is not None:
        notes += _control_notes(problem, result)
    if held_out.folds == 0 and fixes.has_fix.any():
        notes.append("The flights are too short for cross-validation by time blocks.")
    return tuple(notes)


def _control_notes(problem: Problem, result: Estimate) -> list[str]:
    """Return sentences on ground control and how it agrees with GNSS."""
    control, fixes = problem.control, problem.fixes
    assert control is not None
    notes = []
    fitted = int((~control.check).sum())
    if 0 < fitted < 3:
        notes.append(
            f"{fitted} ground control point{'s' if fitted > 1 else ''}: "
            + ("it corrects" if fitted == 1 else "they correct")
            + " the place of the map; its orientation and scale are mostly the telemetry's."
        )
    for k in np.flatnonzero(~control.check & ~control.used):
        off = control.errors_m(result.state.similarity)[k]
        notes.append(
            f"Ground control point {control.names[k]} is left out: it is {_east_north_up(off)} from where "
            "the other points place it; check its coordinates and marks."
        )
    if control.scale > _WIDENED:
        notes.append(
            f"Residuals of the ground control points are {control.scale:.1f} times what survey and marks "
            "explain; their sigma is widened by that."
        )
    if fitted and not control.check.any():
        notes.append(
            "No check points: residuals of fitted points do not tell how true the map is; hold some out with "
            "--check-points."
        )
    group, residual = fixes.bias_group, problem.residuals(result.state)[:3].T
    for g in range(len(result.state.bias)) if fitted else ():
        mine = fixes.has_fix & (group == g)
        if not mine.any():
            continue
        sigma = fixes.bias_m[mine].mean(axis=0)
        # Large contradictions are taken for drift in part: what counts is how far off the fixes are.
        off = np.median(residual[mine], axis=0) + result.state.bias[g] * sigma
        if fixes.free_zero:
            off[2] = np.nan
        sigmas = np.abs(off) / np.maximum(np.hypot(1.0, BIAS_DRIFT_SHARE) * sigma, _LEAST_M)
        of = " of " + ", ".join(
            dict.fromkeys(fixes.flights[f] for f in fixes.flight[mine].tolist())
        ) if len(result.state.bias) > 1 else ""  # fmt: skip
        if np.nanmax(sigmas) > _CONTRADICTION_SIGMAS:
            expected = ", ".join(f"{s:.2f}" for s in sigma[np.isfinite(off)])
            notes.append(
                f"GNSS{of} and ground control contradict each other: fixes are {_east_north_up(off)} off "
                f"where {expected} m (1 sigma) are expected; check coordinate system, datum and heights of "
                "the points, or state --gnss-bias."
            )
        else:
            notes.append(f"Fixes{of} are {_east_north_up(off)} off the ground control.")
    return notes


def _east_north_up(metres: np.ndarray) -> str:
    axes = ("east", "north", "up")
    return ", ".join(f"{m:+.2f} m {axis}" for m, axis in zip(metres, axes, strict=True) if m == m)
