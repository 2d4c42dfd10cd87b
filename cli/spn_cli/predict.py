"""The command `spn-model predict`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from spn_cli import completion, console, options, output

if TYPE_CHECKING:
    from spn_model.prediction.predict import Predicted

_REASONS_SHOWN = 6
_VIEW_SEEN = 0.98  # share of the network's view below which a note is shown


@click.command()
@click.argument(
    "inputs", metavar="SOURCES...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@options.area
@click.option(
    "--run",
    "name",
    required=True,
    shell_complete=completion.runs,
    help="Run whose network estimates the poses.",
)
@click.option(
    "--camera",
    "camera_file",
    type=click.Path(path_type=Path),
    help="Camera of the sources (JSON: model, width, height, params).  [default: photo metadata]",
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
    help="Format to write; may be repeated. The CSV file is always written.",
)
@click.option(
    "--every",
    type=click.IntRange(1, 1_000_000),
    default=1,
    show_default=True,
    help="Use every Nth frame of a video.",
)
@click.option(
    "--fps",
    type=options.Finite(0.001, 1000),
    help="Use at most this many frames per second of a video.  [default: all]",
)
@click.option(
    "--batch",
    type=click.IntRange(1, 1024),
    default=8,
    show_default=True,
    help="Batch size.",
)
@click.option(
    "--attitude",
    "attitude_file",
    type=click.Path(path_type=Path),
    help="CSV file with pitch and roll of the one source, from spn-data telemetry.",
)
@click.option(
    "--attitude-of",
    type=click.Choice(["gimbal", "camera"]),
    default="gimbal",
    show_default=True,
    help="Whose angles: of a gimbal, corrected by its mounting in the bundle of the run, or of the camera.",
)
@click.option(
    "--attitude-sigma",
    type=options.Finite(0.001, 45),
    help="Standard deviation of each angle, degrees.  [default: of the file, or of the mounting]",
)
@click.option(
    "--attitude-offset",
    type=options.Finite(-1e9, 1e9),
    default=0.0,
    show_default=True,
    help="Seconds to add to the times of that file.",
)
@options.device
@options.threads
@click.option("--overwrite", is_flag=True, help="Replace predicted poses in that folder.")
@click.pass_context
def predict(
    context: click.Context,
    /,
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
    attitude_file: Path | None,
    attitude_of: str,
    attitude_sigma: float | None,
    attitude_offset: float,
    device: str,
    threads: int | None,
    overwrite: bool,
) -> None:
    """Estimate camera poses of images and videos.

    SOURCES are images, videos, or folders of them. Their camera must be known: 4-eval/<name>/camera.json of
    a registered flight, a calibration, or the focal length in the metadata of photos. A frame without a pose
    has a row that states the reason.

    \b
    Example:
        spn-model predict flight.mp4 --run first --camera cam.json --to poses/
    """
    from spn_model.prediction.flights import FrameFilter
    from spn_model.prediction.predict import WGS84, PredictionStopped, PredictOptions
    from spn_model.runs.run_files import RunFiles
    from spn_model.runs.run_prediction import AttitudeFile, prepare_prediction

    run = RunFiles(options.open_area(area_folder).run_folder(name))
    prediction = prepare_prediction(
        *(run, inputs, camera_file, target),
        device=device,
        threads=threads or 0,
        overwrite=overwrite,
        attitude=None
        if attitude_file is None
        else AttitudeFile(
            path=attitude_file,
            of=attitude_of,
            sigma_deg=attitude_sigma,
            offset_s=attitude_offset,
        ),
    )
    for note in prediction.notes:
        console.note(note)
    wanted = PredictOptions(
        choice=FrameFilter(every=every, fps=fps),
        formats=tuple(dict.fromkeys(("csv", *formats))),
        batch=batch,
    )
    try:
        with console.progress() as progress:
            found = prediction.write(progress, wanted)
    except PredictionStopped as stopped:
        _show(stopped.predicted)
        click.echo("Stopped: the poses so far are written; the rest is missing.", err=True)
        context.exit(130)
    _show(found)
    if prediction.attitude is not None:
        console.say(prediction.attitude.coverage(found.with_attitude, sum(found.counts.values())))
    view = prediction.network.view
    if "wgs84" in formats and view.origin is not None:
        console.say(f"Heights in {WGS84} are above: {view.origin.height_reference.value}.")
    if view.units != "m":
        console.note("lengths are in model units, not metres.")


def _show(found: Predicted) -> None:
    counts = found.counts
    total = sum(counts.values())
    output.figures(
        written=found.folder,
        frames=counts,
        without_pose=dict(found.reasons),
        network_seconds=found.seconds,
        view_seen=found.seen,
        is_complete=found.complete,
    )
    console.say(
        f"{found.folder}: {counts['estimated']} of {total} frames have a pose; the network took "
        f"{1000 * found.seconds / max(1, total - counts['unreadable']):.0f} ms per image."
    )
    for reason, number in found.reasons[:_REASONS_SHOWN]:
        console.note(f"{number} without a pose: {reason}")
    if found.seen < _VIEW_SEEN:
        console.note(
            f"the flying camera fills {found.seen:.0%} of the view that the network was trained on; the rest "
            "of its images is black, and poses are less certain."
        )
