"""Tests of decoding scene coordinates into poses: accuracy, robustness, covariance and dependencies."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spn_data.errors import GeometryError
from spn_data.geometry.pose import Poses, pose_errors
from spn_data.geometry.rotations import rotation_vectors, rotations_from_vectors
from spn_model.landmarks.aids import KnownHeight, KnownVertical
from spn_model.onboard.decoding import DecodingOptions, decode, with_aids

MATRIX = np.array([[328.0, 0, 240.0], [0, 328.0, 135.0], [0, 0, 1.0]])
GRID = (59, 33)  # cells of a 480 x 270 image, the first at (7.5, 7.5), 8 px apart
TRUE = Poses.from_rotations([[310.0, -4.0, 12.0]], rotations_from_vectors([[1.9, 0.3, -0.2]]))
STILL = DecodingOptions(cells_per_observation=1.0)


def decoded(
    xyz: np.ndarray,
    log_scale: np.ndarray,
    options: DecodingOptions | None = None,
    vertical: KnownVertical | None = None,
    height: KnownHeight | None = None,
):
    return decode(
        *(xyz, log_scale, MATRIX),
        first_px=7.5,
        stride_px=8.0,
        options=options,
        vertical=vertical,
        height=height,
    )


def vertical_off_by(tilt_deg: float, sigma_deg: float) -> KnownVertical:
    """Return up of the true pose, turned about the camera's x axis, with a stated standard deviation."""
    turn = rotations_from_vectors(np.deg2rad([[tilt_deg, 0.0, 0.0]]))[0]
    x, y, z = (turn @ TRUE.rotations[0][:, 2]).tolist()
    return KnownVertical(up=(x, y, z), sigma_deg=sigma_deg)


def scene(seed: int) -> np.ndarray:
    """Return exact coordinates of the cells, shape (3, h, w), at random depths."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(GRID[0]) * 8 + 7.5, np.arange(GRID[1]) * 8 + 7.5)
    rays = np.stack([(x - 240) / 328, (y - 135) / 328, np.ones_like(x)])
    in_camera = rays * rng.uniform(5, 25, x.shape)
    xyz = np.einsum("ij,jhw->ihw", TRUE.rotations[0].T, in_camera)
    return xyz + TRUE.centers[0][:, None, None]


def laplace(rng: np.random.Generator, scale: np.ndarray) -> np.ndarray:
    """Return errors, shape (3, h, w), with density proportional to exp(-length / scale)."""
    direction = rng.normal(size=(3, *scale.shape))
    direction /= np.linalg.norm(direction, axis=0)
    return direction * rng.gamma(3.0, scale)


def test_exact_coordinates_give_the_exact_pose():
    """Exact coordinates give the pose to 1e-6 m and 1e-6 degrees, far from the world's origin."""
    estimate = decoded(scene(0), np.full(GRID[::-1], -3.0))
    error_m, error_deg = pose_errors(estimate.poses, TRUE)
    assert error_m[0] < 1e-6
    assert error_deg[0] < 1e-6
    assert estimate.inliers == estimate.used == 700


def test_most_cells_may_be_wrong():
    """With 60 % outliers of equal confidence the pose stays accurate."""
    rng = np.random.default_rng(1)
    xyz = scene(1)
    wrong = rng.random(GRID[::-1]) < 0.6
    xyz[:, wrong] += rng.normal(0, 15, (3, np.count_nonzero(wrong)))
    estimate = decoded(xyz, np.full(GRID[::-1], -3.0))
    error_m, error_deg = pose_errors(estimate.poses, TRUE)
    assert error_m[0] < 0.02
    assert error_deg[0] < 0.1
    assert 0.3 * 700 < estimate.inliers < 0.5 * 700


def test_the_surest_cells_are_taken():
    """Cells with a large predicted scale do not affect the pose."""
    xyz, log_scale = scene(2), np.full(GRID[::-1], -3.0)
    xyz[:, :20] = 1e4
    log_scale[:20] = 3.0
    error_m, _ = pose_errors(decoded(xyz, log_scale).poses, TRUE)
    assert error_m[0] < 1e-6


def test_certainty_weighs():
    """If half of the cells are 20 times better, using their predicted scales gives a better pose."""
    rng = np.random.default_rng(3)
    told, silent = [], []
    for seed in range(10):
        scale = np.where(rng.random(GRID[::-1]) < 0.5, 0.02, 0.4)
        xyz = scene(seed) + laplace(rng, scale)
        for found, said in ((told, scale), (silent, np.full_like(scale, 0.2))):
            options = replace(STILL, cells=2000)
            found.append(pose_errors(decoded(xyz, np.log(said), options).poses, TRUE)[0][0])
    assert np.mean(told) < 0.6 * np.mean(silent)


def test_covariance_is_that_of_the_errors():
    """For independent errors of the predicted scale, the mean NEES is near 6.

    The order is centre, then rotation vector in the camera frame with R_true = exp(v) R.
    """
    rng = np.random.default_rng(4)
    squares = []
    for seed in range(60):
        scale = np.exp(rng.uniform(-4, -1, GRID[::-1]))
        estimate = decoded(scene(seed) + laplace(rng, scale), np.log(scale), STILL)
        turn = rotation_vectors(TRUE.rotations @ estimate.poses.rotations.transpose(0, 2, 1))[0]
        error = np.concatenate([TRUE.centers[0] - estimate.poses.centers[0], turn])
        squares.append(error @ np.linalg.solve(estimate.covariance, error))
    assert 4.6 < np.mean(squares) < 7.4


def test_cells_above_the_largest_scale_are_left_out():
    """Cells are excluded by comparing the scale itself with the limit, here at 0.99 and 1.01 times 0.2 m."""
    log_scale = np.full(GRID[::-1], np.log(0.99 * 0.2))
    log_scale[:20] = np.log(1.01 * 0.2)
    options = DecodingOptions(cells=log_scale.size, largest_scale=0.2)
    assert decoded(scene(2), log_scale, options).used == log_scale[20:].size


def test_covariance_accounts_for_the_slope_of_the_influence_function():
    """Residuals of u widths scale the covariance by u^2 / slope^2, slope = (1 - u^2) / (1 + u^2)."""
    turn = np.random.default_rng(80).uniform(0, 2 * np.pi, GRID[::-1])
    across = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)]) / 328
    xyz = scene(8)
    in_camera = np.einsum("ij,jhw->ihw", TRUE.rotations[0], xyz - TRUE.centers[0][:, None, None])
    options = replace(STILL, cells=turn.size)
    variance, expected = [], []
    for width in (0.1, 0.5):
        # Standard deviations are `floor_px` = 1, and widths three times that.
        moved = across * in_camera[2] * 3 * width
        moved = np.einsum("ij,jhw->ihw", TRUE.rotations[0].T, moved)
        covariance = decoded(xyz + moved, np.full(turn.shape, -12.0), options).covariance
        variance.append(np.trace(covariance[:3, :3]))
        expected.append((width * (1 + width**2) / (1 - width**2)) ** 2)
    assert variance[1] / variance[0] == pytest.approx(expected[1] / expected[0], rel=0.05)


def test_covariance_knows_which_way_is_weak():
    """In front of a flat wall, sideways translation and rotation are strongly correlated."""
    x, y = np.meshgrid(np.arange(GRID[0]) * 8 + 7.5, np.arange(GRID[1]) * 8 + 7.5)
    xyz = np.stack([(x - 240) / 328, (y - 135) / 328, np.ones_like(x)]) * 10.0
    scale = np.full(GRID[::-1], 0.1)
    xyz += laplace(np.random.default_rng(9), scale)
    covariance = decoded(xyz, np.log(scale), replace(STILL, cells=2000)).covariance
    sigma = np.sqrt(np.diag(covariance))
    assert sigma[0] > 2 * sigma[2]
    assert np.abs(covariance - covariance.T).max() < 1e-9 * covariance.max()
    assert covariance[0, 4] / (sigma[0] * sigma[4]) > 0.9
    assert covariance[1, 3] / (sigma[1] * sigma[3]) < -0.9


def test_wider_scatter_than_stated_widens_the_covariance():
    """Errors four times larger than predicted increase the covariance."""
    rng = np.random.default_rng(5)
    said = np.full(GRID[::-1], 0.02)
    honest = decoded(scene(5) + laplace(rng, said), np.log(said), STILL).covariance
    boastful = decoded(scene(5) + laplace(rng, 4 * said), np.log(said), STILL).covariance
    assert np.trace(boastful[:3, :3]) > 2 * np.trace(honest[:3, :3])


def test_neighbours_that_err_alike_count_less():
    """The covariance is proportional to the number of cells per independent observation."""
    log_scale = np.full(GRID[::-1], -3.0)
    xyz = scene(6) + laplace(np.random.default_rng(6), np.exp(log_scale))
    one = decoded(xyz, log_scale, STILL).covariance
    many = decoded(xyz, log_scale, replace(STILL, cells_per_observation=9.0)).covariance
    assert many == pytest.approx(9 * one)


def test_a_known_vertical_halves_the_tilt_with_a_true_covariance():
    """With a vertical of 0.1 degrees, the tilt is less than half as wrong, and the mean NEES is near 6."""
    rng = np.random.default_rng(20)
    options, scale = replace(STILL, cells=100), np.full(GRID[::-1], 0.1)
    tilts: dict[bool, list[float]] = {True: [], False: []}
    squares = []
    for seed in range(20):
        xyz = scene(seed) + laplace(rng, scale)
        up = vertical_off_by(0.1 * rng.normal(), 0.1)
        for known in (True, False):
            found = decoded(xyz, np.log(scale), options, up if known else None)
            turn = rotation_vectors(TRUE.rotations @ found.poses.rotations.transpose(0, 2, 1))[0]
            tilt = np.linalg.norm(np.cross(TRUE.rotations[0][:, 2], turn))
            tilts[known].append(float(np.rad2deg(tilt)))
            if known:
                error = np.concatenate([TRUE.centers[0] - found.poses.centers[0], turn])
                squares.append(error @ np.linalg.solve(found.covariance, error))
    assert np.mean(tilts[True]) < 0.5 * np.mean(tilts[False])
    assert 4 < np.mean(squares) < 8


def test_a_vertical_that_contradicts_the_cells_is_refused():
    """A vertical that is off by 10 of its standard deviations gives no pose; one that is off by one does."""
    xyz, log_scale = scene(21), np.full(GRID[::-1], -3.0)
    assert decoded(xyz, log_scale, STILL, vertical_off_by(1.0, 1.0)).inliers > 600
    with pytest.raises(GeometryError, match="contradicts the stated attitude by 10"):
        decoded(xyz, log_scale, STILL, vertical_off_by(10.0, 1.0))
    # A vertical that outweighs the cells would draw the pose away from them, and silence them.
    xyz += laplace(np.random.default_rng(21), np.exp(log_scale))
    weak = replace(STILL, cells_per_observation=100.0)
    with pytest.raises(GeometryError, match="contradicts the stated attitude"):
        decoded(xyz, log_scale, weak, vertical_off_by(4.0, 0.1))


def test_a_known_vertical_levels_a_regressed_pose():
    """A pose that is tilted by 4 degrees, known to 3, becomes level to a fifth; heading and place stay."""
    turn = rotations_from_vectors(np.deg2rad([[4.0, 0.0, 0.0]]))
    tilted = Poses.from_rotations(TRUE.centers, turn @ TRUE.rotations)
    covariance = np.diag([0.5**2] * 3 + [np.deg2rad(3.0) ** 2] * 3)
    found, after = with_aids(tilted, covariance, vertical_off_by(0.0, 0.5))
    up, before = found.rotations[0][:, 2], tilted.rotations[0][:, 2]
    off_deg, before_deg = (np.rad2deg(np.arccos(u @ TRUE.rotations[0][:, 2])) for u in (up, before))
    assert off_deg < 0.05 * before_deg
    assert found.centers == pytest.approx(TRUE.centers)
    about_up = TRUE.rotations[0][:, 2]
    assert about_up @ after[3:, 3:] @ about_up == pytest.approx(np.deg2rad(3.0) ** 2, rel=0.05)
    assert np.trace(after[3:, 3:]) < 0.4 * np.trace(covariance[3:, 3:])
    with pytest.raises(GeometryError, match="contradicts the stated attitude"):
        with_aids(tilted, covariance, vertical_off_by(-20.0, 0.5))


def test_a_known_height_moves_a_pose_to_it():
    """Where the height is known better than by the cells, it counts; one that is 20 m off is refused."""
    xyz, log_scale = scene(21), np.full(GRID[::-1], -3.0)
    xyz += laplace(np.random.default_rng(21), np.exp(log_scale))
    weak, true_m = replace(STILL, cells_per_observation=100.0), float(TRUE.centers[0, 2])
    alone = decoded(xyz, log_scale, weak)
    off_m = float(alone.poses.centers[0, 2]) - true_m
    sigma_m = float(np.sqrt(alone.covariance[2, 2]))
    known = KnownHeight(up_m=true_m, sigma_m=sigma_m / 10)
    found = decoded(xyz, log_scale, weak, height=known)
    assert abs(found.poses.centers[0, 2] - true_m) < 0.2 * abs(off_m)
    assert found.covariance[2, 2] < 0.1 * alone.covariance[2, 2]
    with pytest.raises(GeometryError, match="the network contradicts the stated height by"):
        decoded(xyz, log_scale, weak, height=KnownHeight(up_m=true_m + 20, sigma_m=0.1))
    covariance = np.diag([0.5**2] * 3 + [0.01**2] * 3)
    raised, after = with_aids(TRUE, covariance, None, KnownHeight(up_m=true_m + 1, sigma_m=0.5))
    assert raised.centers[0] - TRUE.centers[0] == pytest.approx([0, 0, 0.5])
    assert np.diag(after)[:3] == pytest.approx([0.25, 0.25, 0.125])


def test_nonsense_gives_no_pose():
    """Random coordinates raise GeometryError with the number of inliers instead of giving a pose."""
    xyz = np.random.default_rng(7).normal(0, 10, (3, *GRID[::-1]))
    with pytest.raises(GeometryError, match=r"\d+ of 700 cells agree on a pose, need \d+"):
        decoded(xyz, np.zeros(GRID[::-1]), DecodingOptions(min_inliers=60))


def test_cells_without_a_number_are_left_out():
    """Non-finite coordinates are ignored; if too few cells remain, the error states their number."""
    xyz, log_scale = scene(8), np.full(GRID[::-1], -3.0)
    xyz[:, 5:9] = np.nan
    error_m, _ = pose_errors(decoded(xyz, log_scale).poses, TRUE)
    assert error_m[0] < 1e-6
    xyz[:, 1:] = np.nan
    xyz[:, 0, 5:] = np.inf
    with pytest.raises(GeometryError, match="only 5 cells are confident, need 12"):
        decoded(xyz, log_scale, replace(STILL, cells=3000))


def test_decoding_needs_neither_torch_nor_pycolmap():
    """Decoding can be imported without torch, pycolmap and scipy."""
    code = (
        "import sys\n"
        "sys.modules['torch'] = sys.modules['pycolmap'] = sys.modules['scipy'] = None\n"
        "import spn_model.onboard.decoding\n"
    )
    root = Path(__file__).resolve().parents[3]
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
