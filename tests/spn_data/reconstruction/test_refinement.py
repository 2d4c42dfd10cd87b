"""Final adjustments of a model, on data with exact truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spn_data.colmap import pycolmap
from spn_data.colmap.model import scene_of, write_native
from spn_data.geometry.camera import Camera
from spn_data.geometry.initial_lens import GUESS_SIGMA, InitialLens
from spn_data.reconstruction.attempts import ReconstructOptions
from spn_data.reconstruction.correspondences import FramesToMap
from spn_data.reconstruction.refinement import refine_model
from spn_data.work.timing import Stopwatch


def test_a_shifted_principal_point_is_found_and_told_by_the_key_of_its_camera(
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
