"""The command `spn-data coverage`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from spn_cli import console, options, output, page

if TYPE_CHECKING:
    from spn_data.coverage.sequence_table import Coverage
    from spn_data.pipeline.area_coverage import AreaCoverage

_LIMITS = (options.Finite(0, min_open=True), options.Finite(0, 180, min_open=True))
_SHOWN_STOPS = 20


@click.command()
@options.area
@click.option(
    "--waypoints",
    type=click.Path(path_type=Path),
    metavar="FILE.csv",
    help="Table of planned waypoints to check instead of the evaluation sequences.",
)
@options.waypoint_camera
@click.option(
    "--high",
    type=_LIMITS,
    metavar="M DEG",
    help="Limits of high coverage: distance and angle to the nearest mapping frame.  [default: 2 15]",
)
@click.option(
    "--medium",
    type=_LIMITS,
    metavar="M DEG",
    help="Limits of medium coverage.  [default: 5 40]",
)
@click.option(
    "--fly-again",
    type=click.Path(path_type=Path),
    metavar="FILE.csv",
    help="Write places to fly again in order to close the gaps.",
)
@click.option(
    "--wanted",
    type=click.Choice(["high", "medium"]),
    default="high",
    show_default=True,
    help="Coverage that every frame should reach with --fly-again.",
)
@click.option(
    "--margin",
    type=options.Finite(0, 1, min_open=True),
    default=0.7,
    show_default=True,
    help="Share of the limits used for planning; the rest is a margin for inexact flying.",
)
@click.option(
    "--floor",
    "floor_m",
    type=options.Finite(0, 1000),
    default=2.0,
    show_default=True,
    help="Least height of these places above the ground, in metres.",
)
@click.option("--overwrite", is_flag=True, help="Replace the file of --fly-again if it exists.")
def coverage(
    area_folder: Path,
    waypoints: Path | None,
    camera_file: Path | None,
    fov_deg: float | None,
    fly_again: Path | None,
    overwrite: bool,
    **chosen: Any,
) -> None:
    """Measure how well the mapping flights cover the evaluation flights or planned waypoints.

    \b
    Example:
        spn-data coverage --area fields/north --fly-again again.csv
    """
    from spn_data.coverage.nearest_frame import Stratum
    from spn_data.coverage.refly import ReflyOptions
    from spn_data.geometry.camera_file import read_camera
    from spn_data.pipeline.area_coverage import (
        CoverageStageOptions,
        check_output_file,
        cover_area,
        read_coverage,
    )
    from spn_data.storage.files import write_csv

    if waypoints is None and (camera_file is not None or fov_deg is not None):
        raise click.UsageError("--camera and --fov need --waypoints; labels have their own camera")
    if camera_file is not None and fov_deg is not None:
        raise click.UsageError("give either --camera or --fov")
    wanted = CoverageStageOptions(
        coverage=_strata(chosen["high"], chosen["medium"]),
        refly=ReflyOptions(
            wanted=Stratum(chosen["wanted"]), margin=chosen["margin"], floor_m=chosen["floor_m"]
        ),
        camera=None if camera_file is None else read_camera(camera_file),
        fov_deg=fov_deg,
    )
    if fly_again is not None:
        check_output_file(fly_again, overwrite=overwrite)
    area = options.open_area(area_folder)
    with area.locked():
        with console.progress() as progress:
            found = cover_area(area, wanted, progress, waypoints=waypoints)
        for name, each in found.by_name.items():
            _show(name, each, found)
        _show_stops(found, chosen["wanted"])
        output.figures(coverage=read_coverage(area, found.folder.name))
        console.say(f"Results of each frame: {found.folder}.")
        if fly_again is not None and found.fly_again is not None:
            write_csv(fly_again, found.stops)
            console.say(
                f"{fly_again}: fly these, then spn-data reconstruct VIDEO --add --area {area_folder}",
                wrap=False,
            )
        for note in found.notes:
            console.note(note)
        if fly_again is not None and found.fly_again is None:
            console.note(f"{fly_again} is not written: waypoints need a georegistered map.")
        page.refresh(area)


def _strata(high: tuple[float, float] | None, medium: tuple[float, float] | None) -> Any:
    """Return the given limits, or None if there are none; raise UsageError if they are inconsistent."""
    from spn_data.coverage.nearest_frame import CoverageOptions

    if high is None and medium is None:
        return None
    base = CoverageOptions()
    high = high or (base.high_m, base.high_deg)
    medium = medium or (base.medium_m, base.medium_deg)
    try:
        return CoverageOptions(
            high_m=high[0], high_deg=high[1], medium_m=medium[0], medium_deg=medium[1]
        )
    except ValueError as error:
        raise click.UsageError(f"--high {high} --medium {medium}: {error}") from error


def _show(name: str, coverage: Coverage, found: AreaCoverage) -> None:
    summary = coverage.summary()
    failed, known = summary["failed"], summary["frames"] - summary["failed"]
    unit = "m" if found.units == "m" else "model units"
    rows = [("frames", f"{summary['frames']}" + (f", {failed} of them failed" if failed else ""))]
    options_, median = found.options, summary["median"]
    if options_ is not None and known:
        limits = {
            "high": f"<= {options_.high_m:g} {unit} and <= {options_.high_deg:g} deg",
            "medium": f"<= {options_.medium_m:g} {unit} and <= {options_.medium_deg:g} deg",
            "low": "beyond",
        }
        rows += [
            (f"{stratum} coverage", f"{n} ({n / known:.0%}); {limits[stratum]}")
            for stratum, n in summary["strata"].items()
        ]
    if known:
        rows.append(
            (
                "nearest mapping frame",
                f"{median['distance']:.2f} {unit}, {median['angle_deg']:.1f} deg",
            )
        )
    heights = summary["heights"]
    if known and heights is not None:
        (low, high), (lowest, highest) = heights["mapping"], heights["here"]
        rows += [
            ("height above that frame", f"{median['height']:+.2f} m"),
            ("heights", f"{lowest:.1f} to {highest:.1f} m; mapping {low:.1f} to {high:.1f} m"),
        ]
    if known:
        rows += [
            ("share of the view with map points", f"{median['view_share']:.0%}"),
            (
                "best retrieval result",
                f"error {median['answer_distance']:.2f} {unit}, {median['answer_angle_deg']:.1f} deg",
            ),
        ]
    console.table(f"{name}: coverage (medians over frames with a pose)", rows)


def _show_stops(found: AreaCoverage, wanted: str) -> None:
    if found.fly_again is None:
        return
    count = len(found.fly_again)
    if count == 0:
        console.say(f"Every frame with a pose has {wanted} coverage.\n")
        return
    columns = found.stops
    height = "height_takeoff_m" if "height_takeoff_m" in columns else "z_m"
    shown = ["stop", "lat_deg", "lon_deg", height, "heading_deg", "pitch_deg", "serves"]
    rows = list(zip(*(columns[name] for name in shown), strict=True))[:_SHOWN_STOPS]
    served = int(found.fly_again.serves.sum())
    console.table(
        f"Where to fly again: {count} places would bring {served} frames to {wanted} coverage",
        [(a, b[:-2], c[:-2], d[:-2], e[:-2], f[:-2], g) for a, b, c, d, e, f, g in rows],
        tuple(name.replace("_deg", "").replace("_m", " m").replace("_", " ") for name in shown),
    )
    if count > _SHOWN_STOPS:
        console.say(f"... and {count - _SHOWN_STOPS} more; --fly-again writes all.\n")
