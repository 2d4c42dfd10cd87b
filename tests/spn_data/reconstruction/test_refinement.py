"""Final adjustments of a model, on data with exact truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spn_data.colmap import pycolmap
from spn_data.colmap.model import scene_of, write_native
from spn_data.geometry.camera import Camera
from spn_data.geometry.initial_lens import GUESS_SIGMA, Hold, InitialLens
from spn_data.reconstruction.attempts import ReconstructOptions
from spn_data.reconstruction.correspondences import FramesToMap
from spn_data.reconstruction.refinement import free_principal_points, refine_model
from spn_data.uncertainty.shared_errors import PrincipalPoint
from spn_data.work.timing import Stopwatch


def test_a_shifted_principal_point_is_found_and_named_by_the_key_of_its_camera(
    tmp_path: Path,
) -> None:
    """A principal point 12 px beside the centre of the image is found; the note names the camera's key."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1,
        num_cameras_per_rig=1,
        num_frames_per_rig=10,
        num_points3D=150,
        camera_model_id=pycolmap.CameraModelId.OPENCV,
        camera_width=1000,
        camera_height=800,
        camera_params=[900, 900, 512, 400, 0, 0, 0, 0],
    )
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        native = pycolmap.synthesize_dataset(options, database)
    (camera,) = native.cameras.values()
    camera.params = [900, 900, 500, 400, 0, 0, 0, 0]
    write_native(native, tmp_path / "model")
    scene = scene_of(native)
    n = len(scene.names)
    lens = InitialLens(Camera.from_horizontal_fov(1000, 800, 58.0, (0, 0, 0, 0)), GUESS_SIGMA, "")
    keys, nowhere = np.array(["drone"] * n), np.full((n, 3), np.nan)
    frames = FramesToMap(tmp_path, tuple(scene.names), keys, keys, nowhere, {"drone": lens}, {})
    refined = refine_model(
        tmp_path / "model",
        tmp_path / "database.db",
        frames,
        tmp_path,
        ReconstructOptions(threads=1),
        lambda *_: None,
        Stopwatch(),
    )
    (found,) = refined.scene.cameras.values()
    np.testing.assert_allclose(found.matrix[:2, 2], [512, 400], atol=0.1)
    (note,) = refined.notes
    assert note.startswith("camera drone: the principal point was estimated: +12.0 px across")


def test_one_shifted_principal_point_frees_all_that_are_determined() -> None:
    """A shift of 6 sigma frees one of 2.6 sigma beside it, but none that is unknown."""
    camera = Camera.from_horizontal_fov(960, 540, 72.0)
    shifted = PrincipalPoint(np.array([4.1, -0.2]), np.diag([0.7, 0.3]) ** 2)
    pulled = PrincipalPoint(np.array([2.8, -0.2]), np.diag([1.1, 0.8]) ** 2)
    unknown = PrincipalPoint(np.array([2.8, -0.2]), np.diag([9.0, 0.8]) ** 2)
    cameras = dict.fromkeys((1, 2, 3), camera)
    points = {1: shifted, 2: pulled, 3: unknown}
    assert set(free_principal_points(cameras, points, {})) == {1, 2}
    assert set(free_principal_points(cameras, points, {2: Hold.LENS})) == {1}
    assert not free_principal_points(cameras, {2: pulled, 3: unknown}, {})
