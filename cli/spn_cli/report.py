"""The command `spn-data report`."""

from __future__ import annotations

from pathlib import Path

import click

from spn_cli import console, options, page
from spn_data.area.area import Area


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
@click.option(
    "--serve",
    is_flag=True,
    help="Follow the work in the area: serve a page that updates itself, on this machine only.",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65_535),
    default=8765,
    show_default=True,
    help="Port of --serve; 0: any that is free.",
)
def report(
    area_folder: Path, max_points: int, max_frames: int, *, open_it: bool, serve: bool, port: int
) -> None:
    """Write report.html, which shows whether the area is ready for training, and why.

    With --serve, nothing is written: the page follows what other commands do.

    \b
    Example:
        spn-data report --area fields/north
        spn-data report --serve --area fields/north
    """
    from spn_data.pipeline.area_report import ReportOptions, write_report

    area = options.open_area(area_folder)
    if serve:
        _serve(area, port, open_it=open_it)
        return
    with area.locked(), console.working("Writing the page"):
        path, verdict = write_report(
            area, ReportOptions(max_points=max_points, max_frames=max_frames)
        )
    page.show_verdict(verdict, area, path)
    if open_it:
        page.open_in_browser(path.resolve().as_uri())


def _serve(area: Area, port: int, *, open_it: bool) -> None:
    """Serve the state of the area until Ctrl-C."""
    from spn_cli.serve import LOOPBACK, AreaServer

    with AreaServer(area, port) as running:
        address = f"http://{LOOPBACK}:{running.server_port}/"
        console.say(f"{address} (Ctrl-C ends it)", wrap=False)
        if open_it:
            page.open_in_browser(address)
        try:
            running.serve_forever()
        except KeyboardInterrupt:
            console.say("Ended.")
