"""The command `spn-data telemetry`."""

from __future__ import annotations

from pathlib import Path

import click


@click.command()
@click.argument("file", type=click.Path(dir_okay=False, path_type=Path))
@click.option(
    "--to",
    "target",
    required=True,
    type=click.Path(dir_okay=False, path_type=Path),
    help="CSV file to write; it must be new.",
)
def telemetry(file: Path, target: Path) -> None:
    """Write the telemetry of a flight as one CSV table.

    FILE is a log, a subtitle file, or a video that holds telemetry. Times are seconds on its clock. The table
    is what spn-onboard reads as --attitude.

    \b
    Example:
        spn-data telemetry flight.SRT --to attitude.csv
    """
    import numpy as np

    from spn_cli import console, output
    from spn_data.errors import InputError
    from spn_data.telemetry.read import read_telemetry
    from spn_data.telemetry.table import write_track

    if target.exists():
        raise InputError("already exists; choose another file", path=target)
    with console.working(f"Reading {file}"):
        track = read_telemetry(file)
    write_track(target, track)
    angles = int(np.isfinite(track.gimbal_deg[:, 1:]).all(axis=1).sum())
    output.figures(
        kind=track.kind,
        records=len(track),
        with_position=track.has_fix.sum(),
        with_attitude=angles,
        written=target,
    )
    console.say(
        f"{target}: {len(track)} records ({track.kind}), {int(track.has_fix.sum())} with a position, "
        f"{angles} with pitch and roll of the camera."
    )
    for note in track.notes:
        console.note(note)
