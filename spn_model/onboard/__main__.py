"""`python -m spn_model.onboard BUNDLE SOURCE...`: poses of images and videos, a line each, as they come."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path

# Read by OpenCV when it is loaded: an image's header may claim any size.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(100_000_000))

import cv2
import numpy as np

from spn_data.camera_file import read_camera
from spn_data.errors import InputError, SpnError
from spn_model.onboard import lines
from spn_model.onboard.localizer import Localizer

_IMAGES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
_MAX_IMAGE_BYTES = 500_000_000


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
        for frame, time_s, image in _images(source):
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


def _images(source: Path) -> Iterator[tuple[int, float, np.ndarray]]:
    """Frame, seconds since the video's start (NaN for an image), BGR."""
    if not source.is_file():
        raise InputError("does not exist" if not source.exists() else "is no file", path=source)
    if source.suffix.lower() in _IMAGES:
        if source.stat().st_size > _MAX_IMAGE_BYTES:
            raise InputError("is too large for an image", path=source)
        try:
            image = cv2.imdecode(np.fromfile(source, np.uint8), cv2.IMREAD_COLOR)
        except cv2.error as error:
            raise InputError(f"cannot be read as an image ({error.err})", path=source) from error
        if image is None:
            raise InputError("cannot be read as an image", path=source)
        yield 0, float("nan"), image
        return
    # Resolved: OpenCV takes some names for a device, a pattern or an address.
    video = cv2.VideoCapture(str(source.resolve()), cv2.CAP_FFMPEG)
    try:
        frame = 0
        while True:
            read, image = video.read()
            if not read:
                break
            yield frame, video.get(cv2.CAP_PROP_POS_MSEC) / 1000, image
            frame += 1
        if not frame:
            raise InputError("is no video that can be decoded", path=source)
    finally:
        video.release()


if __name__ == "__main__":
    sys.exit(main())
