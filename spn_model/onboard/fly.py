"""Fly with a bundle: a fix for each image of a flight, written to files and sent to an autopilot."""

from __future__ import annotations

import argparse
import math
import sys
from contextlib import ExitStack
from pathlib import Path

import cv2
import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.camera_file import read_camera
from spn_model.autopilot.datum import Datum
from spn_model.autopilot.frames import Mounting
from spn_model.autopilot.link import FixSink, open_link
from spn_model.autopilot.writers import open_writer
from spn_model.integrity.fix import Fix, NoFix
from spn_model.onboard.attitude import BODY, CAMERA, GIMBAL, add_options, attitude_of
from spn_model.onboard.flight_report import FlightReport
from spn_model.onboard.pilot import Pilot, PilotOptions
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
    cv2.setNumThreads(given.threads)
    check_sources([given.source])
    pilot = Pilot(
        given.bundle,
        read_camera(given.camera),
        PilotOptions(network=not given.no_network),
        int8=given.int8,
        threads=given.threads,
    )
    view = pilot.localizer.bundle.view
    if view.units != "m":
        raise InputError(
            "its world has no metres, so a fix in it means nothing outside; georegister the area",
            path=given.bundle,
        )
    datum = (
        None
        if view.origin is None
        else Datum(origin=view.origin, geoid_height_m=given.geoid_height)
    )
    mounting = Mounting.pitched(given.pitch, np.array(given.lever_arm))
    attitude = attitude_of(given, pilot.localizer.bundle.gimbal, view, mounting.body_from_camera)
    report, images, known = FlightReport(), 0, 0
    with ExitStack() as stack:
        sinks: list[FixSink] = []
        if given.to is not None:
            sinks.append(open_writer(given.to, datum=datum, mounting=mounting))
        if given.mavlink is not None:
            sinks.append(open_link(given.profile, given.mavlink, mounting=mounting, datum=datum))
        for sink in sinks:
            stack.callback(sink.close)
        for number, time_s, image in frames(given.source):
            seconds = number / given.fps if math.isnan(time_s) else time_s
            vertical = None if attitude is None else attitude.at(seconds)
            images, known = images + 1, known + (vertical is not None)
            item: Fix | NoFix = pilot.fix(image, _FIRST_US + round(1e6 * seconds), vertical)
            report.add(item)
            for sink in sinks:
                sink.send(item)
    lines = report.lines()
    if attitude is not None:
        lines.append(attitude.coverage(known, images))
    for line in lines:
        sys.stdout.write(line + "\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="spn-onboard fly", description=__doc__)
    parser.add_argument("bundle", type=Path, help="bundle folder from `spn-model export`")
    parser.add_argument("source", type=Path, help="video of a flight")
    parser.add_argument("--camera", type=Path, required=True, help="camera file")
    parser.add_argument(
        "--to", type=Path, help="file of fixes: .jsonl, .csv, or a ROS 2 bag folder"
    )
    parser.add_argument("--mavlink", help="send to an autopilot, such as udpout:127.0.0.1:14550")
    parser.add_argument("--profile", choices=("px4", "ardupilot"), default="px4")
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
    parser.add_argument("--geoid-height", type=float, help="of the place, m above the ellipsoid")
    parser.add_argument("--fps", type=float, default=10.0, help="where images state no time")
    parser.add_argument("--no-network", action="store_true", help="search by landmarks alone")
    parser.add_argument("--int8", action="store_true", help="use the 8-bit graph")
    parser.add_argument("--threads", type=int, choices=range(1, 257), default=1, metavar="N")
    return parser
