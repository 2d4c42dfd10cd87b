"""The command `spn-model export`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from spn_cli import completion, console, options, output
from spn_data.area.names import DATASET, GEO, SPLIT

_DEFAULT_MB = 10.0  # of landmarks

if TYPE_CHECKING:
    from spn_model.export.exported import ExportedBundle


@click.command("export")
@click.argument("dataset", required=False, type=click.Path(path_type=Path))
@options.area
@click.option(
    "--run",
    "name",
    required=True,
    shell_complete=completion.runs,
    help="Run whose network is exported.",
)
@click.option(
    "--to",
    "target",
    type=click.Path(path_type=Path),
    help="Folder of the bundle.  [default: runs/<run>/bundle]",
)
@click.option(
    "--int8/--no-int8", default=True, show_default=True, help="Also export an 8-bit graph."
)
@click.option(
    "--calibration-images",
    type=click.IntRange(1, 10_000),
    default=64,
    show_default=True,
    help="Number of training images that calibrate the 8-bit activations.",
)
@click.option(
    "--map-mb",
    type=click.FloatRange(0, 200),
    help="Largest size of the landmark map, which fixes of centimetres need; 0 for none.  "
    "[default: 10, or 0 where the data set is not from a georeferenced map of the area]",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing bundle.")
def export(
    dataset: Path | None,
    area_folder: Path,
    *,
    name: str,
    target: Path | None,
    int8: bool,
    calibration_images: int,
    map_mb: float | None,
    overwrite: bool,
) -> None:
    """Export a network as a bundle for the drone: ONNX graphs and the parameters of pose decoding.

    DATASET is a dataset.h5 of the world that the network was trained in, by default that of the area. Its
    training images calibrate the 8-bit graph; its evaluation sequences measure the loss of accuracy.

    \b
    Example:
        spn-model export --area fields/north --run first
    """
    from spn_cli import page
    from spn_data.inputs.landmark_source import read_landmark_source
    from spn_model.export.bundle_checks import BundleOptions
    from spn_model.runs.run_export import export_run
    from spn_model.runs.run_files import RunFiles

    area = options.open_area(area_folder)
    run = RunFiles(area.run_folder(name))
    if map_mb is None:
        map_mb = _DEFAULT_MB if dataset is None and area.has(GEO) else 0.0
        if not map_mb:
            console.note(
                "the bundle gets no landmarks, because there is no georeferenced map of the data set in the "
                "area: spn-onboard gives coarse poses only."
            )
    with console.progress() as progress:
        exported = export_run(
            run,
            dataset or area.folder(SPLIT) / DATASET,
            progress,
            BundleOptions(int8=int8, calibration_images=calibration_images, map_mb=map_mb),
            source=read_landmark_source(area) if map_mb else None,
            target=target,
            overwrite=overwrite,
        )
    output.figures(folder=exported.folder, bundle=exported.bundle)
    if exported.bundle is None:
        console.say(f"{exported.folder}: unchanged, made from the same network and options.")
    else:
        _show(exported.bundle)
        if not exported.is_evaluated:
            console.note(
                f"the run was not evaluated, so its model card contains neither errors nor fixes: run "
                f"spn-model evaluate --run {name}, which completes it."
            )
    for note in exported.notes:
        console.note(note)
    verdict = page.refresh_if_free(area)
    if target is None:
        page.complete_cards(verdict, {name: run.bundle})


def _show(made: ExportedBundle) -> None:
    from spn_model.export.model_card import int8_error_increase, percent_text
    from spn_model.onboard.bundle import CARD, DOCUMENT

    unit = "m" if made.units == "m" else "units"
    rows = []
    for one in made.errors:
        percent = int8_error_increase(made.errors, one.group) if one.precision == "int8" else None
        change = ("", "") if percent is None else tuple(map(percent_text, percent))
        rows.append(
            (
                one.group,
                one.precision,
                f"{made.bytes[one.precision] / 1e6:.2f} MB",
                f"{one.located} of {one.images}",
                _figure(one.position, unit),
                change[0],
                _figure(one.rotation_deg, "deg"),
                change[1],
            )
        )
    header = ("group", "graph", "file", "with a pose", "median", "change", "median", "change")
    console.table("Errors of the exported graphs", rows, header)
    if made.landmarks is not None:
        found = made.landmarks
        console.say(
            f"Landmarks: {found.landmarks} with {found.descriptors} descriptors, from "
            f"{found.training_frames} training frames."
        )
        console.say(f"Attitude: {made.gimbal}.")
    parity = made.parity
    console.say(
        f"Difference from PyTorch on {parity.images} images: outputs {parity.output:.1e} of their largest "
        f"value, poses {parity.position:.1e} {unit} and {parity.rotation_deg:.1e} deg (median)."
    )
    console.say(f"{made.folder}: {DOCUMENT}, graphs, {CARD}.")


def _figure(value: float, unit: str) -> str:
    return f"{value:.3f} {unit}" if math.isfinite(value) else "none"
