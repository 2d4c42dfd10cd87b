"""The command `spn-data`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from spn_cli import options
from spn_cli.audit import audit
from spn_cli.console import Group
from spn_cli.coverage import coverage
from spn_cli.export import export
from spn_cli.import_ import import_
from spn_cli.register import register
from spn_cli.report import report
from spn_cli.split import split


@click.group(cls=Group)
@click.version_option(package_name="squeezeposenet-toolkit")
@click.option("-v", "--verbose", is_flag=True, help="Show log messages and tracebacks.")
def main(verbose: bool) -> None:
    """Prepare an area for flight with image-based localization."""


@main.command()
@click.argument(
    "inputs", metavar="VIDEO...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@options.area
@click.option("--add", is_flag=True, help="Extend the area by these sources; what it has is kept.")
@options.overwrite
@options.fov
@options.camera
@click.option("--frames", "target_count", type=click.IntRange(3), help="Frames wanted in all.")
@click.option(
    "--spacing",
    "motion_share",
    type=options.Finite(0.005, 1),
    default=0.1,
    show_default=True,
    help="Motion of the image between chosen frames, as a share of its width.",
)
@click.option(
    "--mask",
    type=click.Path(exists=True),
    help="Image, white where pixels may be used; or a folder of <sequence>.png.",
)
@click.option(
    "--any-telemetry", is_flag=True, help="Use telemetry whose length does not fit its video."
)
@click.option(
    "--engine",
    type=click.Choice(["incremental", "global"]),
    default="incremental",
    show_default=True,
    help="COLMAP's mapper.",
)
@click.option(
    "--max-features",
    type=click.IntRange(50, 100_000),
    default=4096,
    show_default=True,
    help="Features of an image.",
)
@click.option(
    "--max-image-size",
    type=click.IntRange(64),
    default=1600,
    show_default=True,
    help="Longer side in pixels on which features are found.",
)
@options.threads
@options.cluster
@options.seed
@options.georegistration
def reconstruct(inputs: tuple[Path, ...], area_folder: Path, add: bool, **chosen: Any) -> None:
    """Make a georeferenced model from flight video or photos with telemetry.

    VIDEO is a folder, or a file. An interrupted run goes on where it was; run again with nothing
    changed, it says so.

    \b
    Example:
        spn-data reconstruct video/ --area fields/north --fov 72
    """
    from spn_cli.reconstruct import run

    run(inputs, area_folder, add=add, **chosen)


@main.command()
@options.area
@options.overwrite
@options.georegistration
def georegister(area_folder: Path, overwrite: bool, **chosen: Any) -> None:
    """Put the area's model into metres again, with other options.

    \b
    Example:
        spn-data georegister --area fields/north --gnss-sigma 0.03 0.05 --overwrite
    """
    from spn_cli import page, show
    from spn_data.pipeline.geo_stage import georegister as stage

    area = options.open_area(area_folder)
    with area.locked():
        with show.Live() as live:
            wanted = options.geo_options(**chosen)
            live.stage(stage(area, wanted, live.progress, overwrite=overwrite))
        page.refresh(area)


main.add_command(register)
main.add_command(coverage)
main.add_command(split)
main.add_command(audit)


main.add_command(import_)
main.add_command(export)


main.add_command(report)


@main.command()
@options.area
def status(area_folder: Path) -> None:
    """What the area holds, what it was made with, and what is stale.

    \b
    Example:
        spn-data status --area fields/north
    """
    from spn_cli import show

    show.status(options.open_area(area_folder))


@main.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--preset",
    type=click.Choice(["standard", "demo"]),
    default="standard",
    show_default=True,
    help="standard: 1280x720 at 10 fps; demo: the same flights at 960x540 and 5 fps.",
)
@click.option("--seed", default=1, show_default=True, help="Of scene, flights and errors.")
@click.option(
    "--only", multiple=True, help="Flight or role (mapping, evaluation) to render; may be repeated."
)
@click.option(
    "--path",
    "mapping_paths",
    type=click.Choice(["courtyard", "nadir", "straight"]),
    default="courtyard",
    show_default=True,
    help="How the area is flown for mapping.",
)
@click.option("--rtk", is_flag=True, help="GNSS of 3 cm without drift or multipath.")
@click.option("--no-gimbal", is_flag=True, help="Telemetry without gimbal angles.")
@click.option(
    "--time-offset", "time_offset_s", default=0.0, help="Seconds by which telemetry is early."
)
@click.option(
    "--readout", "readout_s", default=0.0, help="Rolling shutter: seconds from first row to last."
)
@click.option("--area-factor", default=1.0, show_default=True, help="Times the courtyard's area.")
@click.option("--length-factor", default=1.0, show_default=True, help="Times the flights' length.")
def simulate(out: Path, preset: str, seed: int, **chosen: Any) -> None:
    """Render flights over a courtyard, with telemetry and exact truth.

    \b
    Example:
        spn-data simulate flights/ --preset demo --seed 1
    """
    from spn_cli.simulate import run

    run(out, preset, seed, **chosen)
