"""Time the pose estimation of a bundle on this machine and print the result as JSON.

It runs in a process of its own, so that its memory is that of the onboard program.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

from spn_data.errors import SpnError
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import read_camera
from spn_model.onboard.bundle import INPUT
from spn_model.onboard.localizer import Localizer
from spn_model.onboard.sources import read_image

_WARM_UP = 3
_STEPS = ("preprocessing", "graph", "decoding")
_T = TypeVar("_T")


def main(arguments: list[str] | None = None) -> int:
    """Run `python -m spn_model.onboard.benchmark BUNDLE FRAME... --camera FILE` and return its exit code.

    The code is 1, with a one-line message, if bundle, camera or a frame cannot be used, and 0 otherwise.
    """
    parser = argparse.ArgumentParser(
        prog="python -m spn_model.onboard.benchmark", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("bundle", type=Path, help="bundle folder from `spn-model export`")
    parser.add_argument("frames", type=Path, nargs="+", help="images of the flying camera")
    parser.add_argument("--camera", type=Path, required=True, help="camera file (JSON)")
    parser.add_argument("--int8", action="store_true", help="use the 8-bit graph")
    parser.add_argument(
        "--threads", type=int, default=1, help="threads of the network and of OpenCV (default 1)"
    )
    parser.add_argument(
        "--poses", type=int, default=100, help="number of poses to time (default 100)"
    )
    given = parser.parse_args(arguments)
    if not (1 <= given.threads <= 256 and 1 <= given.poses <= 1_000_000):
        parser.error("--threads must be between 1 and 256, --poses between 1 and 1000000")
    try:
        cv2.setNumThreads(given.threads)
        camera = read_camera(given.camera)
        localizer = Localizer(given.bundle, int8=given.int8, threads=given.threads)
        images = [read_image(path) for path in given.frames]
        found = measure(localizer, images, camera, given.poses)
    except SpnError as error:
        sys.stderr.write(f"Error: {error}\n")
        return 1
    sys.stdout.write(json.dumps({**found, "threads": given.threads}) + "\n")
    return 0


def measure(
    localizer: Localizer, images: Sequence[np.ndarray], camera: Camera, poses: int
) -> dict[str, Any]:
    """Time each step of `poses` poses of the images (BGR), used in turn.

    Returns milliseconds of wall clock and CPU time, p50 and p95, by step. `bare` is onnxruntime called on the
    same tensor, alternately right before and right after the localizer's own call; `overhead` is the ratio of
    their median CPU times. `located` : share of frames with a pose. `memory_mb` : peak memory of this process
    so far, None if the system does not report it.
    """
    session, names = localizer.session, localizer.bundle.decoding.outputs
    clocks = {"milliseconds": time.perf_counter, "cpu_milliseconds": time.process_time}
    steps: dict[str, dict[str, list[float]]] = {
        clock: {name: [] for name in (*_STEPS, "bare")} for clock in clocks
    }
    located = 0
    for k in range(-_WARM_UP, poses):
        image = images[k % len(images)]

        def timed(name: str, work: Callable[[], _T], counts: bool = k >= 0) -> _T:
            began = {clock: now() for clock, now in clocks.items()}
            made = work()
            for clock, now in clocks.items():
                if counts:
                    steps[clock][name].append(1000 * (now() - began[clock]))
            return made

        view = timed("preprocessing", partial(localizer.view, image, camera))
        bare = partial(session.run, names, {INPUT: view})
        if k % 2:
            timed("bare", bare)
        outputs = timed("graph", partial(localizer.run, view))
        if not k % 2:
            timed("bare", bare)
        found = timed("decoding", partial(localizer.decode, outputs))
        located += k >= 0 and not found.reason
    quantiles: dict[str, Any] = {}
    for clock, by_name in steps.items():
        total = np.sum([by_name[name] for name in _STEPS], axis=0)
        quantiles[clock] = {
            name: {"p50": float(np.median(values)), "p95": float(np.percentile(values, 95))}
            for name, values in {**by_name, "total": total}.items()
        }
    cpu = steps["cpu_milliseconds"]
    return {
        **quantiles,
        "overhead": float(np.median(cpu["graph"]) / np.median(cpu["bare"])),
        "poses": poses,
        "located": located / poses,
        "frame": [images[0].shape[1], images[0].shape[0]],
        "memory_mb": _peak_memory_mb(),
    }


def _peak_memory_mb() -> float | None:
    status = Path("/proc/self/status")
    if not status.is_file():
        return None
    for line in status.read_text(encoding="utf-8").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024
    return None


if __name__ == "__main__":
    sys.exit(main())
