"""Tests that benchmarks/training_speed.py gives all its loops the same work."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import pytest
import torch

from spn_model.training.machine import choose, limited_threads
from tests.worlds.training_world import write_field

BENCHMARKS = Path(__file__).resolve().parents[3] / "benchmarks"
TOML = 'kind = "tiny"\nweights = "none"\n[[stages]]\nimages = 1000\nbatch = 5\n'


@pytest.fixture
def benchmark(tiny_kind: None, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("training_speed")


def test_every_loop_takes_the_same_steps(benchmark, tmp_path, monkeypatch):
    """Each loop runs the same 4 steps with identical batches of 5 images."""
    (tmp_path / "5-split").mkdir()
    write_field(tmp_path / "5-split" / "dataset.h5", 7, 2)
    recipe = tmp_path / "tiny.toml"
    recipe.write_text(TOML)
    seen: list[torch.Tensor] = []
    loss = benchmark.make("tiny", {}).__class__.loss

    def watched(model, batch):
        seen.append(batch["images"].clone())
        return loss(model, batch)

    monkeypatch.setattr("tests.worlds.training_world.TinyModel.loss", watched)
    machine = choose("cpu", 1, "float32", makes_batches=True)
    with limited_threads(machine):
        found = benchmark.measure(tmp_path, str(recipe), machine, 4, 1)
    assert found["images_per_round"] == 20
    assert set(found["loops"]) == {"loop", "bare", "in turns"}
    assert len(seen) == 4 * 4
    for first, *others in zip(seen[:4], seen[4:8], seen[8:12], seen[12:], strict=True):
        assert all(torch.equal(first, other) for other in others)
    for (one,) in found["loops"].values():
        assert one.images_per_s > 0
        assert 0 < one.stepping_ms <= one.all_threads_ms * 1.05
