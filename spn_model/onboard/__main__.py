"""`python -m spn_model.onboard BUNDLE SOURCE...`: poses of images and videos, a line each, as they come."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

# Read by OpenCV when it is loaded: an image's header may claim any size.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(100_000_000))

import cv2

from spn_data.errors import SpnError
from spn_data.geometry.camera_file import read_camera
from spn_model.onboard import lines
from spn_model.onboard.localizer import Localizer
from spn_model.onboard.sources import frames


def main(arguments: list[str] | None = None) -> int:
    """Exit code: 0, or 1 with one line that says why bundle, camera or source cannot be used."""
    parser = argparse.ArgumentParser(prog="python -m spn_model.onboard", description=__doc__)
    parser.add_argument("bundle", type=Path, help="folder that `spn-model export` made")
    parser.add_argument("sources", type=Path, nargs="+", help="images and videos")
    parser.add_argument(
        "--camera",
        type=Path,
        required=True,
        help="the flying camera as JSON: model, width, height, params",
    )
    parser.add_argument("--int8", action="store_true", help="the network in 8 bits")
    parser.add_argument("--format", choices=("csv", "jsonl"), default="csv")
    parser.add_argument("--threads", type=int, default=1, help="of the network (default 1)")
    given = parser.parse_args(arguments)
    if not 1 <= given.threads <= 256:
        parser.error("--threads lies from 1 to 256")
    try:
        _localize_all(given)
    except SpnError as error:
        sys.stderr.write(f"Error: {error}\n")
        return 1
    except BrokenPipeError:
        # Whoever read the lines has had enough; nothing is left to be flushed to it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0


def _localize_all(given: argparse.Namespace) -> None:
    cv2.setNumThreads(given.threads)
    camera = read_camera(given.camera)
    localizer = Localizer(given.bundle, int8=given.int8, threads=given.threads)
    origin = localizer.bundle.view.origin
    line = lines.csv_line if given.format == "csv" else lines.json_line
    if given.format == "csv":
        sys.stdout.write(lines.csv_header() + "\n")
    told = False
    for source in given.sources:
        for frame, time_s, image in frames(source):
            seen = localizer.renderer(camera, image.shape[1], image.shape[0]).valid.mean()
            if seen < 1 and not told:
                sys.stderr.write(
                    f"Note: the camera sees {100 * seen:.0f} % of the view that the network was trained "
                    "on; the rest of it is black.\n"
                )
                told = True
            located = localizer.localize(image, camera)
            sys.stdout.write(line(str(source), frame, time_s, located, origin) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
