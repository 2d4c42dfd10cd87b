"""`spn-model predict`: poses of any images or video."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from spn_cli import console, options

_REASONS_SHOWN = 6
_SEEN = 0.98  # of the network's view, below which the user is told


@click.command()
@click.argument(
    "inputs", metavar="SOURCES...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@options.area
@click.option("--run", "name", required=True, help="Trained network that tells the poses.")
@click.option(
    "--camera",
    "camera_file",
    type=click.Path(path_type=Path),
    help="The flying camera (JSON: model, width, height, params).  [default: photos' own metadata]",
)
@click.option(
    "--to",
    "target",
    required=True,
    type=click.Path(path_type=Path),
    help="Folder to write; it must be new or empty.",
)
@click.option(
    "--format",
    "formats",
    type=click.Choice(["csv", "tum", "wgs84"]),
    multiple=True,
    default=("csv",),
    show_default=True,
    help="What is written; may be repeated. The CSV is always there.",
)
@click.option(
    "--every",
    type=click.IntRange(1, 1_000_000),
    default=1,
    show_default=True,
    help="Take each so-many-th frame of a video.",
)
@click.option(
    "--fps",
    type=options.Finite(0.001, 1000),
    help="Take at most so many frames a second of a video.  [default: all]",
)
@click.option(
    "--batch",
    type=click.IntRange(1, 1024),
    default=8,
    show_default=True,
    help="Images given to the network at once.",
)
@options.device
@options.threads
@click.option("--overwrite", is_flag=True, help="Replace predicted poses in that folder.")
@click.pass_context
def predict(
    context: click.Context, /, inputs: tuple[Path, ...], area_folder: Path, **chosen: Any
) -> None:
    """Tell the poses of images, folders of images, or videos.

    The flying camera must be known: 4-eval/<name>/camera.json of a registered flight, or a calibration.
    Photos may bring a focal length of their own. A frame without a pose has a row that says why.

    \b
    Example:
        spn-model predict flight.mp4 --run first --camera cam.json --to poses/
    """
    from spn_model.prediction.predict import PredictionStopped

    try:
        run(inputs, area_folder, **chosen)
    except PredictionStopped as stopped:
        _tell(stopped.predicted)
        click.echo("Stopped: the frames so far are written, the rest is not done.", err=True)
        context.exit(130)


def run(
    inputs: tuple[Path, ...],
    area_folder: Path,
    *,
    name: str,
    camera_file: Path | None,
    target: Path,
    formats: tuple[str, ...],
    every: int,
    fps: float | None,
    batch: int,
    device: str,
    threads: int | None,
    overwrite: bool,
) -> None:
    import os

    from spn_data.area.names import CHECKPOINT
    from spn_data.errors import StageError
    from spn_data.geometry.camera_file import camera_to_json, read_camera
    from spn_data.storage.fingerprints import content_fingerprint
    from spn_model.models.checkpoint import load
    from spn_model.prediction.flights import FrameFilter, find_flights
    from spn_model.prediction.predict import PredictOptions, check_target
    from spn_model.prediction.predict import predict as work
    from spn_model.training import machine

    file = options.open_area(area_folder).run_folder(name) / CHECKPOINT
    if not file.is_file():
        raise StageError(
            f"{file.parent} holds no trained network; run spn-model train --run {name} first"
        )
    folder = Path(os.path.abspath(target))
    check_target(folder, overwrite=overwrite)
    given = None if camera_file is None else read_camera(camera_file)
    flights, notes = find_flights(inputs, given)
    chosen = machine.choose(device, threads or 0, "float32")
    with machine.limited_threads(chosen):
        network = load(file, chosen.device)
        if network.view.camera is None and not network.model.any_camera:
            notes.append(
                "the network was trained on images of several cameras, each as it was: poses of another "
                "camera's images are only as right as that is like them."
            )
        for note in notes:
            console.note(note)
        with console.progress() as progress:
            found = work(
                network,
                flights,
                folder,
                progress,
                PredictOptions(
                    choice=FrameFilter(every=every, fps=fps),
                    formats=tuple(dict.fromkeys(("csv", *formats))),
                    batch=batch,
                ),
                facts={
                    "run": name,
                    "checkpoint": content_fingerprint(file),
                    "kind": network.model.kind,
                    "camera": None if given is None else camera_to_json(given),
                },
                overwrite=overwrite,
            )
    _tell(found)
    place = network.view.origin
    if "wgs84" in formats and place is not None:
        console.out.print(f"Heights in wgs84.csv are above: {place.height_reference.value}.")
    if network.view.units != "m":
        console.note("lengths are in units of the model, not metres.")


def _tell(found: Any) -> None:
    counts = found.counts
    total = sum(counts.values())
    console.out.print(
        f"{found.folder}: {counts['estimated']} of {total} frames have a pose; "
        f"{1000 * found.seconds / max(1, total - counts['unreadable']):.0f} ms an image for the network."
    )
    for reason, number in found.reasons[:_REASONS_SHOWN]:
        console.note(f"{number} without a pose: {reason}")
    if found.seen < _SEEN:
        console.note(
            f"the flying camera fills {found.seen:.0%} of the view that the network was trained on; the "
            "rest of its images is black, and poses are less sure."
        )
