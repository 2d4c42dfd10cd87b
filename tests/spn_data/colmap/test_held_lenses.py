"""Tests of lenses that are held, and of telephoto lenses, on exact orbits without images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spn_data.colmap import pycolmap
from spn_data.colmap.adjust import adjust
from spn_data.colmap.database import MapDatabase
from spn_data.colmap.job import MappingJob
from spn_data.colmap.lens_limits import fit_to_lenses
from spn_data.colmap.mapping import run_mapping
from spn_data.colmap.model import load_native, read_scene, scene_of
from spn_data.colmap.verify import native_camera
from spn_data.geometry.initial_lens import Hold, InitialLens
from spn_data.geometry.pose import Similarity, pose_errors
from tests.worlds.orbit_world import lens_of, write_orbit


def mapped(folder: Path, held: dict[int, Hold]) -> list[Path]:
    """Map the database of a folder."""
    for name in ("models", "snapshots"):
        (folder / name).mkdir()
    job = MappingJob(
        database=str(folder / "database.db"),
        images=str(folder),
        output=str(folder / "models"),
        snapshots=str(folder / "snapshots"),
        threads=1,
        min_model_size=3,
        held=tuple(held.items()),
    )
    return run_mapping(job, log=folder / "log", progress=lambda _: None)


@pytest.mark.parametrize("widths", [20.0, 62.0])
def test_all_images_of_a_telephoto_orbit_register_if_the_lens_is_held(
    tmp_path: Path, widths: float
) -> None:
    """A held telephoto registers every image, keeps its lens and finds the poses, from short tracks too."""
    lens = InitialLens(lens_of(widths), 0.005, "given", Hold.LENS)
    truth = write_orbit(tmp_path / "database.db", lens.camera, lens, points=900, track=6)
    model, *_ = mapped(tmp_path, {1: Hold.LENS})
    scene = read_scene(model)
    assert len(scene.names) == len(truth)
    assert np.array_equal(scene.cameras[1].params, lens.camera.params)
    found = Similarity.fit(scene.poses.centers, truth.centers).apply_to_poses(scene.poses)
    distance_m = np.linalg.norm(truth.centers[0])
    error_m, error_deg = pose_errors(found, truth)
    assert error_m.max() < 0.004 * distance_m
    assert error_deg.max() < 0.3


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a model of an orbit through a wide lens that started 3 % too long and was held."""
    folder = tmp_path_factory.mktemp("wide")
    start = InitialLens(lens_of(0.8 * 1.03), 0.03, "given", Hold.FOCAL)
    write_orbit(folder / "database.db", lens_of(0.8), start)
    (model,) = mapped(folder, {1: Hold.FOCAL})
    return model


def test_a_held_focal_length_leaves_distortion_free(wide: Path) -> None:
    """Mapping and adjustment keep a held focal length and estimate distortion; a held lens keeps both."""
    (camera,) = read_scene(wide).cameras.values()
    assert camera.focal_px[0] == 0.8 * 1.03 * 960
    assert camera.params[3] != 0
    for held, focal_is_kept, distortion_is_kept in (
        ({}, False, False),
        ({1: Hold.FOCAL}, True, False),
        ({1: Hold.LENS}, True, True),
    ):
        model = load_native(wide)
        adjust(model, refine_principal_point=False, threads=1, held=held)
        after = scene_of(model).cameras[1]
        assert (after.params[0] == camera.params[0]) == focal_is_kept
        assert (after.params[3] == camera.params[3]) == distortion_is_kept
        if not focal_is_kept:
            assert after.params[0] == pytest.approx(0.8 * 960, rel=0.005)


def test_a_free_lens_beside_a_held_one_is_estimated(tmp_path: Path) -> None:
    """Of two cameras, the one that is free finds its focal length while the other keeps its own."""
    true = InitialLens(lens_of(0.8), 0.03, "given")
    truth = write_orbit(
        tmp_path / "database.db",
        true.camera,
        replace(true, hold=Hold.FOCAL),
        other=replace(true, camera=lens_of(0.8 * 1.03)),
    )
    with MapDatabase.open(tmp_path / "database.db") as database:
        assert database.cameras_of({"00.jpg": "orbit", "01.jpg": "other"}) == {
            "orbit": 1,
            "other": 2,
        }
    (model,) = mapped(tmp_path, {1: Hold.FOCAL})
    native = load_native(model)
    adjust(native, refine_principal_point=False, threads=1, held={1: Hold.FOCAL})
    scene = scene_of(native)
    assert len(scene.names) == len(truth)
    assert scene.cameras[1].params[0] == 0.8 * 960
    assert scene.cameras[1].params[3] != 0
    assert scene.cameras[2].params[0] == pytest.approx(0.8 * 960, rel=0.005)


def test_the_limits_of_colmap_fit_the_lens() -> None:
    """A telephoto raises the limit of the focal length and tightens angles; a wide lens changes neither."""
    default = pycolmap.IncrementalTriangulatorOptions()
    for widths, longest, angle_deg in (
        (0.8, 10.0, 2.0),
        (62.0, 124.0, 2.0 / 62),
        (8.0, 16.0, 0.25),
    ):
        options = pycolmap.IncrementalTriangulatorOptions()
        fit_to_lenses(options, [native_camera(lens_of(widths), focal_is_known=True)])
        assert options.max_focal_length_ratio == pytest.approx(longest)
        assert options.create_max_angle_error == pytest.approx(angle_deg)
        assert options.min_angle == default.min_angle
