"""Estimate camera poses of images and videos with a bundle; one line per frame, written immediately."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path

# OpenCV reads this when it is imported. It limits images whose header claims an arbitrary size.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(100_000_000))

import cv2

from spn_data.errors import InputError, SpnError
from spn_data.geometry.camera_file import read_camera
from spn_model.onboard import lines
from spn_model.onboard.attitude import CAMERA, GIMBAL, add_options, attitude_of
from spn_model.onboard.fly import fly
from spn_model.onboard.localizer import Localizer, Located
from spn_model.onboard.sources import check_sources, frames


def main(arguments: list[str] | None = None) -> int:
    """Run the command line `python -m spn_model.onboard [fly] BUNDLE SOURCE...` and return its exit code.

    The code is 1, with a one-line message, if bundle, camera or source cannot be used, and 0 otherwise.
    """
    parser = argparse.ArgumentParser(
        prog="spn-onboard",
        description=__doc__,
        epilog="For fixes of centimetres with a judgement of each: spn-onboard fly --help",
    )
    parser.add_argument("bundle", type=Path, help="bundle folder from `spn-model export`")
    parser.add_argument("sources", type=Path, nargs="+", help="images and videos")
    parser.add_argument(
        "--camera",
        type=Path,
        required=True,
        help="camera file (JSON: model, width, height, params)",
    )
    parser.add_argument("--int8", action="store_true", help="use the 8-bit graph")
    parser.add_argument("--format", choices=("csv", "jsonl"), default="csv")
    parser.add_argument(
        "--threads", type=int, default=1, help="threads of the network and of OpenCV (default 1)"
    )
    add_options(parser, (GIMBAL, CAMERA))
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments[:1] == ["fly"]:
        return _ended(lambda: fly(arguments[1:]))
    given = parser.parse_args(arguments)
    if not 1 <= given.threads <= 256:
        parser.error("--threads must be between 1 and 256")
    return _ended(lambda: _localize_all(given))


def _ended(work: Callable[[], None]) -> int:
    """Do the work of a command, and return its exit code."""
    try:
        work()
    except SpnError as error:
        sys.stderr.write(f"Error: {error}\n")
        return 1
    except BrokenPipeError:
        # The reader closed the pipe. Redirect stdout, so that the final flush does not fail.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0


def _localize_all(given: argparse.Namespace) -> None:
    """Write a row for each frame; a frame that cannot be used has a reason, and the next one follows.

    Raises InputError if a file does not exist, or none of the frames can be used.
    """
    cv2.setNumThreads(given.threads)
    camera = read_camera(given.camera)
    localizer = Localizer(given.bundle, int8=given.int8, threads=given.threads)
    attitude = attitude_of(given, localizer.bundle.gimbal, localizer.bundle.view)
    if attitude is not None and len(given.sources) > 1:
        raise InputError("--attitude belongs to one video, and several sources are given")
    origin = localizer.bundle.view.origin
    line = lines.csv_line if given.format == "csv" else lines.json_line
    if given.format == "csv":
        sys.stdout.write(lines.csv_header() + "\n")
    check_sources(given.sources)
    noted = False
    used, known, problems = 0, 0, []
    for source in given.sources:
        number = 0
        try:
            for number, time_s, image in frames(source):
                vertical = None if attitude is None else attitude.at(time_s)
                known += vertical is not None
                try:
                    height, width = image.shape[:2]
                    covered = localizer.renderer(camera, width, height).valid.mean()
                    located = localizer.localize(image, camera, vertical=vertical)
                except InputError as error:
                    if not number:
                        raise
                    located = Located.failed(str(error))  # the size changed within the video
                if covered < 1 and not noted:
                    sys.stderr.write(
                        f"Note: the camera covers {100 * covered:.0f} % of the view that the network was "
                        "trained on; the rest is black.\n"
                    )
                    noted = True
                sys.stdout.write(line(str(source), number, time_s, located, origin) + "\n")
                sys.stdout.flush()
                used, number = used + 1, number + 1
        except InputError as error:
            problems.append(error if error.path else InputError(str(error), path=source))
            reason = str(error).removeprefix(f"{source}: ")
            failed = Located.failed(reason)
            sys.stdout.write(line(str(source), number, math.nan, failed, origin) + "\n")
            sys.stdout.flush()
    if attitude is not None:
        sys.stderr.write(attitude.coverage(known, used) + "\n")
    if problems and not used:
        raise problems[0]
    for problem in problems:
        sys.stderr.write(f"Note: {problem}\n")


if __name__ == "__main__":
    sys.exit(main())
