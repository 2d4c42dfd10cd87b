"""Tests of a stage that also trains on validation frames, which then no longer count as held-out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.errors import InputError
from spn_model.evaluation.evaluate import EvaluateOptions, compare
from spn_model.examples.training_set import TrainingSet
from spn_model.models.checkpoint import load
from spn_model.training.recipe import ALL, Recipe, Stage, read_recipe
from spn_model.training.train import Data, TrainingStopped, train
from tests.worlds.training_world import ONE_THREAD, Follower, TinyModel, files, log

pytestmark = pytest.mark.usefixtures("tiny_kind")

HELD_OUT = Stage(name="held out", images=60, batch=6, rate=0.02)
RECIPE = Recipe(
    kind="tiny",
    weights="none",
    stages=(HELD_OUT, replace(HELD_OUT, name="all", images=120, frames=ALL)),
)


@pytest.fixture
def rows_seen(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, set[int]]]:
    """Return the sizes of training sets with the rows used in batches."""
    seen: list[tuple[int, set[int]]] = []
    made = TinyModel.batch

    def batch(self, data, rows, generator, progress):
        if not seen or seen[-1][0] != len(data):
            seen.append((len(data), set()))
        seen[-1][1].update(rows.tolist())
        return made(self, data, rows, generator, progress)

    monkeypatch.setattr(TinyModel, "batch", batch)
    return seen


def test_several_groups_are_one_training_set(field):
    """Rows of the second group follow those of the first, with matching images, poses and points."""
    with Dataset(field) as dataset:
        first, second = dataset.groups["train"], dataset.groups["validation"]
        both = TrainingSet(first, second, memory_bytes=64 * 48 * 3 * 26)
        assert len(both) == 24 + 6
        for row, group, k in ((3, first, 3), (24, second, 0), (29, second, 5)):
            np.testing.assert_array_equal(both.image(row), group.image(k))
            np.testing.assert_array_equal(both.poses.centers[row], group.poses.centers[k])
            np.testing.assert_array_equal(both.points(row).xyz, group.points(k).xyz)


def test_the_last_stage_learns_what_was_held_out(field, tmp_path, rows_seen):
    """The first stage uses 24 training frames, the last one also the 6 validation frames."""
    train(RECIPE, files(tmp_path), Data(field), ONE_THREAD, Follower())
    assert [(count, len(rows)) for count, rows in rows_seen] == [(24, 24), (30, 30)]


@pytest.mark.parametrize("steps", [4, 9, 15])
def test_validation_frames_judge_until_they_are_learnt(field, tmp_path, steps):
    """Validation errors are reported only for the stage that holds validation frames out.

    This holds if training is interrupted in either stage, and the final network is the one kept.
    """
    with pytest.raises(TrainingStopped):
        train(RECIPE, files(tmp_path), Data(field), ONE_THREAD, Follower(steps))
    facts = train(RECIPE, files(tmp_path), Data(field), ONE_THREAD, Follower())
    rows = log(tmp_path)
    assert {row["stage"] for row in rows if row["event"] == "validation"} == {"held out"}
    assert {row["stage"] for row in rows if row["event"] == "training"} == {"held out", "all"}
    judged = [row for row in rows if row["event"] == "validation"]
    assert facts["latest"].keys() == facts["kept"].keys() - {"stage", "steps", "drawn"}
    assert facts["latest"].keys() == {"held out", "training"}
    assert facts["latest"]["held out"]["median_m"] == pytest.approx(
        float(judged[-1]["median_m"]), rel=1e-4
    )
    assert facts["kept"]["steps"] == facts["steps"] == 30
    assert facts["trained_on"] == ["train", "validation"]


def test_evaluating_says_which_frames_a_network_was_trained_on(field, tmp_path):
    """A note marks the network that was also trained on validation frames, and only that one."""
    train(RECIPE, files(tmp_path / "all"), Data(field), ONE_THREAD, Follower())
    held_out = replace(RECIPE, stages=(HELD_OUT,))
    train(held_out, files(tmp_path / "held out"), Data(field), ONE_THREAD, Follower())
    networks = {
        name: load(tmp_path / name / "checkpoint.safetensors") for name in ("all", "held out")
    }
    found = compare(field, networks, ("3-geo",), lambda *_: None, EvaluateOptions(baselines=False))
    told = [note for note in found.notes if "was also trained on validation" in note]
    assert len(told) == 1
    assert told[0].startswith("all ")


def test_other_frames_than_these_are_refused(tmp_path):
    """A recipe that would train on test frames is rejected with its line number."""
    path = tmp_path / "mine.toml"
    path.write_text('kind = "tiny"\n[[stages]]\nimages = 5\nframes = "test"\n')
    with pytest.raises(InputError, match=r":4: frames is 'test', needs to be training or all"):
        read_recipe(str(path))
