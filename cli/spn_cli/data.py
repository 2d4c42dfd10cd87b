"""The command `spn-data`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from spn_cli import options
from spn_cli.audit import audit
from spn_cli.check_points import check_points
from spn_cli.coverage import coverage
from spn_cli.export import export
from spn_cli.group import Group
from spn_cli.import_ import import_
from spn_cli.register import register
from spn_cli.report import report
from spn_cli.split import split
from spn_cli.telemetry import telemetry


@click.group(cls=Group)
@click.version_option(package_name="squeezeposenet-toolkit")
def main() -> None:
    """Prepare an area for image-based localization of UAVs."""


@main.command()
@click.argument(
    "inputs", metavar="VIDEO...", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@options.area
@click.option("--add", is_flag=True, help="Add these sources to the area; its data are kept.")
@options.overwrite
@options.fov
@options.camera
@options.fixed_lens
@click.option(
    "--frames",
    "target_count",
    type=click.IntRange(3),
    help="Total number of frames to choose.  [default: as many as the spacing yields]",
)
@click.option(
    "--spacing",
    "motion_share",
    type=options.Finite(0.005, 1),
    default=0.1,
    show_default=True,
    help="Image motion between chosen frames, as a share of the image width.",
)
@click.option(
    "--mask",
    type=click.Path(exists=True),
    help="Mask image, white where pixels may be used, or a folder of <sequence>.png.",
)
@click.option(
    "--any-telemetry",
    is_flag=True,
    help="Use telemetry even if its length, time or time zone does not match its images.",
)
@click.option(
    "--engine",
    type=click.Choice(["incremental", "global"]),
    default="incremental",
    show_default=True,
    help="COLMAP's mapper to use.",
)
@click.option(
    "--max-features",
    type=click.IntRange(50, 100_000),
    default=4096,
    show_default=True,
    help="Maximum number of features per image.",
)
@click.option(
    "--max-image-size",
    type=click.IntRange(64),
    default=1600,
    show_default=True,
    help="Longer image side in pixels for feature extraction; larger images are reduced.",
)
@options.threads
@options.cluster
@options.seed
@options.georegistration
def reconstruct(inputs: tuple[Path, ...], area_folder: Path, add: bool, **chosen: Any) -> None:
    """Reconstruct a georeferenced map from flight videos or photos with telemetry.

    VIDEO is a file or a folder. The same command resumes an interrupted run; stages that are up to date are
    not redone.

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
    """Georegister the area's model again with other options.

    \b
    Example:
        spn-data georegister --area fields/north --gnss-sigma 0.03 0.05 --overwrite
    """
    from spn_cli import page, remembered, show
    from spn_data.pipeline.geo_stage import georegister as stage

    area = options.open_area(area_folder)
    with area.locked():
        filled = remembered.fill(area, chosen)
        with show.Live() as live:
            wanted = options.geo_options(**filled)
            live.stage(stage(area, wanted, live.progress, overwrite=overwrite))
        remembered.keep(area, chosen)
        page.refresh(area)


main.add_command(check_points)
main.add_command(register)
main.add_command(coverage)
main.add_command(split)
main.add_command(audit)


main.add_command(import_)
main.add_command(export)


main.add_command(report)
main.add_command(telemetry)


@main.command()
@options.area
def status(area_folder: Path) -> None:
    """Show the stages and runs of the area, which of them are stale, and the next step.

    \b
    Example:
        spn-data status --area fields/north
    """
    from spn_cli import page, show

    area = options.open_area(area_folder)
    show.status(area)
    page.show_judgement(area)


@main.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--preset",
    type=click.Choice(["standard", "demo", "look-alike", "modern", "street", "village"]),
    default="standard",
    show_default=True,
    help="Place and flights. standard: a brick courtyard, 1280x720 at 10 fps; demo: the same at 960x540 and "
    "5 fps; look-alike: another courtyard with the same windows; modern: a courtyard of plaster, panels and "
    "glass.",
)
@click.option(
    "--seed", default=1, show_default=True, help="Random seed of scene, flights and errors."
)
@click.option(
    "--only",
    multiple=True,
    help="Flight or role (mapping, evaluation) to render; may be repeated.  [default: all]",
)
@click.option(
    "--path",
    "mapping_paths",
    type=click.Choice(["courtyard", "nadir", "straight"]),
    default="courtyard",
    show_default=True,
    help="Paths of the mapping flights in the brick courtyard.",
)
@click.option(
    "--rtk",
    is_flag=True,
    help="Simulate RTK: GNSS with 3 cm white noise, without drift or multipath.",
)
@click.option("--no-gimbal", is_flag=True, help="Write telemetry without gimbal angles.")
@click.option(
    "--time-offset",
    "time_offset_s",
    default=0.0,
    show_default=True,
    help="Seconds by which telemetry is early.",
)
@click.option(
    "--readout",
    "readout_s",
    default=0.0,
    show_default=True,
    help="Readout time of the rolling shutter in seconds, from first to last row.",
)
@click.option("--area-factor", default=1.0, show_default=True, help="Factor of the ground area.")
@click.option(
    "--length-factor", default=1.0, show_default=True, help="Factor of the duration of the flights."
)
def simulate(out: Path, preset: str, seed: int, **chosen: Any) -> None:
    """Render simulated flights over a place, with telemetry and exact ground truth.

    \b
    Example:
        spn-data simulate flights/ --preset demo --seed 1
    """
    from spn_cli.simulate import run

    run(out, preset, seed, **chosen)
