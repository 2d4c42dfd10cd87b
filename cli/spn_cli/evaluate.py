"""`spn-model evaluate`: how far the poses of trained networks are from labels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from spn_cli import console, options
from spn_data.area.names import DATASET


@click.command()
@click.argument("dataset", required=False, type=click.Path(path_type=Path))
@options.area
@click.option(
    "--run",
    "runs",
    multiple=True,
    required=True,
    help="Trained network to judge; may be repeated, to compare several.",
)
@click.option(
    "--baselines/--no-baselines",
    default=True,
    show_default=True,
    help="Show beside it what needs no network.",
)
@click.option(
    "--dropout-samples",
    type=click.IntRange(7, 1000),
    help="Also the scatter of so many poses under dropout.  [default: not]",
)
@click.option(
    "--training-images",
    type=click.IntRange(1, 100_000),
    default=200,
    show_default=True,
    help="Training images that are judged too, spread evenly.",
)
@click.option(
    "--batch",
    type=click.IntRange(1, 1024),
    default=8,
    show_default=True,
    help="Images given to a network at once.",
)
@options.device
@options.threads
@options.seed
def evaluate(dataset: Path | None, area_folder: Path, runs: tuple[str, ...], **chosen: Any) -> None:
    """Errors of trained networks on the frames that test them.

    DATASET is a dataset.h5 of the world that they were trained in, by default the area's own. Nothing is
    aligned. Tables are printed; metrics.json, errors.csv and figures go to the folder of each run.

    \b
    Example:
        spn-model evaluate --area fields/north --run first
    """
    run(dataset, area_folder, runs, **chosen)


def run(
    dataset: Path | None,
    area_folder: Path,
    names: tuple[str, ...],
    *,
    baselines: bool,
    dropout_samples: int | None,
    training_images: int,
    batch: int,
    device: str,
    threads: int | None,
    seed: int,
) -> None:
    from spn_cli import page, show_networks
    from spn_data.area import names as names_of
    from spn_data.errors import InputError, StageError
    from spn_data.storage.fingerprints import content_fingerprint
    from spn_model.evaluation.comparison_files import (
        network_facts,
        select_network,
        write_comparison,
    )
    from spn_model.evaluation.evaluate import EvaluateOptions, compare
    from spn_model.models.checkpoint import load
    from spn_model.training import machine
    from spn_model.training.training_figure import read_log, training_figure

    area = options.open_area(area_folder)
    folders = {name: area.run_folder(name) for name in names}
    files = {name: folder / names_of.CHECKPOINT for name, folder in folders.items()}
    for name, file in files.items():
        if not file.is_file():
            raise StageError(
                f"{file.parent} holds no trained network; run spn-model train --run {name} first"
            )
    chosen = machine.choose(device, threads or 0, "float32")
    wanted = EvaluateOptions(
        training_images=training_images,
        batch=batch,
        baselines=baselines,
        dropout_samples=dropout_samples or 0,
        seed=seed,
    )
    if dataset is None:
        area.check_fresh(names_of.SPLIT)
    path = dataset or area.folder(names_of.SPLIT) / DATASET
    runs = area.root / names_of.RUNS
    with machine.limited_threads(chosen):
        networks = {name: load(file, chosen.device) for name, file in files.items()}
        with console.progress() as progress:
            found = compare(
                path,
                networks,
                (names_of.MODEL, names_of.GEO),
                progress,
                wanted,
                kept=runs / ".retrieval.json",
            )
    show_networks.comparison(found)
    facts, courses = {}, {}
    unit = "m" if found.units == "m" else "model units"
    for name, folder in folders.items():
        log, course = folder / names_of.LOG, None
        try:
            course = read_log(log) if log.exists() else None
        except InputError as error:
            console.note(f"the course of the training is not drawn: {error}")
        courses[folder] = {} if course is None else {"training": training_figure(course, unit=unit)}
        facts[name] = {
            **network_facts(networks[name]),
            "checkpoint": content_fingerprint(files[name]),
            "course": None if course is None else course.facts(),
        }
    parts = [(folders[name], select_network(found, name), {name: facts[name]}) for name in files]
    if len(files) > 1:
        parts.append((runs / names_of.COMPARED, found, facts))
    for folder, part, of in parts:
        folder.mkdir(parents=True, exist_ok=True)
        write_comparison(
            part,
            {"runs": of},
            metrics=folder / names_of.METRICS,
            errors=folder / names_of.ERRORS,
            drawings=folder / names_of.FIGURES,
            more_drawings=courses.get(folder),
        )
        console.out.print(f"{folder}: {names_of.METRICS}, {names_of.ERRORS}, {names_of.FIGURES}/.")
    page.refresh_if_free(area)
