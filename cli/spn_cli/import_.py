"""The command `spn-data import`."""

from __future__ import annotations

from pathlib import Path

import click

from spn_cli import console, options, output


@click.command(name="import")
@click.argument("folder", type=click.Path(path_type=Path))
@click.option(
    "--to",
    "target",
    required=True,
    type=click.Path(path_type=Path),
    help="File to write, such as shop.h5.",
)
@click.option(
    "--size",
    "width_px",
    type=click.IntRange(16, 16_384),
    default=480,
    show_default=True,
    help="Width of the images in the data set, in pixels.",
)
@click.option(
    "--units",
    type=click.Choice(["m", "model"]),
    default="m",
    show_default=True,
    help="Unit of the positions, which the format does not state: metres, or unknown.",
)
@click.option(
    "--keep-outliers",
    is_flag=True,
    help="Keep frames whose position is implausibly far from all others.",
)
@click.option(
    "--subtract",
    nargs=3,
    type=options.Finite(-1e15, 1e15),
    default=(0.0, 0.0, 0.0),
    help="X Y Z to subtract from all positions for good; UTM coordinates do not need it.  [default: none]",
)
@click.option("--overwrite", is_flag=True, help="Replace the file if it exists.")
def import_(
    folder: Path,
    target: Path,
    *,
    width_px: int,
    units: str,
    keep_outliers: bool,
    subtract: tuple[float, float, float],
    overwrite: bool,
) -> None:
    """Convert a folder in the format of Cambridge Landmarks to a data set.

    FOLDER contains dataset_train.txt and, optionally, dataset_test.txt, dataset_validation.txt, the images
    that they list, and reconstruction.nvm.

    \b
    Example:
        spn-data import ShopFacade --to shop.h5
    """
    from spn_data.pipeline.import_cambridge import ImportOptions, import_cambridge

    wanted = ImportOptions(
        width_px=width_px, units=units, keep_outliers=keep_outliers, subtract=subtract
    )
    with console.progress() as progress:
        done = import_cambridge(folder, target, wanted, progress, overwrite=overwrite)
    output.figures(written=target, frames=done.counts, with_focal=done.with_focal)
    frames = ", ".join(f"{name} {count}" for name, count in done.counts.items())
    what = "images" if done.has_images else "poses without images"
    console.say(f"{target}: {what}: {frames}; {done.with_focal} with a known focal length.")
    for note in done.notes:
        console.note(note)
