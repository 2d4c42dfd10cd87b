"""Coloured field with evaluation flights, and checkpoints of small networks fitted to it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import DatasetInfo, Role
from spn_data.dataset.hdf5_writer import DatasetWriter
from spn_model.examples.dataset_view import view_of
from spn_model.examples.training_set import TrainingSet
from spn_model.models.checkpoint import Checkpoint, load, save
from spn_model.models.registry import make
from tests.worlds.training_world import INFO, frame, moved

ROLES = {
    "train": Role.TRAIN,
    "validation": Role.VALIDATION,
    "medium": Role.TEST,
    "low": Role.TEST,
}


def write_judged(
    path: Path,
    counts: dict[str, int] | None = None,
    *,
    moved_by: tuple[float, float, float] = (0.0, 0.0, 0.0),
    **changes: Any,
) -> Path:
    """Write a dataset with two evaluation flights, one with two strata; `changes` are DatasetInfo fields."""
    info: DatasetInfo = replace(INFO, **changes)
    wanted = counts or {"train": 12, "validation": 3, "medium": 7, "low": 4}
    path.parent.mkdir(parents=True, exist_ok=True)
    with DatasetWriter(path, info, ROLES) as writer:
        for group, count in wanted.items():
            for k in range(count):
                stratum = "" if group == "train" else "medium" if k % 2 else "low"
                writer.append(group, replace(moved(frame(group, k), moved_by), stratum=stratum))
    return path


def write_network(path: Path, dataset: Path, seed: int = 0, **options: Any) -> Checkpoint:
    """Write a network of kind tiny with random weights, scaled to the poses of the dataset."""
    model = make("tiny", options, seed=seed)
    with Dataset(dataset) as data:
        model.fit(TrainingSet(data.groups["train"]))
        save(path, model, view_of(data), {"images_shown": 40, "train_s": 3.0})
    return load(path)
