"""What a bundle costs on this machine: latency, file size, memory of the program on board."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.errors import InputError, StageError
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_to_json
from spn_data.storage.json_files import write_json
from spn_model.evaluation.validation import spread_rows
from spn_model.export.bundle_checks import judged_groups
from spn_model.onboard.bundle import GRAPHS, read_bundle

_SIZE = (1280, 720)
_DISTORTION = (-0.05, 0.01)  # a mild barrel, as of small drones
_WIDER = 1.08  # than the network's view, which the lens so fills
_TIMEOUT_S = 3600


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions:
    """What is timed."""

    poses: int = 100
    threads: int = 1
    frames: int = 8  # of the data set, in turn, where none are given


@dataclass(frozen=True, eq=False, kw_only=True)
class BundleCost:
    """Of one graph. bytes : of its file; found : as `spn_model.onboard.benchmark` prints it."""

    precision: str
    bytes: int
    found: dict[str, Any]


def benchmark(
    folder: Path, frames: Sequence[Path], camera: Path, options: BenchmarkOptions | None = None
) -> tuple[BundleCost, ...]:
    """Of each graph of a bundle, on frames of a flying camera, whose file is given.

    Raises InputError or FormatError where the bundle cannot be used, StageError with what the process said
    where it failed.
    """
    options = options or BenchmarkOptions()
    bundle = read_bundle(folder)
    return tuple(
        BundleCost(
            precision=precision,
            bytes=bundle.graphs[precision].bytes,
            found=_timed(folder, precision, frames, camera, options),
        )
        for precision in GRAPHS
        if precision in bundle.graphs
    )


def flown_frames(folder: Path, dataset: Path, scratch: Path, count: int) -> tuple[list[Path], Path]:
    """Frames and camera file, written into `scratch`: images of a data set through a lens of 1280 x 720.

    Evenly spread over the evaluation sequences, so that their poses are as hard to find as in flight.
    Raises InputError where the data set holds no images.
    """
    view = read_bundle(folder).camera
    camera = Camera.from_horizontal_fov(
        *_SIZE, min(view.horizontal_fov_deg * _WIDER, 160), _DISTORTION
    )
    rays = camera.unproject(
        np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in _SIZE)), -1).reshape(-1, 2)
    )
    with Dataset(dataset) as data:
        groups = [group for group in judged_groups(data) if group.image_size is not None]
        chosen = [
            (group, int(row))
            for group in groups
            for row in spread_rows(len(group), -(-count // len(groups)))
        ]
        if not chosen:
            raise InputError("holds no images to time poses of", path=dataset)
        paths = []
        for k, (group, row) in enumerate(chosen[:count]):
            image = cv2.cvtColor(group.image(row), cv2.COLOR_RGB2BGR)
            own = view.scaled(image.shape[1], image.shape[0])
            at = own.project(np.column_stack([rays, np.ones(len(rays))])) - 0.5
            at = at.reshape(_SIZE[1], _SIZE[0], 2).astype(np.float32)
            seen = cv2.remap(image, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            paths.append(scratch / f"{k}.png")
            paths[-1].write_bytes(cv2.imencode(".png", seen)[1].tobytes())
    write_json(scratch / "camera.json", camera_to_json(camera))
    return paths, scratch / "camera.json"


def _timed(
    folder: Path, precision: str, frames: Sequence[Path], camera: Path, options: BenchmarkOptions
) -> dict[str, Any]:
    root = str(Path(__file__).resolve().parents[2])
    threads = str(options.threads)
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH", "")))),
        # NumPy's own threads would be counted as ours.
        **{f"{library}_NUM_THREADS": threads for library in ("OMP", "OPENBLAS", "MKL")},
    }
    command = [sys.executable, "-P", "-m", "spn_model.onboard.benchmark", str(folder)]
    command += [*map(str, frames), "--camera", str(camera)]
    command += ["--threads", threads, "--poses", str(options.poses)]
    command += ["--int8"] if precision == "int8" else []
    done = subprocess.run(
        command, capture_output=True, text=True, env=environment, timeout=_TIMEOUT_S, check=False
    )
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise StageError(f"the program on board failed: {last.removeprefix('Error: ')}")
    return dict(json.loads(done.stdout))
