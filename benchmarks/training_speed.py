"""Throughput of the training loop, of the computation alone, and of a loader that decodes JPEGs.

    python benchmarks/training_speed.py AREA [--recipe default] [--steps 24] [--rounds 3] [--threads N]
        [--device auto] [--precision auto] [--json FILE]

Four loops run the same steps of a recipe's last stage alternately, so that other load on the machine affects
all of them:

loop      `spn_model.training.train.run_stage`, as run by `spn-model train`: batches are made ahead, with
          log and saved state
bare      the same batches, made in advance and kept in memory: the limit set by the computation
in turns  each batch is made, then used: shows what making ahead saves
plain     like published PoseNet code: each image of a batch is read from its JPEG in 1-frames, decoded,
          resized to the batch's size and normalised every time it is used; no augmentation

In addition to images per second, the CPU time per image is reported, of the stepping thread and of all
threads: it is more meaningful on a machine with other load. Neither validation nor writing the state counts,
as in a training's log. Steps are spread over the whole stage, because some kinds of networks vary their
images with it.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import nn

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import Role
from spn_model.examples.dataset_view import view_of
from spn_model.examples.training_set import TrainingSet
from spn_model.models.pose_model import Batch, PoseModel
from spn_model.models.registry import make
from spn_model.networks.imagenet import MEAN, STD
from spn_model.training.batches import rows_of_step
from spn_model.training.gradients import Gradients, gradient_workers
from spn_model.training.machine import PRECISIONS, Machine, Ranks, choose, limited_threads
from spn_model.training.recipe import Stage, read_recipe
from spn_model.training.train import make_part, optimizer_of, run_stage
from spn_model.training.training_record import Files, Record
from spn_model.training.training_state import Position


@dataclass(frozen=True)
class Round:
    """One loop over all steps. stepping_ms, all_threads_ms : CPU time per image."""

    images_per_s: float
    stepping_ms: float
    all_threads_ms: float


class Silent:
    """Follower of a training that ignores everything."""

    def row(self, values: Mapping[str, Any]) -> None:
        """Ignore a row of the log."""

    def wants_stop(self) -> bool:
        """Never request a stop."""
        return False

    def is_stopping(self) -> bool:
        """Never request a stop."""
        return False


class Contest:
    """Alternative loops over the same steps of one stage."""

    def __init__(
        self,
        model: PoseModel,
        stage: Stage,
        images: TrainingSet,
        machine: Machine,
        optimizer: torch.optim.Optimizer,
        jpegs: list[Path],
        steps: int,
    ):
        self.model, self.images, self.machine, self.jpegs = model, images, machine, jpegs
        self.stage = replace(stage, images=steps * stage.batch, minutes=0.0)
        self.optimizer, self.steps = optimizer, steps
        self.parameters = [p for group in optimizer.param_groups for p in group["params"]]
        self.batches = [self.parts(k) for k in range(steps)]
        self.shown = sum(len(next(iter(part.values()))) for parts in self.batches for part in parts)

    def parts(self, k: int) -> list[Batch]:
        """Make the batch of step k in its parts, as the training loop does."""
        first = k * self.stage.parts
        return [self.part(number) for number in range(first, first + self.stage.parts)]

    def part(self, number: int) -> Batch:
        """Make one part of a batch on the device."""
        made = make_part(self.model, self.images, self.stage, 0, number, 0, Ranks(), 0.0)
        return {name: tensor.to(self.machine.device) for name, tensor in made.items()}

    def step(self, gradient: Gradients, parts: list[Batch]) -> None:
        """Compute one step."""
        gradient.compute(parts)
        nn.utils.clip_grad_norm_(self.parameters, self.stage.clip or float("inf"))
        self.optimizer.step()

    def computing(self) -> AbstractContextManager[Gradients]:
        """Start the workers that compute gradients."""
        return gradient_workers(self.model, self.parameters, self.stage.parts, self.machine)

    def loop(self, record: Record) -> None:
        """Run the training loop of `spn-model train`."""
        run_stage(
            *(self.stage, 0, self.images, self.model, self.optimizer, record.position),
            *(self.machine, Ranks(), record, Silent(), 0, 1),
        )

    def bare(self) -> None:
        """Run the steps on batches made in advance."""
        with self.computing() as gradient:
            for parts in self.batches:
                self.step(gradient, parts)

    def in_turns(self) -> None:
        """Make each batch, then use it."""
        with self.computing() as gradient:
            for k in range(self.steps):
                self.step(gradient, self.parts(k))

    def plain(self) -> None:
        """Decode the JPEGs of each batch before its step."""
        with self.computing() as gradient:
            for k, parts in enumerate(self.batches):
                for part in parts:
                    images = part["images"]
                    rows = rows_of_step(len(self.images), len(images), k, 0, 0)
                    loaded = np.stack([self.decoded(int(row), images.shape[1:3]) for row in rows])
                    # The model normalises its images itself: this only takes its time.
                    assert loaded.shape == (len(rows), 3, *images.shape[1:3])
                self.step(gradient, parts)

    def decoded(self, row: int, size: tuple[int, int]) -> np.ndarray:
        """Decode the JPEG of a training image to (3, h, w) float32."""
        image = cv2.imread(str(self.jpegs[row]), cv2.IMREAD_COLOR_RGB)
        small = cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA)
        scaled = (small.astype(np.float32) / 255 - MEAN) / np.asarray(STD, np.float32)
        return scaled.transpose(2, 0, 1).astype(np.float32)


def measure(
    area: Path, recipe_name: str, machine: Machine, steps: int, rounds: int
) -> dict[str, Any]:
    """Measure the throughput of each loop, round by round."""
    recipe = read_recipe(recipe_name)
    stage = recipe.stages[-1]
    model = make(recipe.kind, recipe.options)
    model.bfloat16 = machine.bfloat16
    if recipe.weights != "none":
        model.load_pretrained(
            model.weights_name if recipe.weights == "published" else recipe.weights
        )
    with (
        Dataset(area / "5-split" / "dataset.h5") as dataset,
        tempfile.TemporaryDirectory() as folder,
    ):
        group = dataset.of_role(Role.TRAIN)[0]
        images = TrainingSet(group)
        jpegs = [area / "1-frames" / name for name in group.names]
        jpegs = [path for path in jpegs if path.is_file()] or [Path("none")]
        jpegs = [jpegs[k % len(jpegs)] for k in range(len(group))]
        model.fit(images)
        model.network.to(machine.device)
        model.network.to(memory_format=torch.channels_last)
        model.begin_stage(stage.options, images)
        model.network.train()
        contest = Contest(
            model, stage, images, machine, optimizer_of(recipe, stage, model), jpegs, steps
        )
        paths = [Path(folder) / name for name in ("best", "last", "state", "log")]

        def loop() -> float:
            at = Position()
            record = Record(Files(*paths), Silent(), model, view_of(dataset), [], at, {})
            with closing(record):
                contest.loop(record)
            return at.train_s

        loops: dict[str, Callable[[], float | None]] = {
            "loop": loop,
            "bare": contest.bare,
            "in turns": contest.in_turns,
        }
        if jpegs[0].is_file() and "images" in contest.batches[0][0]:
            loops["plain"] = contest.plain
        contest.bare()  # warm-up
        found: dict[str, list[Round]] = {name: [] for name in loops}
        for _ in range(rounds):
            for name, run in loops.items():
                found[name].append(timed(run, contest.shown, machine))
    return {"images_per_round": contest.shown, "training_images": len(group), "loops": found}


def timed(run: Callable[[], float | None], images: int, machine: Machine) -> Round:
    """Time one loop, by its own clock if it returns seconds."""
    wall, mine, every = time.perf_counter(), time.thread_time(), time.process_time()
    seconds = run()
    if machine.device.type == "cuda":
        torch.cuda.synchronize()
    return Round(
        images_per_s=images / (seconds or time.perf_counter() - wall),
        stepping_ms=(time.thread_time() - mine) / images * 1e3,
        all_threads_ms=(time.process_time() - every) / images * 1e3,
    )


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("area", type=Path)
    parser.add_argument("--recipe", default="default")
    parser.add_argument("--steps", type=int, default=24)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--precision", choices=PRECISIONS, default="auto")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    machine = choose(given.device, given.threads, given.precision, makes_batches=True)
    with limited_threads(machine):
        found = measure(given.area, given.recipe, machine, given.steps, given.rounds)
    loops = found["loops"]
    columns = ("loop", "images/s", "of bare", "ms per image, stepping", "all threads")
    table = Table(*columns, title=f"{given.recipe}: {machine.plain()}")
    for name, rounds in loops.items():
        of_bare = [
            a.images_per_s / b.images_per_s for a, b in zip(rounds, loops["bare"], strict=True)
        ]
        table.add_row(
            name,
            f"{median(one.images_per_s for one in rounds):.1f}",
            f"{median(of_bare):.0%}",
            f"{median(one.stepping_ms for one in rounds):.2f}",
            f"{median(one.all_threads_ms for one in rounds):.2f}",
        )
    Console(width=110).print(table)
    if given.json:
        plain = {name: [asdict(one) for one in rounds] for name, rounds in loops.items()}
        result = {"recipe": given.recipe, **machine.plain(), **found, "loops": plain}
        given.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
