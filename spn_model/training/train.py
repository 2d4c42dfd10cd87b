"""Training loop. A training can be stopped at any moment, and the same call resumes it.

Batch k of a stage, dropout included, depends on (seed, stage, k) only. With one thread and a budget in
images, a training that was killed and resumed therefore ends with the same weights as an uninterrupted one.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import nn

from spn_data.dataset.hdf5_reader import Dataset, DatasetGroup
from spn_data.dataset.hdf5_schema import Role
from spn_data.errors import InputError, StageError
from spn_data.geometry.pose import position_text
from spn_model.examples.dataset_view import view_of
from spn_model.examples.training_set import TrainingSet
from spn_model.models.pose_model import Batch, PoseModel
from spn_model.models.registry import make
from spn_model.training.batches import (
    generator_of_step,
    prefetch_batches,
    rows_of_step,
    torch_seed_of_step,
)
from spn_model.training.gradients import gradient_workers
from spn_model.training.machine import Machine, Ranks, choose, limited_threads, process_group
from spn_model.training.muon import Muon
from spn_model.training.recipe import ALL, AREA, PRETRAINING, Recipe, Stage
from spn_model.training.training_loss import Diverged, LossMonitor
from spn_model.training.training_record import (
    Clock,
    Files,
    Record,
    TrainingStopped,
    Watch,
    raise_if_stopping,
    select_validation_frames,
)
from spn_model.training.training_state import Position, read_state

_logger = logging.getLogger(__name__)

_LOG_EVERY_S = 10.0
_SAVE_EVERY_S = 30.0
_SAVING_SHARE = 0.05  # largest fraction of the time spent on saving the state
_STEPS_UNSEEN = 20  # steps between checks of the loss on a GPU, each of which waits for the GPU


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Options of a training that are not part of its recipe."""

    seed: int = 0
    device: str = "auto"  # auto, cpu, cuda, cuda:N
    threads: int = 0  # CPU threads; 0: all cores
    precision: str = "auto"  # auto (bfloat16 if the device has it natively), float32, bfloat16
    validations: int = 10  # validations in the whole training, at least one in each stage
    validation_frames: int = 64  # largest number of validation frames, evenly spaced
    sample: int = 16  # evenly spaced training images that are evaluated too


@dataclass(frozen=True)
class Data:
    """Data sets of a training.

    Attributes
    ----------
    area : Path
        Data set of the area.
    pretraining : Path or None
        Another data set, for pretraining stages.
    """

    area: Path
    pretraining: Path | None = None

    def of(self, stage: Stage) -> Path:
        """Return the data set file that a stage trains on."""
        named = {AREA: self.area, PRETRAINING: self.pretraining or self.area}
        return named.get(stage.data, Path(stage.data))


def train(
    recipe: Recipe, files: Files, data: Data, options: TrainOptions, watch: Watch
) -> dict[str, Any]:
    """Train a pose model by a recipe, or resume from `files.state`.

    Parameters
    ----------
    recipe : Recipe
        Kind of network and stages.
    files : Files
        Files to write.
    data : Data
        Data sets.
    options : TrainOptions
        Seed, device and validation.
    watch : Watch
        Receives log rows and can request a stop.

    Returns
    -------
    dict
        Facts of the finished training, which its checkpoints contain too.

    Raises
    ------
    InputError, FormatError
        If the recipe, the weights or the data cannot be used for training.
    StageError
        If the loss diverges or a file cannot be written.
    TrainingStopped
        If the watcher requested a stop.
    """
    with process_group(options.device) as ranks, ExitStack() as stack:
        machine = choose(
            *(options.device, options.threads, options.precision, ranks.local_rank),
            makes_batches=True,
        )
        stack.enter_context(limited_threads(machine))
        state = read_state(files.state)
        position = Position() if state is None else state.position
        model = make(recipe.kind, recipe.options, seed=options.seed)
        if not model.has_parts and any(stage.parts > 1 for stage in recipe.stages):
            raise InputError(
                f"a network of kind {recipe.kind} cannot split a batch: parts needs to be 1"
            )
        model.bfloat16 = machine.bfloat16
        if state is not None:
            state.restore_network(model.network)
        elif recipe.weights != "none":
            published = recipe.weights == "published"
            model.load_pretrained(model.weights_name if published else recipe.weights)
        area = stack.enter_context(Dataset(data.area))
        _check_offset(area, data.of(recipe.stages[-1]))
        # Several processes can only stop together, in a step.
        check = partial(raise_if_stopping, watch) if ranks.world == 1 else lambda: None
        record = None
        if ranks.is_main:
            judged = select_validation_frames(
                area, _training_group(area), options.validation_frames, options.sample
            )
            facts = {"recipe": recipe.plain(), "seed": options.seed, **machine.plain()}
            facts["processes"] = ranks.world
            record = Record(files, watch, model, view_of(area), judged, position, facts, check)
            stack.enter_context(closing(record))
        path, frames, images = None, "", None
        for index in range(position.stage, len(recipe.stages)):
            stage = recipe.stages[index]
            if images is None or (data.of(stage), stage.frames) != (path, frames):
                is_new = data.of(stage) != path
                path, frames = data.of(stage), stage.frames
                dataset = area if path == data.area else stack.enter_context(Dataset(path))
                groups = _groups_of(dataset, frames)
                images = TrainingSet(*groups, up_is_known=dataset.info.up_is_known, check=check)
                if is_new and state is None:
                    model.fit(images)
            if record is not None:
                on_area = [s for s in recipe.stages[: index + 1] if data.of(s) == data.area]
                learnt = {g.name: None for s in on_area for g in _groups_of(area, s.frames)}
                record.set_training_frames(list(learnt), images)
            model.network.to(machine.device)
            model.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
            model.begin_stage(stage.options, images, stage.expected_images)
            ranks.broadcast_from_first(list(model.network.state_dict().values()))
            optimizer = optimizer_of(recipe, stage, model)
            if state is not None:
                state.restore_optimizer(optimizer)
                state = None
            validations = max(1, round(options.validations * recipe.budget_shares[index]))
            run_stage(
                *(stage, index, images, model, optimizer, position),
                *(machine, ranks, record, watch, options.seed, validations),
            )
            position.stage, position.step = index + 1, 0
            position.stage_s, position.validated = 0.0, 0
        return {} if record is None else record.finish()


def run_stage(
    stage: Stage,
    index: int,
    images: TrainingSet,
    model: PoseModel,
    optimizer: torch.optim.Optimizer,
    at: Position,
    machine: Machine,
    ranks: Ranks,
    record: Record | None,
    watch: Watch,
    seed: int,
    validations: int,
) -> None:
    """Run the steps of stage number `index` from at.step until its budget is used up, advancing `at`.

    `record` belongs to the first process and is None in the others. Raises StageError if the loss diverges,
    TrainingStopped if the watcher requests a stop.
    """
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    step_images = stage.batch * ranks.world
    losses = LossMonitor(1 if machine.device.type == "cpu" else _STEPS_UNSEEN)
    before_s = at.train_s - at.stage_s
    clock = Clock(at.stage_s)
    progress = stage.progress(at.step * step_images, at.stage_s)

    def part_of(number: int) -> Batch:
        # For a budget in minutes, use the progress at the time the batch is started.
        spent = progress if stage.minutes else 0.0
        return _pinned(make_part(model, images, stage, index, number, seed, ranks, spent), machine)

    logged = saved = time.perf_counter()
    shown, save_s = at.shown, 0.0
    _logger.debug("stage %s: from step %d on %s", stage.name, at.step, machine)
    with (
        prefetch_batches(part_of, at.step * stage.parts, machine.workers, 2 * stage.parts) as ahead,
        gradient_workers(model, parameters, stage.parts, machine) as gradient,
    ):
        if at.is_due:
            with _divergence_as_stage_error(at):
                _validate(record, stage, progress, at, optimizer)
        waited_s = at.wait_s
        model.network.train()
        while progress < 1:
            rate = stage.learning_rate_at(at.step, progress)
            for group in optimizer.param_groups:
                group["lr"] = rate * group["rate"]
            try:
                parts = [_on_device(ahead.next(), machine) for _ in range(stage.parts)]
            except TrainingStopped:  # the resumed training makes the same batch
                if record is not None:
                    record.save(optimizer)
                raise
            torch.manual_seed(torch_seed_of_step(seed, index, at.step, ranks.rank))
            loss, figures = gradient.compute(parts)
            seconds, stop = ranks.average(parameters, clock.seconds, watch.wants_stop())
            norm = nn.utils.clip_grad_norm_(parameters, stage.clip or math.inf)
            with _divergence_as_stage_error(at):
                losses.add(loss, norm, figures)
            optimizer.step()
            at.step, at.steps = at.step + 1, at.steps + 1
            at.drawn += step_images
            at.shown += sum(len(next(iter(part.values()))) for part in parts) * ranks.world
            progress = stage.progress(at.step * step_images, seconds)
            at.stage_s, at.train_s = seconds, before_s + seconds

            now = time.perf_counter()
            is_judged = progress >= (at.validated + 1) / validations
            is_saved = is_judged or stop or now - saved > max(_SAVE_EVERY_S, save_s / _SAVING_SHARE)
            if not (is_saved or now - logged > _LOG_EVERY_S):
                continue
            at.wait_s = waited_s + ahead.waited_s
            at.validated = min(int(progress * validations + 1e-9), validations)
            with clock.paused(), _divergence_as_stage_error(at):
                means = losses.means()
                if record is not None:
                    means["images_per_s"] = (at.shown - shown) / max(now - logged, 1e-9)
                    record.steps(stage.name, progress, rate, means)
                    if is_judged:
                        _validate(record, stage, progress, at, optimizer)
                        model.network.train()
                    if is_saved:
                        began = time.perf_counter()
                        record.save(optimizer)
                        save_s = time.perf_counter() - began
                if stop:
                    raise TrainingStopped
            logged, shown = time.perf_counter(), at.shown
            saved = logged if is_saved else saved


def _validate(
    record: Record | None,
    stage: Stage,
    progress: float,
    at: Position,
    optimizer: torch.optim.Optimizer,
) -> None:
    """Validate in the first process; if it is stopped, the resumed training begins with it."""
    if record is not None:
        at.is_due = True
        try:
            record.validate(stage.name, progress)
        except TrainingStopped:
            record.save(optimizer)
            raise
    at.is_due = False


def make_part(
    model: PoseModel,
    images: TrainingSet,
    stage: Stage,
    index: int,
    number: int,
    seed: int,
    ranks: Ranks,
    spent: float,
) -> Batch:
    """Make one part of a batch of stage number `index`; `number` counts the parts of all steps.

    `spent` is the used fraction of the stage's minutes.
    """
    step, part = divmod(number, stage.parts)
    part, world = part + ranks.rank * stage.parts, ranks.world * stage.parts
    rows = rows_of_step(
        len(images), stage.batch // stage.parts, step, seed, index, rank=part, world=world
    )
    spent = max(stage.progress(step * stage.batch * ranks.world, 0.0), spent)
    return model.batch(images, rows, generator_of_step(seed, index, step, part), min(spent, 1.0))


@contextmanager
def _divergence_as_stage_error(at: Position) -> Iterator[None]:
    """Turn `Diverged` into a StageError that says which checkpoint is kept."""
    try:
        yield
    except Diverged as error:
        kept = "there is no checkpoint yet"
        if at.kept is not None:
            kept = f"the checkpoint after {at.kept['steps']} steps is kept"
        raise StageError(
            f"the training diverged after {at.steps} steps: {error}; {kept}. "
            "Lower the learning rate in the recipe, or use gradient clipping"
        ) from error


def _training_group(dataset: Dataset) -> DatasetGroup:
    """Return the group of training frames. Raises InputError unless there is exactly one, with images."""
    groups = dataset.of_role(Role.TRAIN)
    filled = [group for group in groups if len(group)] or groups
    if len(filled) != 1:
        raise InputError(
            f"has {len(filled)} groups of training frames, exactly one is needed",
            path=dataset.path,
        )
    if filled[0].image_size is None:
        raise InputError("has no training images: there is nothing to train on", path=dataset.path)
    return filled[0]


def _check_offset(area: Dataset, last: Path) -> None:
    """Raise InputError if the data set of the last stage has another offset than the area's.

    The network would learn poses relative to the former, but its checkpoint states the latter.
    """
    with Dataset(last) as dataset:
        there, here = dataset.info.offset, area.info.offset
    if there != here:
        raise InputError(
            f"its positions have the offset {position_text(there)}, those of {area.path} have "
            f"{position_text(here)}: train the last stage there, or import both with the same --subtract",
            path=last,
        )


def _groups_of(dataset: Dataset, frames: str) -> list[DatasetGroup]:
    """Return the groups that a stage trains on."""
    groups = [_training_group(dataset)]
    if frames == ALL:
        groups += [group for group in dataset.of_role(Role.VALIDATION) if len(group)]
    return groups


def optimizer_of(recipe: Recipe, stage: Stage, model: PoseModel) -> torch.optim.Optimizer:
    """Return the optimiser of a stage. Raises InputError if all its layers are frozen."""
    groups = [group for group in model.parameter_groups() if group["params"]]
    if not groups:
        raise InputError(f"stage {stage.name} trains nothing: all layers are frozen")
    rate, decay = stage.rate, stage.weight_decay
    if recipe.optimizer == "sgd":
        return torch.optim.SGD(
            groups, rate, momentum=recipe.momentum, weight_decay=decay, fused=True
        )
    if recipe.optimizer == "muon":
        return Muon(groups, rate, decay, torch.bfloat16 if model.bfloat16 else torch.float32)
    return torch.optim.AdamW(groups, rate, weight_decay=decay, fused=True)


def _pinned(batch: Batch, machine: Machine) -> Batch:
    """Pin a batch's memory for transfer to the GPU, in the thread that makes it."""
    if machine.device.type == "cpu":
        return batch
    return {name: tensor.pin_memory() for name, tensor in batch.items()}


def _on_device(batch: Batch, machine: Machine) -> Batch:
    if machine.device.type == "cpu":
        return batch
    return {name: t.to(machine.device, non_blocking=True) for name, t in batch.items()}
