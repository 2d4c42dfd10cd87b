"""Tests of pose-regression targets and losses against formulas computed by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import canonical_quats, rotations_from_vectors
from spn_model.networks.pose_loss import (
    LearnedWeighting,
    beta_weighted_loss,
    laplace_nll,
    pose_residuals,
    reprojection_loss,
)
from spn_model.networks.pose_targets import PoseTargets

FAR = np.array(
    [450_000.0, -5_200_000.0, 120.0]
)  # typical map coordinates, at which float32 has steps of 0.5 m


def random_poses(count: int, seed: int = 0, spread: float = 15.0) -> Poses:
    rng = np.random.default_rng(seed)
    return Poses(
        rng.normal(size=(count, 3)) * spread + FAR, canonical_quats(rng.normal(size=(count, 4)))
    )


def fitted(poses: Poses) -> PoseTargets:
    targets = PoseTargets()
    targets.fit(poses)
    return targets


def tensors(*arrays: object) -> list[torch.Tensor]:
    return [torch.tensor(np.asarray(a), dtype=torch.float64) for a in arrays]


def test_poses_come_back_from_targets():
    """Even far from the origin, decoded positions are exact to 10 micrometres and rotations to 1e-6."""
    poses = random_poses(50)
    targets = fitted(poses)
    back = targets.decode(*targets.encode(poses))
    assert back.centers == pytest.approx(poses.centers, abs=1e-5)
    assert back.quats_wxyz == pytest.approx(poses.quats_wxyz, abs=1e-6)


def test_targets_are_centred_and_scaled_by_the_training_poses():
    """Offsets of training poses have mean 0 and an RMS of `scale`; other poses do not affect either."""
    poses = random_poses(200)
    targets = fitted(poses)
    offsets, _ = targets.encode(poses)
    assert offsets.mean(axis=0) == pytest.approx(0, abs=1e-4)
    assert float(targets.scale) == pytest.approx(15 * 3**0.5, rel=0.1)
    assert np.sqrt((offsets.astype(float) ** 2).sum(axis=1).mean()) == pytest.approx(
        float(targets.scale), rel=1e-6
    )
    other, _ = targets.encode(Poses(poses.centers + 100, poses.quats_wxyz))
    assert other.mean(axis=0) == pytest.approx(100, abs=1e-3)


def test_one_place_has_no_spread_and_is_not_scaled():
    """If all training poses share one position, the scale is 1."""
    poses = random_poses(5, spread=0.0)
    assert float(fitted(poses).scale) == 1.0


def test_a_rotation_has_one_target():
    """q and -q have the same target, in the hemisphere of the mean orientation."""
    around = rotations_from_vectors(
        [np.pi * 0.98, 0, 0] + 0.3 * np.random.default_rng(1).normal(size=(40, 3))
    )
    poses = Poses.from_rotations(np.zeros((40, 3)), around)
    assert (poses.quats_wxyz[:, 1] < 0).any()  # w >= 0 alone would split the group
    assert (poses.quats_wxyz[:, 1] > 0).any()
    targets = fitted(poses)
    _, quats = targets.encode(poses)
    _, negated = targets.encode(Poses(poses.centers, -poses.quats_wxyz))
    assert (quats == negated).all()
    assert np.linalg.norm(quats - quats.mean(axis=0), axis=1).max() < 0.8


def test_quaternions_are_read_out_whatever_their_length_and_sign():
    """-3 q decodes to the pose of q; a zero quaternion or a non-finite value decodes to no pose."""
    poses = random_poses(4)
    targets = fitted(poses)
    offsets, quats = targets.encode(poses)
    assert targets.decode(offsets, -3 * quats).quats_wxyz == pytest.approx(
        poses.quats_wxyz, abs=1e-6
    )
    quats[1], offsets[2, 0], quats[3, 2] = 0, np.nan, np.inf
    read = targets.decode(offsets, quats)
    assert np.isfinite(read.centers).all(axis=1).tolist() == [True, False, False, False]
    assert np.isnan(read.quats_wxyz[1:]).all()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_papers_loss_is_as_by_hand(sign):
    """With |x - x*| = 5 m and |q - q*| = 1 for the unnormalised q = (2, 0, 0, 0), the loss is 5 + 500."""
    x, q, true_x, true_q = tensors([[4, 6, 1]], [[2, 0, 0, 0]], [[1, 2, 1]], [[sign, 0, 0, 0]])
    assert beta_weighted_loss(x, q, true_x, true_q, 500.0).tolist() == pytest.approx([505.0])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_learned_loss_is_as_by_hand(sign):
    """The learned loss at s_x = 0.5 and s_q = -2 is 7 exp(-0.5) + 0.5 + 0.3 exp(2) - 2.

    Its initial weights are 0 and -3.
    """
    weighting = LearnedWeighting().double()
    assert (weighting.s_x.item(), weighting.s_q.item()) == (0.0, -3.0)
    with torch.no_grad():
        weighting.s_x.fill_(0.5)
        weighting.s_q.fill_(-2.0)
    x, true_x = tensors([[4, 6, 1]], [[1, 2, 1]])
    q, true_q = tensors([[1.1, -0.2, 0, 0]], [[sign, 0, 0, 0]])
    expected = 7 * np.exp(-0.5) + 0.5 + 0.3 * np.exp(2) - 2
    assert weighting(x, q, true_x, true_q).tolist() == pytest.approx([expected])


def test_reprojection_is_as_the_camera_projects():
    """The loss is the mean |dx| + |dy| in pixels over visible points, as projected by `Camera`."""
    lens = Camera("PINHOLE", 640, 480, np.array([500.0, 520.0, 320.0, 240.0]))
    rng = np.random.default_rng(3)
    truth = Poses.from_rotations(
        rng.normal(size=(4, 3)), rotations_from_vectors(rng.normal(size=(4, 3)))
    )
    moved = Poses.from_rotations(
        truth.centers + rng.normal(size=(4, 3)) * 0.3,
        rotations_from_vectors(rng.normal(size=(4, 3)) * 0.05) @ truth.rotations,
    )
    in_camera = rng.uniform([-3, -2, 5], [3, 2, 20], (4, 30, 3))
    points = in_camera @ truth.rotations + truth.centers[:, None]
    seen = rng.random((4, 30)) < 0.7
    expected = []
    for k in range(4):
        before = lens.project((points[k] - truth.centers[k]) @ truth.rotations[k].T)
        after = lens.project((points[k] - moved.centers[k]) @ moved.rotations[k].T)
        expected.append(np.abs(after - before).sum(axis=1)[seen[k]].mean())
    values = tensors(moved.centers, -2 * moved.quats_wxyz, truth.centers, truth.quats_wxyz, points)
    matrices = tensors(np.tile(lens.matrix, (4, 1, 1)))
    found = reprojection_loss(*values, torch.from_numpy(seen), *matrices)
    assert found.tolist() == pytest.approx(expected)


def test_reprojection_stays_finite():
    """Gradients are finite for points behind the estimated camera, padding, and images without points."""
    x = torch.tensor([[0.0, 0, 20], [0, 0, 0], [0, 0, 0]], requires_grad=True)
    q = torch.tensor([[1.0, 0, 0, 0]] * 3, requires_grad=True)
    points = torch.zeros(3, 2, 3)
    points[:2, 0] = torch.tensor([1.0, 0, 10])
    seen = torch.tensor([[True, False], [True, False], [False, False]])
    matrices = torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]).expand(3, 3, 3)
    found = reprojection_loss(x, q, torch.zeros(3, 3), q.detach(), points, seen, matrices)
    # The point is behind the first camera: it counts at a tenth of its depth, 1 m, 100 px from the centre.
    assert found.tolist() == pytest.approx([90.0, 0.0, 0.0])
    found.sum().backward()
    assert torch.isfinite(x.grad).all()
    assert torch.isfinite(q.grad).all()


def test_residuals_have_the_conventions_of_estimates():
    """Residuals are true minus estimated centre, and v with R_true = exp(v) R.

    Rotation angles range from a tiny turn to 179 degrees.
    """
    rng = np.random.default_rng(7)
    estimated = Poses(rng.normal(size=(30, 3)), canonical_quats(rng.normal(size=(30, 4))))
    axis = rng.normal(size=(30, 3))
    vectors = (
        axis / np.linalg.norm(axis, axis=1, keepdims=True) * np.geomspace(1e-5, 3.12, 30)[:, None]
    )
    away = rng.normal(size=(30, 3))
    truth = Poses.from_rotations(
        estimated.centers + away, rotations_from_vectors(vectors) @ estimated.rotations
    )
    factor = rng.choice([-2.0, 0.5], (30, 1))
    found = pose_residuals(
        *tensors(estimated.centers, factor * estimated.quats_wxyz, truth.centers, truth.quats_wxyz)
    )
    assert found[:, :3].numpy() == pytest.approx(away)
    assert found[:, 3:].numpy() == pytest.approx(vectors, abs=1e-7)


def test_the_likelihood_is_best_at_the_standard_deviation_of_errors():
    """For Laplacian errors of 0.3, a stated deviation of 0.3 is likelier than one 4 % larger or smaller."""
    errors = torch.from_numpy(
        np.random.default_rng(2).laplace(scale=0.3 / 2**0.5, size=(40_000, 6))
    )
    likelihood = [
        float(laplace_nll(errors, torch.full((1, 6), float(np.log(0.3 * by)))).mean())
        for by in (0.96, 1.0, 1.04)
    ]
    assert likelihood[1] < min(likelihood[0], likelihood[2])
    assert likelihood[1] == pytest.approx(6 * (1 + np.log(0.3)), abs=0.02)
