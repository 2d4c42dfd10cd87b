"""Errors that all measurements of a lens share, against lenses that differ from their model."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from spn_data.colmap.model import Scene
from spn_data.geometry.camera import Camera
from spn_data.geometry.initial_lens import Hold
from spn_data.uncertainty.lens_errors import BLOCKS, CONSTANT, TERMS, estimate_field, field_values
from spn_data.uncertainty.map_covariance import MapCovariance, MapCovarianceOptions
from spn_data.uncertainty.shared_errors import LensPrior
from tests.spn_data.uncertainty.test_map_covariance import Small, adjusted, errors_of, scores, small

MODEL = Camera("RADIAL", 640, 480, np.array([500.0, 320, 240, -0.05, 0.02]))
EXACT = MapCovarianceOptions(exact_lenses=True)


@cache
def one_lens() -> Small:
    """Return frames along an arc around a point cloud, all with one lens."""
    both = small(frames=12, points=2500)
    ids = np.ones_like(both.scene.camera_ids)
    return Small(replace(both.scene, camera_ids=ids, cameras={1: MODEL}), both.seen)


def seen_through(lens: Camera, seed: int) -> tuple[Scene, Small]:
    """Return the true scene, and the model made of measurements through a lens, with 0.3 px of noise."""
    truth = one_lens()
    scene, seen = truth.scene, truth.seen
    pixels = np.empty_like(seen.pixels)
    for k in range(len(scene.names)):
        rows = seen.image_idx == k
        pixels[rows] = lens.project(
            scene.poses[k : k + 1].to_camera(scene.points[seen.point_idx[rows]])
        )
    noise = 0.3 * np.random.default_rng(seed).standard_normal(pixels.shape)
    return scene, adjusted(scene, seen, pixels + noise)


def lens_with(shift_px: tuple[float, float] = (0, 0), p1: float = 0.0, p2: float = 0.0) -> Camera:
    """Return the lens with its principal point shifted, and with decentring."""
    x, y = shift_px
    return Camera("OPENCV", 640, 480, np.array([500.0, 500, 320 + x, 240 + y, -0.05, 0.02, p1, p2]))


def test_the_basis_of_the_fields_is_orthonormal_over_the_image() -> None:
    """The mean over the image of the product of two fields is 1 for equal ones and 0 otherwise."""
    x, y = np.meshgrid(np.linspace(0, 640, 641)[:-1] + 0.5, np.linspace(0, 480, 481)[:-1] + 0.5)
    values = field_values(MODEL, np.column_stack([x.ravel(), y.ravel()]))
    assert values.shape[1] == TERMS // 2
    assert np.allclose(values.T @ values / len(values), np.eye(TERMS // 2), atol=1e-3)


def test_radial_distortion_is_no_error_of_a_lens() -> None:
    """A pull along the field of radial distortion changes no expected coefficient."""
    x, y = np.meshgrid(np.arange(1, 640, 2), np.arange(1, 480, 2))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    values = field_values(MODEL, pixels)
    rays = (pixels - [320, 240]) / 320
    cubic = rays * (rays**2).sum(axis=1, keepdims=True)
    radial = (values.T @ cubic / len(values)).T.ravel()
    radial[[0, TERMS // 2]] = 0.0
    found = estimate_field(MODEL, np.eye(TERMS)[None] * 1e4, 1e4 * radial[None], 1e-2)
    assert np.abs(found.coefficients_px).max() < 0.05 * np.abs(radial).max()


def test_what_differs_between_blocks_is_noise_and_what_does_not_is_a_field() -> None:
    """Blocks that agree show a field and little noise; blocks that pull apart as strongly show only noise."""
    rng = np.random.default_rng(0)
    one = np.zeros(TERMS)
    one[8] = 0.05  # of degree 3
    information = np.stack([np.eye(TERMS) * 1e3] * BLOCKS)
    noise = np.sqrt(0.09 * 1e3) * rng.standard_normal((BLOCKS, TERMS))
    alike = estimate_field(MODEL, information, information @ one + noise, 9.0)
    assert 0.07 < alike.variance_px2 < 0.12
    assert abs(alike.coefficients_px[8] - 0.05) < 0.01
    apart = estimate_field(MODEL, information, 10 * noise, 0.09)
    assert 7.0 < apart.variance_px2 < 12.0
    assert np.abs(np.delete(apart.coefficients_px, CONSTANT)).max() < 0.02


def test_measurements_that_tell_nothing_leave_what_is_usual() -> None:
    """Without information, the principal point is as uncertain as among lenses, and nothing else is large."""
    found = estimate_field(MODEL, np.zeros((BLOCKS, TERMS, TERMS)), np.zeros((BLOCKS, TERMS)), 1.0)
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.allclose(sigma[list(CONSTANT)], 6.4, rtol=1e-2)
    assert np.delete(sigma, CONSTANT).max() < 0.2
    assert np.all(found.coefficients_px == 0)


def test_a_shifted_principal_point_is_told_by_converging_views() -> None:
    """A shift of 9 and -6 px is found within three sigma, with a sigma below 3.5 px, in one step."""
    _, made = seen_through(lens_with((9.0, -6.0)), seed=1)
    point = MapCovariance.of(made.scene, made.seen).shared.principal_points[1]
    assert np.all(point.sigma_px < 3.5)
    assert np.all(np.abs(point.shift_px - [9.0, -6.0]) < 3 * point.sigma_px + 0.5)


def test_a_lens_as_modelled_adds_little() -> None:
    """With the lens as modelled, no shift is found, and standard deviations grow to four times at most."""
    _, made = seen_through(lens_with(), seed=2)
    told = MapCovariance.of(made.scene, made.seen)
    point = told.shared.principal_points[1]
    assert np.all(np.abs(point.shift_px) < 3 * point.sigma_px)
    exact = MapCovariance.of(made.scene, made.seen, EXACT).pose_covariances()
    growth = np.einsum("nii->ni", told.pose_covariances()) / np.einsum("nii->ni", exact)
    assert np.sqrt(np.median(growth)) < 4


def test_labels_contain_the_truth_though_the_lens_is_not_as_modelled() -> None:
    """Over 5 lenses with shifted principal points, NEES of poses stays below 3 a coordinate, against 30."""
    rng = np.random.default_rng(3)
    told, exact = [], []
    for seed in range(5):
        lens = lens_with(tuple(rng.normal(0, 6.4, 2)), *rng.normal(0, 5e-4, 2))
        truth, made = seen_through(lens, seed)
        errors, _ = errors_of(made.scene, truth)
        told.append(scores(errors, MapCovariance.of(made.scene, made.seen).pose_covariances()))
        exact.append(
            scores(errors, MapCovariance.of(made.scene, made.seen, EXACT).pose_covariances())
        )
    assert np.median(told) / 6 < 3
    assert np.median(exact) / 6 > 30


@pytest.mark.parametrize("hold", [Hold.FOCAL, Hold.LENS])
def test_a_held_focal_length_is_as_uncertain_as_stated(hold: Hold) -> None:
    """A held focal length that is 2 % wrong, and stated so, leaves poses within what is stated."""
    truth, made = seen_through(lens_with(), seed=4)
    prior = {1: LensPrior(hold=hold, focal_sigma_px=10.0)}
    stated = MapCovariance.of(made.scene, made.seen, MapCovarianceOptions(lenses=prior))
    free = MapCovariance.of(made.scene, made.seen)
    assert 1 not in stated.shared.focal_lengths
    is_free, of_lens = stated.lens_covariances()[1]
    assert not is_free[0]
    assert is_free.any() == (hold is Hold.FOCAL)
    assert of_lens.shape == 2 * (is_free.sum(),)
    assert free.shared.focal_lengths[1].error_px < 5.0
    size = np.einsum(
        "nii->ni", stated.pose_covariances() / np.maximum(free.pose_covariances(), 1e-30)
    )
    assert np.median(size) > 1.0
    errors, _ = errors_of(made.scene, truth)
    assert np.median(scores(errors, stated.pose_covariances())) < 2 * 6
