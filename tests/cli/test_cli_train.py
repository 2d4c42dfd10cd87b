"""`spn-model train`: run folder, resuming, and refusal to overwrite."""

from __future__ import annotations

import errno
import json
import os
import re
import signal
import threading
import time
from pathlib import Path

import click
import pytest
import torch
from click.testing import CliRunner, Result
from spn_cli.model import main
from spn_cli.train import train

from spn_data.dataset.hdf5_reader import DatasetGroup
from spn_model.models.checkpoint import load
from spn_model.training.training_state import COLUMNS
from tests.worlds.training_world import TINY_RECIPE, TinyModel, register_tiny, write_field

pytestmark = pytest.mark.usefixtures("tiny_kind")


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with dataset.h5 and tiny.toml."""
    write_field(tmp_path / "dataset.h5", 12, 3)
    (tmp_path / "tiny.toml").write_text(TINY_RECIPE)
    return tmp_path


def trained(place: Path, *words: str) -> Result:
    """Run `spn-model train` with the tiny recipe on the CPU."""
    given = ["--area", str(place / "area"), "--recipe", str(place / "tiny.toml"), "--device", "cpu"]
    fixed = ["--threads", "1", "--precision", "float32", "--validations", "2", *words]
    return CliRunner().invoke(main, ["train", str(place / "dataset.h5"), *given, *fixed])


def test_a_run_has_all_that_it_takes_to_repeat_it(place):
    """runs/<recipe> contains checkpoint, log and configuration; the output ends with a table of errors."""
    ran = trained(place, "--seed", "3")
    assert ran.exit_code == 0, ran.output
    folder = place / "area" / "runs" / "tiny"
    assert sorted(path.name for path in folder.iterdir()) == [
        ".lock",
        "checkpoint.safetensors",
        "config.json",
        "last.safetensors",
        "log.csv",
    ]
    config = json.loads((folder / "config.json").read_text())
    assert config["options"]["seed"] == 3
    assert [stage["images"] for stage in config["options"]["stages"]] == [40, 120]
    assert config["facts"]["steps"] == 8 + 20
    assert config["inputs"].keys() == {"data set"}
    assert load(folder / "checkpoint.safetensors").facts["seed"] == 3
    table = ran.output[ran.output.index("Errors") :]
    assert ": spn-model evaluate " in table
    assert "validation, kept" in table
    assert "3 of 3" in table


def test_a_finished_run_is_left_as_it_is(place):
    """The same command, with or without --overwrite, prints the table again and writes nothing."""
    trained(place)
    checkpoint = place / "area" / "runs" / "tiny" / "checkpoint.safetensors"
    before = checkpoint.stat().st_mtime_ns
    for words in ((), ("--overwrite",)):
        again = trained(place, *words)
        assert again.exit_code == 0
        assert "is already trained" in again.output
        assert "validation, kept" in again.output
    assert checkpoint.stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--seed", "1"), "was made with seed = 0, now 1"),
        (("--images", "80"), "was made with stages = "),
        (("--validations", "3"), "was made with validations = 2, now 3"),
        (("--precision", "bfloat16"), "was made with precision = 'float32', now 'bfloat16'"),
    ],
)
def test_another_option_over_a_run_is_refused(place, words, told):
    """A changed option is refused with the difference; --overwrite or another --run trains."""
    assert trained(place).exit_code == 0
    refused = trained(place, *words)
    assert refused.exit_code == 1
    assert told in refused.output
    assert "use --overwrite to train again, or another --run to keep it" in refused.output
    assert trained(place, *words, "--run", "b").exit_code == 0
    anew = trained(place, *words, "--overwrite")
    assert anew.exit_code == 0
    assert "is already trained" in trained(place, *words).output


def test_another_data_set_over_a_run_is_refused(place):
    """A run is not continued with a different dataset."""
    assert trained(place).exit_code == 0
    write_field(place / "dataset.h5", 13, 3)
    refused = trained(place)
    assert refused.exit_code == 1
    assert "used a different data set" in refused.output


def test_ctrl_c_keeps_the_state_and_the_same_command_goes_on(place):
    """After Ctrl-C the same command resumes, and the weights equal those of an uninterrupted run."""
    whole = trained(place, "--run", "whole", "--images", "1600")
    assert whole.exit_code == 0
    folder = place / "area" / "runs" / "cut"

    def interrupt() -> None:
        while not (folder / "checkpoint.safetensors").exists():
            if not alive.wait(0.002):
                continue
            return
        os.kill(os.getpid(), signal.SIGINT)

    alive = threading.Event()
    thread = threading.Thread(target=interrupt)
    thread.start()
    try:
        cut = trained(place, "--run", "cut", "--images", "1600")
    finally:
        alive.set()
        thread.join()
    assert cut.exit_code == 130, cut.output
    assert "run the same command to resume" in cut.output
    assert (folder / "state.safetensors").exists()
    resumed = trained(place, "--run", "cut", "--images", "1600")
    assert resumed.exit_code == 0, resumed.output
    assert "Resuming the interrupted training" in resumed.output
    both = [
        load(place / "area" / "runs" / name / "last.safetensors").model.network.state_dict()
        for name in ("whole", "cut")
    ]
    assert all(torch.equal(both[0][name], both[1][name]) for name in both[0])
    assert not (folder / "state.safetensors").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("moment", ["reading the data set", "validation"])
def test_a_first_signal_outside_the_steps_stops_at_once(place, monkeypatch, number, moment):
    """The first signal while images are read or validated stops there, and the resumed run is the same."""
    whole = trained(place, "--run", "whole")
    assert whole.exit_code == 0
    images = []
    inner = DatasetGroup.image if moment == "reading the data set" else TinyModel.estimate

    def interrupted(*arguments):
        images.append(1)
        if len(images) == 2:
            os.kill(os.getpid(), number)
        return inner(*arguments)

    if moment == "validation":
        monkeypatch.setattr(TinyModel, "estimate", interrupted)
    else:
        monkeypatch.setattr(DatasetGroup, "image", interrupted)
    cut = trained(place, "--run", "cut")
    assert cut.exit_code == 128 + number, cut.output
    assert len(images) == 2
    monkeypatch.undo()
    register_tiny()
    resumed = trained(place, "--run", "cut")
    assert resumed.exit_code == 0, resumed.output
    for name in ("last", "checkpoint"):
        both = [
            load(place / "area" / "runs" / run / f"{name}.safetensors").model.network.state_dict()
            for run in ("whole", "cut")
        ]
        assert all(torch.equal(both[0][key], both[1][key]) for key in both[0])


@pytest.mark.parametrize("at", [1, 9])
def test_a_signal_does_not_wait_for_the_batches_that_are_being_made(place, monkeypatch, at):
    """Ctrl-C before the first step, and later, stops the making of batches; the resumed run is the same."""
    assert trained(place, "--run", "whole").exit_code == 0
    inner, made, asked = TinyModel.batch, [], []

    def slow(self, data, rows, *others):
        made.append(1)
        if len(made) >= at:
            if len(made) == at:
                os.kill(os.getpid(), signal.SIGINT)
            for _ in range(1000):  # a hundred novel views of many images each
                asked.append(data.image(int(rows[0])))
                time.sleep(0.01)
        return inner(self, data, rows, *others)

    monkeypatch.setattr(TinyModel, "batch", slow)
    cut = trained(place, "--run", "cut")
    assert cut.exit_code == 130, cut.output
    assert len(asked) < 300
    monkeypatch.undo()
    register_tiny()
    resumed = trained(place, "--run", "cut")
    assert resumed.exit_code == 0, resumed.output
    assert ("Resuming" in resumed.output) == (at > 1)
    both = [
        load(place / "area" / "runs" / run / "last.safetensors").model.network.state_dict()
        for run in ("whole", "cut")
    ]
    assert all(torch.equal(both[0][key], both[1][key]) for key in both[0])


def test_a_kill_before_the_state_is_removed_leaves_nothing(place):
    """The state that a kill at the end of a training leaves is removed by the next run."""
    assert trained(place).exit_code == 0
    state = place / "area" / "runs" / "tiny" / "state.safetensors"
    state.write_bytes(b"left")
    assert "is already trained" in trained(place).output
    assert not state.exists()


def test_a_kill_while_a_run_is_replaced_leaves_its_configuration(place, monkeypatch):
    """--overwrite removes config.json last, so that the same command can go on after a kill."""
    assert trained(place).exit_code == 0
    folder = place / "area" / "runs" / "tiny"
    removed = []
    unlink = Path.unlink

    def record(path, missing_ok=False):
        if path.parent == folder and not path.name.startswith("."):
            removed.append(path.name)
        unlink(path, missing_ok=missing_ok)

    monkeypatch.setattr(Path, "unlink", record)
    assert trained(place, "--seed", "1", "--overwrite").exit_code == 0
    assert removed.index("config.json") == 3
    assert set(removed[:3]) == {"checkpoint.safetensors", "last.safetensors", "log.csv"}


def test_a_full_disk_is_one_line(place, monkeypatch):
    """A full disk is reported with the advice to free space and resume."""

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("spn_model.training.training_record.save_state", lambda *_: os.fsync(-1))
    monkeypatch.setattr("os.fsync", full)
    ran = trained(place)
    assert ran.exit_code == 1
    assert "No space left on device" in ran.output
    assert "free some space and run the same command to resume" in ran.output


def test_what_nothing_can_be_trained_with_leaves_no_run(place):
    """An unknown recipe, device or stage option and a bad run name are rejected and leave no run."""
    (place / "bad.toml").write_text(TINY_RECIPE.replace("frozen = true", "frosen = true"))
    for words, told in (
        (("--recipe", "nothing"), "unknown recipe 'nothing'"),
        (("--device", "tpu"), "unknown device 'tpu'"),
        (("--pretrain", str(place / "none.h5")), None),
        (("--run", "../up"), "is not a valid run name"),
        (("--recipe", str(place / "bad.toml")), "has no option 'frosen'"),
    ):
        ran = trained(place, *words)
        assert ran.exit_code == (0 if told is None else 1), ran.output
        if told is not None:
            assert told in ran.output
            assert ran.output.splitlines()[-1].startswith("Error: ")
    assert [path.name for path in (place / "area" / "runs").iterdir()] == [
        "tiny"
    ]  # of the pretraining
    mended = trained(place, "--recipe", str(place / "bad.toml"), "--seed", "9")
    assert "has no option 'frosen'" in mended.output  # a failed run must not count as existing


def test_an_area_without_a_split_is_refused(place):
    """An area without a split is rejected; the message names the command to run."""
    ran = CliRunner().invoke(main, ["train", "--area", str(place / "area")])
    assert ran.exit_code == 1
    assert "5-split is missing; run spn-data split first" in ran.output


def test_options_are_documented_with_their_defaults():
    """docs/training.md lists exactly the options of the command, with their defaults."""
    page = Path(__file__).resolve().parents[2] / "docs" / "training.md"
    rows = dict(re.findall(r"^\| `(--[a-z]+)` \|([^|]*)\|", page.read_text(), re.MULTILINE))
    given = [p for p in train.params if isinstance(p, click.Option)]
    options = {p.opts[-1]: p for p in given if p.expose_value}
    assert rows.keys() == options.keys()
    for flag, option in options.items():
        if option.show_default is True:
            assert rows[flag].strip("` ") == str(option.default), flag


def test_columns_of_the_log_are_documented():
    """docs/training.md lists exactly the columns of log.csv."""
    page = Path(__file__).resolve().parents[2] / "docs" / "training.md"
    part = page.read_text().split("Columns of `log.csv`")[1].split("## Recipes")[0]
    cells = "".join(re.findall(r"^\| (`[^|]+) \|", part, re.MULTILINE))
    assert sorted(re.findall(r"`(\w+)`", cells)) == sorted(COLUMNS)
