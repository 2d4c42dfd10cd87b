"""Tests of the scene-coordinate model: training examples, learning, and images without a pose."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.errors import GeometryError, InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses, pose_errors
from spn_data.geometry.rotations import rotations_from_vectors
from spn_model.examples.training_set import TrainingSet
from spn_model.landmarks.aids import KnownVertical
from spn_model.models.pose_model import PoseEstimates
from spn_model.models.scene_coordinates import SceneCoordinatesModel
from spn_model.models.scene_examples import SceneStageOptions
from spn_model.networks.scene_coordinates import FIRST_CELL_PX, STRIDE_PX
from spn_model.onboard.decoding import decode
from spn_model.training.covariance_scale import fit_covariance_scale
from spn_model.training.precision import bfloat16_is_fast
from tests.worlds.box_world import CAMERA, seen_by, write_box

pytestmark = pytest.mark.usefixtures("one_thread")

STILL = {
    "tilt_deg": 0,
    "roll_deg": 0,
    "zoom_min": 1,
    "zoom_max": 1,
    "size_min": 1,
    "size_max": 1,
    "ramp_share": 0,
    "look": False,
}
VIEWS = {"views_share": 0.5, "views_rise": 0.3}
# No higher than the hall.
HIGH = {"views_share": 1.0, "views_rise": 0.3, "views_height": 0.3}


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_box(tmp_path_factory.mktemp("hall") / "dataset.h5", train=16)


@pytest.fixture(scope="module")
def data(hall: Path) -> TrainingSet:
    with Dataset(hall) as dataset:
        return TrainingSet(dataset.groups["train"])


def fitted(
    data: TrainingSet, stage: dict[str, object], *, shrink: int = 1
) -> SceneCoordinatesModel:
    model = SceneCoordinatesModel.make({"shrink": shrink}, seed=0)
    model.load_pretrained(model.weights_name)
    model.fit(data)
    model.begin_stage(stage, data)
    return model


def test_a_batch_depends_on_its_arguments_alone(data):
    """Equal rows, generator and progress give equal tensors, whatever batches were drawn before."""
    first, second = fitted(data, VIEWS), fitted(data, VIEWS)
    for k in range(4):
        second.batch(data, np.arange(4), np.random.default_rng(100 + k), 0.9)
    rows = np.array([3, 1, 4, 1, 5])
    a, b = (m.batch(data, rows, np.random.default_rng(7), 0.6) for m in (first, second))
    assert all(torch.equal(a[name], b[name]) for name in ("images", "targets", "known"))
    other = first.batch(data, rows, np.random.default_rng(8), 0.6)
    assert other["images"].shape != a["images"].shape or not torch.equal(
        other["images"], a["images"]
    )


def test_images_follow_the_zoom(data):
    """Augmentation ramps up at a stage's beginning, and image sizes follow the zoom.

    A batch holds more images if they are small, at most twice as many.
    """
    rows = np.arange(6)
    small = fitted(data, STILL | {"size_min": 0.5, "size_max": 0.5})
    batch = small.batch(data, rows, np.random.default_rng(0), 0.5)
    assert batch["images"].shape == (12, 90, 160, 3)
    full = fitted(data, STILL).batch(data, rows, np.random.default_rng(0), 0.1)
    assert full["images"].shape == (6, 180, 320, 3)
    assert np.array_equal(full["images"][2], data.image(2))
    free = {"zoom_min": 0.5, "zoom_max": 2.0, "size_min": 0.1, "size_max": 9.0, "ramp_share": 0.5}
    zooming = fitted(data, free)
    widths = {
        progress: [
            zooming.batch(data, rows[:1], np.random.default_rng(k), progress)["images"].shape[2]
            for k in range(12)
        ]
        for progress in (0.0, 0.9)
    }
    assert np.ptp(np.log(widths[0.0])) < 0.5 * np.ptp(np.log(widths[0.9]))


@pytest.mark.parametrize(
    ("stage", "known_share", "shrink"),
    [
        ({}, 0.25, 1),
        (HIGH, 0.2, 1),
        (HIGH, 0.2, 2),
        ({"views_share": 1.0, "views_rise": 0.3, "views_fused": False}, 0.2, 1),
        ({"views_share": 1.0, "views_rise": 0.3, "views_fused": False}, 0.2, 2),
        ({"surfaces": False}, 0.15, 1),
    ],
    ids=["surfaces", "views", "reduced views", "moved images", "reduced moved images", "points"],
)
def test_targets_are_what_the_cells_show(data, stage, known_share, shrink):
    """The pose decoded from the targets is that of a camera that would take this image.

    For rotated and zoomed images its centre is the training camera's to 2 cm, in a hall of 20 m. The image's
    edges, beyond which the training image shows nothing, are left out of the comparison.
    """
    zoom = 0.8
    model = fitted(
        data,
        {"zoom_min": zoom, "zoom_max": zoom, "ramp_share": 0, "look": False} | stage,
        shrink=shrink,
    )
    zoom /= shrink
    rows = np.arange(6)
    batch = model.batch(data, rows, np.random.default_rng(0), 0.5)
    height, width = batch["images"].shape[1:3]
    lens = Camera("SIMPLE_PINHOLE", width, height, np.array([230.0 * zoom, width / 2, height / 2]))
    moved = []
    for row, image, targets, known in zip(
        rows,
        batch["images"].numpy(),
        batch["targets"].numpy(),
        batch["known"].numpy(),
        strict=False,
    ):
        assert known.mean() > known_share
        log_scale = np.where(known, -5.0, 5.0).astype(np.float32)
        coordinates = np.where(known, targets, np.float32(np.nan))
        found = decode(
            coordinates, log_scale, lens.matrix, first_px=FIRST_CELL_PX, stride_px=STRIDE_PX
        )
        expected, _ = seen_by(found.poses, lens)
        off = np.abs(image.astype(float) - expected).max(axis=2)
        rows_of, columns_of = (np.argwhere(known).T * 8 + 7)[:, :]
        if stage.get("surfaces", True):  # points are up to half a cell off its centre
            assert np.median(off[rows_of, columns_of]) < 12
        moved.append(np.linalg.norm(found.poses.centers[0] - data.poses.centers[row]))
    if stage.get("views_share"):
        assert np.median(moved) > 0.3
    else:
        assert np.median(moved) < (0.02 if stage.get("surfaces", True) else 0.2)


def test_far_points_are_no_targets(data):
    """Points far outside the scene are no targets, while near points are."""
    model = fitted(data, STILL)
    everywhere = model.batch(data, np.arange(6), np.random.default_rng(0), 0.5)["known"]
    model.network.spread.mul_(0.25)
    model.begin_stage(STILL, data)
    near = model.batch(data, np.arange(6), np.random.default_rng(0), 0.5)
    assert 0 < near["known"].sum() < 0.9 * everywhere.sum()
    off = (near["targets"] - model.network.center[:, None, None]).norm(dim=1)[near["known"]]
    assert float(off.max()) < 4 * float(model.network.spread)


def test_a_batch_without_targets_teaches_nothing(data):
    """A batch without targets has a loss of 0 and zero gradients, not NaN."""
    model = fitted(data, STILL)
    batch = model.batch(data, np.arange(2), np.random.default_rng(0), 0.5)
    loss, figures = model.loss(batch | {"known": torch.zeros_like(batch["known"])})
    loss.backward()
    assert float(loss.detach()) == 0
    assert figures == {}
    assert all(float(p.grad.abs().max()) == 0 for p in model.parameter_groups()[0]["params"])


def test_frozen_layers_are_in_no_group(data):
    """Frozen SqueezeNet layers are in no parameter group; the others get their own learning rate."""
    model = fitted(data, {"freeze_layers": 13})
    assert [group["name"] for group in model.parameter_groups()] == ["added"]
    model.begin_stage({"freeze_layers": 5, "features_rate": 0.1}, data)
    groups = {group["name"]: group for group in model.parameter_groups()}
    assert groups["pretrained"]["rate"] == 0.1
    assert len(groups["pretrained"]["params"]) == 36
    assert len(groups["added"]["params"]) == 26


def test_published_weights_are_loaded(data):
    """Pretrained features replace random ones; the head keeps the random weights of its seed."""
    model, other = (SceneCoordinatesModel.make({}, seed) for seed in (0, 1))
    head, features = model.network.fine.weight.clone(), model.network.features[0].weight.clone()
    model.load_pretrained("squeezenet1_1-features")
    assert not torch.equal(model.network.features[0].weight, features)
    assert torch.equal(model.network.fine.weight, head)
    assert not torch.equal(other.network.fine.weight, head)


@pytest.mark.parametrize(
    ("stage", "message"),
    [
        ({"tilt": 3}, "unknown option 'tilt'"),
        ({"tilt_deg": "3"}, "tilt_deg is '3', needs a float"),
        ({"look": 1}, "look is 1, needs a bool"),
        ({"zoom_min": 2.0, "zoom_max": 1.0}, "zoom_max is 1.0, needs to be from 2.0 to 10"),
        ({"freeze_layers": 14}, "freeze_layers is 14"),
        ({"tilt_deg": float("nan")}, "needs a finite number"),
        ({"views_share": 0.5, "surfaces": False}, "needs surfaces"),
    ],
)
def test_stages_that_make_no_sense_are_refused(data, stage, message):
    """An unknown option, a wrong type or a value out of range is rejected by name."""
    with pytest.raises(InputError, match=message):
        SceneCoordinatesModel.make({}).begin_stage(stage, data)


@pytest.mark.parametrize("shrink", [1, 2])
def test_cells_of_reduced_images_lie_where_they_are_said_to(data, shrink):
    """Coordinates seen at each cell's stated pixel decode to the exact pose, for reduced images too."""
    model = fitted(data, STILL, shrink=shrink)
    images = torch.zeros(1, 3, 180, 320)
    rows, columns = model.network(images)[1].shape[2:]
    first, stride = model.network.first_cell_px, model.network.stride_px
    # An image whose values are pixel positions: cells 0 and 1 are at pixels 7 and 15 of the reduced one.
    places = (torch.arange(320) + 0.5).expand(1, 3, 180, 320)
    seen = model.network.reduced(places)[0, 0, 0]
    assert [float(seen[7]), float(seen[15])] == [first, first + stride]
    # A camera with one pixel per cell.
    near = Camera(
        "PINHOLE",
        columns,
        rows,
        np.array([230, 230, 160 - first + stride / 2, 90 - first + stride / 2]) / stride,
    )
    _, shown = seen_by(data.poses[:1], near)
    found = model.decode(
        shown.transpose(2, 0, 1).astype(np.float32), np.full((rows, columns), -5.0), CAMERA.matrix
    )
    error_m, error_deg = pose_errors(found.poses, data.poses[:1])
    assert error_m < 1e-3
    assert error_deg < 1e-2


def test_images_that_are_too_small_once_reduced_are_refused(data):
    """The error for an image too small after reduction states its size and the remedy."""
    model = fitted(data, STILL, shrink=2)
    with pytest.raises(InputError, match=r"100 x 180, reduced by 2, .* or shrink = 1"):
        model.estimate(np.zeros((1, 180, 100, 3), np.uint8), CAMERA.matrix[None])


def test_the_page_tells_all_options_and_their_defaults():
    """docs/scene-coordinates.md lists each stage option with its default."""
    page = (Path(__file__).parents[3] / "docs" / "scene-coordinates.md").read_text()
    told = {}
    for line in page.splitlines():
        cells = [re.findall("`([^`]*)`", cell) for cell in line.split("|")]
        if len(cells) == 5 and cells[1]:
            told |= dict(zip(cells[1], cells[2], strict=True))
    defaults = {f.name: f.default for f in fields(SceneStageOptions)}
    assert told.keys() == defaults.keys()
    for name, default in defaults.items():
        expected = str(default).lower() if isinstance(default, bool) else f"{default:g}"
        assert told[name].removesuffix(".0") == expected, name


def test_options_of_decoding_make_the_model():
    """The model's `options` rebuild the same model; an unknown option is rejected."""
    model = SceneCoordinatesModel.make({"cells": 300, "shrink": 1})
    assert SceneCoordinatesModel.make(model.options).network.shrink == 1
    assert SceneCoordinatesModel.make(model.options).decoding == model.decoding
    assert model.decoding.cells == 300
    with pytest.raises(InputError, match="unknown option 'cell'"):
        SceneCoordinatesModel.make({"cell": 300})


def test_images_without_points_cannot_be_learnt_from(tmp_path):
    """Too few map points raise an error that states the remedy."""
    with Dataset(write_box(tmp_path / "few.h5", train=2, points=20)) as dataset:
        few = TrainingSet(dataset.groups["train"])
    with pytest.raises(InputError, match=r"see 40 map points.*train another network"):
        SceneCoordinatesModel.make({}).fit(few)


def test_an_image_of_nothing_has_no_pose(data):
    """A uniform grey image and an unknown camera give NaN, each with its reason."""
    model = fitted(data, STILL)
    grey = np.full((2, 180, 320, 3), 128, np.uint8)
    intrinsics = np.stack([CAMERA.matrix, np.full((3, 3), np.nan)])
    found = model.estimate(grey, intrinsics)
    assert np.isnan(found.poses.centers).all()
    assert np.isnan(found.covariance).all()
    assert "only 0 cells are confident" in found.reasons[0]
    assert found.reasons[1] == "its camera is not known"


def estimates(true: Poses, errors: np.ndarray, covariance: np.ndarray) -> PoseEstimates:
    """Return estimates that differ from the truth by errors of shape (N, 6)."""
    turned = rotations_from_vectors(-errors[:, 3:]) @ true.rotations
    poses = Poses.from_rotations(true.centers - errors[:, :3], turned)
    return PoseEstimates(poses, covariance, np.full(len(errors), ""))


def test_covariances_are_scaled_by_what_is_seen_on_other_images(data):
    """Errors twice as large as stated give a factor of 4, despite a few outliers."""
    rng = np.random.default_rng(0)
    n = 400
    true = Poses.from_rotations(rng.normal(size=(n, 3)), np.repeat(np.eye(3)[None], n, axis=0))
    root = rng.normal(size=(n, 6, 6)) * [[0.1], [0.1], [0.1], [0.01], [0.01], [0.01]]
    errors = 2 * np.einsum("nij,nj->ni", root, rng.normal(size=(n, 6)))
    errors[:8, 0] = 1000
    covariance = root @ root.swapaxes(1, 2)
    found = estimates(true, errors, covariance)
    found.poses.centers[9:20] = np.nan
    assert fit_covariance_scale(found, true) == pytest.approx(4, rel=0.2)
    few = PoseEstimates(found.poses[:19], covariance[:19], found.reasons[:19])
    with pytest.raises(GeometryError, match="9 images"):
        fit_covariance_scale(few, true[:19])


def test_the_scale_of_covariances_is_part_of_the_state(data):
    """Covariance scales multiply, apply to decoded poses, and are saved in the network's state."""
    model = fitted(data, STILL)
    _, shown = seen_by(data.poses[:1])
    coordinates = shown[7::8, 7::8].transpose(2, 0, 1).astype(np.float32)
    coordinates += np.random.default_rng(0).normal(0, 0.05, coordinates.shape).astype(np.float32)
    log_scale = np.full(coordinates.shape[1:], -3.0, np.float32)
    before = model.decode(coordinates, log_scale, CAMERA.matrix)
    model.set_covariance_scale(3.0)
    model.set_covariance_scale(2.0)
    other = SceneCoordinatesModel.make({"shrink": 1})
    other.network.load_state_dict(model.network.state_dict())
    after = other.decode(coordinates, log_scale, CAMERA.matrix)
    assert other.covariance_scale == 6
    assert after.covariance == pytest.approx(6 * before.covariance)
    assert np.array_equal(after.poses.centers, before.poses.centers)


def test_bfloat16_is_for_processors_that_have_it():
    """bfloat16 support is a plain bool for this processor, and False for an unknown device."""
    assert bfloat16_is_fast("cpu") in (True, False)
    assert not bfloat16_is_fast("abacus")


@pytest.mark.slow
def test_it_learns_sixteen_images_by_heart(data):
    """The model overfits 16 images without augmentation to 0.1 m and 1 degree."""
    model = fitted(data, STILL)
    model.bfloat16 = bfloat16_is_fast("cpu")
    groups = [{**group, "lr": 0.0} for group in model.parameter_groups()]
    optimizer = torch.optim.AdamW(groups, weight_decay=0)
    generator = np.random.default_rng(0)
    steps = 250
    for step in range(steps):
        rate = 2e-3 * min(1, (step + 1) / 20) * (1 + np.cos(np.pi * step / steps)) / 2
        for group in optimizer.param_groups:
            group["lr"] = rate * group["rate"]
        loss, _ = model.loss(
            model.batch(data, generator.permutation(16)[:4], generator, step / steps)
        )
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.network.parameters(), 5.0)
        optimizer.step()
    images = np.stack([data.image(k) for k in range(16)])
    found = model.estimate(images, data.intrinsics)
    error_m, error_deg = pose_errors(found.poses, data.poses)
    assert np.median(error_m) < 0.1
    assert np.median(error_deg) < 1
    # Up of the first image is known, another one than that of its cells; none of the second.
    up = data.poses.rotations[:2, :, 2]
    known = [KnownVertical(up=tuple(-up[0]), sigma_deg=0.5), None]
    again = model.estimate(images[:2], data.intrinsics[:2], known)
    assert "contradicts the stated attitude" in again.reasons[0]
    assert again.poses.centers[1] == pytest.approx(found.poses.centers[1])
