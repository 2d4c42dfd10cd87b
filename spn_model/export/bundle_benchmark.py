"""Benchmark of a bundle on this machine: latency, file size, and memory of the onboard program."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from spn_data.dataset.hdf5_reader import Dataset
from spn_data.errors import InputError, StageError
from spn_data.geometry.camera import Camera, colmap_pixels, opencv_pixels
from spn_data.geometry.camera_file import camera_to_json
from spn_data.storage.json_files import write_json
from spn_model.evaluation.validation import spread_rows
from spn_model.export.bundle_checks import evaluation_groups
from spn_model.onboard.bundle import GRAPHS, read_bundle

_SIZE = (1280, 720)
_DISTORTION = (-0.05, 0.01)  # mild barrel distortion, typical of small drones
_FIELD_OF_VIEW_FACTOR = (
    1.08  # field of view relative to the network's, so that the lens fills the view
)
_TIMEOUT_S = 3600


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions:
    """What is timed.

    Attributes
    ----------
    poses : int
        Number of poses to time.
    threads : int
        Threads of the network.
    frames : int
        Number of data set images used in turn, if no frames are given.
    """

    poses: int = 100
    threads: int = 1
    frames: int = 8


@dataclass(frozen=True, eq=False, kw_only=True)
class BundleCost:
    """Cost of one graph of a bundle.

    Attributes
    ----------
    precision : str
        FLOAT32 or INT8.
    bytes : int
        Size of the graph file.
    found : dict
        Measurements, as printed by `spn_model.onboard.benchmark`.
    """

    precision: str
    bytes: int
    found: dict[str, Any]


def benchmark(
    folder: Path, frames: Sequence[Path], camera: Path, options: BenchmarkOptions | None = None
) -> tuple[BundleCost, ...]:
    """Time each graph of a bundle in a process of its own.

    Parameters
    ----------
    folder : Path
        Bundle.
    frames : sequence of Path
        Images of the flying camera.
    camera : Path
        Camera file of the flying camera.
    options : BenchmarkOptions, optional
        What is timed.

    Returns
    -------
    tuple of BundleCost
        One for each graph of the bundle.

    Raises
    ------
    InputError, FormatError
        If the bundle cannot be used.
    StageError
        If the process fails; the message holds its last line.
    """
    options = options or BenchmarkOptions()
    bundle = read_bundle(folder)
    return tuple(
        BundleCost(
            precision=precision,
            bytes=bundle.graphs[precision].bytes,
            found=_run_benchmark(folder, precision, frames, camera, options),
        )
        for precision in GRAPHS
        if precision in bundle.graphs
    )


def benchmark_on_dataset(
    folder: Path, dataset: Path, options: BenchmarkOptions | None = None
) -> tuple[BundleCost, ...]:
    """Time each graph of a bundle on frames rendered from a data set.

    Parameters
    ----------
    folder : Path
        Bundle.
    dataset : Path
        Data set whose images are used.
    options : BenchmarkOptions, optional
        What is timed.

    Returns
    -------
    tuple of BundleCost
        One for each graph of the bundle.

    Raises
    ------
    InputError, FormatError
        If the bundle or the data set cannot be used.
    StageError
        If the process fails; the message holds its last line.
    """
    options = options or BenchmarkOptions()
    with tempfile.TemporaryDirectory(prefix="spn-benchmark-") as scratch:
        frames, camera = render_flight_frames(folder, dataset, Path(scratch), options.frames)
        return benchmark(folder, frames, camera, options)


def render_flight_frames(
    folder: Path, dataset: Path, scratch: Path, count: int
) -> tuple[list[Path], Path]:
    """Render frames of a flying camera of 1280 x 720 px from images of a data set.

    The frames are evenly spread over the evaluation sequences, so that their poses are as hard to find as in
    flight.

    Parameters
    ----------
    folder : Path
        Bundle.
    dataset : Path
        Data set.
    scratch : Path
        Folder for the frames and the camera file.
    count : int
        Number of frames.

    Returns
    -------
    frames : list of Path
        PNG files.
    camera : Path
        Camera file.

    Raises
    ------
    InputError
        If the data set has no images.
    """
    view = read_bundle(folder).camera
    camera = Camera.from_horizontal_fov(
        *_SIZE, min(view.horizontal_fov_deg * _FIELD_OF_VIEW_FACTOR, 160), _DISTORTION
    )
    rays = camera.unproject(
        np.stack(np.meshgrid(*(colmap_pixels(np.arange(n)) for n in _SIZE)), -1).reshape(-1, 2)
    )
    with Dataset(dataset) as data:
        groups = [group for group in evaluation_groups(data) if group.image_size is not None]
        chosen = [
            (group, int(row))
            for group in groups
            for row in spread_rows(len(group), -(-count // len(groups)))
        ]
        if not chosen:
            raise InputError("has no images to benchmark with", path=dataset)
        paths = []
        for k, (group, row) in enumerate(chosen[:count]):
            image = cv2.cvtColor(group.image(row), cv2.COLOR_RGB2BGR)
            own = view.scaled(image.shape[1], image.shape[0])
            at = opencv_pixels(own.project(np.column_stack([rays, np.ones(len(rays))])))
            at = at.reshape(_SIZE[1], _SIZE[0], 2).astype(np.float32)
            seen = cv2.remap(image, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            paths.append(scratch / f"{k}.png")
            paths[-1].write_bytes(cv2.imencode(".png", seen)[1].tobytes())
    write_json(scratch / "camera.json", camera_to_json(camera))
    return paths, scratch / "camera.json"


def _run_benchmark(
    folder: Path, precision: str, frames: Sequence[Path], camera: Path, options: BenchmarkOptions
) -> dict[str, Any]:
    root = str(Path(__file__).resolve().parents[2])
    threads = str(options.threads)
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH", "")))),
        # Otherwise NumPy's own threads would be counted as well.
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
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise StageError(f"the onboard program failed: {last.removeprefix('Error: ')}")
    return dict(json.loads(done.stdout))
