"""Options shared by several commands, and their parameter types."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from spn_cli import completion
from spn_data.area.area import Area
from spn_data.area.names import DATASET, SPLIT

if TYPE_CHECKING:
    from spn_data.pipeline.geo_stage import GeoStageOptions

area = click.option(
    "--area",
    "area_folder",
    type=click.Path(path_type=Path),
    default=Path(),
    shell_complete=completion.areas,
    help="Folder of the area.  [default: the current folder]",
)
overwrite = click.option(
    "--overwrite", is_flag=True, help="Redo a stage whose options or inputs changed."
)
seed = click.option(
    "--seed",
    type=click.IntRange(0, 2**31 - 1),
    default=0,
    show_default=True,
    help="Random seed.",
)
threads = click.option(
    "--threads", type=click.IntRange(1, 1024), help="Number of CPU threads.  [default: all cores]"
)
cluster = click.option(
    "--cluster",
    metavar="ADDRESS",
    default="",
    help="Address of a Dask scheduler whose workers extract and match features, e.g. tcp://10.0.0.5:8786.",
)
device = click.option(
    "--device",
    default="auto",
    show_default=True,
    help="Device of the network: auto, cpu, cuda or cuda:N.",
)


class Finite(click.FloatRange):
    """Finite number within bounds; NaN is rejected too, although it passes comparisons with bounds."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the number; fail if it is out of bounds or not finite."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number", param, ctx)
        return number


_WIDEST_DEG = 170.0


class FieldOfView(Finite):
    """Horizontal field of view in degrees, from a telephoto lens to the widest without a fisheye model."""

    def __init__(self) -> None:
        super().__init__(0.2)

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the angle; fail if it is out of bounds, with what to do about a fisheye lens."""
        angle = super().convert(value, param, ctx)
        if angle > _WIDEST_DEG:
            self.fail(
                f"{angle:g} is above {_WIDEST_DEG:g} degrees, which needs a fisheye model; --camera takes "
                "none either: render the images as those of a pinhole first",
                param,
                ctx,
            )
        return angle


class PerSequence(click.ParamType[tuple[str, float]]):
    """Number for all sequences (`VALUE`) or one (`SEQUENCE=VALUE`), as ("*" or the sequence, value)."""

    name = "[SEQUENCE=]VALUE"

    def __init__(self, number: Finite):
        self._number = number

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, float]:
        """Return the sequence and the number; fail if the number is out of bounds."""
        if isinstance(value, tuple):
            return value
        sequence, _, number = str(value).rpartition("=")
        try:
            float(number)
        except ValueError:
            self.fail(f"{number!r} is not a number", param, ctx)
        return sequence or "*", self._number.convert(number, param, ctx)


class FilePerSequence(click.ParamType[tuple[str, str]]):
    """File for all sequences (`FILE`) or one (`SEQUENCE=FILE`), as ("*" or the sequence, path)."""

    name = "[SEQUENCE=]FILE"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, str]:
        """Return the sequence and the path; fail if there is no such file."""
        if isinstance(value, tuple):
            return value
        sequence, _, path = str(value).rpartition("=")
        if not Path(path).is_file():
            self.fail(f"{path!r} is not a file", param, ctx)
        return sequence or "*", path


class HorizontalVertical(click.ParamType[tuple[float, float]]):
    """Metres horizontally and, after a comma, vertically; 2.5 times as much vertically if left out."""

    name = "H[,V]"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float]:
        """Return both numbers; fail if one is none, negative or not finite."""
        if isinstance(value, tuple):
            return value
        horizontal, comma, vertical = str(value).partition(",")
        try:
            h = float(horizontal)
            v = float(vertical) if comma else 2.5 * h
        except ValueError:
            self.fail(f"{value!r} is not a number, or two with a comma", param, ctx)
        if not (0 <= h < math.inf and 0 <= v < math.inf):
            self.fail(f"{value!r} is not between 0 and infinity", param, ctx)
        return h, v


camera = click.option(
    "--camera",
    "camera_files",
    type=FilePerSequence(),
    multiple=True,
    help="Calibrated camera (JSON: model, width, height, params) as initial value.",
)
fov = click.option(
    "--fov",
    "fov_deg",
    type=PerSequence(FieldOfView()),
    multiple=True,
    help="Horizontal field of view in degrees, as initial value.",
)
fixed_lens = click.option(
    "--fixed-lens",
    is_flag=True,
    help="Hold the lens of --camera, and focal lengths of --fov or photo metadata.",
)


gcp_sigma = click.option(
    "--gcp-sigma",
    "gcp_sigma_m",
    type=(Finite(0, min_open=True), Finite(0, min_open=True)),
    metavar="H V",
    default=(0.03, 0.05),
    show_default=True,
    help="Standard deviation of surveyed points in metres, horizontal (per axis) and vertical.",
)
mark_sigma = click.option(
    "--mark-sigma",
    "mark_sigma_px",
    type=Finite(0, min_open=True),
    default=1.0,
    show_default=True,
    help="Standard deviation of marks of ground control points in pixels.",
)


def open_area(folder: Path) -> Area:
    """Return the area in a folder, which need not exist yet."""
    return Area(folder)


def dataset_or_split(area: Area, dataset: Path | None) -> Path:
    """Return the given data set, or the area's own; raise StageError if that is missing or stale."""
    if dataset is not None:
        return dataset
    area.check_fresh(SPLIT)
    return area.folder(SPLIT) / DATASET


_GEOREGISTRATION = (
    click.option(
        "--gnss-sigma",
        "gnss_sigma_m",
        type=(Finite(0, min_open=True), Finite(0, min_open=True)),
        metavar="H V",
        help="Standard deviation of a GNSS fix in metres, horizontal (per axis) and vertical.  "
        "[default: the source's own, otherwise that of its kind]",
    ),
    click.option(
        "--gnss-bias",
        "gnss_bias_m",
        type=HorizontalVertical(),
        help="Standard deviation in metres of the error that all fixes of a day share, horizontal (per axis) "
        "and vertical (2.5 times that if left out).  [default: that of the source's kind]",
    ),
    click.option(
        "--gcp",
        "gcp_file",
        type=click.Path(dir_okay=False, path_type=Path),
        help="Ground control points with their marks in images: ODM's gcp_list.txt, or CSV.",
    ),
    click.option(
        "--check-points",
        metavar="N|NAME,...",
        help="Ground control points to hold out, to check the map: so many, or these.",
    ),
    gcp_sigma,
    mark_sigma,
    click.option(
        "--time-offset",
        "time_offset_s",
        type=PerSequence(Finite(-4e8, 4e8)),
        multiple=True,
        help="Seconds to add to telemetry times.  [default: estimated]",
    ),
    click.option(
        "--heights",
        type=click.Choice(["auto", "relative", "absolute"]),
        default="auto",
        show_default=True,
        help="Heights to use: above take-off, or absolute as given by the source.",
    ),
    click.option(
        "--height-reference",
        type=click.Choice(["ellipsoid", "amsl"]),
        help="Reference of --takeoff-alt or of absolute heights.",
    ),
    click.option(
        "--takeoff-alt",
        "takeoff_alt_m",
        type=Finite(-1000, 10_000),
        help="Height of the take-off point in metres.",
    ),
    click.option(
        "--correlation-time",
        "correlation_time_s",
        type=Finite(0, min_open=True),
        default=60.0,
        show_default=True,
        help="Correlation time of GNSS errors in seconds.",
    ),
    click.option("--ignore-gimbal", is_flag=True, help="Do not use gimbal angles."),
)


# What the area remembers: it is stated about flights, and a later command that needs it takes it.
REMEMBERED = (
    *(
        "--fov",
        "--gnss-sigma",
        "--gnss-bias",
        "--gcp",
        "--check-points",
        "--gcp-sigma",
        "--mark-sigma",
    ),
    *("--time-offset", "--heights", "--height-reference", "--takeoff-alt", "--correlation-time"),
    "--ignore-gimbal",
)


def georegistration(command: Any) -> Any:
    """Add the options of georegistration to a command, in the order of the list above."""
    for option in reversed(_GEOREGISTRATION):
        command = option(command)
    return command


def waypoint_camera(command: Any) -> Any:
    """Add the options that state the camera of planned waypoints."""
    command = click.option(
        "--fov",
        "fov_deg",
        type=FieldOfView(),
        metavar="DEG",
        help="Horizontal field of view in degrees, instead of --camera.",
    )(command)
    return click.option(
        "--camera",
        "camera_file",
        type=click.Path(path_type=Path),
        metavar="FILE",
        help="Camera (JSON) of waypoints that name none.  [default: that of most mapping frames]",
    )(command)


def geo_options(
    *,
    gnss_sigma_m: tuple[float, float] | None,
    gnss_bias_m: tuple[float, float] | None,
    gcp_file: Path | None,
    check_points: str | None,
    gcp_sigma_m: tuple[float, float],
    mark_sigma_px: float,
    time_offset_s: tuple[tuple[str, float], ...],
    heights: str,
    height_reference: str | None,
    takeoff_alt_m: float | None,
    correlation_time_s: float,
    ignore_gimbal: bool,
) -> GeoStageOptions:
    """Return the options of georegistration as given on the command line."""
    from spn_data.geometry.geodesy import HeightReference
    from spn_data.georegistration.georegister_options import GeoregisterOptions, Heights
    from spn_data.pipeline.geo_stage import GeoStageOptions
    from spn_data.pipeline.ground_control import ControlOptions

    if takeoff_alt_m is not None and height_reference is None:
        raise click.UsageError("--takeoff-alt needs --height-reference")
    fit = GeoregisterOptions(
        gnss_sigma_m=gnss_sigma_m,
        gnss_bias_m=gnss_bias_m,
        heights=Heights(heights),
        height_reference=None if height_reference is None else HeightReference(height_reference),
        takeoff_alt_m=takeoff_alt_m,
        correlation_time_s=correlation_time_s,
        use_gimbal=not ignore_gimbal,
    )
    control = None
    if gcp_file is not None:
        names = (name.strip() for name in (check_points or "").split(","))
        control = ControlOptions(
            file=str(gcp_file.resolve()),
            check=tuple(name for name in names if name),
            sigma_m=gcp_sigma_m,
            mark_sigma_px=mark_sigma_px,
        )
    elif check_points is not None:
        raise click.UsageError("--check-points needs --gcp")
    return GeoStageOptions(fit=fit, time_offset_s=dict(time_offset_s), control=control)
