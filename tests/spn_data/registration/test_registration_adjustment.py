"""Least-squares adjustment of a sequence in a frozen map: Jacobians and minimum against references."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from spn_data.geometry.camera import MODELS, Camera
from spn_data.geometry.initial_lens import InitialLens
from spn_data.geometry.least_squares import POSE
from spn_data.geometry.pose import Poses, pose_errors
from spn_data.geometry.rotations import rotations_from_vectors
from spn_data.registration.adjustment import (
    IntrinsicsPrior,
    SequenceObservations,
    SequenceState,
    adjust,
    cauchy_weights,
    lens_parameters,
    linearize,
    normal_equations,
    principal_point_prior,
)
from tests.worlds.registration_scene import LENS, flight

OPENCV = Camera(
    "OPENCV", 320, 240, np.array([280.0, 276.0, 160.0, 120.0, -0.05, 0.01, 1e-3, -5e-4])
)


def problem(
    camera: Camera = LENS,
    *,
    frames: int = 4,
    own: int = 12,
    noise_px: float = 0.0,
    every: int = 1,
) -> tuple[SequenceState, SequenceObservations]:
    """Return the true state of a flight with this lens, and measurements; `own` points are not in the map."""
    made = flight(frames, noise_px=0.0)
    rng = np.random.default_rng(2)
    seen_twice = np.intersect1d(made.shows[0], made.shows[1])
    own_ids = seen_twice[:: max(1, len(seen_twice) // max(own, 1))][:own]
    own_row = np.full(len(made.points), -1)
    own_row[own_ids] = np.arange(len(own_ids))
    frame, pixels, point = [], [], []
    for row, shows in enumerate(made.shows):
        kept = shows[np.isin(shows, own_ids) | (shows % every == 0)]
        in_camera = (made.points[kept] - made.poses.centers[row]) @ made.poses.rotations[row].T
        frame.append(np.full(len(kept), row))
        pixels.append(camera.project(in_camera) + rng.normal(0, noise_px, (len(kept), 2)))
        point.append(kept)
    points = np.concatenate(point)
    is_own = own_row[points] >= 0
    observations = SequenceObservations(
        np.concatenate(frame),
        np.concatenate(pixels),
        np.where(is_own[:, None], np.nan, made.points[points]),
        own_row[points],
    )
    state = SequenceState(made.poses, camera, made.points[own_ids], InitialLens(camera, 0.05, ""))
    return state, observations


def changed(state: SequenceState, change: np.ndarray, lens: tuple[str, ...]) -> SequenceState:
    """Return the state moved by (6N + L + 3P,): poses, lens, own points, in the module's parametrisation."""
    n = len(state.poses)
    moves = change[: POSE * n].reshape(n, POSE)
    params = state.camera.params.copy()
    for name, value in zip(lens, change[POSE * n : POSE * n + len(lens)], strict=True):
        params[MODELS[state.camera.model].index(name)] += value
    return SequenceState(
        Poses.from_rotations(
            state.poses.centers + moves[:, :3],
            rotations_from_vectors(moves[:, 3:]) @ state.poses.rotations,
        ),
        replace(state.camera, params=params),
        state.own_points + change[POSE * n + len(lens) :].reshape(-1, 3),
        state.expected,
    )


def disturbed(state: SequenceState, seed: int = 4) -> SequenceState:
    """Return a start that is decimetres, degrees and per cent off."""
    rng = np.random.default_rng(seed)
    lens = lens_parameters(state.camera)
    change = np.concatenate(
        [
            (rng.normal(size=(len(state.poses), POSE)) * [0.2, 0.2, 0.2, 0.02, 0.02, 0.02]).ravel(),
            [8.0 if name[0] == "f" else 0.01 for name in lens],
            rng.normal(0, 0.1, 3 * len(state.own_points)),
        ]
    )
    return changed(state, change, lens)


def full_jacobian(state: SequenceState, observations: SequenceObservations) -> np.ndarray:
    """Return the Jacobian (2M, 6N + L + 3P) by central differences."""
    lens = lens_parameters(state.camera)
    unknowns = POSE * len(state.poses) + len(lens) + 3 * len(state.own_points)
    columns = []
    for k in range(unknowns):
        step = np.zeros(unknowns)
        step[k] = 1e-5
        ends = [
            linearize(changed(state, sign * step, lens), observations, lens).residuals_px.ravel()
            for sign in (1, -1)
        ]
        columns.append((ends[0] - ends[1]) / 2e-5)
    return np.column_stack(columns)


def dense(
    state: SequenceState, observations: SequenceObservations, lens: tuple[str, ...]
) -> np.ndarray:
    """Return the analytic Jacobian, dense, in the column order of `changed`."""
    found = linearize(state, observations, lens)
    n, m = len(state.poses), len(observations.frame)
    whole = np.zeros((m, 2, POSE * n + len(lens) + 3 * len(state.own_points)))
    for k, (row, own) in enumerate(zip(observations.frame, observations.own, strict=True)):
        whole[k, :, POSE * row : POSE * row + POSE] = found.by_pose[k]
        whole[k, :, POSE * n : POSE * n + len(lens)] = found.by_lens[k]
        if own >= 0:
            first = POSE * n + len(lens) + 3 * own
            whole[k, :, first : first + 3] = found.by_point[k]
    return whole.reshape(2 * m, -1)


@pytest.mark.parametrize("camera", [LENS, OPENCV], ids=lambda c: c.model)
def test_derivatives_are_those_of_finite_differences(camera: Camera) -> None:
    """Jacobians by pose, focal length, distortion and own points equal finite differences."""
    state, observations = problem(camera, frames=3, noise_px=1.0)
    told = dense(state, observations, lens_parameters(camera))
    assert np.abs(told - full_jacobian(state, observations)).max() < 1e-6 * np.abs(told).max()


def test_a_point_behind_the_camera_counts_as_far_and_pulls_at_nothing() -> None:
    """A point behind the camera gets a residual of 1000 px and zero derivatives."""
    state, observations = problem(frames=2, own=0)
    places = observations.map_xyz.copy()
    places[0] = state.poses.centers[0] - 5 * state.poses.rotations[0][2]
    found = linearize(state, replace(observations, map_xyz=places), ("f",))
    assert np.all(found.residuals_px[0] == 1000.0)
    assert not found.by_pose[0].any()
    assert not found.by_lens[0].any()
    assert np.abs(found.residuals_px[1:]).max() < 1e-9


def test_eliminating_own_points_changes_no_step() -> None:
    """Eliminating own points by the Schur complement gives the same step as the full normal equations."""
    state, observations = problem(noise_px=1.0)
    lens = lens_parameters(state.camera)
    weights = np.random.default_rng(1).uniform(0.2, 1, len(observations.frame))
    linearized = linearize(state, observations, lens)
    reduced = normal_equations(
        linearized,
        observations,
        len(state.poses),
        len(state.own_points),
        weights,
        IntrinsicsPrior(*np.zeros((2, len(lens)))),
    )
    step = np.linalg.solve(reduced.matrix.toarray(), reduced.right)
    points = reduced.point_right - (reduced.coupling.T @ step).reshape(-1, 3)
    points = np.einsum("pij,pj->pi", reduced.point_inverse, points)
    root = np.repeat(np.sqrt(weights), 2)
    whole = np.linalg.lstsq(
        dense(state, observations, lens) * root[:, None],
        -linearized.residuals_px.ravel() * root,
        rcond=None,
    )[0]
    assert np.allclose(np.concatenate([step, points.ravel()]), whole, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("camera", [LENS, OPENCV], ids=lambda c: c.model)
def test_exact_measurements_lead_back_to_the_truth(camera: Camera) -> None:
    """From a start decimetres, degrees and per cent off, exact data recover the truth to a micrometre."""
    true, observations = problem(camera)
    found = adjust(disturbed(true), observations, scale_px=1.0, lens=lens_parameters(camera))
    error_m, error_deg = pose_errors(found.poses, true.poses)
    assert error_m.max() < 1e-6
    assert error_deg.max() < 1e-5
    assert np.allclose(found.camera.params, camera.params, rtol=1e-5, atol=1e-6)
    assert np.abs(found.own_points - true.own_points).max() < 1e-5


def test_the_minimum_is_that_of_scipy() -> None:
    """With noise, outliers and the same Cauchy loss, SciPy's minimiser reaches the same state."""
    true, observations = problem(frames=3, own=4, noise_px=0.7, every=4)
    pixels = observations.pixels.copy()
    pixels[::15] += [25.0, -10.0]
    observations = replace(observations, pixels=pixels)
    lens = lens_parameters(true.camera)
    found = adjust(disturbed(true), observations, scale_px=1.0, lens=lens)

    start = linearize(true, observations, lens)
    weights = np.repeat(cauchy_weights(start.residuals_px, 1.0), 2)
    design = dense(true, observations, lens) * np.sqrt(weights)[:, None]
    # Steps are in units of one standard deviation so that any minimiser converges quickly.
    step = np.linalg.inv(np.linalg.cholesky(design.T @ design)).T

    def loss(x: np.ndarray) -> tuple[float, np.ndarray]:
        state = changed(true, step @ x, lens)
        residuals = linearize(state, observations, lens).residuals_px
        weighted = residuals * cauchy_weights(residuals, 1.0)[:, None]
        gradient = 2 * dense(state, observations, lens).T @ weighted.ravel()
        prior = principal_point_prior(state, lens, 1.0)
        first = POSE * len(state.poses)
        gradient[first : first + len(lens)] += 2 * prior.weights * prior.offsets
        of_residuals = np.log1p((residuals**2).sum(axis=1)).sum()
        return float(of_residuals + prior.cost), step.T @ gradient

    least = minimize(loss, np.zeros(len(step)), jac=True, method="BFGS", options={"gtol": 1e-4})
    assert least.success
    expected = changed(true, step @ least.x, lens)
    error_m, error_deg = pose_errors(found.poses, expected.poses)
    assert error_m.max() < 1e-3
    assert error_deg.max() < 5e-3
    assert found.camera.params[0] == pytest.approx(expected.camera.params[0], abs=0.05)


def test_gross_errors_hardly_move_the_result() -> None:
    """With 10 % of measurements 40 px off, errors are centimetres, against 0.5 m for least squares."""
    true, observations = problem(noise_px=0.3)
    pixels = observations.pixels.copy()
    pixels[::10] += [40.0, 0.0]
    wrong = replace(observations, pixels=pixels)
    lens = lens_parameters(true.camera)
    robust, plain = (
        pose_errors(adjust(true, wrong, scale_px=scale, lens=lens).poses, true.poses)[0].max()
        for scale in (1.0, 1e4)
    )
    assert robust < 0.05
    assert plain > 0.3


def test_a_lens_that_is_held_stays_as_it_is() -> None:
    """A fixed lens is unchanged by the adjustment."""
    true, observations = problem(noise_px=0.5)
    found = adjust(disturbed(true), observations, scale_px=1.0, lens=())
    assert np.array_equal(found.camera.params, disturbed(true).camera.params)


def test_a_minimum_is_left_alone() -> None:
    """Adjusting the result a second time changes nothing significant."""
    true, observations = problem(noise_px=0.5)
    lens = lens_parameters(true.camera)
    once = adjust(disturbed(true), observations, scale_px=1.0, lens=lens)
    twice = adjust(once, observations, scale_px=1.0, lens=lens)
    assert pose_errors(once.poses, twice.poses)[0].max() < 1e-4
