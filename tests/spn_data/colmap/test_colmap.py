"""Tests of the COLMAP adapter on synthetic pycolmap data with exact ground truth and no images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spn_data.colmap import pycolmap
from spn_data.colmap.database import DatabaseImage, MapDatabase
from spn_data.colmap.job import MappingJob
from spn_data.colmap.mapping import latest_snapshot, refine, run_mapping, triangulate
from spn_data.colmap.model import (
    count_registered,
    read_map,
    read_scene,
    scene_of,
    upgrade_camera,
    write_transformed,
)
from spn_data.colmap.verify import VerifiedPair
from spn_data.errors import FormatError, StageError
from spn_data.geometry.camera import Camera
from spn_data.geometry.initial_lens import GUESS_SIGMA, InitialLens
from spn_data.geometry.pose import Poses, Similarity, pose_errors
from spn_data.geometry.rotations import rotations_from_vectors
from spn_data.matching.features import Features


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pycolmap.Reconstruction]:
    """Return a folder with database.db of 20 images and 300 points, and the true model."""
    folder = tmp_path_factory.mktemp("synthetic")
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=20, num_points3D=300
    )
    with pycolmap.Database.open(folder / "database.db") as database:
        truth = pycolmap.synthesize_dataset(options, database)
    return folder, truth


def job(folder: Path, target: Path, **options: object) -> MappingJob:
    for name in ("models", "snapshots"):
        (target / name).mkdir(parents=True, exist_ok=True)
    return MappingJob(
        database=str(folder / "database.db"),
        images=str(folder),
        output=str(target / "models"),
        snapshots=str(target / "snapshots"),
        threads=1,
        **options,  # type: ignore[arg-type]
    )


@pytest.fixture(scope="module")
def mapped(synthetic: tuple[Path, pycolmap.Reconstruction]) -> Path:
    """Return the model that the mapper reconstructs from it; snapshots are in a sibling folder."""
    folder, _ = synthetic
    (model,) = run_mapping(
        job(folder, folder / "mapped", snapshot_every=5),
        log=folder / "log",
        progress=lambda _: None,
    )
    return model


def test_mapping_finds_the_true_poses(
    synthetic: tuple[Path, pycolmap.Reconstruction], mapped: Path
) -> None:
    """After alignment, the mapped poses equal the true ones."""
    true = scene_of(synthetic[1])
    found = read_scene(mapped)
    assert found.names == true.names
    aligned = Similarity.fit(found.poses.centers, true.poses.centers).apply_to_poses(found.poses)
    error, error_deg = pose_errors(aligned, true.poses)
    assert error.max() < 1e-4
    assert error_deg.max() < 1e-3


def test_mapping_tells_how_many_images_are_registered(
    synthetic: tuple[Path, pycolmap.Reconstruction], tmp_path: Path
) -> None:
    """Mapping reports the number of registered images as it grows."""
    folder, _ = synthetic
    heard: list[int] = []
    run_mapping(job(folder, tmp_path), log=tmp_path / "log", progress=heard.append)
    assert heard == list(range(2, 21)) or heard == [2, *range(3, 21)]


def test_mapping_goes_on_from_a_snapshot(
    synthetic: tuple[Path, pycolmap.Reconstruction], mapped: Path, tmp_path: Path
) -> None:
    """Mapping resumes from a snapshot and registers all images."""
    folder, _ = synthetic
    first = min((folder / "mapped" / "snapshots").iterdir(), key=lambda p: p.name)
    assert 2 <= count_registered(first) < 20
    heard: list[int] = []
    (model,) = run_mapping(
        job(folder, tmp_path, start_from=str(first)), log=tmp_path / "log", progress=heard.append
    )
    assert heard == list(range(count_registered(first), 21))
    assert count_registered(model) == 20


def test_a_half_written_snapshot_is_passed_over(mapped: Path, tmp_path: Path) -> None:
    """The latest complete snapshot is used; truncated ones are ignored."""
    snapshots = mapped.parent.parent / "snapshots"
    newest = max(snapshots.iterdir(), key=lambda p: p.name)
    assert latest_snapshot(snapshots) == newest
    for name, cut in ((newest.name, 0), ("9999999999999", 200)):
        (tmp_path / name).mkdir()
        for file in newest.iterdir():
            data = file.read_bytes()
            end = len(data) - cut if file.name == "points3D.bin" else len(data)
            (tmp_path / name / file.name).write_bytes(data[:end])
    assert latest_snapshot(tmp_path) == tmp_path / newest.name
    assert latest_snapshot(tmp_path / "nowhere") is None


def test_a_death_of_the_mapper_is_told_with_the_end_of_its_log(tmp_path: Path) -> None:
    """A mapper process that fails is reported as a stage error."""
    (tmp_path / "database.db").write_text("no database")
    with pytest.raises(StageError, match=r"mapping (ended with code|was killed by)"):
        run_mapping(job(tmp_path, tmp_path), log=tmp_path / "log", progress=lambda _: None)


def test_a_thinned_database_keeps_the_features_that_match_most(tmp_path: Path) -> None:
    """Thinning keeps features matched in two pairs first, then the strongest matched ones."""
    rng = np.random.default_rng(0)
    lens = InitialLens(Camera.from_horizontal_fov(800, 600, 70), 0.05, "")
    matches = {
        (1, 2): np.stack([rng.permutation(500), rng.permutation(500)], axis=1)[:400],
        (2, 3): np.stack([np.arange(480, 500), np.arange(460, 480)], axis=1),  # few, and weak
    }
    with MapDatabase.open(tmp_path / "database.db") as database:
        images = [DatabaseImage(f"{k}.jpg", "a") for k in "123"]
        database.add_images(images, {"a": lens})
        for image in images:
            points = rng.uniform(0, 600, (500, 4)).astype(np.float32)
            database.write_features(image.name, Features(points, np.zeros((500, 128), np.uint8)))
        for ids, pairs in matches.items():
            pairs = pairs.astype(np.uint32)
            database.write_pair(VerifiedPair(ids, pairs, pairs, 3, None, np.eye(3), None))
        for _ in range(2):  # the second call replaces the first file
            database.write_thinned(tmp_path / "thin.db", features=100)
        whole = {image.name: database.read_keypoints(image.name) for image in images}
    with MapDatabase.open(tmp_path / "thin.db") as thin:
        assert thin.ids == {"1.jpg": 1, "2.jpg": 2, "3.jpg": 3}
        rows = {}  # rows of the kept features in the full database
        for name, keypoints in whole.items():
            few = thin.read_keypoints(name)
            assert len(few) == 100
            rows[name] = np.flatnonzero(np.isin(keypoints[:, 0], few[:, 0]))
            assert np.array_equal(keypoints[rows[name], :2], few[:, :2])

        def kept(first: str, second: str) -> set[tuple[int, int]]:
            one, other = thin.read_inliers(first, second).T
            return set(zip(rows[first][one].tolist(), rows[second][other].tolist(), strict=True))

        a, b = matches[1, 2].T
        assert kept("2.jpg", "3.jpg") >= {(i, j) for i, j in matches[2, 3].tolist() if i in b}
        twice = sorted(set(b.tolist()) & set(range(480, 500)))
        once = sorted(set(b.tolist()) - set(twice))
        alone = sorted(set(range(480, 500)) - set(twice))  # matched only in the weak pair
        of_second = [*twice, *sorted([*once, *alone])[: 100 - len(twice)]]
        of_first = sorted(a.tolist())[:100]
        strong = np.isin(a, of_first) & np.isin(b, of_second)
        assert kept("1.jpg", "2.jpg") == {tuple(pair) for pair in matches[1, 2][strong].tolist()}
        assert 15 < np.count_nonzero(strong) < 40


def test_a_database_without_an_image_has_all_of_the_others(
    synthetic: tuple[Path, pycolmap.Reconstruction], tmp_path: Path
) -> None:
    """Removing an image drops only its features and pairs; new features can be written for it."""
    with MapDatabase.open(synthetic[0] / "database.db") as whole:
        bare, *others = sorted(whole.ids)
        for _ in range(2):  # the second call replaces the first file
            whole.write_without(tmp_path / "bare.db", [bare])
        expected = {k: n for k, n in whole.verified_pairs().items() if bare not in k}
        with MapDatabase.open(tmp_path / "bare.db") as made:
            assert made.ids == whole.ids
            assert made.verified_pairs() == expected
            assert made.num_pairs() == len(others) * (len(others) - 1) // 2
            assert all(
                np.array_equal(made.read_keypoints(k), whole.read_keypoints(k)) for k in others
            )
            for a, b in expected:
                assert np.array_equal(made.read_inliers(a, b), whole.read_inliers(a, b))
            assert made.num_keypoints(bare) == 0
            assert not made.has_features(bare)
            features = Features(np.ones((9, 4), np.float32), np.zeros((9, 128), np.uint8))
            made.write_features(bare, features)
            assert made.num_keypoints(bare) == 9
    assert [file.name for file in tmp_path.iterdir()] == ["bare.db"]


def test_poses_from_a_thinned_database_get_the_points_of_all_matches(
    synthetic: tuple[Path, pycolmap.Reconstruction], mapped: Path, tmp_path: Path
) -> None:
    """Triangulating with all matches restores the tracks without moving the poses."""
    folder, _ = synthetic
    with MapDatabase.open(folder / "database.db") as database:
        database.write_thinned(tmp_path / "database.db", features=200)
    log = tmp_path / "log"
    (few,) = run_mapping(job(tmp_path, tmp_path), log=log, progress=lambda _: None)
    triangulate(few, tmp_path / "all", database=folder / "database.db", log=log)
    thin, full, expected = read_scene(few), read_scene(tmp_path / "all"), read_scene(mapped)
    assert full.names == thin.names == expected.names
    assert np.array_equal(full.poses.centers, thin.poses.centers)
    observed = expected.track_lengths.sum()
    assert thin.track_lengths.sum() < 0.8 * observed
    assert full.track_lengths.sum() >= 0.99 * observed


def test_refinement_with_a_fuller_camera_keeps_a_perfect_model(
    synthetic: tuple[Path, pycolmap.Reconstruction], mapped: Path, tmp_path: Path
) -> None:
    """Refining a perfect model as OPENCV keeps its reprojection error and distortion near zero."""
    done = refine(
        mapped,
        tmp_path / "refined",
        images=tmp_path,
        positions={},
        camera_model="OPENCV",
        refine_principal_point=False,
        held={},
        threads=1,
        log=tmp_path / "log",
    )
    assert done["error_px"] < 1e-3
    (camera,) = read_scene(tmp_path / "refined").cameras.values()
    assert camera.model == "OPENCV"
    assert (
        np.abs(camera.opencv_distortion).max()
        < 1e-4 + abs(scene_of(synthetic[1]).cameras[1].opencv_distortion).max()
    )


def test_a_wrong_match_beyond_the_rim_does_not_decide_the_lens(
    mapped: Path, tmp_path: Path
) -> None:
    """A point 81 degrees off axis but measured mid-image is dropped before refinement."""
    model = pycolmap.Reconstruction(mapped)
    image = model.images[model.reg_image_ids()[0]]
    # A point next to the camera, visible from cameras on the far side of the scene.
    beside = image.cam_from_world().inverse() * np.array([6.3, 0.0, 1.0])
    track = pycolmap.Track()
    for other_id in model.reg_image_ids():
        other = model.images[other_id]
        camera = model.cameras[other.camera_id]
        pixel = camera.img_from_cam(other.cam_from_world() * beside)
        if other_id == image.image_id:
            pixel = np.array([camera.width / 2 + 20, camera.height / 2])
        elif pixel is None or not ((pixel > 0) & (pixel < [camera.width, camera.height])).all():
            continue
        k = next(k for k, p in enumerate(other.points2D) if p.has_point3D())
        model.delete_observation(other_id, k)  # frees a keypoint for the new measurement
        other.points2D[k].xy = pixel
        track.add_element(other_id, k)
    assert track.length() >= 3
    model.add_point3D(beside, track, np.zeros(3, np.uint8))
    (tmp_path / "wrong").mkdir()
    model.write(tmp_path / "wrong")
    done = refine(
        tmp_path / "wrong",
        tmp_path / "refined",
        images=tmp_path,
        positions={},
        camera_model="RADIAL",
        refine_principal_point=False,
        held={},
        threads=1,
        log=tmp_path / "log",
    )
    assert done["dropped"] == 1
    (before,) = read_scene(mapped).cameras.values()
    (after,) = read_scene(tmp_path / "refined").cameras.values()
    assert np.abs(after.opencv_distortion - before.opencv_distortion).max() < 1e-4


@pytest.mark.parametrize("model", ["RADIAL", "OPENCV"])
def test_an_upgraded_camera_projects_as_before(model: str) -> None:
    """Upgrading a SIMPLE_RADIAL camera to a richer model keeps its projection."""
    native = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=800, height=600, params=[500.0, 401, 299, -0.05]
    )
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (50, 3))
    before = native.img_from_cam(points)
    upgrade_camera(native, model)
    assert native.model_name == model
    assert np.abs(native.img_from_cam(points) - before).max() < 1e-9


def test_a_camera_that_is_fuller_already_stays_as_it_is() -> None:
    """An OPENCV camera is not reduced to RADIAL."""
    params = [5.0, 5, 4, 3, 0.1, 0, 0, 0]
    native = pycolmap.Camera(model="OPENCV", width=8, height=6, params=params)
    upgrade_camera(native, "RADIAL")
    assert native.model_name == "OPENCV"
    assert native.params.tolist() == params


def test_residuals_are_projected_minus_measured(mapped: Path) -> None:
    """Residuals equal pycolmap's own projection minus the measured keypoints."""
    scene, seen, _ = read_map(mapped)
    native = pycolmap.Reconstruction(str(mapped))
    image = next(
        native.images[i] for i in native.reg_image_ids() if native.images[i].name == scene.names[3]
    )
    expected = []
    for point2d in image.get_observation_points2D():
        expected.append(image.project_point(native.points3D[point2d.point3D_id].xyz) - point2d.xy)
    assert np.abs(seen.residuals_px[seen.image_idx == 3] - expected).max() < 1e-8


def test_a_transformed_model_is_the_model_seen_from_the_other_frame(
    mapped: Path, tmp_path: Path
) -> None:
    """A similarity moves poses and points together and keeps residuals small."""
    rotation = rotations_from_vectors(np.array([[0.3, -1.2, 2.0]]))[0]
    world_from_model = Similarity(2.5, rotation, np.array([100.0, -50.0, 7.0]))
    write_transformed(mapped, tmp_path / "world", world_from_model)
    before, after = read_scene(mapped), read_scene(tmp_path / "world")
    error, error_deg = pose_errors(world_from_model.apply_to_poses(before.poses), after.poses)
    assert error.max() < 1e-9
    assert error_deg.max() < 1e-9
    assert np.abs(world_from_model.apply(before.points) - after.points).max() < 1e-9
    residuals = read_map(tmp_path / "world")[1]
    assert np.abs(residuals.residuals_px).max() < 1e-2


def test_poses_agree_with_pycolmaps_own_centres(mapped: Path) -> None:
    """Camera centres equal pycolmap's projection centres."""
    scene = read_scene(mapped)
    native = pycolmap.Reconstruction(str(mapped))
    centers = {
        native.images[i].name: native.images[i].projection_center() for i in native.reg_image_ids()
    }
    assert np.abs(scene.poses.centers - [centers[name] for name in scene.names]).max() < 1e-12


@pytest.mark.parametrize("damage", ["missing", "truncated"])
def test_a_damaged_model_is_a_format_error(mapped: Path, tmp_path: Path, damage: str) -> None:
    """A model with a missing or truncated images.bin raises FormatError."""
    for file in mapped.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    if damage == "missing":
        (tmp_path / "images.bin").unlink()
    else:
        data = (tmp_path / "images.bin").read_bytes()
        (tmp_path / "images.bin").write_bytes(data[:-24])
    with pytest.raises(FormatError, match="not a complete COLMAP model"):
        read_scene(tmp_path)


def features(n: int) -> Features:
    rng = np.random.default_rng(n)
    return Features(
        rng.uniform(0, 100, (n, 4)).astype(np.float32),
        rng.integers(0, 255, (n, 128)).astype(np.uint8),
    )


def test_the_database_gives_back_what_was_written(tmp_path: Path) -> None:
    """Images, features, pairs and cameras written to the database are read back unchanged."""
    lens = InitialLens(Camera.from_horizontal_fov(800, 600, 70, (0.0,)), 0.05, "")
    images = [
        DatabaseImage("a/1.jpg", "a"),
        DatabaseImage("a/2.jpg", "a"),
        DatabaseImage("b/1.jpg", "b"),
    ]
    none = np.zeros((0, 2), np.uint32)
    matches = np.array([[0, 1], [2, 3]], np.uint32)
    with MapDatabase.open(tmp_path / "db") as database:
        database.add_images(images[:2], {"a": lens})
        database.write_features("a/1.jpg", features(10))
        database.write_pair(
            VerifiedPair((1, 2), matches, matches[:1], 2, np.eye(3), np.eye(3), None)
        )
    with MapDatabase.open(tmp_path / "db") as database:
        # Existing images keep their ids; new ones are appended with their own camera.
        database.add_images(images, {"a": lens, "b": replace(lens, focal_sigma=GUESS_SIGMA)})
        database.write_pair(VerifiedPair((1, 3), none, none, 1, None, None, None))
        assert database.ids == {"a/1.jpg": 1, "a/2.jpg": 2, "b/1.jpg": 3}
        assert [database.has_features(name) for name in database.ids] == [True, False, False]
        read = database.read_features("a/1.jpg")
        assert np.array_equal(read.keypoints, features(10).keypoints)
        assert np.array_equal(read.descriptors, features(10).descriptors)
        assert [database.has_pair(p) for p in ((1, 2), (1, 3), (2, 3))] == [True, True, False]
        assert database.verified_pairs() == {("a/1.jpg", "a/2.jpg"): 1}
        assert database.num_pairs() == 2
    with pycolmap.Database.open(tmp_path / "db") as native:
        assert [i.camera_id for i in native.read_all_images()] == [1, 1, 2]
        assert native.read_camera(1).has_prior_focal_length
        assert not native.read_camera(2).has_prior_focal_length


def test_a_file_that_is_no_database_is_a_format_error(tmp_path: Path) -> None:
    """A text file opened as a database raises FormatError."""
    (tmp_path / "db").write_text("text")
    with (
        pytest.raises(FormatError, match="not a COLMAP database"),
        MapDatabase.open(tmp_path / "db"),
    ):
        pass


def test_poses_survive_the_way_through_colmaps_convention() -> None:
    """Poses survive the round trip through COLMAP's cam_from_world."""
    rng = np.random.default_rng(0)
    poses = Poses.from_rotations(
        rng.normal(size=(20, 3)), rotations_from_vectors(rng.normal(size=(20, 3)))
    )
    again = Poses.from_cam_from_world(*poses.to_cam_from_world())
    error, error_deg = pose_errors(again, poses)
    assert error.max() < 1e-12
    assert error_deg.max() < 1e-10
