"""The command `spn-data check-points`."""

from __future__ import annotations

from pathlib import Path

import click

from spn_cli import options


@click.command("check-points")
@click.argument("file", type=click.Path(dir_okay=False, path_type=Path))
@options.area
@options.gcp_sigma
@options.mark_sigma
def check_points(
    file: Path, area_folder: Path, gcp_sigma_m: tuple[float, float], mark_sigma_px: float
) -> None:
    """Compare surveyed points, marked in images of the map, with a georegistered area.

    FILE is ODM's gcp_list.txt, or CSV. All its points are check points, and nothing is changed.

    \b
    Example:
        spn-data check-points targets.csv --area fields/north
    """
    from dataclasses import asdict

    from spn_cli import console, show
    from spn_data.pipeline.ground_control import ControlOptions
    from spn_data.pipeline.ground_control import check_points as check
    from spn_data.storage.json_files import finite

    wanted = ControlOptions(file=str(file), sigma_m=gcp_sigma_m, mark_sigma_px=mark_sigma_px)
    points, notes = check(options.open_area(area_folder), wanted)
    show.surveyed([finite(asdict(point)) for point in points])
    for note in notes:
        console.note(note)
