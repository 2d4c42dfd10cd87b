"""Options that several commands share, and parameter types of the domain."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from spn_data.area.area import Area

if TYPE_CHECKING:
    from spn_data.pipeline.geo_stage import GeoStageOptions

area = click.option(
    "--area",
    "area_folder",
    type=click.Path(path_type=Path),
    default=Path(),
    help="Folder of the area.  [default: the current folder]",
)
overwrite = click.option(
    "--overwrite", is_flag=True, help="Make anew what stands already and was made otherwise."
)
seed = click.option(
    "--seed",
    type=click.IntRange(0, 2**31 - 1),
    default=0,
    show_default=True,
    help="Of everything random.",
)
threads = click.option("--threads", type=click.IntRange(1, 1024), help="[default: all cores]")
cluster = click.option(
    "--cluster",
    metavar="ADDRESS",
    default="",
    help="Dask scheduler whose workers find features and matches, as in tcp://10.0.0.5:8786.",
)
device = click.option(
    "--device", default="auto", show_default=True, help="auto, cpu, cuda or cuda:N."
)


class Finite(click.FloatRange):
    """A number within bounds; neither infinite nor NaN, which passes any comparison."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number", param, ctx)
        return number


class PerSequence(click.ParamType[tuple[str, float]]):
    """`VALUE` for all sequences or `SEQUENCE=VALUE` for one, as ("*" or the sequence, value)."""

    name = "[SEQUENCE=]VALUE"

    def __init__(self, low: float, high: float):
        self._low, self._high = low, high

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, float]:
        if isinstance(value, tuple):
            return value
        sequence, _, number = str(value).rpartition("=")
        try:
            found = float(number)
        except ValueError:
            self.fail(f"{number!r} is not a number", param, ctx)
        if not self._low <= found <= self._high:
            self.fail(f"{found:g} lies outside {self._low:g} to {self._high:g}", param, ctx)
        return sequence or "*", found


class FilePerSequence(click.ParamType[tuple[str, str]]):
    """`FILE` for all sequences or `SEQUENCE=FILE` for one, as ("*" or the sequence, file)."""

    name = "[SEQUENCE=]FILE"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, str]:
        if isinstance(value, tuple):
            return value
        sequence, _, path = str(value).rpartition("=")
        if not Path(path).is_file():
            self.fail(f"{path!r} is no file", param, ctx)
        return sequence or "*", path


camera = click.option(
    "--camera",
    "camera_files",
    type=FilePerSequence(),
    multiple=True,
    help="Calibrated camera (JSON: model, width, height, params) to start from.",
)
fov = click.option(
    "--fov",
    "fov_deg",
    type=PerSequence(5, 170),
    multiple=True,
    help="Horizontal field of view in degrees, where known.",
)


def open_area(folder: Path) -> Area:
    """The area in a folder, which need not exist yet."""
    return Area(folder)


_GEOREGISTRATION = (
    click.option(
        "--gnss-sigma",
        "gnss_sigma_m",
        type=(Finite(0, min_open=True), Finite(0, min_open=True)),
        metavar="H V",
        help="Standard deviation of a fix in metres, horizontal (per axis) and vertical.  "
        "[default: the source's own, else that of its kind]",
    ),
    click.option(
        "--time-offset",
        "time_offset_s",
        type=PerSequence(-3600, 3600),
        multiple=True,
        help="Seconds to add to telemetry's times.  [default: estimated]",
    ),
    click.option(
        "--heights",
        type=click.Choice(["auto", "relative", "absolute"]),
        default="auto",
        show_default=True,
        help="Heights above take-off, or what the source calls absolute.",
    ),
    click.option(
        "--height-reference",
        type=click.Choice(["ellipsoid", "amsl"]),
        help="What --takeoff-alt, or absolute heights, count from.",
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
        help="Seconds over which GNSS errors stay alike.",
    ),
    click.option("--ignore-gimbal", is_flag=True, help="Leave gimbal angles out."),
)


def georegistration(command: Any) -> Any:
    """The options of georegistration, in the order of the list above."""
    for option in reversed(_GEOREGISTRATION):
        command = option(command)
    return command


def geo_options(
    *,
    gnss_sigma_m: tuple[float, float] | None,
    time_offset_s: tuple[tuple[str, float], ...],
    heights: str,
    height_reference: str | None,
    takeoff_alt_m: float | None,
    correlation_time_s: float,
    ignore_gimbal: bool,
) -> GeoStageOptions:
    """What those options say."""
    from spn_data.geometry.geodesy import HeightReference
    from spn_data.georegistration.georegister_options import GeoregisterOptions, Heights
    from spn_data.pipeline.geo_stage import GeoStageOptions

    if takeoff_alt_m is not None and height_reference is None:
        raise click.UsageError("--takeoff-alt needs --height-reference: what does it count from?")
    fit = GeoregisterOptions(
        gnss_sigma_m=gnss_sigma_m,
        heights=Heights(heights),
        height_reference=None if height_reference is None else HeightReference(height_reference),
        takeoff_alt_m=takeoff_alt_m,
        correlation_time_s=correlation_time_s,
        use_gimbal=not ignore_gimbal,
    )
    return GeoStageOptions(fit=fit, time_offset_s=dict(time_offset_s))
