"""Tests of errors correlated in time and of the uncertainty of a georegistration."""

from __future__ import annotations

import numpy as np
import pytest

from spn_data.geometry.pose import Similarity
from spn_data.geometry.rotations import rotations_from_angles, rotations_from_vectors
from spn_data.georegistration import georegistration_errors
from spn_data.georegistration.cross_validation import time_blocks
from spn_data.georegistration.gravity import robust_direction, up_from_level_cameras
from spn_data.georegistration.noise import (
    Chains,
    LinearSystem,
    NoiseLevels,
    apply_inverse_covariance,
    robust_weights,
    solve,
    update_levels,
)
from spn_data.georegistration.uncertainty import Uncertainty, radius_sigma

TABLE = [(0.7, 0.5, 0.1, 1.0), (1.1, 0.5, 0.2, 1.0)]


def _chains(rng: np.random.Generator) -> tuple[Chains, np.ndarray]:
    """Return two chains of group 0 and one of group 1, in mixed order, with their dense covariance."""
    m = 40
    chain = rng.integers(0, 3, m)
    time_s = rng.uniform(0, 100, m)
    group = (chain == 2).astype(np.int64)
    unit = rng.uniform(0.5, 2.0, m)
    tau = np.where(group == 1, 200.0, 60.0)
    chains, order = Chains.build(chain, time_s, tau, group, unit, np.arange(m))
    chain, time_s, tau = chain[order], time_s[order], tau[order]
    bias = np.array([0.7, 1.1])[chains.group] * chains.unit
    alike = np.exp(-np.abs(time_s[:, None] - time_s) / tau) * (chain[:, None] == chain)
    return chains, bias[:, None] * alike * bias


def test_the_banded_inverse_is_the_dense_covariance_s():
    """The banded inverse covariance and its determinant agree with dense linear algebra."""
    rng = np.random.default_rng(0)
    chains, covariance = _chains(rng)
    weights = rng.uniform(0.01, 1.5, 40)
    white = np.array([0.1, 0.2])[chains.group] * chains.unit
    covariance = covariance + np.diag(white**2 / weights)
    columns = rng.standard_normal((40, 3))
    inverse, log_det = apply_inverse_covariance(
        chains, NoiseLevels.from_table(TABLE), weights, columns
    )
    assert inverse == pytest.approx(np.linalg.solve(covariance, columns), rel=1e-9, abs=1e-9)
    assert log_det == pytest.approx(np.linalg.slogdet(covariance)[1], rel=1e-12)


def test_the_step_is_generalised_least_squares():
    """Step and information matrix equal generalised least squares with a prior."""
    rng = np.random.default_rng(1)
    chains, covariance = _chains(rng)
    white = np.array([0.1, 0.2])[chains.group] * chains.unit
    precision = np.linalg.inv(covariance + np.diag(white**2))
    jacobian, residual = rng.standard_normal((40, 2)), rng.standard_normal(40)
    prior, value = np.array([0.0, 4.0]), np.array([0.0, 0.5])
    solution = solve(
        chains,
        NoiseLevels.from_table(TABLE),
        np.ones(40),
        LinearSystem(residual, jacobian, prior, value),
    )
    information = jacobian.T @ precision @ jacobian + np.diag(prior)
    step = np.linalg.solve(information, jacobian.T @ precision @ residual - prior * value)
    assert solution.step == pytest.approx(step, rel=1e-9)
    assert solution.information == pytest.approx(information, rel=1e-9)
    # The residual splits into bias and white noise; the white part is D C^-1 r.
    assert solution.white == pytest.approx(white**2 * (precision @ (residual - jacobian @ step)))


def test_times_at_one_instant_share_their_error_and_break_nothing():
    """Frames with the same timestamp count about as one observation."""
    time_s = np.zeros(30)
    ids = np.zeros(30, dtype=np.int64)
    chains, _ = Chains.build(ids, time_s, np.full(30, 60.0), ids, np.ones(30), np.arange(30))
    levels = NoiseLevels.from_table([(1.0, 0.0, 0.1, 0.0)])
    inverse, _ = apply_inverse_covariance(chains, levels, np.ones(30), np.ones((30, 1)))
    assert inverse.sum() == pytest.approx(1.0, abs=0.05)


def test_noise_levels_are_estimated_two_sidedly():
    """Bias and white noise are estimated to about a third from 300 s of errors and a wrong start."""
    rng = np.random.default_rng(2)
    time_s = np.arange(0, 300, 0.8)
    m = len(time_s)
    alike = np.exp(-np.abs(time_s[:, None] - time_s) / 60.0)
    error = np.linalg.cholesky(alike + 1e-12 * np.eye(m)) @ rng.standard_normal(m) * 0.7
    error += 0.08 * rng.standard_normal(m)
    ids = np.zeros(m, dtype=np.int64)
    chains, _ = Chains.build(ids, time_s, np.full(m, 60.0), ids, np.ones(m), np.arange(m))
    levels = NoiseLevels.from_table([(2.0, 2.0, 0.5, 2.0)])
    linear = LinearSystem(error, np.ones((m, 1)), np.zeros(1), np.zeros(1))
    for _ in range(20):
        levels = update_levels(chains, levels, np.ones(m), linear)
    assert 0.5 < np.exp(levels.log_bias[0]) < 0.95
    assert 0.06 < np.exp(levels.log_white[0]) < 0.1


def test_outliers_lose_their_weight_and_others_keep_theirs():
    """A residual of ten sigma loses its weight, one of two sigma keeps it; pairs share theirs."""
    ids = np.zeros(4, dtype=np.int64)
    chains, _ = Chains.build(
        np.arange(4), np.zeros(4), np.ones(4), ids, np.ones(4), np.array([0, 0, 1, 2])
    )
    levels = NoiseLevels.from_table([(1.0, 0.0, 0.1, 0.0)])
    weights, distance = robust_weights(chains, levels, np.array([1.0, 0.0, 0.2, -1.0]))
    assert weights[0] == weights[1] < 0.03
    assert weights[2] > 0.9
    assert weights[3] < 0.02
    assert distance == pytest.approx([10 / np.sqrt(2), 10 / np.sqrt(2), 2, 10])


def test_twice_a_radius_sigma_holds_95_percent():
    """Twice the radius sigma contains 95 % of errors on a line, in a circle and in an ellipse."""
    assert radius_sigma(np.diag([0.25, 0.0])) == pytest.approx(0.5)
    assert radius_sigma(np.eye(2)) == pytest.approx(np.sqrt(-2 * np.log(1 - 0.9544997361)) / 2)
    rng = np.random.default_rng(3)
    sample = rng.standard_normal((100_000, 2)) * [1.0, 0.5]
    share = np.mean(np.linalg.norm(sample, axis=1) < 2 * radius_sigma(np.diag([1.0, 0.25])))
    assert share == pytest.approx(0.954, abs=0.01)


def test_uncertainty_grows_away_from_the_middle():
    """At 100 m from the middle, 1 mrad of heading adds 0.1 m across and 1 % of scale 1 m along."""
    covariance = np.diag([0.04, 0.04, 0.09, 0.0, 0.0, 1e-6, 1e-4])
    stated = Uncertainty.from_covariance(covariance, np.array([10.0, 0.0, 0.0]))
    here, there = stated.point_covariance(np.array([[10.0, 0.0, 0.0], [110.0, 0.0, 0.0]]))
    assert here == pytest.approx(np.diag([0.04, 0.04, 0.09]))
    assert there == pytest.approx(np.diag([0.04 + 1.0, 0.04 + 0.01, 0.09]))


def test_uncertainty_of_points_follows_shifts_turns_and_scale():
    """The covariance at a point is propagated from all seven parameters of the similarity."""
    rng = np.random.default_rng(6)
    root = rng.normal(size=(7, 7))
    middle, point = np.array([5.0, -3.0, 2.0]), np.array([[20.0, 30.0, -40.0]])
    found = Uncertainty.from_covariance(root @ root.T, middle).point_covariance(point)
    moved = []
    for k in range(7):
        shift, turn, scale = np.split(1e-6 * np.eye(7)[k], [3, 6])
        lever = np.exp(scale) * rotations_from_vectors(turn) @ (point[0] - middle)
        moved.append((middle + shift + lever - point[0]) / 1e-6)
    by_parameter = np.column_stack(moved)
    np.testing.assert_allclose(found[0], by_parameter @ root @ root.T @ by_parameter.T, rtol=1e-4)


def test_errors_against_the_truth_come_apart():
    """Errors of position, tilt, heading and scale are each recovered."""
    points = np.random.default_rng(4).uniform(-10, 10, (50, 3))
    points -= points.mean(axis=0)
    moved = Similarity(1.0, np.eye(3), np.array([0.6, 0.8, -0.5]))
    errors = georegistration_errors(moved, Similarity.identity(), points)
    assert errors.horizontal_m == pytest.approx(1.0)
    assert errors.vertical_m == pytest.approx(-0.5)
    assert errors.position_m == pytest.approx(np.sqrt(1.25))
    tilted = Similarity(1.01, rotations_from_vectors(np.deg2rad([0.0, 2.0, 0.0])), np.zeros(3))
    errors = georegistration_errors(tilted, Similarity.identity(), points)
    assert (errors.tilt_deg, errors.scale) == pytest.approx((2.0, 0.01))
    turned = Similarity(1.0, rotations_from_vectors(np.deg2rad([0.0, 0.0, -3.0])), np.zeros(3))
    errors = georegistration_errors(turned, Similarity.identity(), points)
    assert (errors.heading_deg, errors.tilt_deg) == pytest.approx((-3.0, 0.0), abs=1e-9)


def test_blocks_of_time_do_not_cross_flights():
    """Time blocks group frames by minute, separately for each flight."""
    flight = np.array([0, 0, 0, 1, 1])
    blocks = time_blocks(flight, np.array([5.0, 30.0, 70.0, 0.0, 61.0]), 60.0)
    assert blocks.tolist() == [0, 0, 1, 2, 3]


def test_level_cameras_of_many_headings_show_up_and_of_one_do_not():
    """Level cameras determine the vertical only if their headings differ."""
    angles = np.column_stack([np.arange(0, 360, 30.0), np.full(12, 5.0), np.zeros(12)])
    up, determined = up_from_level_cameras(rotations_from_angles(angles))
    assert up == pytest.approx([0, 0, 1], abs=1e-12)
    assert determined > 0.4
    angles[:, 0] = 40.0
    assert up_from_level_cameras(rotations_from_angles(angles))[1] < 1e-9


def test_a_robust_direction_is_not_moved_by_a_quarter_of_nonsense():
    """With 30 % random directions, the robust mean stays within 2 degrees."""
    rng = np.random.default_rng(5)
    directions = np.array([0.0, 0.0, 1.0]) + 0.01 * rng.standard_normal((100, 3))
    directions[:30] = rng.standard_normal((30, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert robust_direction(directions) @ [0, 0, 1] > np.cos(np.deg2rad(2))
