"""The command `spn-data report`."""

from __future__ import annotations

from pathlib import Path

import click

from spn_cli import options, page


@click.command()
@options.area
@click.option(
    "--max-points",
    type=click.IntRange(0, 2_000_000),
    default=100_000,
    show_default=True,
    help="Maximum number of map points in the page.",
)
@click.option(
    "--max-frames",
    type=click.IntRange(100, 200_000),
    default=30_000,
    show_default=True,
    help="Maximum number of frames in the page; failed and chosen ones are always kept.",
)
@click.option("--open", "open_it", is_flag=True, help="Open the page in a browser.")
def report(area_folder: Path, max_points: int, max_frames: int, open_it: bool) -> None:
    """Write report.html, which shows whether the area is ready for training, and why.

    \b
    Example:
        spn-data report --area fields/north
    """
    from spn_data.pipeline.area_report import ReportOptions, write_report

    area = options.open_area(area_folder)
    with area.locked():
        path, verdict = write_report(
            area, ReportOptions(max_points=max_points, max_frames=max_frames)
        )
    page.show_verdict(verdict, area, path)
    if open_it:
        page.open_in_browser(path)
