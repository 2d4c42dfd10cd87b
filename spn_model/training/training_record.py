"""What a training leaves on disk while it runs: log, checkpoints, the state to go on from."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from spn_data.dataset.hdf5_reader import Dataset, DatasetGroup
from spn_data.dataset.hdf5_schema import Role
from spn_data.errors import GeometryError
from spn_model.evaluation.validation import PosedImages, ValidationErrors, spread_rows, validate
from spn_model.examples.training_set import TrainingSet
from spn_model.models import checkpoint
from spn_model.models.pose_model import PoseModel
from spn_model.onboard.view import View
from spn_model.training.covariance_scale import LEAST_FRAMES, fit_covariance_scale
from spn_model.training.training_state import Log, Position, save_state

# A later network is kept where its score is at most this times the best one: rates fall towards the end, and
# validation frames are few and of one or two places.
_WORSE = 1.25
_VIEWS = 64  # that judge, at most; one is rendered in about 80 ms
# By what covariances are scaled, the first that there is. After a few minutes hardly a validation frame is
# found, for training shows little of their places: errors there tell nothing of places that it shows.
_SCALING = ("views", "validation")
_SHOWN_SHARE = 0.5  # of a validation frame's map points, seen by training images too


@dataclass(frozen=True)
class Files:
    """checkpoint : the best by validation; last : as training left it; state : to go on from; log : CSV."""

    checkpoint: Path
    last: Path
    state: Path
    log: Path


class Watch(Protocol):
    """Who follows a training."""

    def row(self, values: Mapping[str, Any]) -> None:
        """A row of the log, by column: event "steps" (figures of the steps since the last one),
        "validation", "views" or "training" (errors on validation frames, on views that training never
        draws, and on images that are trained on)."""

    def wants_stop(self) -> bool:
        """Asked at each step: True saves the state and ends the training."""


@dataclass(frozen=True, eq=False)
class ValidationFrames:
    """Frames that a member is judged by: some rows of a group of a name, or views, of none."""

    event: str
    frames: PosedImages
    rows: np.ndarray
    group: str = ""

    def errors(self, model: PoseModel, *, scales: bool) -> ValidationErrors:
        """Of the member's estimates; scales : they also tell how large its covariances have to be."""
        errors, found = validate(model, self.frames, self.rows)
        if scales:
            # Too few frames with a pose: covariances stay as they are.
            with suppress(GeometryError):
                factor = fit_covariance_scale(found, self.frames.poses[self.rows])
                model.set_covariance_scale(min(max(factor, 1e-6), 1e6))
        return errors


def select_validation_frames(
    dataset: Dataset, training: DatasetGroup, frames: int, sample: int
) -> list[ValidationFrames]:
    """Validation frames, where there are any, and a sample of those that are trained on."""
    judged = []
    for group in [g for g in dataset.of_role(Role.VALIDATION) if len(g) and g.image_size][:1]:
        rows = _shown_to_training(group, training)
        judged.append(
            ValidationFrames("validation", group, rows[spread_rows(len(rows), frames)], group.name)
        )
    return [
        *judged,
        ValidationFrames("training", training, spread_rows(len(training), sample), training.name),
    ]


def _shown_to_training(group: DatasetGroup, training: DatasetGroup) -> np.ndarray:
    """Rows of a group of whose map points training images show half or more; all rows where they are few.

    Of a place that no training image shows a network can know nothing: such frames tell neither which
    moment of a training was best nor how large covariances are.
    """
    known = np.unique(np.concatenate(training.point_ids()))
    shares = [np.isin(ids, known).mean() if len(ids) else 0.0 for ids in group.point_ids()]
    rows = np.flatnonzero(np.array(shares) >= _SHOWN_SHARE)
    return rows if len(rows) >= LEAST_FRAMES else np.arange(len(group))


@dataclass(eq=False)
class Record:
    """Written by the first process alone.

    position : moves on with the training. facts : what the checkpoints say of it.
    """

    files: Files
    watch: Watch
    model: PoseModel
    view: View
    judged: list[ValidationFrames]
    position: Position
    facts: dict[str, Any]
    _learnt: list[str] = field(default_factory=list)
    _images: TrainingSet | None = None
    _log: Log = field(init=False)

    def __post_init__(self) -> None:
        self._log = Log(self.files.log, self.position.log_bytes)

    def steps(self, stage: str, progress: float, rate: float, figures: Mapping[str, float]) -> None:
        """Figures of the steps since the last row."""
        own = {"loss", "images_per_s"}
        others = " ".join(f"{k}={v:.5g}" for k, v in figures.items() if k not in own)
        self._row(
            "steps",
            stage,
            progress,
            {**{k: figures[k] for k in own}, "rate": rate, "figures": others},
        )

    def set_training_frames(self, groups: Sequence[str], images: TrainingSet) -> None:
        """Before a stage: names of the groups that it or an earlier one learns: they judge no longer.

        images : that it trains on. What it renders of them judges too.
        """
        self._learnt, self._images = list(groups), images
        self.judged = [judged for judged in self.judged if judged.event != "views"]
        left = [j for j in self.judged if j.event == "training" or j.group not in self._learnt]
        if len(left) == len(self.judged):
            return
        self.judged, latest = left, self.position.latest
        if "validation" in latest:
            latest["held out"] = latest.pop("validation")

    def _with_views(self) -> list[ValidationFrames]:
        """What judges, with the stage's views, which are rendered when first asked for."""
        if self._images is not None:
            views = self.model.held_out_views(self._images, _VIEWS)
            if views is not None:
                rows = np.arange(len(views.poses))
                self.judged = [ValidationFrames("views", views, rows), *self.judged]
            self._images = None
        return self.judged

    def validate(self, stage: str, progress: float) -> None:
        """Judge, and keep the network where it is among the best so far, or where nothing can tell."""
        at = self.position
        began = time.perf_counter()
        judged = self._with_views()
        events = [one.event for one in judged]
        by = next((event for event in _SCALING if event in events), None)
        found = {one.event: one.errors(self.model, scales=one.event == by) for one in judged}
        at.validate_s += time.perf_counter() - began
        for event, errors in found.items():
            plain = errors.plain()
            self._row(event, stage, progress, plain)
            at.latest[event] = plain
        if "validation" in found:
            score = found["validation"].score
            if at.best is not None and score > _WORSE * at.best:
                return
            at.best = score if at.best is None else min(at.best, score)
        at.kept = {"stage": stage, "steps": at.steps, "drawn": at.drawn, **at.latest}
        checkpoint.save(self.files.checkpoint, self.model, self.view, self.summary())

    def save(self, optimizer: torch.optim.Optimizer | None) -> None:
        """The state to go on from."""
        save_state(self.files.state, self.model.network, optimizer, self.position)

    def finish(self) -> dict[str, Any]:
        """The network as it is at the end; facts of the training."""
        told = self.summary()
        checkpoint.save(self.files.last, self.model, self.view, told)
        return told

    def summary(self) -> dict[str, Any]:
        """Facts of the training so far."""
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
        self._log.close()


class Clock:
    """Seconds of training; what is done in `paused` does not count."""

    def __init__(self, before_s: float):
        self._before_s, self._began = before_s, time.perf_counter()

    @property
    def seconds(self) -> float:
        return self._before_s + time.perf_counter() - self._began

    @contextmanager
    def paused(self) -> Iterator[None]:
        self._before_s = self.seconds
        try:
            yield
        finally:
            self._began = time.perf_counter()
