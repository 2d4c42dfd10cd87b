"""Ground control on simulated flights: errors of check points and of the map, beside what is stated.

    python benchmarks/ground_control.py AREA FLIGHTS [--draws 50] [--marks-px 0.5] [--write FILE.csv]

AREA is the map of FLIGHTS, the output of `spn-data simulate`. Points lie on the ground and in front of the
facades; their true projections, with noise, are the marks, and their true positions, with noise, the survey.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import FRAMES, FRAMES_TABLE, MODEL
from spn_data.capture.frames import read_frames
from spn_data.colmap.model import read_scene
from spn_data.geometry.geodesy import GeoOrigin
from spn_data.georegistration.georegister import georegister
from spn_data.georegistration.observe import align_telemetry
from spn_data.pipeline.geo_stage import read_tracks
from spn_data.pipeline.ground_control import ControlOptions, read_control
from spn_data.simulate.truth import Truth, read_truth

SURVEY_M = (0.015, 0.025)
MARKS_PER_POINT = 6
FARTHEST_M = 30.0


def draw_points(count: int, half_m: float, rng: np.random.Generator) -> np.ndarray:
    """Return true positions (count, 3): on the ground, and at up to 6 m near the facades."""
    points = np.column_stack([rng.uniform(-half_m, half_m, (count, 2)) * 0.8, np.zeros(count)])
    for k in range(0, count, 2):
        points[k, k // 2 % 2] = np.sign(points[k, k // 2 % 2]) * half_m * 0.9
        points[k, 2] = rng.uniform(1.0, 6.0)
    return points


def draw_rows(
    area: Area,
    truths: dict[str, Truth],
    points: np.ndarray,
    marks_px: float,
    rng: np.random.Generator,
) -> list[dict[str, object]]:
    """Return the rows of a CSV file: surveyed positions and marks with noise."""
    scene = read_scene(area.folder(MODEL))
    frames = read_frames(area.folder(FRAMES) / FRAMES_TABLE)
    of = {name: k for k, name in enumerate(frames.names.tolist())}
    origin = next(iter(truths.values())).origin
    survey = points + rng.standard_normal(points.shape) * [SURVEY_M[0], *SURVEY_M]
    place = origin.wgs84_from_enu(survey)
    rows: list[dict[str, object]] = []
    for k, point in enumerate(points):
        seen = []
        for name in scene.names:
            row = of[name]
            truth = truths[str(frames.sequences[row])]
            frame = int(frames.video_frame[row])
            in_camera = truth.poses.to_camera(point[None], frame)
            pixel = truth.camera.project(in_camera)[0]
            inside = (pixel > 5).all() and (
                pixel < [truth.camera.width - 5, truth.camera.height - 5]
            ).all()
            if inside and 2.0 < in_camera[0, 2] < FARTHEST_M:
                seen.append((name, pixel))
        chosen = rng.permutation(len(seen))[:MARKS_PER_POINT]
        for name, pixel in (seen[i] for i in chosen):
            x, y = pixel + marks_px * rng.standard_normal(2)
            rows.append(
                {"name": f"p{k + 1}", "lat": f"{place[k, 0]:.9f}", "lon": f"{place[k, 1]:.9f}",
                 "height": f"{place[k, 2]:.4f}", "epsg": "4979", "image": name,
                 "x": f"{x:.3f}", "y": f"{y:.3f}"}
            )  # fmt: skip
    return rows


def write_rows(path: Path, rows: Sequence[dict[str, object]]) -> None:
    """Write the rows as CSV."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("area", type=Path)
    parser.add_argument("flights", type=Path)
    parser.add_argument("--draws", type=int, default=50)
    parser.add_argument("--points", type=int, default=10)
    parser.add_argument("--check", type=int, default=4, help="points that are held out")
    parser.add_argument("--marks-px", type=float, default=0.5)
    parser.add_argument("--write", type=Path, help="write the points of the first draw, and stop")
    args = parser.parse_args()
    area = Area(args.area)
    frames = read_frames(area.folder(FRAMES) / FRAMES_TABLE)
    truths = {
        name: read_truth(args.flights / "truth", name) for name in set(frames.sequences.tolist())
    }
    path = args.write or args.area.parent / "ground-control.csv"
    scene = read_scene(area.folder(MODEL))
    row = {name: k for k, name in enumerate(frames.names.tolist())}
    chosen = frames.select(np.array([row[name] for name in scene.names]))
    tracks = read_tracks(area)
    rows = align_telemetry(tracks, chosen.sequences.tolist(), chosen.time_s)
    true = np.array(
        [
            truths[s].poses.centers[f]
            for s, f in zip(chosen.sequences.tolist(), chosen.video_frame.tolist(), strict=True)
        ]
    )
    checks, stated, map_errors, map_stated = [], [], [], []
    for draw in range(args.draws):
        rng = np.random.default_rng([draw, 31])
        half_m = 0.9 * float(np.abs(true[:, :2]).max())
        write_rows(
            path, draw_rows(area, truths, draw_points(args.points, half_m, rng), args.marks_px, rng)
        )
        if args.write:
            return
        options = ControlOptions(
            file=str(path), check=(str(args.check),), sigma_m=SURVEY_M, mark_sigma_px=args.marks_px
        )
        control, _ = read_control(area, scene, options, tracks=tracks)
        fit = georegister(
            scene.poses, rows, chosen.sequences.tolist(), chosen.time_s, None, control
        )
        for point in fit.control:
            if point.role == "check":
                checks.append(point.residual_m)
                stated.append(point.sigma_m)
        origin: GeoOrigin = next(iter(truths.values())).origin
        world = fit.origin.enu_from_wgs84(origin.wgs84_from_enu(true))
        found = fit.world_from_model.apply(scene.poses.centers)
        map_errors.append((found - world).mean(axis=0))
        map_stated.append(np.sqrt(np.diag(fit.uncertainty.covariance)[:3]))
    path.unlink()
    for title, errors, sigma in (("check points", checks, stated), ("map", map_errors, map_stated)):
        e, s = np.array(errors), np.array(sigma)
        print(f"{title} ({len(e)}):")
        for k, axis in enumerate(("east", "north", "up")):
            within = np.mean(np.abs(e[:, k]) <= 2 * s[:, k])
            print(
                f"  {axis:6} RMSE {np.sqrt(np.mean(e[:, k] ** 2)):.4f} m, stated "
                f"{np.sqrt(np.mean(s[:, k] ** 2)):.4f} m, within 2 sigma {within:.1%}"
            )


if __name__ == "__main__":
    main()
