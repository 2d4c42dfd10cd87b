"""The command `spn-model availability`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from spn_cli import completion, console, options, output

if TYPE_CHECKING:
    from spn_model.evaluation.availability import ExpectedFix

_SHOWN = 20
_UNKNOWN = (
    "not known here: light, seasons, what moved or moves, and motion blur; the views are as the training "
    "images show the place."
)


@click.command()
@options.area
@click.option(
    "--run",
    "name",
    required=True,
    shell_complete=completion.runs,
    help="Run whose bundle will fly.",
)
@click.option(
    "--waypoints",
    type=click.Path(path_type=Path),
    metavar="FILE.csv",
    help="Table of planned waypoints.  [default: the frames of the evaluation flights]",
)
@options.waypoint_camera
@click.option(
    "--to",
    "target",
    type=click.Path(path_type=Path),
    metavar="FILE.csv",
    help="Write a row for each waypoint or frame.",
)
@click.option("--overwrite", is_flag=True, help="Replace the file of --to if it exists.")
def availability(
    area_folder: Path,
    *,
    name: str,
    waypoints: Path | None,
    camera_file: Path | None,
    fov_deg: float | None,
    target: Path | None,
    overwrite: bool,
) -> None:
    """Say before a flight where a fix is to be expected.

    At each waypoint, a view is rendered from the training images, and the bundle of the run searches for it.
    Without waypoints, this is done for the frames of the evaluation flights and compared with the fixes that
    they had. What is expected of the last plan is kept in the folder of the run, and report.html shows it.

    \b
    Example:
        spn-model availability --area fields/north --run first --waypoints plan.csv --fov 84
    """
    from spn_cli import page
    from spn_data.geometry.camera_file import read_camera
    from spn_data.inputs.area_labels import map_folder, read_labelled_area
    from spn_data.inputs.evaluation_flights import read_evaluation_flights
    from spn_data.labels.map_hash import map_hash
    from spn_data.pipeline.area_coverage import (
        CoverageStageOptions,
        check_output_file,
        read_plan,
    )
    from spn_model.runs.run_availability import (
        expect_fixes,
        keep_plan,
        measured_usable,
        searched_frames,
        write_expected,
    )
    from spn_model.runs.run_files import RunFiles

    if waypoints is None and (camera_file is not None or fov_deg is not None):
        raise click.UsageError("--camera and --fov need --waypoints; labels have their own camera")
    if camera_file is not None and fov_deg is not None:
        raise click.UsageError("give either --camera or --fov")
    if target is not None:
        check_output_file(target, overwrite=overwrite)
    area = options.open_area(area_folder)
    run = RunFiles(area.run_folder(name))
    dataset = options.dataset_or_split(area, None)
    measured: dict[str, bool] = {}
    if waypoints is not None:
        camera = None if camera_file is None else read_camera(camera_file)
        wanted = CoverageStageOptions(camera=camera, fov_deg=fov_deg)
        labelled = read_labelled_area(area, mapping_covariance=False, tracked=False)
        queries = {waypoints.name: read_plan(area, labelled, wanted, waypoints)}
    else:
        measured = measured_usable(run)
        flights = read_evaluation_flights(area).flights
        queries = {flight.name: searched_frames(flight) for flight in flights}
    with console.progress() as progress:
        hashed = map_hash(map_folder(area))
        parts = expect_fixes(run, dataset, hashed, list(queries.values()), progress)
    found = dict(zip(queries, parts, strict=True))
    output.figures(expected=found)
    if waypoints is not None:
        _show_plan(found)
    else:
        _show_comparison(found, measured)
    if waypoints is not None:
        keep_plan(run, waypoints.name, parts[0])
    if target is not None:
        write_expected(target, [one for part in parts for one in part])
        console.say(f"{target}: {sum(map(len, parts))} rows.")
    console.note(_UNKNOWN)
    if waypoints is not None:
        page.refresh_if_free(area)


def _show_plan(found: dict[str, list[ExpectedFix]]) -> None:
    """Print how many waypoints have a fix to be expected, and those that have none."""
    for name, part in found.items():
        lacking = [one for one in part if one.reason]
        console.say(
            f"{name}: a fix is to be expected at {len(part) - len(lacking)} of {len(part)} waypoints."
        )
        if not lacking:
            continue
        rows = [
            (
                one.name,
                one.expectation.value,
                str(one.landmarks),
                f"{one.spread:.0%}",
                f"{one.shown:.0%}",
                one.reason,
            )
            for one in lacking[:_SHOWN]
        ]
        header = ("waypoint", "fix", "landmarks", "spread", "shown", "reason")
        console.table(f"{name}: waypoints without a fix in the rendered view", rows, header)
        if len(lacking) > _SHOWN:
            console.say(f"... and {len(lacking) - _SHOWN} more; --to writes all.\n")


def _show_comparison(found: dict[str, list[ExpectedFix]], measured: dict[str, bool]) -> None:
    """Print what was expected of the frames of evaluation flights against what they had."""
    rows = []
    for name, part in found.items():
        both = [(one.expectation.value, measured[one.name]) for one in part if one.name in measured]
        counts = [
            f"{both.count((said, True))} of {sum(one == said for one, _ in both)}"
            for said in ("yes", "perhaps", "no")
        ]
        rows.append((name, *counts))
        pairs = {one.name: measured[one.name] for one in part if one.name in measured}
        output.current().figures.setdefault("measured_usable", {})[name] = pairs
    console.table(
        "Frames that had a fix, by what was expected of the rendered view",
        rows,
        ("flight", "yes", "perhaps", "no"),
    )
