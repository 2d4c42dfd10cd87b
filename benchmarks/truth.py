"""Compare an area with the exact ground truth of the simulated flights it was made from.

    python benchmarks/truth.py AREA FLIGHTS [--json OUT]

FLIGHTS is the output of `spn-data simulate`. Positions and rotations are compared twice: after the best
similarity (reconstruction only), and without alignment (including georegistration).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from spn_data.area.area import Area
from spn_data.area.names import FRAMES, FRAMES_TABLE, GEO, GEO_FIT, MODEL
from spn_data.capture.frames import Frames, read_frames
from spn_data.colmap.model import Scene, read_scene
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.pose import Poses, Similarity, pose_errors
from spn_data.georegistration.result import GeoFit
from spn_data.labels.labels import Labels
from spn_data.simulate.truth import read_truth
from spn_data.storage.json_files import read_json


def true_flight(flights: Path, sequence: str) -> tuple[Poses, float]:
    """Return the exact poses of the frames of a flight, and its focal length in px."""
    table = flights / f"{sequence}.truth.csv"  # of courtyard-b
    if not table.exists():
        truth = read_truth(flights / "truth", sequence)
        return truth.poses, truth.camera.focal_px[0]
    rows = np.loadtxt(table, delimiter=",", skiprows=1, ndmin=2)
    if not np.array_equal(rows[:, 0], np.arange(len(rows))):
        raise SystemExit(f"{table}: frames are not numbered from 0")
    camera = json.loads((flights / f"{sequence}.camera.json").read_text())
    return Poses(rows[:, 2:5], rows[:, 5:9]), float(camera["f"])


def true_poses(frames: Frames | Labels, flights: Path) -> Poses:
    """Return the exact poses of N frames by their index in the video."""
    true = Poses.unknown(len(frames))
    for sequence in np.unique(frames.sequences).tolist():
        rows = np.flatnonzero(frames.sequences == sequence)
        poses = true_flight(flights, sequence)[0][frames.video_frame[rows]]
        true.centers[rows], true.quats_wxyz[rows] = poses.centers, poses.quats_wxyz
    return true


def at_origin(true: Poses, true_origin: GeoOrigin, origin: GeoOrigin) -> Poses:
    """Move true poses to another origin. Heights above take-off are the simulator's up coordinates."""
    lat_lon_alt = true_origin.wgs84_from_enu(true.centers)
    if origin.height_reference == HeightReference.TAKEOFF:
        lat_lon_alt[:, 2] = true.centers[:, 2]
    return Poses(origin.enu_from_wgs84(lat_lon_alt), true.quats_wxyz)


def compare(area: Area, flights: Path) -> dict[str, Any]:
    """Return all figures, lengths in metres."""
    frames = read_frames(area.folder(FRAMES) / FRAMES_TABLE)
    chosen = frames.select(frames.chosen)
    scene = read_scene(area.folder(MODEL))
    true = true_of_scene(scene, chosen, flights)
    world_from_model = Similarity.fit(scene.poses.centers, true.centers)
    figures: dict[str, Any] = {
        "chosen": len(chosen),
        "registered": len(scene.names),
        "model": error_figures(world_from_model.apply_to_poses(scene.poses), true),
    }
    if area.has(GEO):
        geo = read_scene(area.folder(GEO))
        origin = GeoFit.from_json(read_json(area.folder(GEO) / GEO_FIT)).origin
        there = at_origin(true, read_truth(flights / "truth", chosen.sequences[0]).origin, origin)
        true_from_geo = Similarity.fit(geo.poses.centers, there.centers)
        figures["georegistered"] = error_figures(geo.poses, there)
        up = true_from_geo.rotation[2, 2]
        figures["tilt_deg"] = float(np.rad2deg(np.arccos(np.clip(up, -1, 1))))
        figures["scale_error"] = 1 / true_from_geo.scale - 1
    return figures


def true_of_scene(scene: Scene, chosen: Frames, flights: Path) -> Poses:
    """Return the exact poses of a scene's images in its order."""
    row = {name: k for k, name in enumerate(chosen.names.tolist())}
    registered = chosen.select(np.array([row[name] for name in scene.names]))
    return true_poses(registered, flights)


def error_figures(poses: Poses, true: Poses) -> dict[str, float]:
    """Return quantiles of the errors of poses without alignment."""
    error_m, error_deg = pose_errors(poses, true)
    return {
        "position_median_m": float(np.median(error_m)),
        "position_p95_m": float(np.quantile(error_m, 0.95)),
        "position_max_m": float(error_m.max()),
        "rotation_median_deg": float(np.median(error_deg)),
        "rotation_p95_deg": float(np.quantile(error_deg, 0.95)),
    }


def read_arguments(description: str | None) -> argparse.Namespace:
    """Parse the arguments area, flights and json (where to write the figures)."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("area", type=Path)
    parser.add_argument("flights", type=Path)
    parser.add_argument("--json", type=Path)
    return parser.parse_args()


def main() -> None:
    """Run the benchmark."""
    arguments = read_arguments(__doc__)
    figures = compare(Area(arguments.area), arguments.flights)
    table = Table(title="Against exact truth", title_justify="left", box=None)
    for column in ("", "median", "p95", "max", "rotation median", "p95"):
        table.add_column(column)
    for key, label in (
        ("model", "after the best similarity"),
        ("georegistered", "as georegistered"),
    ):
        if key in figures:
            e = figures[key]
            table.add_row(
                label,
                *(f"{e[f'position_{q}_m'] * 100:.1f} cm" for q in ("median", "p95", "max")),
                *(f"{e[f'rotation_{q}_deg']:.3f} deg" for q in ("median", "p95")),
            )
    console = Console()
    console.print(table)
    console.print(f"{figures['registered']} of {figures['chosen']} frames in one model")
    if "tilt_deg" in figures:
        console.print(f"tilt {figures['tilt_deg']:.2f} deg, scale {figures['scale_error']:+.3%}")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
