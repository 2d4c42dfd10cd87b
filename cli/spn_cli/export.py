"""The command `spn-data export`."""

from __future__ import annotations

from pathlib import Path

import click

from spn_cli import completion, console, options, output

FORMATS = (
    "tum",
    "nerfstudio",
    "kapture",
    "geojson",
    "kml",
    "colmap-text",
    "colmap",
    "nvm",
    "geotiff",
    "all",
)


@click.command()
@click.argument("format_name", metavar="FORMAT", type=click.Choice(FORMATS))
@click.option(
    "--to",
    "target",
    required=True,
    type=click.Path(path_type=Path),
    help="Folder to write; it must be new or empty.",
)
@options.area
@click.option(
    "--sequence",
    "sequences",
    multiple=True,
    shell_complete=completion.sequences,
    help="Sequence to export; may be repeated.  [default: all]",
)
@click.option(
    "--all-frames", is_flag=True, help="Include tracked frames, in formats that list no images."
)
@click.option("--no-images", is_flag=True, help="Do not copy the images.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier export in that folder.")
def export(
    format_name: str,
    target: Path,
    area_folder: Path,
    sequences: tuple[str, ...],
    all_frames: bool,
    no_images: bool,
    overwrite: bool,
) -> None:
    """Export the poses of all registered frames to formats of other programs.

    FORMAT is tum, nerfstudio, kapture, geojson, kml, colmap-text, colmap, nvm or geotiff (an orthophoto of
    the ground); all writes a folder of each. Mapping and evaluation frames are exported; the area is not
    changed.

    \b
    Example:
        spn-data export nerfstudio --to north-nerf --area fields/north
    """
    from dataclasses import asdict

    from spn_data.pipeline import area_export as stage

    area = options.open_area(area_folder)
    chosen = stage.LabelExportOptions(
        sequences=sequences, all_frames=all_frames, images=not no_images
    )
    with area.locked(), console.working(f"Writing {target}"):
        done = stage.export(area, stage.Format(format_name), target, chosen, overwrite=overwrite)
    output.figures(written=target, **asdict(done))
    rows = [(name, str(count)) for name, count in done.frames.items()]
    console.table("Poses", rows, ("sequence", "frames"))
    console.say(f"Written to {target}: {', '.join(done.formats)}.")
    if done.units != "m":
        console.note("the map is not georegistered: lengths are in model units, not metres.")
    for note in done.notes:
        console.note(note)
    for name, reason in done.left_out.items():
        console.note(f"{name} is left out: {reason}.")
