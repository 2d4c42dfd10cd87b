"""Files that a training writes while it runs: log, checkpoints and the state to resume from."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from spn_data.dataset.hdf5_reader import Dataset, DatasetGroup
from spn_data.dataset.hdf5_schema import Role
from spn_data.errors import GeometryError
from spn_model.evaluation.validation import (
    ValidationErrors,
    ValidationImages,
    spread_rows,
    validate,
)
from spn_model.examples.training_set import TrainingSet
from spn_model.models import checkpoint
from spn_model.models.pose_model import PoseModel
from spn_model.onboard.view import View
from spn_model.training.covariance_scale import LEAST_FRAMES, fit_covariance_scale
from spn_model.training.training_state import Log, Position, save_state

_logger = logging.getLogger(__name__)

# A later network is kept if its score is at most this factor times the best one: learning rates decrease
# towards the end, and the validation frames are few and show only one or two places.
_WORSE = 1.25
_VIEWS = 64  # largest number of rendered validation views; one takes about 80 ms
# Frames used to scale the covariances, in order of preference. After a few minutes of training hardly any
# validation frame is located, because the training images show little of these places; errors there say
# nothing about places that training covers.
_SCALING = ("views", "validation")
_SHOWN_SHARE = 0.5  # fraction of a validation frame's map points that training images see too


@dataclass(frozen=True)
class Files:
    """Files of a training.

    Attributes
    ----------
    checkpoint : Path
        Best network by validation.
    last : Path
        Network at the end of the training.
    state : Path
        State to resume from.
    log : Path
        log.csv.
    """

    checkpoint: Path
    last: Path
    state: Path
    log: Path


class Watch(Protocol):
    """Observer of a training."""

    def row(self, values: Mapping[str, Any]) -> None:
        """Receive a row of the log, by column.

        The event is "steps" (means over the steps since the last one), "validation", "views" or "training"
        (errors on validation frames, on rendered views that training never draws, and on images that are
        trained on).
        """

    def wants_stop(self) -> bool:
        """Return whether to save the state and end the training; called once in each step."""

    def is_stopping(self) -> bool:
        """Return whether a stop was requested; called between steps, often in what takes long."""


class TrainingStopped(Exception):
    """Raised when the watcher requested a stop; the state is saved."""


def raise_if_stopping(watch: Watch) -> None:
    """Raise TrainingStopped if a stop was requested."""
    if watch.is_stopping():
        raise TrainingStopped


@dataclass(frozen=True, eq=False)
class ValidationFrames:
    """Frames on which a model is evaluated during training: rows of a named group, or views without one.

    offset : position of the model's zero in the world of the frames' poses.
    """

    event: str
    frames: ValidationImages
    rows: np.ndarray
    group: str = ""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def errors(
        self, model: PoseModel, *, scales: bool, check: Callable[[], None]
    ) -> ValidationErrors:
        """Return the errors of the model's estimates; if `scales`, also rescale its covariances by them."""
        errors, estimates = validate(model, self.frames, self.rows, check, offset=self.offset)
        if scales:
            try:
                factor = fit_covariance_scale(estimates, self.frames.poses[self.rows])
                model.set_covariance_scale(min(max(factor, 1e-6), 1e6))
            except GeometryError as error:  # too few poses
                _logger.debug("the covariances stay as they are: %s", error)
        return errors


def select_validation_frames(
    dataset: Dataset, training: DatasetGroup, frames: int, sample: int
) -> list[ValidationFrames]:
    """Return validation frames, if there are any, and a sample of the training frames."""
    judged, offset = [], dataset.info.offset
    for group in [g for g in dataset.of_role(Role.VALIDATION) if len(g) and g.image_size][:1]:
        rows = _shown_to_training(group, training)
        rows = rows[spread_rows(len(rows), frames)]
        judged.append(ValidationFrames("validation", group, rows, group.name, offset))
    rows = spread_rows(len(training), sample)
    return [*judged, ValidationFrames("training", training, rows, training.name, offset)]


def _shown_to_training(group: DatasetGroup, training: DatasetGroup) -> np.ndarray:
    """Return the rows of frames at least half of whose map points are seen by training images.

    Returns all rows if these are too few. A network can know nothing about a place that no training image
    shows, so that such frames indicate neither the best moment of a training nor the size of covariances.
    """
    known = np.unique(np.concatenate(training.point_ids()))
    shares = [np.isin(ids, known).mean() if len(ids) else 0.0 for ids in group.point_ids()]
    rows = np.flatnonzero(np.array(shares) >= _SHOWN_SHARE)
    return rows if len(rows) >= LEAST_FRAMES else np.arange(len(group))


@dataclass(eq=False)
class Record:
    """Log and checkpoints of a training, written by the first process only.

    Attributes
    ----------
    files : Files
        Files to write.
    watch : Watch
        Observer of the log.
    model : PoseModel
        Model that is trained.
    view : View
        Camera and world of the area.
    judged : list of ValidationFrames
        Frames to evaluate.
    position : Position
        Progress of the training, which is updated.
    facts : dict
        Facts that are written into the checkpoints.
    check : callable
        Called often during a validation; may raise TrainingStopped.
    """

    files: Files
    watch: Watch
    model: PoseModel
    view: View
    judged: list[ValidationFrames]
    position: Position
    facts: dict[str, Any]
    check: Callable[[], None] = lambda: None
    _learnt: list[str] = field(default_factory=list)
    _images: TrainingSet | None = None
    _log: Log = field(init=False)

    def __post_init__(self) -> None:
        self._log = Log(self.files.log, self.position.log_bytes)

    def steps(self, stage: str, progress: float, rate: float, figures: Mapping[str, float]) -> None:
        """Log metrics of the steps since the last row."""
        own = {"loss", "images_per_s"}
        others = " ".join(f"{k}={v:.5g}" for k, v in figures.items() if k not in own)
        self._row(
            "steps",
            stage,
            progress,
            {**{k: figures[k] for k in own}, "rate": rate, "figures": others},
        )

    def set_training_frames(self, groups: Sequence[str], images: TrainingSet) -> None:
        """Set what the next stage trains on.

        Groups trained on by this or an earlier stage, given by name in `groups`, no longer validate. Views
        rendered from `images` validate too.
        """
        self._learnt, self._images = list(groups), images
        self.judged = [frames for frames in self.judged if frames.event != "views"]
        left = [f for f in self.judged if f.event == "training" or f.group not in self._learnt]
        if len(left) == len(self.judged):
            return
        self.judged, latest = left, self.position.latest
        if "validation" in latest:
            latest["held out"] = latest.pop("validation")

    def _with_views(self) -> list[ValidationFrames]:
        """Return the frames to evaluate, including the stage's views, which are rendered on first use."""
        if self._images is not None:
            views = self.model.held_out_views(self._images, _VIEWS)
            if views is not None:
                rows = np.arange(len(views.poses))
                self.judged = [ValidationFrames("views", views, rows), *self.judged]
            self._images = None
        return self.judged

    def validate(self, stage: str, progress: float) -> None:
        """Evaluate the model; save a checkpoint if it is among the best or nothing can validate it.

        Raises TrainingStopped if a stop is requested before the evaluation is complete.
        """
        at = self.position
        began = time.perf_counter()
        judged = self._with_views()
        events = [frames.event for frames in judged]
        by = next((event for event in _SCALING if event in events), None)
        # The scaling changes the model, so it comes last, when nothing can stop any more.
        found = {
            f.event: f.errors(self.model, scales=f.event == by, check=self.check)
            for f in sorted(judged, key=lambda f: f.event == by)
        }
        results = {event: found[event] for event in events}
        at.validate_s += time.perf_counter() - began
        for event, errors in results.items():
            plain = errors.plain()
            self._row(event, stage, progress, plain)
            at.latest[event] = plain
        if "validation" in results:
            score = results["validation"].score
            if at.best is not None and score > _WORSE * at.best:
                return
            at.best = score if at.best is None else min(at.best, score)
        at.kept = {"stage": stage, "steps": at.steps, "drawn": at.drawn, **at.latest}
        checkpoint.save(self.files.checkpoint, self.model, self.view, self.summary())

    def save(self, optimizer: torch.optim.Optimizer | None) -> None:
        """Save the state to resume from."""
        save_state(self.files.state, self.model.network, optimizer, self.position)

    def finish(self) -> dict[str, Any]:
        """Save the network as it is at the end; return the facts of the training."""
        summary = self.summary()
        checkpoint.save(self.files.last, self.model, self.view, summary)
        return summary

    def summary(self) -> dict[str, Any]:
        """Return the facts of the training so far."""
        at = self.position
        return {
            **self.facts,
            "steps": at.steps,
            "images_drawn": at.drawn,
            "images_shown": at.shown,
            "train_s": at.train_s,
            "validate_s": at.validate_s,
            "wait_s": at.wait_s,
            "kept": at.kept,
            "latest": at.latest,
            "trained_on": self._learnt,
        }

    def _row(self, event: str, stage: str, progress: float, values: Mapping[str, Any]) -> None:
        at = self.position
        row = {
            "event": event,
            "stage": stage,
            "step": at.step,
            "images": at.shown,
            "progress": min(progress, 1.0),
            "train_s": at.train_s,
            "validate_s": at.validate_s,
            "wait_s": at.wait_s,
            **values,
        }
        at.log_bytes = self._log.write(row)
        self.watch.row(row)

    def close(self) -> None:
        """Close the log."""
        self._log.close()


class Clock:
    """Stopwatch of the training time, excluding what is done in `paused`."""

    def __init__(self, before_s: float):
        self._before_s, self._began = before_s, time.perf_counter()

    @property
    def seconds(self) -> float:
        """Seconds of training so far."""
        return self._before_s + time.perf_counter() - self._began

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Stop the clock within the block."""
        self._before_s = self.seconds
        try:
            yield
        finally:
            self._began = time.perf_counter()
