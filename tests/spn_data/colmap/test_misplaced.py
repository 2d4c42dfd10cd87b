"""Tests that images whose pose shows hardly any of their matched points are removed, and no others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from spn_data.colmap import pycolmap
from spn_data.colmap.database import MapDatabase
from spn_data.colmap.misplaced import drop_misplaced
from spn_data.colmap.model import read_scene, write_native

_LEFT = 12  # observations that agree with a wrong pose by chance


@pytest.fixture(scope="module")
def synthetic(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[pycolmap.Reconstruction, dict[tuple[str, str], int]]:
    """Return the true model of 20 images and 300 points, and the number of matches per pair."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=20, num_points3D=300
    )
    path = tmp_path_factory.mktemp("synthetic") / "database.db"
    with pycolmap.Database.open(path) as native:
        truth = pycolmap.synthesize_dataset(options, native)
    with MapDatabase.open(path) as database:
        return truth, database.verified_pairs()


def test_a_right_model_keeps_all_its_images(
    synthetic: tuple[pycolmap.Reconstruction, dict[tuple[str, str], int]], tmp_path: Path
) -> None:
    """No image of a correct model is removed, and no model is written."""
    truth, matches = synthetic
    write_native(truth, tmp_path / "right")
    assert drop_misplaced(tmp_path / "right", tmp_path / "placed", matches) == []
    assert not (tmp_path / "placed").exists()


def test_images_that_show_a_dozen_of_the_points_they_match_are_taken_out(
    synthetic: tuple[pycolmap.Reconstruction, dict[tuple[str, str], int]], tmp_path: Path
) -> None:
    """Images with only a dozen observations are removed; all other poses and points are unchanged."""
    truth, matches = synthetic
    wrong = pycolmap.Reconstruction(truth)
    names = []
    for image_id in wrong.reg_image_ids()[3:5]:
        image = wrong.images[image_id]
        names.append(image.name)
        for row in image.get_observation_point2D_idxs()[_LEFT:]:
            wrong.delete_observation(image_id, row)
    write_native(wrong, tmp_path / "wrong")
    assert drop_misplaced(tmp_path / "wrong", tmp_path / "placed", matches) == sorted(names)
    before, after = read_scene(tmp_path / "wrong"), read_scene(tmp_path / "placed")
    assert set(before.names) - set(after.names) == set(names)
    kept = [k for k, name in enumerate(before.names) if name not in names]
    assert np.array_equal(before.poses.centers[kept], after.poses.centers)
    assert len(after.points) == len(before.points)
    assert before.track_lengths.sum() - after.track_lengths.sum() == 2 * _LEFT


def test_an_image_that_matches_little_may_show_little(
    synthetic: tuple[pycolmap.Reconstruction, dict[tuple[str, str], int]], tmp_path: Path
) -> None:
    """An image with few observations is kept if it also has few matches."""
    truth, matches = synthetic
    model = pycolmap.Reconstruction(truth)
    image = model.images[model.reg_image_ids()[0]]
    for row in image.get_observation_point2D_idxs()[_LEFT:]:
        model.delete_observation(image.image_id, row)
    write_native(model, tmp_path / "model")
    few = {pair: 20 if image.name in pair else n for pair, n in matches.items()}
    assert drop_misplaced(tmp_path / "model", tmp_path / "placed", few) == []
