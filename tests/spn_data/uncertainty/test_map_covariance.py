"""Map covariance against dense algebra, repeated bundle adjustments and gauge transformations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from spn_data.colmap import pycolmap
from spn_data.colmap.model import MapObservations, Scene, read_map
from spn_data.errors import GeometryError
from spn_data.geometry.camera import Camera
from spn_data.geometry.least_squares import POSE
from spn_data.geometry.pose import Poses, Similarity
from spn_data.geometry.rotations import (
    rotation_vectors,
    rotations_from_angles,
    rotations_from_vectors,
)
from spn_data.uncertainty.bundle_jacobians import (
    LinearizedBundle,
    Unknowns,
    gauge_null_space,
    linearize_bundle,
)
from spn_data.uncertainty.map_covariance import Functional, MapCovariance, MapCovarianceOptions
from tests.worlds.native_world import native_model

EXACT = MapCovarianceOptions(exact_lenses=True)
INDEPENDENT = MapCovarianceOptions(clustered=False, exact_lenses=True)


@dataclass(frozen=True, eq=False)
class Small:
    """Two lenses, frames along an arc around a point cloud, and noise-free measurements."""

    scene: Scene
    seen: MapObservations

    def noisy(self, noise_px: np.ndarray) -> Small:
        """Return the bundle adjustment of measurements with errors (M, 2)."""
        return adjusted(self.scene, self.seen, self.seen.pixels + noise_px)


@cache
def small(frames: int = 10, points: int = 300, window: int = 6) -> Small:
    rng = np.random.default_rng(7)
    angle = np.linspace(0, 1.6, frames)
    centers = np.stack([12 * np.sin(angle), -12 * np.cos(angle), 3 + np.sin(3 * angle)], axis=1)
    heading = np.rad2deg(-angle) + rng.normal(0, 3, frames)
    turns = np.stack([heading, np.full(frames, -8.0), rng.normal(0, 4, frames)], axis=1)
    poses = Poses.from_rotations(centers, rotations_from_angles(turns))
    cameras = {
        1: Camera("RADIAL", 640, 480, np.array([500.0, 320, 240, -0.05, 0.02])),
        2: Camera("OPENCV", 640, 480, np.array([480.0, 470, 320, 240, 0.02, -0.01, 1e-3, 5e-4])),
    }
    ids = np.where(np.arange(frames) < frames // 2, 1, 2)
    cloud = rng.uniform([-4, -4, 0], [4, 4, 5], (points, 3))
    frame, point, pixels = [], [], []
    start = rng.integers(-window // 2, frames - window // 2, points)
    for k in range(frames):
        projected = cameras[int(ids[k])].project((cloud - centers[k]) @ poses.rotations[k].T)
        inside = ((projected > 0) & (projected < [640, 480])).all(axis=1)
        index = np.flatnonzero(inside & (start <= k) & (k < start + window))
        frame.append(np.full(len(index), k))
        point.append(index)
        pixels.append(projected[index])
    seen = MapObservations(
        np.concatenate(frame),
        np.concatenate(point),
        np.concatenate(pixels),
        np.zeros((sum(map(len, frame)), 2)),
    )
    lengths = np.bincount(seen.point_idx, minlength=points)
    assert lengths.min() >= 3
    names = tuple(f"a/{k:03d}.jpg" for k in range(frames))
    scene = Scene(names, poses, ids, cameras, cloud, lengths)
    return Small(scene, seen)


def adjusted(
    scene: Scene, seen: MapObservations, pixels: np.ndarray, *, hold_focal: bool = False
) -> Small:
    """Run COLMAP's bundle adjustment on measurements, starting from the given scene."""
    tracks: list[list[tuple[int, int]]] = [[] for _ in scene.points]
    measured = []
    for k in range(len(scene.names)):
        rows = np.flatnonzero(seen.image_idx == k)
        measured.append(pixels[rows])
        for position, point in enumerate(seen.point_idx[rows].tolist()):
            tracks[point].append((k, position))
    model = native_model(
        scene.cameras,
        scene.camera_ids.tolist(),
        scene.names,
        scene.poses,
        measured,
        zip(scene.points, tracks, strict=True),
    )
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.solver_options.num_threads = 1
    options.refine_focal_length = not hold_focal
    pycolmap.bundle_adjustment(model, options)
    return Small(*_observed(model))


def _observed(model: pycolmap.Reconstruction) -> tuple[Scene, MapObservations]:
    with TemporaryDirectory() as folder:
        model.write(folder)
        return read_map(Path(folder))[:2]


def drifting(rng: np.random.Generator, seen: MapObservations, sigma_px: float) -> np.ndarray:
    """Return errors (M, 2) that drift along each track: neighbours are correlated by 0.9."""
    noise = sigma_px * rng.standard_normal((len(seen.point_idx), 2))
    for k in range(int(seen.point_idx.max()) + 1):
        rows = np.flatnonzero(seen.point_idx == k)  # sorted by frame
        for before, after in pairwise(rows):
            noise[after] = 0.9 * noise[before] + np.sqrt(1 - 0.9**2) * noise[after]
    return noise


def errors_of(found: Scene, truth: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return truth minus estimate after the best-fit similarity: poses (N, 6) and points (P, 3)."""
    found_from_true = Similarity.fit(truth.poses.centers, found.poses.centers)
    true = found_from_true.apply_to_poses(truth.poses)
    turns = rotation_vectors(true.rotations @ np.swapaxes(found.poses.rotations, 1, 2))
    poses = np.concatenate([true.centers - found.poses.centers, turns], axis=1)
    return poses, found_from_true.apply(truth.points) - found.points


def scores(errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Return the squared Mahalanobis norms (N,) e^T C^-1 e of errors (N, k)."""
    return np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)


def linearized(scene: Scene, seen: MapObservations) -> tuple[Unknowns, LinearizedBundle]:
    unknowns = Unknowns.of(scene)
    rows = np.arange(len(seen.point_idx))
    return unknowns, linearize_bundle(scene, seen, unknowns, rows)


def some_functional(scene: Scene, camera_id: int | None = None, seed: int = 1) -> Functional:
    """Return a functional with three values of 20 points and of a lens."""
    rng = np.random.default_rng(seed)
    index = rng.choice(len(scene.points), 20, replace=False)
    by_lens = None if camera_id is None else rng.normal(size=(3, 8)) * [1, 1, 0, 0, *[100] * 4]
    return Functional(index, rng.normal(size=(3, 20, 3)), camera_id, by_lens)


def test_derivatives_are_those_of_the_residuals() -> None:
    """Small changes of poses, intrinsics and points change the residuals as the Jacobian predicts."""
    scene, seen = small().scene, small().seen
    unknowns, bundle = linearized(scene, seen)
    rng = np.random.default_rng(3)
    change = 1e-6 * rng.standard_normal(bundle.design.shape[1])
    frames = change[: POSE * len(scene.names)].reshape(-1, POSE)
    centers = scene.poses.centers + frames[:, :3]
    rotations = rotations_from_vectors(frames[:, 3:]) @ scene.poses.rotations
    cameras = {}
    for camera_id, camera in scene.cameras.items():
        full = unknowns.lens_jacobian[camera_id] @ change[unknowns.lens_columns[camera_id]]
        full = full if camera.model == "OPENCV" else full[[0, 2, 3, 4, 5]]
        cameras[camera_id] = replace(camera, params=camera.params + full)
    projected = np.empty_like(seen.pixels)
    for k in range(len(scene.names)):
        rows = seen.image_idx == k
        points = (scene.points[seen.point_idx[rows]] - centers[k]) @ rotations[k].T
        projected[rows] = cameras[int(scene.camera_ids[k])].project(points)
    told = (bundle.design @ change).reshape(-1, 2)
    assert np.abs(projected - seen.pixels - told).max() < 1e-4 * np.abs(told).max()


def test_moving_turning_and_scaling_the_world_changes_no_residual() -> None:
    """The seven gauge directions are null vectors of the reduced normal matrix, up to rounding."""
    scene, seen = small().scene, small().seen
    unknowns, bundle = linearized(scene, seen)
    information = bundle.reduced_normal_matrix()
    pull = information @ gauge_null_space(scene, unknowns)
    assert np.abs(pull).max() < 1e-9 * information.diagonal().max()


def dense_covariance(scene: Scene, seen: MapObservations, sigma_px: float) -> np.ndarray:
    """Return the covariance of all unknowns, points last, under the seven inner constraints."""
    unknowns, bundle = linearized(scene, seen)
    n, p = bundle.design.shape[1], 3 * len(scene.points)
    by_point = np.zeros((bundle.design.shape[0], p))
    for row, (k, j) in enumerate(zip(seen.image_idx, seen.point_idx, strict=True)):
        camera = scene.cameras[int(scene.camera_ids[k])]
        moved = scene.points[j] + np.vstack([1e-5 * np.eye(3), -1e-5 * np.eye(3)])
        pixels = camera.project((moved - scene.poses.centers[k]) @ scene.poses.rotations[k].T)
        by_point[2 * row : 2 * row + 2, 3 * j : 3 * j + 3] = (pixels[:3] - pixels[3:]).T / 2e-5
    full = np.hstack([bundle.design.toarray(), by_point])
    conditions = np.zeros((n + p, 7))
    gauge = gauge_null_space(scene, unknowns)
    frames = np.arange(POSE * len(scene.names)).reshape(-1, POSE)[:, :3].ravel()
    conditions[frames] = gauge[frames]
    bordered = np.block([[full.T @ full, conditions], [conditions.T, np.zeros((7, 7))]])
    scale = 1 / np.sqrt(np.maximum(np.abs(np.diag(bordered)), 1e-6))
    inverse = np.linalg.pinv(bordered * scale[:, None] * scale, rcond=1e-15)
    return sigma_px**2 * (inverse * scale[:, None] * scale)[: n + p, : n + p]


def test_independent_errors_give_what_the_whole_dense_system_gives() -> None:
    """Poses, lens and functionals of points agree with the dense bordered inverse to 1e-4."""
    rng = np.random.default_rng(5)
    whole = small(8, 60)
    made = whole.noisy(0.3 * rng.standard_normal(whole.seen.pixels.shape))
    covariance = MapCovariance.of(made.scene, made.seen, INDEPENDENT)
    dense = dense_covariance(made.scene, made.seen, covariance.sigma_px)
    blocks = np.stack([dense[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(8)])
    size = np.sqrt(np.einsum("nii->ni", blocks))
    scaled = (covariance.pose_covariances() - blocks) / (size[:, :, None] * size[:, None, :])
    assert np.abs(scaled).max() < 1e-4
    unknowns, _ = linearized(made.scene, made.seen)
    n = unknowns.count
    for camera_id, (is_free, found) in covariance.lens_covariances().items():
        assert is_free.all()
        of_lens = dense[np.ix_(*2 * [unknowns.lens_columns[camera_id]])]
        sigma = np.sqrt(np.diag(of_lens))
        assert np.abs((found - of_lens) / np.outer(sigma, sigma)).max() < 1e-4
    for camera_id in (None, 2):
        wanted = some_functional(made.scene, camera_id)
        row = np.zeros((3, len(dense)))
        columns = n + (3 * wanted.point_idx[:, None] + np.arange(3)).ravel()
        row[:, columns] = wanted.by_points.reshape(3, -1)
        if camera_id is not None:
            assert wanted.by_lens is not None
            row[:, unknowns.lens_columns[camera_id]] += (
                wanted.by_lens @ unknowns.lens_jacobian[camera_id]
            )
        expected = row @ dense @ row.T
        found = covariance.functional_covariances([wanted])[0].measured
        assert np.allclose(found, expected, rtol=0, atol=1e-4 * np.trace(expected))


def test_clusters_give_the_sandwich_of_dense_algebra() -> None:
    """The cluster-robust covariance is K M K, M summed over tracks, times the redundancy correction."""
    rng = np.random.default_rng(6)
    whole = small(8, 60)
    made = whole.noisy(drifting(rng, whole.seen, 0.3))
    found = MapCovariance.of(made.scene, made.seen, EXACT).pose_covariances()
    _, bundle = linearized(made.scene, made.seen)
    design, residuals = bundle.design.toarray(), bundle.residuals
    n = design.shape[1]
    pulls = np.zeros((60, n))
    for row, point in enumerate(np.repeat(bundle.point, 2)):
        pulls[point] += design[row] * residuals[row]
    freedom = len(residuals) - 180
    pull = pulls.T @ pulls * freedom / (freedom - n + 7)
    covariance = MapCovariance.of(made.scene, made.seen, INDEPENDENT)
    inverse = dense_covariance(made.scene, made.seen, 1.0)[:n, :n]
    expected = inverse @ pull @ inverse
    for k in range(8):
        block = expected[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        size = np.sqrt(np.diag(block))
        assert np.abs((found[k] - block) / np.outer(size, size)).max() < 1e-3
    assert covariance.sigma_px == pytest.approx(0.15, rel=0.5)  # poses and points absorb drift


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["independent", "drifting"])
def test_repeated_bundle_adjustments_scatter_as_told(kind: str) -> None:
    """Over 30 noise draws, NEES of poses and functionals is within a third of its expectation.

    Errors that drift along tracks meet this only if they are not assumed independent.
    """
    rng = np.random.default_rng(12)
    whole = small(points=800)
    told: dict[str, list[np.ndarray]] = {"poses": [], "points": [], "poses if independent": []}
    for _ in range(30):
        if kind == "independent":
            noise = 0.3 * rng.standard_normal(whole.seen.pixels.shape)
        else:
            noise = drifting(rng, whole.seen, 0.3)
        made = whole.noisy(noise)
        pose_errors, point_errors = errors_of(made.scene, whole.scene)
        covariance = MapCovariance.of(made.scene, made.seen, EXACT)
        told["poses"].append(scores(pose_errors, covariance.pose_covariances()))
        independent = MapCovariance.of(made.scene, made.seen, INDEPENDENT).pose_covariances()
        told["poses if independent"].append(scores(pose_errors, independent))
        for seed in range(8):
            wanted = some_functional(made.scene, seed=seed)
            value = np.einsum("rki,ki->r", wanted.by_points, point_errors[wanted.point_idx])
            spread = covariance.functional_covariances([wanted])[0].measured
            told["points"].append(scores(value[None], spread[None]))
    mean = {name: float(np.mean(values)) for name, values in told.items()}
    assert mean["poses"] / 6 == pytest.approx(1, abs=0.35)
    assert mean["points"] / 3 == pytest.approx(1, abs=0.35)
    if kind == "independent":
        assert mean["poses if independent"] / 6 == pytest.approx(1, abs=0.25)
    else:
        assert mean["poses if independent"] / 6 > 1.6


def test_a_similarity_moves_covariances_with_the_map() -> None:
    """Scaling by 7, rotating and translating the map transforms its covariances in the same way."""
    rng = np.random.default_rng(8)
    whole = small()
    made = whole.noisy(0.3 * rng.standard_normal(whole.seen.pixels.shape))
    turn = rotations_from_vectors(np.array([0.5, -1.0, 2.0]))
    there = Similarity(7.0, turn, np.array([300.0, -50.0, 20.0]))
    moved = replace(
        made.scene,
        poses=there.apply_to_poses(made.scene.poses),
        points=there.apply(made.scene.points),
    )
    before = MapCovariance.of(made.scene, made.seen)
    after = MapCovariance.of(moved, made.seen)
    jacobian = np.eye(6)
    jacobian[:3, :3] = 7 * turn
    expected = jacobian @ before.pose_covariances() @ jacobian.T
    assert np.allclose(after.pose_covariances(), expected, rtol=1e-5, atol=1e-7 * expected.max())
    wanted = some_functional(made.scene, 1)
    assert wanted.by_lens is not None
    same = replace(wanted, by_points=wanted.by_points @ turn.T / 7)
    assert np.allclose(
        after.functional_covariances([same])[0].measured,
        before.functional_covariances([wanted])[0].measured,
        rtol=1e-5,
    )
    assert after.sigma_px == pytest.approx(before.sigma_px, rel=1e-6)


def test_a_map_in_pieces_is_the_map_as_a_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Linearising 100 measurements at a time changes nothing and splits no cluster."""
    rng = np.random.default_rng(13)
    whole = small()
    made = whole.noisy(drifting(rng, whole.seen, 0.3))
    at_once = MapCovariance.of(made.scene, made.seen)
    monkeypatch.setattr("spn_data.uncertainty.map_covariance._MEASUREMENTS_AT_ONCE", 100)
    in_pieces = MapCovariance.of(made.scene, made.seen)
    assert np.allclose(in_pieces.pose_covariances(), at_once.pose_covariances(), rtol=1e-6)
    wanted = some_functional(made.scene, 1)
    assert np.allclose(
        in_pieces.functional_covariances([wanted])[0].measured,
        at_once.functional_covariances([wanted])[0].measured,
        rtol=1e-6,
    )


def test_many_functionals_at_once_are_those_one_by_one() -> None:
    """A batch of three functionals agrees with single calls, including one without points."""
    rng = np.random.default_rng(9)
    whole = small()
    made = whole.noisy(0.3 * rng.standard_normal(whole.seen.pixels.shape))
    covariance = MapCovariance.of(made.scene, made.seen)
    wanted = [some_functional(made.scene), some_functional(made.scene, 2)]
    wanted.append(Functional(np.zeros(0, np.int64), np.zeros((8, 0, 3)), 2, np.eye(8)))
    together = covariance.functional_covariances(wanted)
    for functional, found in zip(wanted, together, strict=True):
        alone = covariance.functional_covariances([functional])[0]
        assert np.allclose(found.measured, alone.measured, rtol=1e-9)
        assert np.allclose(found.shared, alone.shared, rtol=1e-9)
    assert covariance.functional_covariances([]) == []
    some = covariance.pose_covariances(np.array([7, 2]))
    assert np.allclose(some, covariance.pose_covariances()[[7, 2]], rtol=1e-9)


def test_a_point_with_parallel_rays_has_an_open_depth_and_harms_nothing() -> None:
    """A point seen by two frames in one place has undetermined depth and does not affect the poses."""
    rng = np.random.default_rng(10)
    whole = small()
    made = whole.noisy(0.3 * rng.standard_normal(whole.seen.pixels.shape))
    scene, seen = made.scene, made.seen
    point, frames = 17, np.flatnonzero(seen.point_idx == 17)
    drop = np.ones(len(seen.point_idx), dtype=bool)
    drop[frames[2:]] = False
    kept = MapObservations(
        seen.image_idx[drop], seen.point_idx[drop], seen.pixels[drop], seen.residuals_px[drop]
    )
    far = scene.points.copy()
    first = int(seen.image_idx[frames[0]])
    far[point] += 1e12 * (far[point] - scene.poses.centers[first])
    covariance = MapCovariance.of(replace(scene, points=far), kept)
    independent = MapCovariance.of(replace(scene, points=far), kept, INDEPENDENT)
    toward = Functional(np.array([point]), (far[point] / np.linalg.norm(far[point]))[None, None])
    depth = independent.functional_covariances([toward])[0].measured[0, 0]
    assert depth > 1e12
    assert 0.01 < covariance.functional_covariances([toward])[0].measured[0, 0] / depth < 100
    before = MapCovariance.of(scene, seen, INDEPENDENT).pose_covariances()
    assert np.allclose(independent.pose_covariances(), before, rtol=0, atol=0.1 * before.max())


def test_a_map_in_two_pieces_is_refused() -> None:
    """A map in two parts without common points has two gauges and is refused."""
    whole = small(12, 300, 6)
    seen = whole.seen
    left = np.bincount(seen.point_idx, seen.image_idx < 6) / whole.scene.track_lengths
    keep = (seen.image_idx < 6) == (left[seen.point_idx] > 0.5)
    part = MapObservations(
        seen.image_idx[keep], seen.point_idx[keep], seen.pixels[keep], seen.residuals_px[keep]
    )
    with pytest.raises(GeometryError, match="connect"):
        MapCovariance.of(whole.scene, part)
