"""Fly with a bundle: a fix for each image of a flight, written to files and sent to an autopilot."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.camera_file import read_camera
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_model.autopilot.datum import Datum
from spn_model.autopilot.frames import Mounting
from spn_model.autopilot.link import FixSink, Link, open_link
from spn_model.autopilot.parameters import parameter_file
from spn_model.autopilot.profiles import PROFILES, ROS2, Message
from spn_model.autopilot.writers import open_writer
from spn_model.integrity.fix import Fix, NoFix
from spn_model.integrity.height import HeightErrors
from spn_model.onboard.attitude import (
    BODY,
    CAMERA,
    GIMBAL,
    Attitude,
    GimbalMounting,
    LiveAttitude,
    add_options,
    attitude_of,
    check_up,
)
from spn_model.onboard.flight_report import FlightReport
from spn_model.onboard.height import BarometerHeights, add_height_options, heights_of
from spn_model.onboard.pilot import Pilot, PilotOptions
from spn_model.onboard.pre_arm import StatedPosition, pre_arm
from spn_model.onboard.progress import FlightProgress
from spn_model.onboard.replay import FlownImage, RealTime
from spn_model.onboard.sources import check_sources, frames

_FIRST_US = 1_000_000  # time of the first image of a recording whose clock starts at zero


def fly(arguments: list[str]) -> None:
    """Run the command line `spn-onboard fly BUNDLE SOURCE`.

    Raises
    ------
    InputError
        If bundle, camera or source cannot be used.
    """
    given = _parser().parse_args(arguments)
    messages = None if given.messages is None else tuple(Message(m) for m in given.messages)
    if given.mavlink is not None and given.profile == ROS2:
        raise InputError(
            "--mavlink goes to an autopilot: give --profile px4 or ardupilot; --to writes a ROS 2 bag"
        )
    is_live = given.live_attitude
    if is_live and (given.mavlink is None or given.attitude is not None or given.pre_arm):
        raise InputError(
            "--live-attitude comes over --mavlink, takes the place of --attitude, and is not for --pre-arm"
        )
    if given.parameters is not None:
        _write_parameters(given.parameters, given.profile, messages, use_height=given.use_height)
    cv2.setNumThreads(given.threads)
    check_sources([given.source])
    stated = None
    if given.at is not None:
        stated = StatedPosition(lat_deg=given.at[0], lon_deg=given.at[1], sigma_m=given.at_sigma)
    progress = FlightProgress(quiet=given.quiet)
    pilot = _pilot(given)
    view, gimbal = pilot.localizer.bundle.view, pilot.localizer.bundle.gimbal
    datum = _datum(given, view.origin)
    mounting = Mounting.pitched(given.pitch, np.array(given.lever_arm))
    attitude: Attitude | LiveAttitude | None = attitude_of(
        given, gimbal, view, mounting.body_from_camera
    )
    if is_live:
        check_up(view, given.bundle)
    heights = heights_of(given, view)
    images = _images(given, attitude, heights)
    if given.pre_arm:
        _tell(given, [*pre_arm(pilot, images, stated), "Ready."], {"ready": True})
        return
    report, count, known, with_height, clock = FlightReport(), 0, 0, 0, RealTime()
    with ExitStack() as stack:
        sinks: list[FixSink] = []
        if given.to is not None:
            sinks.append(open_writer(given.to, datum=datum, mounting=mounting, coast_s=given.coast))
            stack.callback(sinks[-1].close)
        if given.mavlink is not None:
            link = open_link(
                given.profile,
                given.mavlink,
                mounting=mounting,
                datum=datum,
                messages=messages,
                use_height=given.use_height,
                coast_s=given.coast,
                attitude_of="" if not is_live else BODY if given.attitude_of == BODY else GIMBAL,
            )
            sinks.append(link)
            stack.callback(link.close)
            if is_live:
                attitude = _live_attitude(given, link, gimbal, mounting)
            images = clock.paced(images)
        for time_us, image, vertical, height_m in images:
            if isinstance(attitude, LiveAttitude):
                vertical = attitude.at(time_us)
            count, known = count + 1, known + (vertical is not None)
            with_height += height_m is not None
            item: Fix | NoFix = pilot.fix(image, time_us, vertical, height_m)
            report.add(item, pilot.steps_s)
            progress.image()
            for sink in sinks:
                sink.send(item)
    lines: list[str] = []
    if clock.late:
        lines.append(
            f"{clock.late} images were left out: the recording is replayed in real time, and they were late."
        )
    if attitude is not None:
        lines.append(attitude.coverage(known, count))
    if heights is not None:
        zero = pilot.height
        lines.append(
            f"Height: known for {with_height} of {count} images; its zero is {zero.zero_m:+.2f} m from the "
            f"stated one, known to {math.sqrt(zero.variance):.2f} m."
        )
    _tell(given, [*report.lines(), *lines], {**report.to_json(), "notes": lines})


def _tell(given: argparse.Namespace, lines: list[str], figures: dict[str, Any]) -> None:
    """Write what was found, as lines or as one JSON object."""
    if given.json:
        figures = {"command": "spn-onboard fly", **figures}
        lines = [json.dumps(figures, indent=1, allow_nan=False)]
    for line in lines:
        sys.stdout.write(line + "\n")


def _pilot(given: argparse.Namespace) -> Pilot:
    """Return the pilot of a bundle; raise InputError if its world has no metres."""
    pilot = Pilot(
        given.bundle,
        read_camera(given.camera),
        PilotOptions(
            network=not given.no_network,
            height=HeightErrors(sigma_m=given.height_sigma, zero_m=given.height_zero_sigma),
        ),
        int8=given.int8,
        threads=given.threads,
    )
    if pilot.localizer.bundle.view.units != "m":
        raise InputError(
            "its world has no metres, so a fix in it means nothing outside; georegister the area",
            path=given.bundle,
        )
    return pilot


def _datum(given: argparse.Namespace, origin: GeoOrigin | None) -> Datum | None:
    if origin is None:
        return None
    return Datum(origin=above_sea(origin, given.takeoff_height), geoid_height_m=given.geoid_height)


def _live_attitude(
    given: argparse.Namespace, link: FixSink, gimbal: GimbalMounting | None, mounting: Mounting
) -> LiveAttitude:
    assert isinstance(link, Link)
    assert link.attitude is not None
    return LiveAttitude(
        link.attitude,
        of=given.attitude_of,
        mounting=gimbal,
        body_from_camera=mounting.body_from_camera,
        sigma_deg=given.attitude_sigma,
        offset_s=given.attitude_offset,
    )


def above_sea(origin: GeoOrigin, takeoff_height_m: float | None) -> GeoOrigin:
    """Return the origin with its height above sea level, if that of the take-off point is given."""
    if takeoff_height_m is None:
        return origin
    if origin.height_reference != HeightReference.TAKEOFF:
        raise InputError(
            "--takeoff-height is for a world whose heights count from take-off; those of this one are above "
            f"'{origin.height_reference.value}'"
        )
    height = origin.alt_m + takeoff_height_m
    return GeoOrigin(origin.lat_deg, origin.lon_deg, height, HeightReference.AMSL)


def _images(
    given: argparse.Namespace,
    attitude: Attitude | LiveAttitude | None,
    heights: BarometerHeights | None,
) -> Iterator[FlownImage]:
    """Yield the images with what is known at their times."""
    for number, time_s, image in frames(given.source):
        seconds = number / given.fps if math.isnan(time_s) else time_s
        vertical = attitude.at(seconds) if isinstance(attitude, Attitude) else None
        height_m = None if heights is None else heights.at(seconds)
        yield _FIRST_US + round(1e6 * seconds), image, vertical, height_m


def _write_parameters(
    path: Path, profile: str, messages: tuple[Message, ...] | None, *, use_height: bool
) -> None:
    """Write the parameter file of a receiver; raise InputError if it exists or cannot be written."""
    options = {} if profile == ROS2 else {"messages": messages, "use_height": use_height}
    text = parameter_file(profile, **options)
    try:
        with path.open("x", encoding="utf-8") as handle:
            handle.write(text)
    except FileExistsError as error:
        raise InputError("already exists; choose another file", path=path) from error
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", path=path) from error


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="spn-onboard fly", description=__doc__)
    parser.add_argument("bundle", type=Path, help="bundle folder from `spn-model export`")
    parser.add_argument("source", type=Path, help="video of a flight")
    parser.add_argument("--camera", type=Path, required=True, help="camera file")
    parser.add_argument(
        "--to", type=Path, help="file of fixes: .jsonl, .csv, or a ROS 2 bag folder"
    )
    parser.add_argument("--mavlink", help="send to an autopilot, such as udpout:127.0.0.1:14550")
    parser.add_argument(
        "--profile", choices=(*PROFILES, ROS2), default="px4", help="receiver of the messages"
    )
    parser.add_argument(
        "--messages",
        nargs="+",
        choices=[m.value for m in Message],
        help="MAVLink messages instead of those of the profile",
    )
    parser.add_argument(
        "--parameters", type=Path, help="new file for the receiver's parameters, with explanations"
    )
    parser.add_argument(
        "--use-height", action="store_true", help="the autopilot uses the height of the fixes"
    )
    parser.add_argument(
        "--coast",
        type=float,
        default=0.5,
        metavar="S",
        help="age of a fix up to which predictions from it are sent, 0 to 1 s; 0: none",
    )
    parser.add_argument(
        "--pitch", type=float, default=0.0, help="of the camera in the body, deg, negative: down"
    )
    parser.add_argument(
        "--lever-arm",
        type=float,
        nargs=3,
        default=(0.0, 0.0, 0.0),
        metavar=("FORWARD", "RIGHT", "DOWN"),
        help="of the camera from the body's centre, m",
    )
    add_options(parser, (GIMBAL, CAMERA, BODY))
    parser.add_argument(
        "--live-attitude",
        action="store_true",
        help="take the attitude from what the autopilot (of the body) or its gimbal sends over --mavlink",
    )
    add_height_options(parser)
    parser.add_argument(
        "--pre-arm",
        action="store_true",
        help="test the bundle on the first images, and stop; exit code 1 if it is not ready",
    )
    parser.add_argument(
        "--at",
        type=float,
        nargs=2,
        metavar=("LAT", "LON"),
        help="where the drone stands, for --pre-arm",
    )
    parser.add_argument(
        "--at-sigma", type=float, default=3.0, metavar="M", help="of that position (default 3)"
    )
    parser.add_argument("--geoid-height", type=float, help="of the place, m above the ellipsoid")
    parser.add_argument(
        "--takeoff-height",
        type=float,
        help="of the take-off point, m above sea level, where heights count from there",
    )
    parser.add_argument("--fps", type=float, default=10.0, help="where images state no time")
    parser.add_argument("--no-network", action="store_true", help="search by landmarks alone")
    parser.add_argument("--int8", action="store_true", help="use the 8-bit graph")
    parser.add_argument("--json", action="store_true", help="print the report as one JSON object")
    parser.add_argument("-q", "--quiet", action="store_true", help="print no progress")
    parser.add_argument("--threads", type=int, choices=range(1, 257), default=1, metavar="N")
    return parser
