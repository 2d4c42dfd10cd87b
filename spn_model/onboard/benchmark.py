"""`python -m spn_model.onboard.benchmark BUNDLE FRAME... --camera FILE`: what a pose costs here, as JSON.

A process of its own, for its memory to be that of the program on board.
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
    """Exit code: 0, or 1 with one line that says why bundle, camera or a frame cannot be used."""
    parser = argparse.ArgumentParser(
        prog="python -m spn_model.onboard.benchmark", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("bundle", type=Path, help="folder that `spn-model export` made")
    parser.add_argument("frames", type=Path, nargs="+", help="images of the flying camera")
    parser.add_argument("--camera", type=Path, required=True, help="the flying camera as JSON")
    parser.add_argument("--int8", action="store_true", help="the network in 8 bits")
    parser.add_argument("--threads", type=int, default=1, help="of the network (default 1)")
    parser.add_argument("--poses", type=int, default=100, help="how many to time (default 100)")
    given = parser.parse_args(arguments)
    if not (1 <= given.threads <= 256 and 1 <= given.poses <= 1_000_000):
        parser.error("--threads lies from 1 to 256, --poses from 1 to 1000000")
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
    """Milliseconds of each step, of the clock and of the processor, p50 and p95 over `poses` poses of the
    images (BGR) in turn.

    `bare` is onnxruntime called on the same tensor, right before or right after our own call of it, by turns;
    `overhead` the ratio of the medians of the processor's time. `located` : share of the poses that were
    found. `memory_mb` : greatest of this process so far, None where the system does not tell.
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
    told: dict[str, Any] = {}
    for clock, by_name in steps.items():
        total = np.sum([by_name[name] for name in _STEPS], axis=0)
        told[clock] = {
            name: {"p50": float(np.median(values)), "p95": float(np.percentile(values, 95))}
            for name, values in {**by_name, "total": total}.items()
        }
    cpu = steps["cpu_milliseconds"]
    return {
        **told,
        "overhead": float(np.median(cpu["graph"]) / np.median(cpu["bare"])),
        "poses": poses,
        "located": located / poses,
        "frame": [images[0].shape[1], images[0].shape[0]],
        "memory_mb": _greatest_memory_mb(),
    }


def _greatest_memory_mb() -> float | None:
    status = Path("/proc/self/status")
    if not status.is_file():
        return None
    for line in status.read_text(encoding="utf-8").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024
    return None


if __name__ == "__main__":
    sys.exit(main())
