"""Errors, time and memory of the baselines without training, on the evaluation groups of a dataset.

    python benchmarks/baselines.py DATASET [--out FOLDER]

DATASET is a dataset.h5. --out writes metrics.json, errors.csv and figures to a folder. Times are CPU
seconds of one thread per image: VLAD includes SIFT, GeM includes the network, both include the search.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import cv2
import torch
from rich.console import Console
from rich.table import Table

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import Role
from spn_model.evaluation import figures
from spn_model.evaluation.baselines import (
    GEM,
    VLAD,
    Describe,
    Images,
    baselines,
    better_retrieval,
    gem,
    vlad,
)
from spn_model.evaluation.feature_maps import squeezenet_maps
from spn_model.evaluation.metrics import Evaluation, axes_of, evaluate, evaluation_frames
from spn_model.evaluation.tables import header, paper_rows, rows, write_errors, write_metrics


class Timed:
    """Image descriptor that counts its images and CPU seconds."""

    def __init__(self, describe: Describe):
        self.describe, self.images, self.seconds = describe, 0, 0.0

    def __call__(self, images: Images):
        """Describe images."""
        start = time.process_time()
        found = self.describe(images)
        self.seconds += time.process_time() - start
        self.images += len(images)
        return found


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    at_start_mb = peak_mb()
    with Dataset(arguments.dataset) as data:
        (training,) = data.of_role(Role.TRAIN)
        groups = [*data.of_role(Role.VALIDATION), *data.of_role(Role.TEST)]
        groups = [group for group in groups if len(group)]
        start = time.process_time()
        describe = {VLAD: Timed(vlad(training)), GEM: Timed(gem(squeezenet_maps()))}
        facts = {"vocabulary_s": time.process_time() - start}
        estimates = baselines(training, groups, describe)
        axes = axes_of(data.info)
        frames = [
            evaluation_frames(g.name, g.names, g.strata, g.poses, training.poses, axes=axes)
            for g in groups
        ]
        poses, units = training.poses, data.info.units
    found = [[evaluate(e, f) for e in of] for of, f in zip(estimates, frames, strict=True)]
    for method, timed in describe.items():
        facts[f"{method}: seconds an image"] = timed.seconds / timed.images
    facts |= {"peak_mb": peak_mb(), "peak_mb_before_data": at_start_mb}
    for of in found:
        show(of)
    Console(width=160).print(facts)
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        everything = [one for of in found for one in of]
        best = {of[0].frames.group: better_retrieval(of[2:]).method for of in found}
        write_metrics(
            arguments.out / "metrics.json", everything, units=units, retrieval=best, facts=facts
        )
        write_errors(arguments.out / "errors.csv", everything)
        for k, (of, group) in enumerate(zip(found, frames, strict=True)):
            drawn = {
                "trajectories": figures.trajectories(poses, group, estimates[k][2:], unit=units),
                "histograms": figures.histograms(of, unit=units),
                "curve": figures.error_curves(of, unit=units),
            }
            for what, figure in drawn.items():
                (arguments.out / f"{what}-{k}.svg").write_text(figure)


def show(evaluations: list[Evaluation]) -> None:
    """Print the table of one group."""
    titles = header(evaluations)
    group = evaluations[0].frames.group
    table = Table(title=group, title_justify="left", box=None)
    for title in titles:
        table.add_column(title, justify="left" if title == "method" else "right")
    for row in [*rows(evaluations), *paper_rows(group, len(titles))]:
        table.add_row(*row)
    Console(width=200).print(table)


def peak_mb() -> float:
    """Return the peak memory of this process in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
