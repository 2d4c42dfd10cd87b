"""The command `spn-model train`."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from spn_cli import completion, console, options


@click.command()
@click.argument("dataset", required=False, type=click.Path(path_type=Path))
@options.area
@click.option(
    "--recipe",
    default="default",
    show_default=True,
    shell_complete=completion.recipes,
    help="Recipe to train by: one of the package, or a TOML file.",
)
@click.option(
    "--run",
    "run_name",
    shell_complete=completion.runs,
    help="Name of the folder in runs/.  [default: the recipe's name]",
)
@click.option(
    "--pretrain",
    type=click.Path(path_type=Path),
    help="dataset.h5 for the pretraining stages of the recipe.  [default: DATASET]",
)
@click.option(
    "--minutes",
    type=options.Finite(0, 10**6, min_open=True),
    help="Total training time in minutes, excluding validation.  [default: the recipe's]",
)
@click.option(
    "--images",
    type=click.IntRange(1, 10**10),
    help="Total number of training images to draw.  [default: the recipe's]",
)
@options.seed
@click.option(
    "--precision",
    type=click.Choice(["auto", "float32", "bfloat16"]),
    default="auto",
    show_default=True,
    help="Precision of the network; auto: bfloat16 if the device supports it natively.",
)
@click.option(
    "--validations",
    type=click.IntRange(1, 10_000),
    default=10,
    show_default=True,
    help="Number of validations during the training.",
)
@options.device
@options.threads
@click.option(
    "--overwrite", is_flag=True, help="Train again if options, recipe or data set changed."
)
def train(
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
    """Train a network for the area, or resume an interrupted training.

    DATASET is a dataset.h5, by default that of `spn-data split`. The folder runs/NAME receives
    checkpoint.safetensors, log.csv and config.json. The same command resumes an interrupted training.

    \b
    Example:
        spn-model train --area fields/north --run first
        spn-model train --area fields/north --recipe paper --minutes 10 --seed 2
    """
    from spn_cli import page
    from spn_cli.show_training import TrainingDisplay, errors_table
    from spn_data.area.names import FRAMES
    from spn_data.report.verdict import Level, VerdictReason
    from spn_model.runs.run_files import RunFiles
    from spn_model.runs.run_training import TrainRequest, train_run
    from spn_model.training.recipe import read_recipe
    from spn_model.training.train import Data, TrainOptions
    from spn_model.training.training_record import TrainingStopped

    area = options.open_area(area_folder)
    chosen = read_recipe(recipe).with_budget(images, minutes)
    run = RunFiles(area.run_folder(run_name or Path(recipe).stem))
    request = TrainRequest(
        run=run,
        recipe=chosen,
        recipe_name=recipe,
        data=Data(options.dataset_or_split(area, dataset), pretrain),
        options=TrainOptions(
            seed=seed,
            device=device,
            threads=threads or 0,
            precision=precision,
            validations=validations,
        ),
    )
    try:
        trained = train_run(request, TrainingDisplay(chosen), overwrite=overwrite)
    except TrainingStopped:
        raise KeyboardInterrupt from None
    if trained is None:
        return
    if not trained.is_new:
        console.say(f"{run.folder} is already trained.", wrap=False)
    errors_table(trained.facts, trained.unit)
    if trained.is_new:
        console.say(f"{run.folder}: {run.checkpoint.name}, {run.log.name}.", wrap=False)
    if not area.has(FRAMES):  # the data set is of another area, or imported
        words = ["spn-model", "evaluate", *([str(dataset)] if dataset else []), "--run", run.name]
        do = "Evaluate the network on frames that it was not trained on"
        page.show_next(VerdictReason(Level.GOOD, "", do, shlex.join(words)), area)
    # Also after a training that was complete: the run that finished it may have been killed before this.
    page.refresh_if_free(area)
