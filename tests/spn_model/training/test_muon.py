"""Tests of the Muon optimizer: orthogonalization, step size, and resuming."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from spn_model.training.muon import Muon, orthogonalized
from spn_model.training.recipe import Recipe, Stage
from spn_model.training.train import Data, TrainingStopped, train
from tests.worlds.training_world import ONE_THREAD, Follower, files, weights

RECIPE = Recipe(
    kind="tiny",
    weights="none",
    optimizer="muon",
    options={"dropout": 0.0},
    stages=(Stage(name="all", images=600, batch=6, rate=0.02),),
)


@pytest.mark.parametrize("shape", [(8, 40), (40, 8), (16, 16), (1, 9)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_what_is_left_of_a_matrix_is_nearly_orthogonal(one_thread, shape, dtype):
    """Singular values become 0.5 to 1.3 along the same singular vectors, whatever the matrix size."""
    rows, columns = shape
    left = torch.linalg.qr(torch.randn(rows, rows))[0][:, : min(shape)]
    right = torch.linalg.qr(torch.randn(columns, columns))[0][:, : min(shape)]
    values = torch.linspace(1, 0.1, min(shape)) * 1e-5
    found = orthogonalized(left * values @ right.T, dtype)
    assert found.dtype == torch.float32
    core = left.T @ found @ right
    assert core.diagonal().min() > 0.5
    assert core.diagonal().max() < 1.3
    assert (core - torch.diag(core.diagonal())).abs().max() < 0.06


def test_nothing_is_left_of_nothing():
    """A zero matrix stays zero."""
    assert torch.equal(orthogonalized(torch.zeros(3, 5), torch.bfloat16), torch.zeros(3, 5))


@pytest.mark.parametrize("size", [1e-8, 1.0, 1e6])
def test_the_entries_of_a_step_have_the_rate_as_their_size(one_thread, size):
    """The RMS of a step is the learning rate, for any memory format and gradient size."""
    for order in (torch.contiguous_format, torch.channels_last):
        weight = torch.nn.Parameter(torch.zeros(8, 4, 3, 3).to(memory_format=order))
        weight.grad = torch.randn(8, 4, 3, 3).mul(size).to(memory_format=order)
        Muon([{"params": [weight]}], 0.01, 0.0).step()
        assert weight.detach().square().mean().sqrt() == pytest.approx(0.01, rel=0.3)
        assert (weight.detach() * weight.grad).sum() < 0


def test_both_orders_of_memory_end_alike(one_thread):
    """Both memory formats give bit-identical weights after a step."""
    gradient = torch.randn(8, 4, 3, 3)
    ends = []
    for order in (torch.contiguous_format, torch.channels_last):
        weight = torch.nn.Parameter(torch.ones(8, 4, 3, 3).to(memory_format=order))
        weight.grad = gradient.to(memory_format=order)
        Muon([{"params": [weight]}], 0.01, 0.1).step()
        ends.append(weight.detach().contiguous())
    assert torch.equal(*ends)


def test_vectors_move_as_adamw_moves_them(one_thread):
    """Vectors get the updates of AdamW over ten steps, with decay and a changing learning rate."""
    first = torch.randn(7)
    own, other = (torch.nn.Parameter(first.clone()) for _ in range(2))
    optimizers = (
        Muon([{"params": [own]}], 0.1, 0.2),
        torch.optim.AdamW([other], 0.1, weight_decay=0.2),
    )
    for k in range(10):
        own.grad = torch.randn(7)
        other.grad = own.grad.clone()
        for optimizer in optimizers:
            optimizer.param_groups[0]["lr"] = 0.1 / (k + 1)
            optimizer.step()
    assert torch.allclose(own, other, rtol=1e-5)
    assert (own - first).abs().min() > 0.01


def test_a_parameter_without_a_gradient_stays():
    """A parameter without a gradient does not change, not even by weight decay."""
    weight = torch.nn.Parameter(torch.ones(3, 3))
    Muon([{"params": [weight]}], 0.1, 0.5).step()
    assert torch.equal(weight.detach(), torch.ones(3, 3))


@pytest.mark.usefixtures("tiny_kind")
def test_a_training_goes_on_with_its_momentum(field, tmp_path):
    """Training converges, and resuming after 40 of 100 steps gives bit-identical weights."""
    follower = Follower()
    train(RECIPE, files(tmp_path / "whole"), Data(field), ONE_THREAD, follower)
    with pytest.raises(TrainingStopped):
        train(RECIPE, files(tmp_path / "again"), Data(field), ONE_THREAD, Follower(40))
    train(RECIPE, files(tmp_path / "again"), Data(field), ONE_THREAD, Follower())
    whole, again = (weights(tmp_path / of / "last.safetensors") for of in ("whole", "again"))
    assert all(torch.equal(whole[name], again[name]) for name in whole)
    judged = [row["median_m"] for row in follower.rows if row["event"] == "validation"]
    assert judged[-1] < 10  # from about 20 before training
    adam = replace(RECIPE, optimizer="adamw")
    train(adam, files(tmp_path / "adam"), Data(field), ONE_THREAD, Follower())
    other = weights(tmp_path / "adam" / "last.safetensors")
    assert not any(torch.equal(whole[name], other[name]) for name in whole if "weight" in name)
