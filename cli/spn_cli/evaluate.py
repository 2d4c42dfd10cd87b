"""The command `spn-model evaluate`."""

from __future__ import annotations

from pathlib import Path

import click

from spn_cli import completion, console, options, output
from spn_data.area.names import ERRORS, FIGURES, FIXES, METRICS


@click.command()
@click.argument("dataset", required=False, type=click.Path(path_type=Path))
@options.area
@click.option(
    "--run",
    "names",
    multiple=True,
    shell_complete=completion.runs,
    required=True,
    help="Run whose network is evaluated; may be repeated to compare several.",
)
@click.option(
    "--baselines/--no-baselines",
    default=True,
    show_default=True,
    help="Compare with baselines that need no network.",
)
@click.option(
    "--fixes/--no-fixes",
    default=None,
    help="Localize the images of the evaluation flights with the exported bundle.  "
    "[default: where the run has one with landmarks]",
)
@click.option(
    "--attitude/--no-attitude",
    default=True,
    show_default=True,
    help="Measure fixes a second time, with pitch and roll from the telemetry of the flight.",
)
@click.option(
    "--video",
    "video_folder",
    type=click.Path(path_type=Path),
    help="Folder with the videos of the evaluation flights.  [default: where they were registered from]",
)
@click.option(
    "--dropout-samples",
    type=click.IntRange(7, 1000),
    help="Also estimate the covariance by Monte-Carlo dropout with this many samples.  [default: off]",
)
@click.option(
    "--training-images",
    type=click.IntRange(1, 100_000),
    default=200,
    show_default=True,
    help="Number of training images to evaluate as well, evenly spread.",
)
@click.option(
    "--batch",
    type=click.IntRange(1, 1024),
    default=8,
    show_default=True,
    help="Batch size.",
)
@click.option(
    "--figures",
    "formats",
    multiple=True,
    type=click.Choice(("png", "pdf")),
    help="Also write the figures in this format; may be repeated.  [default: SVG alone]",
)
@click.option(
    "--error-limits",
    nargs=2,
    type=(options.Finite(0.001, 1e6), options.Finite(0.001, 1e6)),
    metavar="DISTANCE DEGREES",
    help="Ends of the scales in histograms of errors, to compare figures.  [default: those of each group]",
)
@options.device
@options.threads
@options.seed
def evaluate(
    dataset: Path | None,
    area_folder: Path,
    *,
    names: tuple[str, ...],
    baselines: bool,
    fixes: bool | None,
    attitude: bool,
    video_folder: Path | None,
    dropout_samples: int | None,
    training_images: int,
    batch: int,
    formats: tuple[str, ...],
    error_limits: tuple[float, float] | None,
    device: str,
    threads: int | None,
    seed: int,
) -> None:
    """Evaluate trained networks on test and validation frames.

    DATASET is a dataset.h5 of the world that the networks were trained in, by default that of the area.
    Poses are not aligned to the labels. Fixes are those of the bundle of the run, on the full-size images of
    the evaluation flights of the area. Tables are printed; metrics.json, errors.csv, fixes.csv and figures
    are written to the folder of each run.

    \b
    Example:
        spn-model evaluate --area fields/north --run first
    """
    from spn_cli import page, show_networks
    from spn_data.charts.convert import convert_figures, require_matplotlib
    from spn_data.inputs.evaluation_flights import read_evaluation_flights
    from spn_data.storage.json_files import load_json
    from spn_model.evaluation.evaluate import EvaluateOptions
    from spn_model.evaluation.fix_files import RunFixes
    from spn_model.runs.run_evaluation import evaluate_runs, write_evaluation
    from spn_model.runs.run_files import RunFiles
    from spn_model.runs.run_fixes import fixes_of_runs

    if formats:
        require_matplotlib()
    area = options.open_area(area_folder)
    runs = [RunFiles(area.run_folder(name)) for name in dict.fromkeys(names)]
    for run in runs:
        run.require_checkpoint()
    path = options.dataset_or_split(area, dataset)
    wanted = EvaluateOptions(
        training_images=training_images,
        batch=batch,
        baselines=baselines,
        dropout_samples=dropout_samples or 0,
        seed=seed,
    )
    with console.progress() as progress:
        measured = (
            {run.name: RunFixes(reason="--no-fixes was given") for run in runs}
            if fixes is False
            else fixes_of_runs(
                runs,
                lambda: read_evaluation_flights(area, video_folder=video_folder),
                progress,
                required=bool(fixes),
                attitude=attitude,
            )
        )
        evaluated = evaluate_runs(
            runs, path, progress, wanted, fixes=measured, device=device, threads=threads or 0
        )
    show_networks.comparison(evaluated.comparison)
    show_networks.fixes(evaluated)
    written = write_evaluation(evaluated, error_limits)
    output.figures(runs={folder.name: load_json(folder / METRICS) for folder in written.folders})
    for folder in written.folders:
        if formats:
            convert_figures(folder / FIGURES, dict.fromkeys(formats))
        has_fixes = (folder / FIXES).is_file()
        console.say(
            f"{folder}: {METRICS}, {ERRORS}, {f'{FIXES}, ' if has_fixes else ''}{FIGURES}/."
        )
    show_networks.notes(evaluated)
    for note in written.notes:
        console.note(note)
    page.complete_cards(page.refresh_if_free(area), {run.name: run.bundle for run in runs})
