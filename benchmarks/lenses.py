"""Check stated uncertainties of maps against lenses that differ from their camera model.

Each draw makes a flight (nadir at one height, or an orbit), exact points, and a lens whose principal point is
about 1 % of the width off, with decentring and a third radial term. Measurements with errors that drift along
their tracks are adjusted as `spn-data reconstruct` does, and compared with the truth after the best-fit
similarity over the camera centres:

    PYTHONPATH=. python benchmarks/lenses.py --draws 200 --models lenses

Adjusted models are kept in the folder given, and used again, so that estimates of the uncertainty can be
compared on the same draws. What was looked at while they were chosen were seeds from 1000 (`--first 1000`).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from spn_data.colmap.adjust import adjust
from spn_data.colmap.clean import drop_without_depth
from spn_data.colmap.model import Scene, read_map, write_native
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses, Similarity
from spn_data.geometry.rotations import rotation_vectors, rotations_from_angles
from spn_data.reconstruction.refinement import free_principal_points
from spn_data.uncertainty.map_covariance import MapCovariance
from tests.worlds.native_world import native_model

WIDTH, HEIGHT, FOCAL = 1000, 750, 800.0
NOISE_PX, DRIFT = 0.4, 0.8
MEDIAN = 5.35  # of chi-squared with 6 degrees of freedom


def flight(kind: str, rng: np.random.Generator) -> tuple[Poses, np.ndarray]:
    """Return the poses and the points of a flight, in metres."""
    if kind == "nadir":
        rows, columns = np.meshgrid(np.arange(5), np.arange(8), indexing="ij")
        centers = np.column_stack([12.0 * columns.ravel(), 16.0 * rows.ravel(), np.full(40, 60.0)])
        heading = np.where(rows.ravel() % 2 == 0, 90.0, 270.0)
        turns = np.column_stack([heading, np.full(40, -85.0), np.zeros(40)])
        points = np.column_stack(
            [rng.uniform(-40, 124, 2500), rng.uniform(-40, 104, 2500), rng.exponential(3.0, 2500)]
        )
    else:
        angle = np.linspace(0, 2 * np.pi, 41)[:-1]
        centers = np.column_stack(
            [30 * np.sin(angle), -30 * np.cos(angle), 12 + 3 * np.sin(3 * angle)]
        )
        turns = np.column_stack([np.rad2deg(-angle), np.full(40, -15.0), rng.normal(0, 3, 40)])
        points = rng.uniform([-15, -15, 0], [15, 15, 10], (900, 3))
    jitter = rng.normal(0, [0.5, 0.5, 0.3], (40, 3))
    return Poses.from_rotations(
        centers + jitter, rotations_from_angles(turns + rng.normal(0, 2, (40, 3)))
    ), points


def measured(
    poses: Poses, points: np.ndarray, rng: np.random.Generator
) -> tuple[Camera, list[np.ndarray], list[list[tuple[int, int]]]]:
    """Return the lens as its model would have it, the measurements of each image, and the tracks."""
    shift = rng.normal(0, 0.01 * WIDTH, 2)
    k1, k2, k3 = rng.normal(-0.05, 0.03), rng.normal(0.01, 0.01), rng.normal(0, 0.005)
    p1, p2 = rng.normal(0, 2e-4, 2)
    error = np.zeros((len(points), 2))
    pixels, tracks = [], [[] for _ in points]
    for k in range(len(poses)):
        rays = poses[k : k + 1].to_camera(points)
        x, y = (rays[:, :2] / rays[:, 2:]).T
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        seen = np.column_stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ]
        )
        seen = FOCAL * seen + np.array([WIDTH, HEIGHT]) / 2 + shift
        inside = (rays[:, 2] > 1) & (r2 < 1) & ((seen > 0) & (seen < [WIDTH, HEIGHT])).all(axis=1)
        inside &= rng.random(len(points)) < 0.6
        fresh = NOISE_PX * rng.standard_normal(error.shape)
        error = np.where(k == 0, fresh, DRIFT * error + np.sqrt(1 - DRIFT**2) * fresh)
        index = np.flatnonzero(inside)
        for row, point in enumerate(index.tolist()):
            tracks[point].append((k, row))
        pixels.append(seen[index] + error[index])
    params = np.array([FOCAL * rng.normal(1, 0.03), WIDTH / 2, HEIGHT / 2, 0.0, 0.0])
    return Camera("RADIAL", WIDTH, HEIGHT, params), pixels, tracks


def make(kind: str, seed: int, folder: Path) -> None:
    """Write the models of a draw, with the principal point held and estimated, and its true poses."""
    rng = np.random.default_rng([seed, len(kind)])
    poses, points = flight(kind, rng)
    camera, pixels, tracks = measured(poses, points, rng)
    used = [(xyz, track) for xyz, track in zip(points, tracks, strict=True) if len(track) >= 3]
    names = tuple(f"{k:03d}" for k in range(len(poses)))
    model = native_model({1: camera}, [1] * len(poses), names, poses, pixels, used)
    for name in ("held", "free"):
        adjust(model, refine_principal_point=name == "free", threads=1)
        drop_without_depth(model)
        model.update_point_3d_errors()
        write_native(model, folder / name)
    np.savez(folder / "true.npz", centers=poses.centers, quats_wxyz=poses.quats_wxyz)


def draw(kind: str, seed: int, folder: Path) -> dict[str, float]:
    """Return how far a draw is from the truth, in stated standard deviations."""
    folder = folder / kind / str(seed)
    if not (folder / "true.npz").exists():
        make(kind, seed, folder)
    scene, covariance = _read(folder / "held")
    freed = bool(free_principal_points(scene.cameras, covariance.shared.principal_points, {}))
    if freed:
        scene, covariance = _read(folder / "free")
    with np.load(folder / "true.npz") as arrays:
        poses = Poses(arrays["centers"], arrays["quats_wxyz"])
    found_from_true = Similarity.fit(poses.centers, scene.poses.centers)
    true = found_from_true.apply_to_poses(poses)
    turns = rotation_vectors(true.rotations @ np.swapaxes(scene.poses.rotations, 1, 2))
    errors = np.concatenate([true.centers - scene.poses.centers, turns], axis=1)
    stated = covariance.pose_covariances()
    scores = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(stated), errors)
    within = np.abs(errors) <= 2 * np.sqrt(np.einsum("nii->ni", stated))
    focal = covariance.shared.focal_lengths[1]
    return {
        "freed": float(freed),
        "chi2": float(np.median(scores)),
        "within": float(within[:, :3].mean()),
        "within_up": float(_up_within(errors, stated, found_from_true).mean()),
        "within_rotation": float(within[:, 3:].mean()),
        "focal_error": float(scene.cameras[1].params[0] / FOCAL - 1),
        "focal_within": float(abs(scene.cameras[1].params[0] - FOCAL) <= 2 * focal.error_px),
        "error_m": float(np.median(np.linalg.norm(errors[:, :3], axis=1)) / found_from_true.scale),
        "error_deg": float(np.rad2deg(np.median(np.linalg.norm(turns, axis=1)))),
    }


def _up_within(errors: np.ndarray, stated: np.ndarray, found_from_true: Similarity) -> np.ndarray:
    """Return whether errors of height (N,) are within two standard deviations."""
    up = found_from_true.rotation[:, 2]
    sigma = np.sqrt(np.einsum("i,nij,j->n", up, stated[:, :3, :3], up))
    return np.abs(errors[:, :3] @ up) <= 2 * sigma


def _read(folder: Path) -> tuple[Scene, MapCovariance]:
    scene, observations, _ = read_map(folder)
    return scene, MapCovariance.of(scene, observations)


def main() -> None:
    """Print a table, and write the draws as JSON if asked to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--kinds", nargs="+", default=["nadir", "orbit"])
    parser.add_argument("--first", type=int, default=0, help="seed of the first draw")
    parser.add_argument("--models", type=Path, required=True, help="folder of adjusted models")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    rows = {}
    for kind in given.kinds:
        seeds = range(given.first, given.first + given.draws)
        draws = [draw(kind, seed, given.models) for seed in seeds]
        rows[kind] = draws
        mean = {name: np.mean([one[name] for one in draws]) for name in draws[0]}
        chi2 = np.median([one["chi2"] for one in draws])
        print(
            f"{kind}: n = {given.draws}; within 2 sigma: position {mean['within']:.1%}, height "
            f"{mean['within_up']:.1%}, rotation {mean['within_rotation']:.1%}, focal length "
            f"{mean['focal_within']:.1%}; median chi2(6) {chi2:.2f} ({chi2 / MEDIAN:.2f} of expected); "
            f"principal point estimated in {mean['freed']:.0%}; median error "
            f"{np.median([one['error_m'] for one in draws]):.3f} m, "
            f"{np.median([one['error_deg'] for one in draws]):.3f} deg, focal length "
            f"{np.median([abs(one['focal_error']) for one in draws]):.2%}",
            flush=True,
        )
    if given.json:
        given.json.write_text(json.dumps(rows))


if __name__ == "__main__":
    main()
