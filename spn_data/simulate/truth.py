"""Files with the exact ground truth of simulated flights."""

from __future__ import annotations

import csv
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from spn_data.errors import FormatError, InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.geodesy import GeoOrigin
from spn_data.geometry.pose import Poses
from spn_data.simulate.flight import FlightPath
from spn_data.simulate.presets import SimulateOptions
from spn_data.storage.json_files import read_json

VERSION = 1
_COLUMNS = ("frame", "time_s", "x", "y", "z", "qw", "qx", "qy", "qz", "blurred")


@dataclass(frozen=True, eq=False)
class Truth:
    """Exact ground truth of one flight.

    Attributes
    ----------
    time_s : ndarray, shape (N,)
        Container timestamps of the video frames.
    poses : Poses
        Poses at mid-exposure of the middle row, East-North-Up in metres about `origin`.
    blurred : ndarray of bool, shape (N,)
        Whether the frame has motion blur.
    camera : Camera
        Intrinsics of all frames.
    origin : GeoOrigin
        Origin of the world, with ellipsoidal height.
    """

    time_s: np.ndarray
    poses: Poses
    blurred: np.ndarray
    camera: Camera
    origin: GeoOrigin


def write_truth(folder: Path, path: FlightPath) -> None:
    """Write `<flight>.csv` and `<flight>_camera.json` to a folder."""
    with (folder / f"{path.name}.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_COLUMNS)
        rows = zip(path.time_s, path.poses, path.blurred, strict=True)
        for i, (time_s, (center, quat), blurred) in enumerate(rows):
            values = [f"{time_s:.6f}", *(f"{v:.9f}" for v in center), *(f"{v:.12f}" for v in quat)]
            writer.writerow([i, *values, int(blurred)])
    camera = {
        "model": path.camera.model,
        "width": path.camera.width,
        "height": path.camera.height,
        "params": [float(v) for v in path.camera.params],
    }
    _write_json(folder / f"{path.name}_camera.json", camera)


def write_options(folder: Path, options: SimulateOptions) -> None:
    """Write `origin.json` and `options.json` to a folder."""
    origin = options.origin
    _write_json(
        folder / "origin.json",
        {
            **origin.plain(),
            "abs_alt_minus_up_m": origin.alt_m - options.geoid_m,
            "rel_alt_minus_up_m": 0.0,
        },
    )
    _write_json(folder / "options.json", asdict(options))


def _write_json(path: Path, values: dict[str, object]) -> None:
    text = json.dumps({"version": VERSION, **values}, indent=2, sort_keys=True)
    path.write_text(text + "\n", encoding="utf-8")


def read_truth(folder: Path, flight: str) -> Truth:
    """Read the ground truth of one flight from `OUT/truth`.

    Parameters
    ----------
    folder : Path
        The folder `truth` of simulated flights.
    flight : str
        Name of the flight.

    Returns
    -------
    Truth
        Exact poses and camera of the flight.

    Raises
    ------
    InputError
        If there is no ground truth of this flight.
    FormatError
        If a file is damaged or was written by a newer version.
    """
    table_path, camera_path = folder / f"{flight}.csv", folder / f"{flight}_camera.json"
    if not table_path.is_file():
        raise InputError(f"no ground truth for flight {flight!r}", path=folder)
    camera, origin = read_json(camera_path), read_json(folder / "origin.json")
    try:
        with table_path.open(encoding="utf-8", newline="") as file:
            header = tuple(next(csv.reader(file)))
            if header != _COLUMNS:
                raise ValueError(f"columns are {', '.join(header)}")
            table = np.loadtxt(file, delimiter=",", ndmin=2)
        return Truth(
            table[:, 1],
            Poses(table[:, 2:5], table[:, 5:9]),
            table[:, 9] != 0,
            Camera(
                camera["model"],
                int(camera["width"]),
                int(camera["height"]),
                np.array(camera["params"], dtype=np.float64),
            ),
            GeoOrigin(origin["lat_deg"], origin["lon_deg"], origin["alt_m"]),
        )
    except (ValueError, KeyError, IndexError, StopIteration, TypeError) as error:
        raise FormatError(
            f"{table_path}: not a ground-truth file of spn-data simulate ({error})"
        ) from error
