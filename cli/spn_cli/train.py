"""`spn-model train`: a network of the area, from dataset.h5 and a recipe."""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from spn_cli import console, options
from spn_data.area.names import DATASET
from spn_data.errors import StageError
from spn_data.storage.files import LOCK, locked

if TYPE_CHECKING:
    from spn_data.area.area import Area
    from spn_data.storage.stage_record import StageRecord


@click.command()
@click.argument("dataset", required=False, type=click.Path(path_type=Path))
@options.area
@click.option(
    "--recipe",
    default="default",
    show_default=True,
    help="What to train, and how: a recipe of the package, or a TOML file.",
)
@click.option("--run", "run_name", help="Folder for it in runs/.  [default: the recipe's name]")
@click.option(
    "--pretrain",
    type=click.Path(path_type=Path),
    help="Another dataset.h5, for the recipe's stages of pretraining.  [default: as the area's]",
)
@click.option(
    "--minutes",
    type=options.Finite(0, 10**6, min_open=True),
    help="Of training in all, validation aside.  [default: the recipe's]",
)
@click.option(
    "--images",
    type=click.IntRange(1, 10**10),
    help="Training images to draw in all.  [default: the recipe's]",
)
@options.seed
@click.option(
    "--precision",
    type=click.Choice(["auto", "float32", "bfloat16"]),
    default="auto",
    show_default=True,
    help="auto: bfloat16 where the device multiplies it by itself.",
)
@click.option(
    "--validations",
    type=click.IntRange(1, 10_000),
    default=10,
    show_default=True,
    help="How often the network is judged, over the whole training.",
)
@options.device
@options.threads
@options.overwrite
def train(dataset: Path | None, area_folder: Path, **chosen: Any) -> None:
    """Train a network for the area; the same command goes on where it was stopped.

    DATASET is a dataset.h5, by default that of `spn-data split`. What comes of it lies in runs/NAME:
    checkpoint.safetensors, log.csv, config.json.

    \b
    Example:
        spn-model train --area fields/north --run first
        spn-model train --area fields/north --recipe paper --minutes 10 --seed 2
    """
    run(dataset, area_folder, **chosen)


def run(
    dataset: Path | None,
    area_folder: Path,
    *,
    recipe: str,
    run_name: str | None,
    pretrain: Path | None,
    minutes: float | None,
    images: int | None,
    seed: int,
    precision: str,
    validations: int,
    device: str,
    threads: int | None,
    overwrite: bool,
) -> None:
    from spn_cli import page
    from spn_cli.show_training import Following, errors_table
    from spn_data.area import names
    from spn_data.dataset.hdf5_reader import Dataset
    from spn_data.errors import InputError
    from spn_data.storage.fingerprints import content_fingerprint
    from spn_data.storage.stage_record import StageRecord, versions
    from spn_model.training.recipe import read_recipe
    from spn_model.training.train import Data, TrainingStopped, TrainOptions
    from spn_model.training.train import train as train_network
    from spn_model.training.training_record import Files

    area = options.open_area(area_folder)
    wanted = read_recipe(recipe).with_budget(images, minutes)
    folder = area.run_folder(run_name or Path(recipe).stem)
    path = _dataset(area, dataset)
    with Dataset(path) as opened:
        unit = "m" if opened.info.units == "m" else "model units"
    inputs = {"data set": content_fingerprint(path)}
    for stage in wanted.stages:
        other = Data(path, pretrain).of(stage)
        if other != path:
            if not other.is_file():
                raise InputError("does not exist", path=other)
            inputs[f"data set for stage {stage.name}"] = content_fingerprint(other)
    record = StageRecord(
        stage=f"{names.RUNS}/{folder.name}",
        options=json.loads(
            json.dumps(
                {
                    **wanted.plain(),
                    "seed": seed,
                    "precision": precision,
                    "validations": validations,
                }
            )
        ),
        inputs=inputs,
        upstream={},
    )
    leads = int(os.environ.get("RANK", "0")) == 0
    files = Files(
        *(folder / name for name in (names.CHECKPOINT, names.LAST, names.STATE, names.LOG))
    )
    with _held(folder, leads):
        found = _standing(folder / names.CONFIG, record, files, overwrite=overwrite, leads=leads)
        if found is not None and found["facts"] is not None:
            if leads:
                console.out.print(f"{folder} is trained already.", soft_wrap=True)
                errors_table(found["facts"], unit)
            return
        config = {
            "version": 1,
            "options": record.options,
            "inputs": record.inputs,
            "recipe": recipe,
            "dataset": str(path),
            "pretrain": None if pretrain is None else str(pretrain),
            "device": device,
            "threads": threads,
            "versions": versions(),
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
            "facts": None,
        }
        if leads and found is None:
            _write(folder / names.CONFIG, config)
        follow = Following(wanted, unit, shows=leads)
        how = TrainOptions(
            seed=seed,
            device=device,
            threads=threads or 0,
            precision=precision,
            validations=validations,
        )
        try:
            with _asked_to_stop(follow.stop), follow:
                if files.state.exists():
                    follow.say("Going on from where it was stopped.")
                facts = train_network(wanted, files, Data(path, pretrain), how, follow)
        except TrainingStopped:
            raise KeyboardInterrupt from None
        if not leads:
            return
        _write(folder / names.CONFIG, {**(found or config), "facts": facts})
        files.state.unlink(missing_ok=True)
    errors_table(facts, unit)
    console.out.print(
        f"{folder}: {names.CHECKPOINT}, {names.LOG}. Next: spn-model evaluate --run {folder.name}",
        soft_wrap=True,
    )
    page.refresh_if_free(area)


def _dataset(area: Area, given: Path | None) -> Path:
    """Raises StageError where the area's own is missing or stale."""
    from spn_data.area.names import SPLIT

    if given is not None:
        return given
    area.check_fresh(SPLIT)
    return area.folder(SPLIT) / DATASET


def _standing(
    path: Path, record: StageRecord, files: Any, *, overwrite: bool, leads: bool
) -> dict[str, Any] | None:
    """The configuration of the same training, finished or not; None where it begins.

    Raises StageError where another training would be lost and `overwrite` is false.
    """
    from spn_data.errors import FormatError, StageError
    from spn_data.storage.json_files import read_json
    from spn_data.storage.stage_record import StageRecord, difference

    if not path.exists():
        if files.checkpoint.exists():
            raise StageError(
                f"{path.parent} holds a network without its {path.name}; name another --run"
            )
        return None
    config: dict[str, Any] = read_json(path)
    try:
        found = StageRecord(
            stage=record.stage, options=config["options"], inputs=config["inputs"], upstream={}
        )
        is_same = found.made_of == record.made_of
        facts = config["facts"]
        if not isinstance(facts, dict | None):
            raise TypeError(f"facts is {facts!r:.40}")
    except (KeyError, TypeError, AttributeError) as error:
        raise FormatError(f"{path}: cannot be read ({error!r})") from error
    if is_same and (facts is None or files.checkpoint.exists()):
        return config
    if files.state.exists() or files.checkpoint.exists():
        if not overwrite:
            raise StageError(
                f"{path.parent} stands already and {difference(found, record)}; "
                "--overwrite trains anew, another --run leaves it"
            )
        if leads:
            for entry in path.parent.iterdir():
                if entry.name != LOCK:
                    shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
    return None


def _write(path: Path, config: dict[str, Any]) -> None:
    from spn_data.storage.json_files import finite, write_json

    write_json(path, finite(config))


@contextmanager
def _held(folder: Path, leads: bool) -> Iterator[None]:
    """Only one training at a time works in a folder, which is made."""
    if not leads:
        yield
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StageError(f"{folder} cannot be written to: {error.strerror}") from error
    with locked(folder, "spn-model train"):
        try:
            yield
        finally:
            if [entry.name for entry in folder.iterdir()] == [LOCK]:
                shutil.rmtree(folder)


@contextmanager
def _asked_to_stop(stop: Callable[[], None]) -> Iterator[None]:
    """Ctrl-C and an end asked for by the system let the step be finished; a second Ctrl-C does not wait."""
    numbers = (int(signal.SIGINT), int(signal.SIGTERM))
    before: dict[int, Any] = {}

    def hear(number: int, _: object) -> None:
        stop()
        signal.signal(signal.SIGINT, before[numbers[0]])

    for number in numbers:
        before[number] = signal.signal(number, hear)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
