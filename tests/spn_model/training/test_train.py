"""Tests of the training loop on a small field: convergence, resuming after a kill, and divergence."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import Role
from spn_data.dataset.hdf5_writer import DatasetWriter
from spn_data.errors import FormatError, InputError, StageError
from spn_data.geometry.pose import Poses
from spn_model.evaluation.validation import spread_rows, validate
from spn_model.examples.dataset_view import view_of
from spn_model.examples.held_out_views import HeldOutViews
from spn_model.examples.training_set import TrainingSet
from spn_model.models.checkpoint import load
from spn_model.models.pose_model import PoseEstimates
from spn_model.training.batches import generator_of_step, rows_of_step, torch_seed_of_step
from spn_model.training.covariance_scale import fit_covariance_scale
from spn_model.training.recipe import Recipe, Stage
from spn_model.training.train import Data, TrainingStopped, train
from spn_model.training.training_loss import Diverged, LossMonitor
from spn_model.training.training_record import Record, select_validation_frames
from spn_model.training.training_state import COLUMNS, Log, Position, read_state
from tests.worlds.training_world import (
    INFO,
    ONE_THREAD,
    Follower,
    TinyModel,
    files,
    frame,
    log,
    weights,
    write_field,
)

pytestmark = pytest.mark.usefixtures("tiny_kind")

ROOT = Path(__file__).resolve().parents[3]
FREEZE = {"frozen": True, "brightness": 0.05}
RECIPE = Recipe(
    kind="tiny",
    weights="none",
    stages=(
        Stage(name="head", images=60, batch=5, rate=0.02, warmup_steps=3, options=FREEZE),
        Stage(name="all", images=240, batch=6, rate=0.02, options={"brightness": 0.05}),
    ),
)


@pytest.fixture(scope="module")
def unbroken(field: Path, tiny_kind: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of an uninterrupted training."""
    folder = tmp_path_factory.mktemp("unbroken")
    train(RECIPE, files(folder), Data(field), ONE_THREAD, Follower())
    return folder


def test_a_training_learns_where_the_camera_is(field, tmp_path):
    """Training on 6000 images reduces the validation error from about 20 m to less than 4 m."""
    recipe = replace(RECIPE, stages=(Stage(name="all", images=6000, batch=12, rate=0.03),))
    follower = Follower()
    facts = train(recipe, files(tmp_path), Data(field), ONE_THREAD, follower)
    judged = [row["median_m"] for row in follower.rows if row["event"] == "validation"]
    assert len(judged) == 4
    assert judged[-1] < 4
    found = load(tmp_path / "checkpoint.safetensors")
    assert found.facts["kept"] == facts["kept"]
    with Dataset(field) as dataset:
        group = dataset.groups["validation"]
        errors, _ = validate(found.model, group, np.arange(len(group)))
    assert errors.median_m == pytest.approx(facts["kept"]["validation"]["median_m"], rel=1e-5)


def test_two_trainings_of_one_seed_are_the_same(field, unbroken, tmp_path):
    """Two trainings with one seed are bit-identical; another seed gives another network."""
    train(RECIPE, files(tmp_path / "a"), Data(field), ONE_THREAD, Follower())
    train(RECIPE, files(tmp_path / "b"), Data(field), replace(ONE_THREAD, seed=6), Follower())
    first, same, other = (
        weights(folder / "last.safetensors")
        for folder in (unbroken, tmp_path / "a", tmp_path / "b")
    )
    assert all(torch.equal(first[name], same[name]) for name in first)
    assert not torch.equal(first["out.weight"], other["out.weight"])


@pytest.mark.parametrize("steps", [1, 7, 12, 30])
def test_a_stopped_training_goes_on_to_the_same_end(field, unbroken, tmp_path, steps):
    """A resumed training gives the same weights and errors as an uninterrupted one.

    It is stopped within, at the end of, and after the first stage.
    """
    with pytest.raises(TrainingStopped):
        train(RECIPE, files(tmp_path), Data(field), ONE_THREAD, Follower(steps))
    state = read_state(tmp_path / "state.safetensors")
    assert state is not None
    assert state.position.steps == steps + 1
    facts = train(RECIPE, files(tmp_path), Data(field), ONE_THREAD, Follower())
    assert facts["steps"] == 12 + 40
    for name in ("last.safetensors", "checkpoint.safetensors"):
        whole, resumed = weights(unbroken / name), weights(tmp_path / name)
        assert all(torch.equal(whole[key], resumed[key]) for key in whole)
    judged = [
        [r["median_m"] for r in log(f) if r["event"] == "validation"] for f in (unbroken, tmp_path)
    ]
    assert judged[0] == judged[1]


KILLED = """
import sys, time
from pathlib import Path
from tests.spn_model.training.test_train import *
from tests.worlds.training_world import register_tiny
from spn_model.training import train as module
register_tiny()
module._SAVE_EVERY_S = 0.0

class Slow(Follower):
    def wants_stop(self):
        time.sleep(0.03)
        return False

torch.set_num_threads(1)
train(RECIPE, files(Path(sys.argv[1])), Data(Path(sys.argv[2])), ONE_THREAD, Slow())
"""


@pytest.mark.slow
def test_a_training_killed_with_signal_9_goes_on_to_the_same_end(field, unbroken, tmp_path):
    """A training killed three times at different steps ends bit-identical to an uninterrupted one."""
    command = [sys.executable, "-c", KILLED, str(tmp_path), str(field)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    reached = []
    for enough in (5, 17, 33):
        process = subprocess.Popen(command, cwd=ROOT, env=environment)
        try:
            deadline = time.monotonic() + 60
            while time.monotonic() < deadline:
                assert process.poll() is None, "it ended before it was killed"
                state = read_state(tmp_path / "state.safetensors")
                if state is not None and state.position.steps >= enough:
                    break
                time.sleep(0.02)
        finally:
            process.send_signal(signal.SIGKILL)
            process.wait(timeout=10)
        reached.append(read_state(tmp_path / "state.safetensors").position.steps)
    assert 5 <= reached[0] < reached[1] < reached[2] < 52
    train(RECIPE, files(tmp_path), Data(field), ONE_THREAD, Follower())
    whole, resumed = weights(unbroken / "last.safetensors"), weights(tmp_path / "last.safetensors")
    assert all(torch.equal(whole[name], resumed[name]) for name in whole)
    steps = [int(row["step"]) for row in log(tmp_path) if row["event"] == "validation"]
    assert steps == [int(r["step"]) for r in log(unbroken) if r["event"] == "validation"]


ALIKE = replace(
    RECIPE,
    options={"dropout": 0.0, "normalised": False},
    optimizer="sgd",  # unlike Adam, distinguishes the mean of gradients from their sum
    stages=(Stage(name="all", images=240, batch=4, rate=0.05),),
)
SHARED = """
import sys
from tests.spn_model.training.test_train import *
from tests.worlds.training_world import register_tiny
register_tiny()
torch.set_num_threads(1)
follower = Follower()
train(ALIKE, files(Path(sys.argv[1])), Data(Path(sys.argv[2])), ONE_THREAD, follower)
print(len(follower.rows))
"""


@pytest.mark.slow
def test_two_processes_make_the_network_of_one_with_batches_twice_as_large(field, tmp_path):
    """Two processes that average gradients over gloo match one process with twice the batch size.

    Each process gets half of a batch, and only the first one writes.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    world = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    command = [sys.executable, "-c", SHARED, str(tmp_path / "two"), str(field)]
    started = [
        subprocess.Popen(
            command,
            cwd=ROOT,
            env={**os.environ, **world, "RANK": rank, "LOCAL_RANK": rank, "OMP_NUM_THREADS": "1"},
            stdout=subprocess.PIPE,
            text=True,
        )
        for rank in "01"
    ]
    try:
        said = [process.communicate(timeout=100)[0] for process in started]
    finally:
        for process in started:
            process.kill()
    assert [process.returncode for process in started] == [0, 0]
    assert int(said[0]) > 0
    assert int(said[1]) == 0
    whole = replace(ALIKE, stages=(replace(ALIKE.stages[0], batch=8),))
    train(whole, files(tmp_path / "one"), Data(field), ONE_THREAD, Follower())
    two, one = (load(tmp_path / name / "last.safetensors") for name in ("two", "one"))
    assert two.facts["images_shown"] == one.facts["images_shown"] == 240
    assert two.facts["processes"] == 2
    state, other = two.model.network.state_dict(), one.model.network.state_dict()
    for name in state:
        if name != "variance":  # from a few validation frames: a ratio of small errors
            assert torch.allclose(state[name], other[name], rtol=1e-4, atol=1e-5), name


def test_the_log_tells_training_and_validation_apart(unbroken):
    """Every log row has all columns; training and validation seconds accumulate separately."""
    rows = log(unbroken)
    assert list(rows[0]) == list(COLUMNS)
    assert [r["stage"] for r in rows if r["event"] == "validation"] == ["head", "all", "all", "all"]
    for name in ("train_s", "validate_s", "images"):
        values = [float(row[name]) for row in rows]
        assert values == sorted(values)
        assert values[-1] > 0
    assert int(rows[-1]["images"]) == 60 + 240
    trained = [row for row in rows if row["event"] == "training"]
    assert {row["frames"] for row in trained} == {"16"}
    assert all("position=" in row["figures"] for row in rows if row["event"] == "steps")


def test_a_budget_in_minutes_ends_a_training(field, tmp_path):
    """A budget of 0.02 minutes ends training after 1.2 s, plus at most one step."""
    recipe = RECIPE.with_budget(None, 0.02)
    facts = train(recipe, files(tmp_path), Data(field), ONE_THREAD, Follower())
    assert 1.2 <= facts["train_s"] < 1.8


def test_judging_does_not_count_as_training(field, tmp_path, monkeypatch):
    """Slow validation does not count as training time; both times are reported separately."""
    quick = TinyModel.estimate

    def slow(self: TinyModel, images: np.ndarray, intrinsics: np.ndarray) -> PoseEstimates:
        time.sleep(0.1)
        return quick(self, images, intrinsics)

    monkeypatch.setattr(TinyModel, "estimate", slow)
    recipe = replace(RECIPE, stages=RECIPE.stages[1:])
    often = replace(ONE_THREAD, validations=8)
    facts = train(recipe, files(tmp_path), Data(field), often, Follower())
    assert facts["validate_s"] > 8 * 3 * 0.1  # 6 validation and 16 training frames, in batches of 8
    assert facts["train_s"] < 0.7 * facts["validate_s"]


def test_the_best_network_is_kept_and_the_later_of_two_alike(field, tmp_path):
    """A much worse network does not replace the best one; one that is 2 % worse does."""
    model = TinyModel.make({"dropout": 0.0}, 5)
    with Dataset(field) as dataset:
        training = dataset.groups["train"]
        model.fit(TrainingSet(training))
        judged = select_validation_frames(dataset, training, 64, 4)
        record = Record(
            *(files(tmp_path), Follower(), model, view_of(dataset), judged, Position(), {})
        )
        with closing(record):
            kept = []
            for shift_m in (0.0, 30.0, 0.2):
                with torch.no_grad():
                    before = model.network.center.clone()
                    model.network.center += shift_m
                record.position.steps += 1
                record.validate("all", 0.5)
                kept.append(load(tmp_path / "checkpoint.safetensors").facts["steps"])
                model.network.center.copy_(before)
    medians = [row["median_m"] for row in record.watch.rows if row["event"] == "validation"]
    assert medians[1] > 1.5 * medians[0]
    assert medians[0] < medians[2] < 1.05 * medians[0]
    assert kept == [1, 1, 3]


def test_covariances_are_scaled_by_views_that_are_not_trained_on(tmp_path, monkeypatch):
    """If a stage renders views, covariances are scaled to held-out views instead of validation frames.

    Each stage renders its own views.
    """
    stages = []

    def views(self: TinyModel, data: TrainingSet, count: int) -> HeldOutViews:
        stages.append(len(data))
        shown = 12
        poses = data.poses[:shown]
        moved = Poses(poses.centers + 30.0, poses.quats_wxyz)
        return HeldOutViews(
            moved, data.intrinsics[:shown], [data.image(k) for k in range(shown)], 1
        )

    monkeypatch.setattr(TinyModel, "held_out_views", views)
    field = write_field(tmp_path / "dataset.h5", validation=12)
    facts = train(RECIPE, files(tmp_path), Data(field), ONE_THREAD, Follower())
    judged = [row["stage"] for row in log(tmp_path) if row["event"] == "views"]
    assert judged == ["head", "all", "all", "all"]
    assert len(stages) == 2
    assert facts["latest"]["views"]["frames"] == 12
    last = load(tmp_path / "last.safetensors").model
    with Dataset(field) as dataset:
        shown = views(last, TrainingSet(dataset.groups["train"]), 64)
        assert fit_covariance_scale(
            validate(last, shown, np.arange(12))[1], shown.poses
        ) == pytest.approx(1)
        rows = np.arange(12)
        validation = dataset.groups["validation"]
        of_validation = fit_covariance_scale(
            validate(last, validation, rows)[1], validation.poses[rows]
        )
    assert not 0.5 < of_validation < 2


def test_frames_of_places_that_no_training_image_shows_do_not_judge(tmp_path):
    """Validation frames without points in common with training frames are not used for validation.

    If too few frames remain (here 5 of 24), all are used.
    """
    for strange, expected in ((12, 12), (19, 24)):
        path = tmp_path / f"{strange}.h5"
        with DatasetWriter(
            path, INFO, {"train": Role.TRAIN, "validation": Role.VALIDATION}
        ) as writer:
            for k in range(6):
                writer.append("train", frame("train", k))
            for k in range(24):
                seen = frame("validation", k)
                ids = seen.point_ids + (1000 if k < strange else 0)
                writer.append("validation", replace(seen, point_ids=ids))
        with Dataset(path) as dataset:
            judged = select_validation_frames(dataset, dataset.groups["train"], 64, 4)
        assert [one.event for one in judged] == ["validation", "training"]
        assert len(judged[0].rows) == expected
        if expected == 12:
            assert judged[0].rows.min() == 12


@pytest.mark.parametrize("at", [0.0, 0.6])
def test_a_training_that_turns_to_nan_stops(field, tmp_path, at):
    """A NaN loss stops training with a message that says whether an earlier checkpoint is kept."""
    stage = Stage(name="sick", images=240, batch=6, rate=0.02, options={"sick_at": at})
    told = "the checkpoint after 20 steps is kept" if at else "there is no checkpoint yet"
    with pytest.raises(StageError, match=f"diverged after .* steps: the loss is nan.*{told}"):
        train(
            replace(RECIPE, stages=(stage,)), files(tmp_path), Data(field), ONE_THREAD, Follower()
        )
    assert (tmp_path / "checkpoint.safetensors").exists() == (at > 0)
    if at:
        assert load(tmp_path / "checkpoint.safetensors").facts["steps"] == 20


def test_a_loss_far_above_its_beginning_is_seen():
    """A noisy loss is accepted; a hundredfold increase is detected within 100 steps."""
    rng = np.random.default_rng(0)
    sound, sick = LossMonitor(1), LossMonitor(1)
    for k in range(400):
        value = torch.tensor(3 * np.exp(-k / 100) - 4 + rng.normal())
        sound.add(value, torch.tensor(1.0), {})
    assert sound.means()["loss"] < 0
    for _ in range(60):
        sick.add(torch.tensor(5.0), torch.tensor(1.0), {})

    def grow() -> None:
        for _ in range(90):
            sick.add(torch.tensor(500.0), torch.tensor(1.0), {})

    with pytest.raises(Diverged, match="rose from"):
        grow()


def test_another_training_set_is_refused(tmp_path):
    """A data set without training frames, one with two training groups, and a missing file are rejected."""
    empty = tmp_path / "empty.h5"
    with DatasetWriter(empty, INFO, {"train": Role.TRAIN, "low": Role.TEST}) as writer:
        writer.append("low", frame("low", 0))
    two = tmp_path / "two.h5"
    with DatasetWriter(two, INFO, {"train": Role.TRAIN, "more": Role.TRAIN}) as writer:
        for group in ("train", "more"):
            writer.append(group, frame(group, 0))
    for path, told in (
        (empty, "there is nothing to train on"),
        (two, "has 2 groups of training frames, exactly one is needed"),
        (tmp_path / "none.h5", "does not exist"),
    ):
        with pytest.raises(InputError, match=told):
            train(RECIPE, files(tmp_path / path.stem), Data(path), ONE_THREAD, Follower())


def test_a_kind_of_network_hears_how_long_a_stage_is(field, tmp_path, monkeypatch):
    """`begin_stage` receives the number of images that each stage draws."""
    heard = []
    begin = TinyModel.begin_stage
    monkeypatch.setattr(TinyModel, "begin_stage", lambda *of: (heard.append(of[3]), begin(*of)))
    train(RECIPE, files(tmp_path), Data(field), ONE_THREAD, Follower())
    assert heard == [60, 240]


def test_pretraining_takes_its_own_data_set(field, tmp_path):
    """The first stage trains on the pretraining data set, the second on the area's.

    Targets are those of the area, and the weights of the first stage are kept.
    """
    other = write_field(tmp_path / "other.h5", 7, 2)
    stages = tuple(
        replace(s, data=d) for s, d in zip(RECIPE.stages, ("pretraining", "area"), strict=True)
    )
    recipe = replace(RECIPE, stages=stages)
    train(recipe, files(tmp_path / "a"), Data(field, other), ONE_THREAD, Follower())
    train(RECIPE, files(tmp_path / "b"), Data(field), ONE_THREAD, Follower())
    mine, plain = (weights(tmp_path / name / "last.safetensors") for name in "ab")
    assert torch.equal(mine["center"], plain["center"])
    assert not torch.equal(mine["out.weight"], plain["out.weight"])
    train(recipe, files(tmp_path / "c"), Data(field), ONE_THREAD, Follower())
    same = weights(tmp_path / "c" / "last.safetensors")
    assert all(torch.equal(plain[name], same[name]) for name in plain)


def test_a_frozen_layer_stays_and_others_move(field, tmp_path):
    """A stage that freezes the first convolution leaves it unchanged and trains other layers."""
    recipe = replace(RECIPE, stages=RECIPE.stages[:1])
    train(recipe, files(tmp_path), Data(field), ONE_THREAD, Follower())
    new = TinyModel.make({}, 5).network.state_dict()
    trained = weights(tmp_path / "last.safetensors")
    assert torch.equal(new["convolution.weight"], trained["convolution.weight"])
    assert not torch.equal(new["out.weight"], trained["out.weight"])


def test_a_state_of_another_training_is_refused(field, tmp_path):
    """The state of another network and a damaged state are rejected."""
    with pytest.raises(TrainingStopped):
        train(RECIPE, files(tmp_path), Data(field), ONE_THREAD, Follower(3))
    wider = replace(RECIPE, options={"width": 9})
    with pytest.raises(FormatError, match="belongs to another network"):
        train(wider, files(tmp_path), Data(field), ONE_THREAD, Follower(3))
    state = tmp_path / "state.safetensors"
    state.write_bytes(state.read_bytes()[:300])
    with pytest.raises(FormatError, match="or damaged"):
        train(RECIPE, files(tmp_path), Data(field), ONE_THREAD, Follower(3))


def test_the_log_of_redone_steps_is_cut_off(tmp_path):
    """Rows written after the last saved state are removed on resuming, so none is duplicated."""
    log_file = Log(tmp_path / "log.csv", 0)
    kept = log_file.write({"event": "steps", "step": 1, "loss": 0.5})
    log_file.write({"event": "steps", "step": 2})
    log_file.close()
    again = Log(tmp_path / "log.csv", kept)
    again.write({"event": "validation", "step": 2})
    again.close()
    assert [row["event"] for row in log(tmp_path)] == ["steps", "validation"]


def test_every_image_comes_once_an_epoch():
    """Every image is drawn once per epoch, in a different order each time.

    This holds for batches that do not divide the number of images, and for several processes.
    """
    rows = np.concatenate([rows_of_step(10, 4, k, 3, 0) for k in range(5)])
    assert sorted(rows[:10]) == sorted(rows[10:]) == list(range(10))
    assert list(rows[:10]) != list(rows[10:])
    both = [rows_of_step(10, 2, k, 3, 0, rank=r, world=2) for k in range(5) for r in (0, 1)]
    assert np.array_equal(np.concatenate(both), rows)
    assert sorted(rows_of_step(3, 7, 0, 0, 0)) == [0, 0, 0, 1, 1, 2, 2] or len(rows) == 20


def test_what_is_random_differs_between_steps_stages_and_processes():
    """Random seeds differ between steps, stages and processes, and are the same for the same step."""
    keys = [(1, 0, 5, 0), (2, 0, 5, 0), (1, 1, 5, 0), (1, 0, 6, 0), (1, 0, 5, 1)]
    assert len({generator_of_step(*key).integers(2**60) for key in keys}) == len(keys)
    assert len({torch_seed_of_step(*key) for key in keys}) == len(keys)
    assert generator_of_step(1, 0, 5).integers(9**9) == generator_of_step(1, 0, 5).integers(9**9)


def test_spread_rows_hold_the_ends():
    """Selected rows include the first and the last, without duplicates."""
    assert list(spread_rows(5, 64)) == [0, 1, 2, 3, 4]
    assert list(spread_rows(100, 3)) == [0, 50, 99]
    assert list(spread_rows(1, 4)) == [0]
