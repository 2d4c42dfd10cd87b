"""`spn-model export`: a trained network as a bundle for the drone."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from spn_cli import console, options
from spn_data.area.names import DATASET

if TYPE_CHECKING:
    from spn_model.export.exported import ExportedBundle


@click.command("export")
@click.argument("dataset", required=False, type=click.Path(path_type=Path))
@options.area
@click.option("--run", "name", required=True, help="Trained network to export.")
@click.option(
    "--to",
    "target",
    type=click.Path(path_type=Path),
    help="Folder of the bundle.  [default: runs/<run>/bundle]",
)
@click.option("--int8/--no-int8", default=True, show_default=True, help="Also in 8 bits.")
@click.option(
    "--calibration-images",
    type=click.IntRange(1, 10_000),
    default=64,
    show_default=True,
    help="Training images that tell the ranges of 8-bit activations.",
)
@options.overwrite
def export(dataset: Path | None, area_folder: Path, **chosen: Any) -> None:
    """Write a bundle for the drone: the network as ONNX, and all that makes poses of its output.

    DATASET is a dataset.h5 of the world that it was trained in, by default the area's own: 8 bits are
    calibrated on its training images, and what they lose is measured on its evaluation sequences.

    \b
    Example:
        spn-model export --area fields/north --run first
    """
    run(dataset, area_folder, **chosen)


def run(
    dataset: Path | None,
    area_folder: Path,
    *,
    name: str,
    target: Path | None,
    int8: bool,
    calibration_images: int,
    overwrite: bool,
) -> None:
    from spn_data.area import names as names_of
    from spn_data.errors import StageError
    from spn_data.storage.fingerprints import content_fingerprint
    from spn_model.export.bundle_checks import BundleOptions
    from spn_model.export.bundle_export import export as work
    from spn_model.export.bundle_export import is_up_to_date
    from spn_model.models.checkpoint import load

    area = options.open_area(area_folder)
    file = area.run_folder(name) / names_of.CHECKPOINT
    if not file.is_file():
        raise StageError(
            f"{file.parent} holds no trained network; run spn-model train --run {name} first"
        )
    folder = target or area.run_folder(name) / names_of.BUNDLE
    source = dataset or area.folder(names_of.SPLIT) / DATASET
    fingerprint = content_fingerprint(file)
    metrics = _evaluation(area.run_folder(name) / names_of.METRICS, name, fingerprint)
    wanted = BundleOptions(int8=int8, calibration_images=calibration_images)
    facts = {"run": name, "checkpoint": fingerprint, "evaluated": metrics is not None}
    if not overwrite and is_up_to_date(folder, facts, wanted):
        console.out.print(f"{folder}: stands already, made of the same.")
        return
    network = load(file)
    with console.progress() as progress:
        made = work(
            network,
            source,
            folder,
            {**network.facts, **facts},
            progress,
            wanted,
            world_names=(names_of.MODEL, names_of.GEO),
            metrics=metrics,
            overwrite=overwrite,
        )
    _show(made)
    if metrics is None:
        console.note(
            "the run was not evaluated: its card has no errors. "
            f"spn-model evaluate --run {name}, then export again with --overwrite."
        )


def _evaluation(path: Path, name: str, fingerprint: str) -> dict[str, Any] | None:
    """Of this very network; None where there is none, or of another state of it."""
    if not path.is_file():
        return None
    try:
        metrics = json.loads(path.read_text(encoding="utf-8"))
        same = metrics["facts"]["runs"][name]["checkpoint"] == fingerprint
        groups = metrics["groups"]
        return metrics if same and any(name in methods for methods in groups.values()) else None
    except (OSError, ValueError, KeyError, TypeError) as error:
        console.note(f"{path} cannot be read ({error!r}): the card has no errors.")
        return None


def _show(made: ExportedBundle) -> None:
    from spn_model.export.model_card import int8_error_increase

    unit = "m" if made.units == "m" else "units"
    rows = []
    for one in made.errors:
        percent = int8_error_increase(made.errors, one.group) if one.precision == "int8" else None
        told = ("", "") if percent is None else (_percent(percent[0]), _percent(percent[1]))
        rows.append(
            (
                one.group,
                one.precision,
                f"{made.bytes[one.precision] / 1e6:.2f} MB",
                f"{one.located} of {one.images}",
                _figure(one.position, unit),
                told[0],
                _figure(one.rotation_deg, "deg"),
                told[1],
            )
        )
    header = ("group", "graph", "file", "with a pose", "median", "change", "median", "change")
    console.table("Errors of the exported graphs", rows, header)
    parity = made.parity
    console.out.print(
        f"Against PyTorch, on {parity.images} images: outputs to {parity.output:.1e} of their largest value; "
        f"half of the poses to {parity.position:.1e} {unit} and {parity.rotation_deg:.1e} deg."
    )
    console.out.print(f"{made.folder}: bundle.json, graphs, MODEL_CARD.md.")


def _figure(value: float, unit: str) -> str:
    return f"{value:.3f} {unit}" if math.isfinite(value) else "none"


def _percent(value: float) -> str:
    return f"{value:+.1f} %" if math.isfinite(value) else ""
