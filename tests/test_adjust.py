"""Bundle adjustment of surveys that mapping left bent, with exact truth."""

from __future__ import annotations

import numpy as np
import pytest

from spn_data.camera import Camera
from spn_data.colmap import pycolmap
from spn_data.colmap.adjust import adjust
from spn_data.colmap.clean import drop_out_of_view
from spn_data.colmap.model import scene_of
from spn_data.pose import Poses, Similarity, rotations_from_vectors
from tests.native_world import native_model

_LINES, _PER_LINE, _STEP_M, _APART_M, _HEIGHT_M = 4, 40, 7.5, 14.0, 45.0
_CAMERA = Camera("RADIAL", 960, 540, np.array([660.0, 480.0, 270.0, -0.05, 0.015]))


def survey(sag_m: float, wrong: int = 0) -> tuple[pycolmap.Reconstruction, np.ndarray]:
    """A model of 160 images that look down, its ends lifted by `sag_m`, and the true positions.

    wrong : of the measurements, anywhere in the image. The others deviate by 0.3 pixels.
    """
    rng = np.random.default_rng(0)
    length, width = _PER_LINE * _STEP_M, _LINES * _APART_M
    points = rng.uniform((-20, -30, 0), (length + 20, width + 30, 6), (6000, 3))
    line, k = np.divmod(np.arange(_LINES * _PER_LINE), _PER_LINE)
    height = _HEIGHT_M + rng.uniform(-1, 1, len(k))
    centers = np.stack([_STEP_M * k, _APART_M * line, height], axis=1)

    def bent(positions: np.ndarray) -> np.ndarray:
        lift = sag_m * (2 * positions[:, 0] / length - 1) ** 2
        return positions + np.stack([0 * lift, 0 * lift, lift], axis=1)

    tracks: list[list[tuple[int, int]]] = [[] for _ in points]
    down = np.diag([1.0, -1.0, -1.0])
    pixels, rotations = [], []
    for i, center in enumerate(centers):
        projected = _CAMERA.project((points - center) @ down.T)
        inside = np.flatnonzero(((projected > 0) & (projected < (960, 540))).all(axis=1))
        seen = rng.choice(inside, min(len(inside), 150), replace=False)
        measured = projected[seen] + rng.normal(0, 0.3, (len(seen), 2))
        pixels.append(measured)
        slope = 4 * sag_m / length * (2 * center[0] / length - 1)
        rotations.append(down @ rotations_from_vectors(np.array([[0.0, slope, 0.0]]))[0])
        for row, point in enumerate(seen.tolist()):
            tracks[point].append((i, row))
    model = native_model(
        {1: _CAMERA},
        [1] * len(k),
        [f"{i:03d}.jpg" for i in range(len(k))],
        Poses.from_rotations(bent(centers), np.stack(rotations)),
        pixels,
        [pair for pair in zip(bent(points), tracks, strict=True) if len(pair[1]) > 1],
    )
    for image_id in rng.choice(np.arange(1, len(k) + 1), wrong).tolist():
        image = model.images[image_id]
        row = int(rng.choice(image.get_observation_point2D_idxs()))
        image.points2D[row].xy = rng.uniform((0, 0), (960, 540))
    return model, centers


def error_m(model: pycolmap.Reconstruction, centers: np.ndarray) -> float:
    """Median over the images, after the best similarity."""
    scene = scene_of(model)
    rows = [int(name[:3]) for name in scene.names]
    found = scene.poses.centers
    apart = Similarity.fit(found, centers[rows]).apply(found) - centers[rows]
    return float(np.median(np.linalg.norm(apart, axis=1)))


@pytest.fixture(scope="module")
def unbent_m() -> float:
    """What noise alone leaves where adjustment starts at the truth."""
    model, centers = survey(0.0)
    assert error_m(model, centers) < 1e-9
    adjust(model, refine_principal_point=False, threads=2)
    return error_m(model, centers)


@pytest.mark.parametrize("sag_m", [3.0, 10.0])
def test_a_bent_survey_is_straightened_as_far_as_noise_lets_it(
    unbent_m: float, sag_m: float
) -> None:
    """It hardly decreases the cost, and few right measurements of points that come along are dropped."""
    model, centers = survey(sag_m)
    before = error_m(model, centers)
    assert before > 0.5
    assert adjust(model, refine_principal_point=False, threads=2) < 10
    assert 0.01 < error_m(model, centers) < 1.15 * unbent_m


def test_wrong_measurements_are_found_in_a_bent_survey(unbent_m: float) -> None:
    model, centers = survey(3.0, wrong=300)
    dropped = adjust(model, refine_principal_point=False, threads=2)
    assert 270 < dropped < 600
    assert error_m(model, centers) < 1.3 * unbent_m


def test_a_step_that_leaves_all_behind_the_cameras_is_not_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What lies there costs nothing: an undamped step has ended there, at no cost at all."""
    adjustment, radii = pycolmap.bundle_adjustment, []

    def overshoot_first(
        model: pycolmap.Reconstruction, options: pycolmap.BundleAdjustmentOptions
    ) -> None:
        radii.append(options.ceres.solver_options.initial_trust_region_radius)
        if len(radii) > 1:
            adjustment(model, options)
            return
        for frame in model.frames.values():
            pose = frame.rig_from_world
            frame.rig_from_world = pycolmap.Rigid3d(
                pose.rotation, pose.translation - [0, 0, 3 * _HEIGHT_M]
            )

    monkeypatch.setattr(pycolmap, "bundle_adjustment", overshoot_first)
    model, _ = survey(3.0)
    adjust(model, refine_principal_point=False, threads=2)
    assert radii[0] > radii[1] == 1e4
    assert drop_out_of_view(model) == 0
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 0.4
