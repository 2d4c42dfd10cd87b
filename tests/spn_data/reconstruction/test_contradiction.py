"""Detection of wrong models, on data with exact truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spn_data.colmap import pycolmap
from spn_data.colmap.database import MapDatabase
from spn_data.colmap.model import Scene, scene_of
from spn_data.geometry.camera import Camera
from spn_data.geometry.initial_lens import GUESS_SIGMA, InitialLens
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_vectors
from spn_data.reconstruction.contradiction import contradictions, focal_changes, shape_error
from spn_data.reconstruction.correspondences import FramesToMap


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Scene]:
    """Database of 20 images and 300 points, all of which match, and the true scene."""
    path = tmp_path_factory.mktemp("synthetic") / "database.db"
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=20, num_points3D=300
    )
    with pycolmap.Database.open(path) as database:
        truth = pycolmap.synthesize_dataset(options, database)
    return path, scene_of(truth)


def turned(scene: Scene, rows: np.ndarray) -> Scene:
    """Return the scene with some cameras rotated by 20 degrees about the origin as one rigid part."""
    turn = rotations_from_vectors(np.array([[0.0, 0.0, np.deg2rad(20)]]))[0]
    centers, rotations = scene.poses.centers.copy(), scene.poses.rotations.copy()
    centers[rows], rotations[rows] = centers[rows] @ turn.T, rotations[rows] @ turn.T
    return replace(scene, poses=Poses.from_rotations(centers, rotations))


def test_a_right_model_is_not_contradicted(synthetic: tuple[Path, Scene]) -> None:
    """No pair contradicts the correct model."""
    path, scene = synthetic
    with MapDatabase.open(path) as database:
        assert len(database.verified_pairs()) > 100
        assert contradictions(database, scene) == []


def test_pairs_across_two_parts_that_lie_wrongly_contradict_them(
    synthetic: tuple[Path, Scene],
) -> None:
    """Pairs across a wrongly placed part contradict the model, pairs within it do not; most matches first."""
    path, scene = synthetic
    part = np.arange(7)
    with MapDatabase.open(path) as database:
        found = contradictions(database, turned(scene, part))
    assert len(found) > 20
    inside = {scene.names[k] for k in part}
    assert all((one.images[0] in inside) != (one.images[1] in inside) for one in found)
    assert all(one.share < 0.5 for one in found)
    counts = [one.matches for one in found]
    assert counts == sorted(counts, reverse=True)


def test_pairs_with_few_matches_do_not_contradict(
    synthetic: tuple[Path, Scene], tmp_path: Path
) -> None:
    """Chance matches of a wrong pair, as on repeated windows, are no evidence against a correct model."""
    path, scene = synthetic
    (tmp_path / "database.db").write_bytes(path.read_bytes())
    rng = np.random.default_rng(0)
    with pycolmap.Database.open(tmp_path / "database.db") as native:
        first, second = (i.image_id for i in native.read_all_images()[:2])
        geometry = native.read_two_view_geometry(first, second)
        geometry.inlier_matches = rng.permutation(300)[:120].reshape(-1, 2).astype(np.uint32)
        native.delete_two_view_geometry(first, second)
        native.write_two_view_geometry(first, second, geometry)
    with MapDatabase.open(tmp_path / "database.db") as database:
        assert 60 in database.verified_pairs().values()
        assert contradictions(database, scene) == []


@pytest.mark.parametrize(
    ("factor", "known", "told"),
    [(1.0, True, 0), (1.4, True, 0), (3.5, True, 1), (0.3, True, 1), (3.5, False, 0)],
)
def test_a_known_focal_length_that_comes_out_far_off_speaks_against_a_model(
    synthetic: tuple[Path, Scene], factor: float, known: bool, told: int
) -> None:
    """A known focal length that comes out far off contradicts a model; a guessed one does not."""
    _, scene = synthetic
    (camera,) = scene.cameras.values()
    start = Camera("SIMPLE_PINHOLE", 100, 100, np.array([camera.focal_px[0] / factor, 50, 50]))
    n = len(scene.names)
    lens = InitialLens(start, 0.05 if known else GUESS_SIGMA, "")
    keys, nowhere = np.array(["lens"] * n), np.full((n, 3), np.nan)
    frames = FramesToMap(
        Path(),
        tuple(scene.names),
        keys,
        keys,
        nowhere,
        {"lens": lens},
        {},
    )
    changes = focal_changes(scene, frames, 1.5)
    assert len(changes) == told
    for change in changes:
        assert change.ratio == pytest.approx(max(factor, 1 / factor))
        assert change.estimated_px / change.known_px == pytest.approx(factor)


def test_fixes_contradict_a_model_of_another_shape_and_no_model_of_the_same_one() -> None:
    """Noise, scale and a common offset of fixes do not contradict a model; a misplaced part does."""
    rng = np.random.default_rng(0)
    path = np.column_stack(
        [np.linspace(0, 60, 80), 5 * np.sin(np.arange(80) / 9), np.full(80, 12.0)]
    )
    fixes = path + rng.normal(0, 1.5, path.shape) + [300.0, -20.0, 7.0]
    assert shape_error(path / 7.3, fixes) is None
    folded = path.copy()
    folded[40:, 0] = 60 - folded[40:, 0]  # the second half of a street taken for the first
    error = shape_error(folded / 7.3, fixes)
    assert error is not None
    assert error.error_m > 4
    assert 15 < error.distance_m < 30
    fixes[4:] = np.nan
    assert shape_error(folded, fixes) is None
