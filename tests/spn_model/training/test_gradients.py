"""Tests of gradients of a batch in parts: the result does not depend on threads or their order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.errors import InputError
from spn_model.examples.training_set import TrainingSet
from spn_model.models.scene_coordinates import SceneCoordinatesModel
from spn_model.training.gradients import gradient_workers
from spn_model.training.machine import choose
from spn_model.training.recipe import Recipe, Stage
from spn_model.training.train import Data, TrainingStopped, train
from tests.worlds.box_world import write_box
from tests.worlds.training_world import ONE_THREAD, Follower, TinyModel, files, weights

STAGE = Stage(name="all", images=180, batch=6, parts=3, rate=0.02)
RECIPE = Recipe(
    kind="tiny", weights="none", options={"dropout": 0.0, "normalised": False}, stages=(STAGE,)
)


@pytest.fixture
def in_parts(tiny_kind: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TinyModel, "has_parts", True)


@pytest.fixture(scope="module")
def model_and_parts(tmp_path_factory: pytest.TempPathFactory):
    """Return a scene-coordinate model and two parts of a batch with different sizes."""
    with Dataset(write_box(tmp_path_factory.mktemp("hall") / "hall.h5", train=6)) as dataset:
        data = TrainingSet(dataset.groups["train"])
    model = SceneCoordinatesModel.make({}, seed=1)
    model.load_pretrained(model.weights_name)
    model.fit(data)
    model.begin_stage({}, data)
    rng = np.random.default_rng(0)
    parts = [model.batch(data, np.array(rows), rng, 1.0) for rows in ([0, 1, 2, 3], [4, 5])]
    return model, parts


def gradient(model, parts, threads: int) -> tuple[float, list[torch.Tensor]]:
    parameters = [p for group in model.parameter_groups() for p in group["params"]]
    machine = choose("cpu", threads, "float32", makes_batches=True)
    with gradient_workers(model, parameters, len(parts), machine) as computing:
        loss, _ = computing.compute(parts)
    return float(loss), [p.grad for p in parameters]


def test_the_gradient_of_a_batch_is_the_mean_of_its_parts(model_and_parts):
    """Gradient and loss are the means of those computed for each part separately."""
    model, parts = model_and_parts
    loss, found = gradient(model, parts, 1)
    parameters = [p for group in model.parameter_groups() for p in group["params"]]
    alone = []
    for part in parts:
        for parameter in parameters:
            parameter.grad = None
        one, _ = model.loss(part)
        one.backward()
        alone.append((float(one.detach()), [p.grad for p in parameters]))
    assert loss == pytest.approx((alone[0][0] + alone[1][0]) / 2, rel=1e-6)
    for mean, first, second in zip(found, alone[0][1], alone[1][1], strict=True):
        torch.testing.assert_close(mean, (first + second) / 2)


def test_threads_compute_the_gradient_of_one(model_and_parts, one_thread):
    """Two threads repeatedly give the bit-identical gradient of one, despite parts of different size."""
    model, parts = model_and_parts
    _, alone = gradient(model, parts, 1)
    for _ in range(5):
        _, together = gradient(model, parts, 2)
        assert all(torch.equal(a, b) for a, b in zip(alone, together, strict=True))


@pytest.mark.parametrize("threads", [1, 2])
def test_a_training_in_parts_goes_on_to_the_same_end(field, in_parts, tmp_path, threads):
    """A resumed training in parts matches an uninterrupted one, with one or two threads."""
    train(RECIPE, files(tmp_path / "whole"), Data(field), ONE_THREAD, Follower())
    options = replace(ONE_THREAD, threads=threads)
    with pytest.raises(TrainingStopped):
        train(RECIPE, files(tmp_path / "cut"), Data(field), options, Follower(11))
    train(RECIPE, files(tmp_path / "cut"), Data(field), options, Follower())
    whole, cut = (weights(tmp_path / name / "last.safetensors") for name in ("whole", "cut"))
    assert all(torch.equal(whole[name], cut[name]) for name in whole)


def test_parts_draw_the_images_of_a_whole_batch(field, in_parts, tmp_path):
    """Without augmentation, training in parts matches training with whole batches up to rounding."""
    train(RECIPE, files(tmp_path / "parts"), Data(field), ONE_THREAD, Follower())
    recipe = replace(RECIPE, stages=(replace(STAGE, parts=1),))
    train(recipe, files(tmp_path / "whole"), Data(field), ONE_THREAD, Follower())
    parts, whole = (weights(tmp_path / name / "last.safetensors") for name in ("parts", "whole"))
    for name in whole:
        if name != "variance":  # from a few validation frames: a ratio of small errors
            torch.testing.assert_close(parts[name], whole[name], rtol=1e-4, atol=1e-5)


def test_a_network_with_statistics_of_the_batch_has_no_parts(field, tmp_path):
    """A pose regressor, which normalises over the whole batch, rejects parts before training."""
    recipe = replace(RECIPE, kind="regression", options={})
    with pytest.raises(InputError, match="cannot split a batch: parts needs to be 1"):
        train(recipe, files(tmp_path), Data(field), ONE_THREAD, Follower())
