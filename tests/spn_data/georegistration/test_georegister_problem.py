"""Tests of the residuals of georegistration and their Jacobian."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spn_data.geometry.geodesy import GeoOrigin
from spn_data.geometry.rotations import rotations_from_angles, rotations_from_vectors
from spn_data.georegistration.georegister_options import GeoregisterOptions
from spn_data.georegistration.observe import Fixes
from spn_data.georegistration.problem import SHARED, FitState, Kind, Problem

ROTATION = rotations_from_vectors(np.array([0.3, 1.2, -0.5]))


def _problem(noise: float) -> tuple[Problem, FitState]:
    """Return nine cameras of two flights (one nadir, one on its side) and the state that fits them."""
    rng = np.random.default_rng(0)
    n = 9
    flight = np.arange(n) % 2
    model = rng.standard_normal((n, 3))
    angles = np.column_stack(
        [rng.uniform(0, 360, n), rng.uniform(-60, 20, n), rng.uniform(-5, 5, n)]
    )
    angles[0], angles[1] = [40.0, -90.0, 0.0], [40.0, 5.0, 90.0]
    attitude = rotations_from_angles(angles)
    state = FitState(
        ROTATION,
        7.0,
        np.array([3.0, -2.0, 5.0]),
        np.array([0.0, 4.0]),
        np.zeros((2, 3)),
        np.zeros(2),
        np.zeros((2, 3)),
    )
    enu = 7.0 * model @ ROTATION.T + state.center - np.outer(state.offsets_m[flight], [0, 0, 1])
    shake = rotations_from_vectors(noise * rng.standard_normal((n, 3)))
    fixes = Fixes(
        enu + noise * rng.standard_normal((n, 3)),
        np.ones((n, 3)),
        (shake @ attitude)[:, :, 2],
        shake @ attitude,
        flight,
        ("a", "b"),
        np.arange(n, dtype=np.float64),
        np.full((n, 3), 2.0),
        np.arange(2),
        np.ones(2, dtype=bool),
        GeoOrigin(0, 0, 0),
        True,
        False,
        True,
        (),
    )
    problem = Problem.build(
        model, attitude @ ROTATION, fixes, np.ones(n, dtype=bool), GeoregisterOptions()
    )
    return problem, state


def test_the_true_state_leaves_no_residual():
    """The true state has zero residuals, also for a nadir camera and one on its side."""
    problem, state = _problem(0.0)
    residual = problem.residuals(state)
    for kind in Kind:
        if kind is not Kind.LEVEL:
            assert np.abs(residual[kind]).max() < 1e-9
    # The camera on its side looks 5 degrees up, so its right axis points 85 degrees below the horizon.
    assert residual[Kind.LEVEL][1] == pytest.approx(np.rad2deg(np.cos(np.deg2rad(5.0))))


def test_the_jacobian_is_the_residuals_derivative():
    """The Jacobian equals central differences for all observations and parameters."""
    problem, state = _problem(1e-4)
    linear = problem.linearise(state, np.full(2, 1e3), np.ones(2))
    assert linear.jacobian.shape == (7 * 9, SHARED + 16)
    h = 1e-6
    for k in range(SHARED + 16):
        step = np.zeros(SHARED + 16)
        step[k] = h
        after, before = (
            problem.residuals(state.updated(step)),
            problem.residuals(state.updated(-step)),
        )
        slope = ((after - before) / (2 * h))[problem.kind, problem.frame]
        # The Jacobian is exact to first order in the gimbal residuals, which are 1e-4 here.
        assert -slope == pytest.approx(linear.jacobian[:, k], abs=0.02), k


def test_observations_that_are_missing_take_no_row():
    """A missing height removes only that row, and an excluded frame all its rows."""
    problem, _ = _problem(0.0)
    enu = problem.fixes.enu_m.copy()
    enu[2, 2] = np.nan
    fixes = replace(problem.fixes, enu_m=enu)
    rebuilt = Problem.build(
        problem.model, problem.cam_from_model, fixes, problem.use_level, problem.options
    )
    assert sorted(rebuilt.kind[rebuilt.frame == 2]) == [k for k in Kind if k is not Kind.UP]
    mask = np.arange(9) != 3
    assert 3 not in rebuilt.on_frames(mask).frame
    assert Kind.LEVEL not in rebuilt.without_level().kind
