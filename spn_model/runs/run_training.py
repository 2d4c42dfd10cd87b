"""Training in the folder of a run, which is locked, described in config.json, and resumed if interrupted."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Protocol

from spn_data.area.names import RUNS
from spn_data.dataset.hdf5_reader import Dataset
from spn_data.errors import FormatError, InputError, SpnError, StageError
from spn_data.storage.files import LOCK, locked
from spn_data.storage.fingerprints import content_fingerprint
from spn_data.storage.json_files import DAMAGE, finite, kind_of, read_json, write_json
from spn_data.storage.stage_record import StageRecord, difference, versions
from spn_model.runs.run_files import RunFiles
from spn_model.training.machine import is_main_process
from spn_model.training.recipe import Recipe
from spn_model.training.train import Data, TrainOptions, train
from spn_model.training.training_record import Files, Watch

_VERSION = 1  # of config.json


@dataclass(frozen=True, kw_only=True)
class TrainRequest:
    """What is trained, and in which folder.

    Attributes
    ----------
    run : RunFiles
        Files of the run.
    recipe : Recipe
        Recipe with its final budget.
    recipe_name : str
        Name or path of the recipe, for config.json.
    data : Data
        Data sets.
    options : TrainOptions
        Seed, device and validation.
    """

    run: RunFiles
    recipe: Recipe
    recipe_name: str
    data: Data
    options: TrainOptions


@dataclass(frozen=True, kw_only=True)
class TrainedRun:
    """A finished training.

    Attributes
    ----------
    facts : mapping
        Facts of the training, see `train`.
    unit : str
        "m" or "model units", of all lengths.
    is_new : bool
        Whether it was finished by this call, not by an earlier one.
    """

    facts: Mapping[str, Any]
    unit: str
    is_new: bool


class RunWatch(Watch, Protocol):
    """Observer of a training in the folder of a run."""

    def training(self, unit: str, *, resumes: bool) -> AbstractContextManager[object]:
        """Return a context that is entered while the network is trained.

        Parameters
        ----------
        unit : str
            "m" or "model units", of lengths in log rows.
        resumes : bool
            Whether the training continues an interrupted one.
        """


def train_run(
    request: TrainRequest, watch: RunWatch, *, overwrite: bool = False
) -> TrainedRun | None:
    """Train a network in the folder of a run, or resume an interrupted training of the same options and data.

    Parameters
    ----------
    request : TrainRequest
        What is trained.
    watch : RunWatch
        Receives log rows and can request a stop.
    overwrite : bool
        Whether a run with other options or data may be replaced.

    Returns
    -------
    TrainedRun or None
        None in all but the first of several processes.

    Raises
    ------
    StageError
        If the folder holds another training and `overwrite` is false, if it cannot be written to, or if the
        loss diverges.
    InUseError
        If another process trains in the folder.
    InputError, FormatError
        If the recipe, the weights, the data or an existing config.json cannot be used.
    TrainingStopped
        If the watcher requested a stop.
    """
    run, is_main = request.run, is_main_process()
    with Dataset(request.data.area) as data:
        unit = "m" if data.info.units == "m" else "model units"
    record = _record(request)
    with _locked(run) if is_main else nullcontext():
        config = _existing_config(run, record, overwrite=overwrite, is_main=is_main)
        if config is not None and config["facts"] is not None:
            if is_main:  # left by a run that was killed in between
                run.state.unlink(missing_ok=True)
            return TrainedRun(facts=config["facts"], unit=unit, is_new=False) if is_main else None
        begins = config is None
        if config is None:
            config = _config(request, record)
            if is_main:
                write_json(run.config, finite(config))
        with watch.training(unit, resumes=run.state.exists()):
            files = Files(run.checkpoint, run.last, run.state, run.log)
            try:
                facts = train(request.recipe, files, request.data, request.options, watch)
            except SpnError:
                if is_main and begins and not _has_work(run):
                    _remove_files(run)  # a run in which nothing was learnt is none
                raise
        if not is_main:
            return None
        write_json(run.config, finite({**config, "facts": facts}))
        run.state.unlink(missing_ok=True)
    return TrainedRun(facts=facts, unit=unit, is_new=True)


def _record(request: TrainRequest) -> StageRecord:
    """Return options and inputs of a training; if they are equal, so is the trained network."""
    options = {
        **request.recipe.plain(),
        "seed": request.options.seed,
        "precision": request.options.precision,
        "validations": request.options.validations,
    }
    inputs = {"data set": content_fingerprint(request.data.area)}
    for stage in request.recipe.stages:
        dataset = request.data.of(stage)
        if dataset == request.data.area:
            continue
        if not dataset.is_file():
            raise InputError("does not exist", path=dataset)
        inputs[f"data set for stage {stage.name}"] = content_fingerprint(dataset)
    return StageRecord(
        stage=f"{RUNS}/{request.run.name}",
        options=json.loads(json.dumps(options)),
        inputs=inputs,
        upstream={},
    )


def _config(request: TrainRequest, record: StageRecord) -> dict[str, Any]:
    """Return the content of config.json of a training that begins."""
    pretraining = request.data.pretraining
    return {
        "version": _VERSION,
        "options": record.options,
        "inputs": record.inputs,
        "recipe": request.recipe_name,
        "dataset": str(request.data.area),
        "pretrain": None if pretraining is None else str(pretraining),
        "device": request.options.device,
        "threads": request.options.threads or None,
        "versions": versions(),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "facts": None,
    }


def _existing_config(
    run: RunFiles, record: StageRecord, *, overwrite: bool, is_main: bool
) -> dict[str, Any] | None:
    """Return the configuration of the same training, finished or not; None if it has not begun.

    Another training in the folder is removed if `overwrite` is true, by the first process. Raises StageError
    if `overwrite` is false.
    """
    if not run.config.exists():
        if run.checkpoint.exists():
            raise StageError(
                f"{run.folder} contains a network but no {run.config.name}; choose another --run"
            )
        return None
    config: dict[str, Any] = read_json(run.config)
    try:
        for name in ("options", "inputs"):
            if not isinstance(config[name], dict):
                raise TypeError(f"{name!r} is {kind_of(config[name])} instead of an object")
        found = StageRecord(
            stage=record.stage, options=config["options"], inputs=config["inputs"], upstream={}
        )
        is_same = found.is_made_as(record)
        facts = config["facts"]
        if not isinstance(facts, dict | None):
            raise TypeError(f"facts is {facts!r:.40}")
    except DAMAGE as error:
        raise FormatError(f"{run.config}: cannot be read ({error!r})") from error
    if is_same and (facts is None or run.checkpoint.exists()):
        return config
    if run.state.exists() or run.checkpoint.exists():
        if not overwrite:
            raise StageError(
                f"{run.folder} already exists but {difference(found, record)}; "
                "use --overwrite to train again, or another --run to keep it"
            )
        if is_main:
            _remove_files(run)
    return None


def _has_work(run: RunFiles) -> bool:
    """Return whether the folder has a network, or a state to resume from."""
    return any(path.exists() for path in (run.checkpoint, run.last, run.state))


def _remove_files(run: RunFiles) -> None:
    # The configuration last: without it, what a kill leaves would belong to no known training.
    for entry in sorted(run.folder.iterdir(), key=lambda entry: entry == run.config):
        if entry.name != LOCK:
            shutil.rmtree(entry) if entry.is_dir() else entry.unlink()


@contextmanager
def _locked(run: RunFiles) -> Iterator[None]:
    """Create and lock the run's folder for one training; remove the folder if it is empty at the end."""
    try:
        run.folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StageError(f"{run.folder} cannot be written to: {error.strerror}") from error
    with locked(run.folder, "spn-model train"):
        try:
            yield
        finally:
            if [entry.name for entry in run.folder.iterdir()] == [LOCK]:
                shutil.rmtree(run.folder)
