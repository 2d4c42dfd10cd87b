"""Tests of the pose regression model: training examples, frozen layers, covariances and learning."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import nn

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.errors import InputError
from spn_data.geometry.pose import Poses, pose_errors
from spn_data.geometry.rotations import rotations_from_vectors
from spn_model.evaluation.calibration import calibrate
from spn_model.evaluation.dropout import dropout_estimates
from spn_model.examples.training_set import TrainingSet
from spn_model.landmarks.aids import KnownVertical
from spn_model.models.registry import make
from spn_model.models.regression import RegressionModel
from spn_model.models.regression_examples import augmented_example
from spn_model.networks.normalization import InsertedBatchNorm
from spn_model.networks.pose_loss import beta_weighted_loss, pose_residuals
from tests.worlds.box_world import CAMERA, seen_by, write_box

pytestmark = pytest.mark.usefixtures("one_thread")

STILL = {"augmentation": False, "dropout": False}
LEARNED = {**STILL, "loss": "learned"}
CACHED = {"freeze_trunk": True, "cached_features": 1, "dropout": False}
NARROW = 64


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_box(tmp_path_factory.mktemp("hall") / "dataset.h5", train=16)


@pytest.fixture(scope="module")
def data(hall: Path) -> TrainingSet:
    with Dataset(hall) as dataset:
        return TrainingSet(dataset.groups["train"])


@pytest.fixture(scope="module")
def four(tmp_path_factory: pytest.TempPathFactory) -> TrainingSet:
    path = write_box(tmp_path_factory.mktemp("four") / "dataset.h5", train=4)
    with Dataset(path) as dataset:
        return TrainingSet(dataset.groups["train"])


def made(
    network: str = "squeezeposenet", width: int = NARROW, **options: object
) -> RegressionModel:
    """Return a model with published weights if they are part of the package, else random ones."""
    values = {"network": network, "width": width, "network_options": options}
    model = make("regression", values, seed=0)
    assert isinstance(model, RegressionModel)
    if network == "squeezeposenet":
        model.load_pretrained(model.weights_name)
    return model


def begun(data: TrainingSet, stage: dict[str, object], **options: object) -> RegressionModel:
    model = made(**options)
    model.fit(data)
    model.begin_stage(stage, data)
    return model


def train(model: RegressionModel, data: TrainingSet, steps: int, rate: float) -> list[float]:
    """Train on all images at once, with warm-up and cosine decay, and return the losses."""
    groups = [{**group, "lr": rate * group["rate"]} for group in model.parameter_groups()]
    optimizer = torch.optim.AdamW(groups, weight_decay=0, fused=True)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda k: min(1, (k + 1) / 20) * (1 + np.cos(np.pi * k / steps)) / 2
    )
    generator, rows = np.random.default_rng(0), np.arange(len(data))
    model.network.train()
    losses = []
    for step in range(steps):
        loss, _ = model.loss(model.batch(data, rows, generator, step / steps))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
    model.network.eval()
    return losses


def all_images(data: TrainingSet) -> np.ndarray:
    return np.stack([data.image(row) for row in range(len(data))])


def worst(model: RegressionModel, data: TrainingSet) -> tuple[float, float]:
    """Return the largest errors on the training images, in metres and degrees."""
    found = model.estimate(all_images(data), data.intrinsics)
    error_m, error_deg = pose_errors(found.poses, data.poses)
    return float(error_m.max()), float(error_deg.max())


def trunk_state(model: RegressionModel) -> dict[str, torch.Tensor]:
    state = model.network.regressor.features.state_dict()
    return {name: tensor.clone() for name, tensor in state.items()}


def changed(model: RegressionModel, before: dict[str, torch.Tensor]) -> set[str]:
    now = trunk_state(model)
    return {name for name, tensor in before.items() if not torch.equal(tensor, now[name])}


def test_it_learns_sixteen_images(data):
    """Without augmentation and dropout, all 16 images are learned to 0.1 m and 1 degree."""
    model = begun(data, LEARNED)
    start_m, start_deg = worst(model, data)
    assert start_m > 4
    assert start_deg > 15
    train(model, data, 140, 5e-4)
    error_m, error_deg = worst(model, data)
    assert error_m < 0.1
    assert error_deg < 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stage", "steps", "rate"),
    [({"beta": 500.0}, 350, 5e-4), ({"loss": "reprojection"}, 500, 5e-4)],
)
def test_other_losses_learn_sixteen_images_too(data, stage, steps, rate):
    """The paper's beta-weighted loss and the reprojection loss alone also overfit 16 images."""
    model = begun(data, {**STILL, **stage})
    train(model, data, steps, rate)
    error_m, error_deg = worst(model, data)
    assert error_m < 0.1
    assert error_deg < 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("network", "stages"),
    [
        ("posenet", [(LEARNED, 80, 1e-3)]),
        ("vgg16", [({**LEARNED, **CACHED}, 300, 1e-3), (LEARNED, 15, 3e-6)]),
    ],
)
def test_large_networks_learn_four_images(four, network, stages):
    """From random weights, large networks learn all 4 images to 0.5 m and 3 degrees."""
    model = made(network, width=64)
    model.fit(four)
    for stage, steps, rate in stages:
        model.begin_stage(stage, four)
        train(model, four, steps, rate)
    error_m, error_deg = worst(model, four)
    assert error_m < 0.5
    assert error_deg < 3


def test_it_starts_at_the_mean_pose(data):
    """Before training, estimates are at the mean training centre, near the mean orientation."""
    found = begun(data, {}).estimate(all_images(data), data.intrinsics)
    assert found.poses.centers == pytest.approx(
        np.tile(data.poses.centers.mean(axis=0), (16, 1)), abs=1e-5
    )
    assert pose_errors(found.poses, data.poses)[1].max() < 45
    # The initial uncertainty is the spread of the training poses, and one radian.
    spread = ((data.poses.centers - data.poses.centers.mean(axis=0)) ** 2).sum(axis=1).mean()
    assert np.diag(found.covariance[0]) == pytest.approx([spread] * 3 + [1] * 3, rel=1e-4)


def test_fitting_keeps_the_pretrained_features(data):
    """Features do not change when normalisation layers are initialised, as these start as the identity."""
    model = made()
    images = model.normalised(torch.from_numpy(all_images(data)[:, ::2, ::2].copy()))
    with torch.no_grad():
        layers = [m for m in model.network.modules() if isinstance(m, InsertedBatchNorm)]
        hooks = [layer.register_forward_hook(lambda layer, x, y: x[0]) for layer in layers]
        without = model.network.regressor.trunk(images)[0]
        for hook in hooks:
            hook.remove()
        model.fit(data)
        after = model.network.regressor.trunk(images)[0]
    assert len(layers) == 25
    assert torch.allclose(without, after, rtol=1e-4, atol=1e-4)
    # A fresh layer in eval mode would also be the identity, but without measured statistics.
    for layer in layers:
        assert layer.running_mean.abs().max() > 0.1
        assert torch.equal(layer.bias, layer.running_mean)


def test_another_data_set_moves_the_targets_alone(data, four):
    """Fitting a trained network to another data set changes only its target centre, scale and hemisphere."""
    model = begun(data, LEARNED)
    train(model, data, 2, 1e-3)
    state = {k: v.clone() for k, v in model.network.state_dict().items()}
    model.fit(four)
    now = model.network.state_dict()
    moved = {name for name, tensor in state.items() if not torch.equal(tensor, now[name])}
    assert moved == {"targets.center", "targets.scale", "targets.hemisphere"}


@pytest.mark.parametrize("batch_statistics", [False, True])
def test_a_frozen_trunk_stays_as_it_is(data, batch_statistics):
    """Weights and statistics of a frozen trunk do not change while the added layers learn."""
    stage = {**STILL, "freeze_trunk": True, "batch_statistics": batch_statistics}
    model = begun(data, stage)
    before = trunk_state(model)
    head = model.network.regressor.x.weight.clone()
    losses = train(model, data, 10, 1e-4)
    assert changed(model, before) == set()
    assert not torch.equal(head, model.network.regressor.x.weight)
    assert losses[-1] < losses[0]


@pytest.mark.parametrize("batch_statistics", [False, True])
def test_stored_statistics_move_only_where_that_is_chosen(data, batch_statistics):
    """Training all layers changes all weights, but running statistics only with batch_statistics."""
    model = begun(data, {**STILL, "batch_statistics": batch_statistics})
    before = trunk_state(model)
    train(model, data, 2, 1e-2)
    moved = changed(model, before)
    assert {name for name in before if name.endswith(("weight", "bias"))} <= moved
    assert any("running" in name for name in moved) == batch_statistics


def test_dropout_can_be_off(data):
    """The loss of a batch is deterministic if dropout is disabled, and random otherwise."""
    for dropout in (False, True):
        model = begun(data, {"augmentation": False, "dropout": dropout})
        nn.init.normal_(model.network.regressor.x.weight)
        model.network.train()
        batch = model.batch(data, np.arange(4), np.random.default_rng(0), 0.0)
        first, second = (model.loss(batch)[0].item() for _ in range(2))
        assert (first == second) == (not dropout)


@pytest.mark.parametrize("width", [0, 160])
def test_a_turned_camera_sees_what_its_label_says(data, width):
    """Rendering the scene at an example's pose reproduces the example, wherever the camera saw it."""
    model = begun(data, {"look": False, "tilt_deg": 15.0, "roll_deg": 20.0}, width=width)
    rows = np.array([2, 7])
    batch = model.batch(data, rows, np.random.default_rng(1), 0.5)
    poses = model.network.targets.decode(batch["x"].numpy(), batch["q"].numpy())
    assert pose_errors(poses, data.poses[rows])[1].min() > 5
    assert poses.centers == pytest.approx(data.poses.centers[rows], abs=1e-5)
    for k in range(2):
        rendered, _ = seen_by(poses[k : k + 1])
        image = batch["images"][k].numpy()
        if width:
            rendered = cv2.resize(rendered, (160, 90), interpolation=cv2.INTER_AREA)
        inside = cv2.erode((image.sum(axis=2) > 0).astype(np.uint8), np.ones((5, 5))) > 0
        assert inside.mean() > 0.4
        away = np.abs(image.astype(int) - rendered)[inside]
        assert np.median(away) <= 2
        assert away.mean() < (5 if width else 3)  # warping small images blurs them


def test_a_batch_is_a_function_of_its_arguments(data):
    """Equal seeds give equal batches, other seeds differ, and points are within the rotated image."""
    model = begun(data, {"loss": "reprojection", "points": 50})
    rows = np.array([3, 3, 8])
    one, same, other = (
        model.batch(data, rows, np.random.default_rng(seed), 0.0) for seed in (5, 5, 6)
    )
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert not torch.equal(one["images"], other["images"])
    assert not torch.equal(one["images"][0], one["images"][1])
    assert one["images"].shape == (3, 36, NARROW, 3)
    assert one["points"].shape == (3, 50, 3)
    assert one["seen"].sum(dim=1).min() > 20
    # Every point projects into the rotated image, with the data set's own K.
    poses = model.network.targets.decode(one["x"].numpy(), one["q"].numpy())
    for k in range(3):
        xyz = (
            one["points"][k].numpy()[one["seen"][k].numpy()] + model.network.targets.center.numpy()
        )
        pixels = CAMERA.project((xyz - poses.centers[k]) @ poses.rotations[k].T)
        assert ((pixels > -0.01) & (pixels < [320.01, 180.01])).all()


@pytest.mark.parametrize("network", ["squeezeposenet", "posenet"])
def test_stored_features_are_those_of_their_images(data, network):
    """Cached features equal those that the trunk computes for the variant, with its own label."""
    model = begun(data, CACHED, network=network)
    rows = np.array([4, 0, 11])
    batch = model.batch(data, rows, np.random.default_rng(0), 0.0)
    varied = [
        augmented_example(
            data, int(row), NARROW, model._stage, np.random.default_rng((int(row), 0))
        )
        for row in rows
    ]
    model.network.train()
    with torch.no_grad():
        images = torch.from_numpy(np.stack([image for image, _ in varied]))
        features = model.network.regressor.trunk(model.normalised(images))
    assert len(features) == (3 if network == "posenet" else 1)
    for k, part in enumerate(features):
        assert torch.allclose(batch[f"features{k}"], part, rtol=1e-3, atol=1e-3)
    x, q = model.network.targets.encode(Poses.concatenate(pose for _, pose in varied))
    assert (batch["x"].numpy() == x).all()
    assert (batch["q"].numpy() == q).all()
    assert "images" not in batch


def test_variants_of_stored_features_differ(data):
    """With 3 variants per image, one row yields 3 different labels, each with its own features."""
    model = begun(data, {**CACHED, "cached_features": 3})
    batch = model.batch(data, np.full(40, 5), np.random.default_rng(0), 0.0)
    labels = {tuple(q) for q in batch["q"].tolist()}
    both = {(*q, *f) for q, f in zip(batch["q"].tolist(), batch["features0"].tolist(), strict=True)}
    assert len(labels) == len(both) == 3


def test_positions_count_in_metres(data):
    """The paper's loss is computed in metres, however large the internal unit is."""
    model = begun(data, STILL)
    with torch.no_grad():
        model.network.regressor.x.bias.copy_(torch.tensor([0.5, -1.0, 0.25]))
    batch = model.batch(data, np.arange(16), np.random.default_rng(0), 0.0)
    loss, figures = model.loss(batch)
    found = model.estimate(all_images(data), data.intrinsics)
    apart = np.linalg.norm(found.poses.centers - data.poses.centers, axis=1)
    q = model.network.regressor.q.bias.detach()
    expected = apart.mean() + 500 * np.linalg.norm(batch["q"].numpy() - q.numpy(), axis=1).mean()
    assert (loss - figures["likelihood"]).item() == pytest.approx(expected, rel=1e-5)
    assert apart.min() > 1


def test_stating_uncertainty_changes_no_pose(data):
    """The likelihood affects only the `uncertainty` layer; other gradients are those of the paper's loss."""
    model = begun(data, STILL)
    network = model.network
    nn.init.normal_(network.regressor.x.weight, std=0.01)
    nn.init.normal_(network.uncertainty.weight, std=0.01)
    batch = model.batch(data, np.arange(4), np.random.default_rng(0), 0.0)
    model.loss(batch)[0].backward()
    assert network.uncertainty.weight.grad.abs().max() > 0
    found = {n: p.grad.clone() for n, p in network.regressor.named_parameters()}
    network.zero_grad()
    x, q = network.outputs(network.regressor.trunk(model.normalised(batch["images"]))).estimates[0]
    beta_weighted_loss(x, q, batch["x"], batch["q"], 500.0).mean().backward()
    for name, parameter in network.regressor.named_parameters():
        assert torch.allclose(found[name], parameter.grad, rtol=1e-4, atol=1e-5), name


def test_stated_covariances_become_those_of_the_errors(data):
    """Training only `uncertainty` makes covariances match the errors, and covariance scales multiply."""
    model = begun(data, {**CACHED, "cached_features": 4})
    for group in model.parameter_groups():
        if group["name"] != "uncertainty":
            for parameter in group["params"]:
                parameter.requires_grad_(False)
    train(model, data, 150, 2e-2)
    found = model.estimate(all_images(data), data.intrinsics)
    errors = pose_residuals(
        *(
            torch.from_numpy(a)
            for poses in (found.poses, data.poses)
            for a in (poses.centers, poses.quats_wxyz)
        )
    ).numpy()
    ratio = calibrate(errors, found.covariance).ratio
    assert 0.2 < ratio < 3
    model.set_covariance_scale(4.0)
    model.set_covariance_scale(0.5)
    again = model.estimate(all_images(data), data.intrinsics)
    assert again.covariance == pytest.approx(2 * found.covariance, rel=1e-4)
    assert (again.poses.centers == found.poses.centers).all()


def test_a_known_vertical_levels_the_pose_of_its_image(data):
    """One image is levelled, one that contradicts its vertical has a reason, one without stays as it was."""
    model = begun(data, {})
    alone = model.estimate(all_images(data)[:3], data.intrinsics[:3])
    up = alone.poses.rotations[:, :, 2]
    turn = rotations_from_vectors(np.deg2rad([[1.0, 0.0, 0.0]]))[0]
    verticals = [
        KnownVertical(up=tuple(turn @ up[0]), sigma_deg=0.01),
        None,
        KnownVertical(up=tuple(-up[2]), sigma_deg=0.01),
    ]
    found = model.estimate(all_images(data)[:3], data.intrinsics[:3], verticals)
    assert found.poses.rotations[0][:, 2] == pytest.approx(turn @ up[0], abs=1e-3)
    assert np.linalg.det(found.covariance[0]) < np.linalg.det(alone.covariance[0])
    assert found.poses.rotations[1] == pytest.approx(alone.poses.rotations[1])
    assert found.reasons.tolist()[:2] == ["", ""]
    assert "contradicts the stated attitude" in found.reasons[2]
    assert np.isnan(found.poses.centers[2]).all()


def test_its_state_is_the_whole_member(data):
    """A model rebuilt from options and state gives the same estimates, for single images and batches."""
    model = begun(data, LEARNED)
    train(model, data, 3, 1e-3)
    model.set_covariance_scale(3.0)
    anew = make("regression", model.options, seed=9)
    anew.network.load_state_dict(model.network.state_dict())
    found = model.estimate(all_images(data), data.intrinsics)
    for row in (0, 9):
        one = anew.estimate(data.image(row)[None], data.intrinsics[row : row + 1])
        assert one.poses.centers[0] == pytest.approx(found.poses.centers[row], abs=1e-4)
        assert one.poses.quats_wxyz[0] == pytest.approx(found.poses.quats_wxyz[row], abs=1e-5)
        assert one.covariance[0] == pytest.approx(found.covariance[row], rel=1e-3)
    none = anew.estimate(np.zeros((0, 180, 320, 3), np.uint8), np.zeros((0, 3, 3)))
    assert len(none.poses) == 0


def test_an_answer_that_is_no_pose_is_said_to_be_none(data):
    """A NaN output gives a NaN pose with a reason."""
    model = begun(data, STILL)
    with torch.no_grad():
        model.network.regressor.x.bias[1] = torch.nan
    found = model.estimate(all_images(data)[:2], data.intrinsics[:2])
    assert np.isnan(found.poses.centers).all()
    assert np.isnan(found.covariance).all()
    assert found.reasons.tolist() == ["the network's answer is no pose"] * 2


def test_dropout_tells_a_covariance_too(data):
    """Monte-Carlo dropout (Kendall and Cipolla) gives a full covariance and a mean near the estimate."""
    model = begun(data, LEARNED)
    train(model, data, 20, 1e-3)
    images, matrices = all_images(data)[:2], data.intrinsics[:2]
    plain = model.estimate(images, matrices)
    sampled = dropout_estimates(model, images, matrices, 12)
    assert (np.linalg.eigvalsh(sampled.covariance) > 0).all()
    spread = np.sqrt(np.einsum("nii->n", sampled.covariance[:, :3, :3]))
    apart = pose_errors(sampled.poses, plain.poses)[0]
    assert (apart < 2 * spread).all()
    assert not any(module.training for module in model.network.modules())


@pytest.mark.parametrize(
    ("stage", "said"),
    [
        ({"rate": 1.0}, "unknown option 'rate'"),
        ({"loss": "huber"}, "one of beta, learned, reprojection"),
        ({"beta": -1}, "beta is -1.0"),
        ({"tilt_deg": 80}, "tilt_deg is 80.0"),
        ({"freeze_trunk": 1}, "needs a bool"),
        ({"cached_features": 4}, "needs freeze_trunk"),
        ({**CACHED, "cached_features": 4, "augmentation": False}, "without augmentation"),
        ({**CACHED, "cached_features": 10_000}, "allowed"),
    ],
)
def test_wrong_stages_are_refused(data, stage, said):
    """Invalid names, values and combinations of stage options are rejected with a specific message."""
    model = made("posenet", width=64)
    model.fit(data)
    with pytest.raises(InputError, match=said):
        model.begin_stage(stage, data)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"network": "alexnet"}, "unknown network 'alexnet'"),
        ({"width": 12}, "width is 12"),
        ({"height": 100}, "unknown option 'height'"),
        ({"network_options": {"slope": 2.0}}, "slope"),
        ({"network_options": 3}, "needs a table"),
    ],
)
def test_wrong_networks_are_refused(options, said):
    """Invalid model options are rejected with a specific message."""
    with pytest.raises(InputError, match=said):
        make("regression", options)


def test_what_cannot_be_trained_on_is_refused(tmp_path, data):
    """Missing points for the reprojection loss, an unknown camera and tiny images are rejected."""
    with Dataset(write_box(tmp_path / "dataset.h5", train=2, points=0)) as dataset:
        bare = TrainingSet(dataset.groups["train"])
    bare.has_points = False
    model = made()
    model.fit(bare)
    with pytest.raises(InputError, match="needs map points"):
        model.begin_stage({"loss": "reprojection"}, bare)
    bare.intrinsics = np.full((2, 3, 3), np.nan)
    with pytest.raises(InputError, match="set tilt_deg and roll_deg to 0"):
        model.begin_stage({}, bare)
    model.begin_stage({"tilt_deg": 0, "roll_deg": 0}, bare)
    with pytest.raises(
        InputError, match="images of 30 x 17 are too small: squeezeposenet needs at least 21"
    ):
        made(width=30).fit(data)


def test_input_is_sized_alike_in_training_and_estimates(data):
    """A width rescales images proportionally, up or down; 0 keeps their size."""
    for width, size in ((60, (34, 60)), (0, (180, 320)), (400, (225, 400))):
        model = made(width=width)
        model.begin_stage(STILL, data)
        batch = model.batch(data, np.array([1]), np.random.default_rng(0), 0.0)
        assert batch["images"].shape[1:3] == size
