"""Import of Cambridge Landmarks folders: exact poses, and all anomalies reported."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from spn_cli.data import main
from spn_cli.import_ import import_

from spn_data.dataset.cambridge import read_cambridge, write_cambridge
from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import Role
from spn_data.dataset.nvm import build_nvm_model, write_nvm
from spn_data.dataset.nvm_frames import camera_from_visualsfm
from spn_data.errors import GeometryError, InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.pipeline.import_cambridge import LISTS, Imported, ImportOptions, import_cambridge

OUTLIER = "seq5/frame00297.png"
LENS = Camera("SIMPLE_PINHOLE", 160, 90, np.array([120.0, 80.0, 45.0]))
TRAIN, TEST = (0, 1, 2, 3), (4, 5)
NAMES = tuple(f"seq{1 + k // 4}/frame{k:05d}.png" for k in range(6))


def run(folder: Path, target: Path, *, overwrite: bool = False, **options) -> Imported:
    def progress(step: str, done: int, total: int) -> None:
        assert 0 <= done <= total, step

    return import_cambridge(folder, target, ImportOptions(**options), progress, overwrite=overwrite)


@pytest.mark.parametrize("scene", ["ShopFacade", "GreatCourt"])
def test_lists_come_back_as_they_were_printed(shared_data, tmp_path, scene):
    """Text to HDF5 and back gives the same bytes, for every image of the published lists."""
    folder = shared_data / "cambridge" / scene
    run(folder, tmp_path / "dataset.h5", keep_outliers=True)
    with Dataset(tmp_path / "dataset.h5") as dataset:
        assert sorted(dataset.groups) == ["test", "train"]
        for name, group in dataset.groups.items():
            original = folder / f"dataset_{name}.txt"
            write_cambridge(tmp_path / name, group.names.tolist(), group.poses)
            assert (tmp_path / name).read_bytes() == original.read_bytes()


def test_the_second_round_trip_is_identical(shared_data, tmp_path):
    """What came out of a data set goes into another: the same poses, bit by bit."""
    first = tmp_path / "first.h5"
    run(shared_data / "cambridge" / "ShopFacade", first)
    again = tmp_path / "again"
    again.mkdir()
    with Dataset(first) as dataset:
        for name, group in dataset.groups.items():
            write_cambridge(again / f"dataset_{name}.txt", group.names.tolist(), group.poses)
    run(again, tmp_path / "second.h5")
    with Dataset(first) as one, Dataset(tmp_path / "second.h5") as two:
        for name, group in one.groups.items():
            assert (group.poses.centers == two.groups[name].poses.centers).all()
            assert (group.poses.quats_wxyz == two.groups[name].poses.quats_wxyz).all()


def test_lists_alone_say_what_they_lack(shared_data, tmp_path):
    """Poses without images: no image, no focal length, no origin, no known up, and all of it is said."""
    done = run(shared_data / "cambridge" / "ShopFacade", tmp_path / "dataset.h5")
    assert done.counts == {"train": 231, "test": 103}
    assert not done.has_images
    assert done.with_focal == 0
    notes = "\n".join(done.notes)
    for part in (
        "unknown origin and up direction",
        "none of the listed images",
        "focal lengths are unknown",
    ):
        assert part in notes
    with Dataset(tmp_path / "dataset.h5") as dataset:
        assert dataset.info.origin is None
        assert not dataset.info.up_is_known
        assert not dataset.info.has_images
        assert dataset.info.units == "m"
        assert dataset.info.notes == done.notes
        assert sorted(dataset.info.fingerprints) == ["dataset_test.txt", "dataset_train.txt"]
        train = dataset.groups["train"]
        assert train.role is Role.TRAIN
        assert np.isnan(train.intrinsics).all()
        assert np.isnan(train.time_s).all()
        assert train.sequences[0] == "seq2"


def test_the_outlier_of_great_court_is_left_out_and_reported(shared_data, tmp_path):
    """The frame three million kilometres away would ruin any training; leaving it out is reported."""
    done = run(shared_data / "cambridge" / "GreatCourt", tmp_path / "dataset.h5")
    assert done.counts == {"train": 1531, "test": 760}
    notes = [note for note in done.notes if OUTLIER in note]
    assert any("from the median position" in note for note in notes)
    assert f"{OUTLIER}: left out because of its position; use --keep-outliers to keep it" in notes
    with Dataset(tmp_path / "dataset.h5") as dataset:
        assert OUTLIER not in dataset.groups["train"].names
        assert np.abs(dataset.groups["train"].poses.centers).max() < 1000


def poses() -> Poses:
    """Six cameras side by side that look north."""
    centers = np.column_stack([np.arange(6) * 0.5, np.zeros(6), np.full(6, 2.0)])
    angles = np.column_stack([np.linspace(-6, 6, 6), np.full(6, -3.0), np.zeros(6)])
    return Poses.from_rotations(centers, rotations_from_angles(angles))


def world() -> np.ndarray:
    rng = np.random.default_rng(4)
    return np.column_stack(
        [rng.uniform(-6, 8, 200), rng.uniform(9, 14, 200), rng.uniform(-1, 5, 200)]
    )


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A folder with lists, images and a model; each point is a bright dot on black."""
    folder = tmp_path / "scene"
    seen: list[tuple[int, int, np.ndarray]] = []
    for k, (center, rotation) in enumerate(zip(poses().centers, poses().rotations, strict=True)):
        image = np.zeros((90, 160, 3), np.uint8)
        pixels = LENS.project((world() - center) @ rotation.T)
        for point, pixel in enumerate(pixels):
            if np.all((pixel > 1) & (pixel < [159, 89])):
                seen.append((point, k, pixel - [80, 45]))
                image[int(pixel[1]), int(pixel[0])] = (0, 0, 255)  # red, as OpenCV writes it
        (folder / NAMES[k]).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(folder / NAMES[k]), image)
    for name, rows in (("train", TRAIN), ("test", TEST)):
        write_cambridge(
            folder / f"dataset_{name}.txt", [NAMES[k] for k in rows], poses()[np.array(rows)]
        )
    model = build_nvm_model(
        tuple(name.replace(".png", ".jpg") for name in NAMES),
        poses(),
        np.full(6, 120.0),
        (world(), np.zeros((200, 3), np.uint8)),
        (
            np.array([s[0] for s in seen]),
            np.array([s[1] for s in seen]),
            np.array([s[2] for s in seen]),
        ),
    )
    write_nvm(folder / "reconstruction.nvm", model)
    return folder


def test_images_lenses_and_points_of_a_folder_are_taken(scene, tmp_path):
    """A folder with a model gives images in RGB, intrinsics, and points where the images show them."""
    done = run(scene, tmp_path / "dataset.h5", width_px=80)
    assert done.counts == {"train": 4, "test": 2}
    assert done.has_images
    assert done.with_focal == 6
    with Dataset(tmp_path / "dataset.h5") as dataset:
        train, test = dataset.groups["train"], dataset.groups["test"]
        assert train.image_size == (80, 45)
        assert train.intrinsics[0].tolist() == [[60, 0, 40], [0, 60, 22.5], [0, 0, 1]]
        assert train.points_for_training
        assert not test.points_for_training
        for group, k in ((train, 2), (test, 1)):
            points, image = group.points(k), group.image(k).astype(float)
            assert len(points.ids) > 20
            column, row = points.pixels.astype(int).T
            assert (image[row, column, 0] > 40).all()  # the red dot, a quarter of it at least
            assert image[..., 2].max() == 0
            pose = group.poses[k : k + 1]
            in_camera = (points.xyz - pose.centers[0]) @ pose.rotations[0].T
            reduced = Camera("SIMPLE_PINHOLE", 80, 45, np.array([60, 40, 22.5]))
            assert np.abs(reduced.project(in_camera) - points.pixels).max() < 1e-3


def test_points_for_training_are_seen_by_two_training_frames(scene, tmp_path):
    """One training frame alone gives no point; validation and test frames keep all of theirs."""
    run(scene, tmp_path / "dataset.h5", width_px=80)
    with Dataset(tmp_path / "dataset.h5") as dataset:
        train, test = dataset.groups["train"], dataset.groups["test"]
        ids = np.concatenate([np.unique(train.training_points(k).ids) for k in range(4)])
        assert np.bincount(ids)[np.unique(ids)].min() >= 2
        of_test = np.concatenate([test.points(k).ids for k in range(2)])
        assert not np.isin(of_test, ids).all()


def test_points_of_another_world_are_left_out(scene, tmp_path):
    """A model whose poses are not the lists' keeps its cameras and loses its points, which is reported."""
    moved = Poses(poses().centers + np.array([0, 0, 5.0]), poses().quats_wxyz)
    for name, rows in (("train", TRAIN), ("test", TEST)):
        write_cambridge(
            scene / f"dataset_{name}.txt", [NAMES[k] for k in rows], moved[np.array(rows)]
        )
    done = run(scene, tmp_path / "dataset.h5", width_px=80)
    assert done.with_focal == 6
    assert (
        f"{NAMES[0]} and 5 more: the pose in reconstruction.nvm is different, so its map points are left out"
        in (done.notes)
    )
    with Dataset(tmp_path / "dataset.h5") as dataset:
        assert [len(dataset.groups["train"].points(k).ids) for k in range(4)] == [0] * 4


def test_without_a_model_images_are_reduced_and_the_focal_length_is_unknown(scene, tmp_path):
    """The image is the same as with the model; what is not known is NaN."""
    run(scene, tmp_path / "with.h5", width_px=80)
    (scene / "reconstruction.nvm").unlink()
    done = run(scene, tmp_path / "without.h5", width_px=80)
    assert done.with_focal == 0
    with Dataset(tmp_path / "with.h5") as one, Dataset(tmp_path / "without.h5") as two:
        assert np.isnan(two.groups["train"].intrinsics).all()
        assert (two.groups["train"].image(1) == one.groups["train"].image(1)).all()


def test_a_missing_image_is_left_out_and_reported(scene, tmp_path):
    """The other images are taken; one that was converted to JPEG is found."""
    (scene / NAMES[1]).unlink()
    image = cv2.imread(str(scene / NAMES[2]))
    cv2.imwrite(str((scene / NAMES[2]).with_suffix(".jpg")), image)
    (scene / NAMES[2]).unlink()
    done = run(scene, tmp_path / "dataset.h5", width_px=80)
    assert done.counts == {"train": 3, "test": 2}
    assert f"{NAMES[1]}: left out because the image is missing" in done.notes


def test_an_image_in_two_lists_is_refused(scene, tmp_path):
    """What trains must not test."""
    write_cambridge(scene / "dataset_validation.txt", [NAMES[0]], poses()[:1])
    with pytest.raises(InputError, match=r"seq1/frame00000.png is also in dataset_train.txt"):
        run(scene, tmp_path / "dataset.h5")
    assert not (tmp_path / "dataset.h5").exists()


def test_a_folder_without_a_training_list_is_refused(tmp_path):
    """The message names the file that is missing."""
    with pytest.raises(InputError, match=r"dataset_train\.txt: does not exist"):
        run(tmp_path, tmp_path / "dataset.h5")
    with pytest.raises(InputError, match="is not a folder"):
        run(tmp_path / "nothing", tmp_path / "dataset.h5")


def test_a_damaged_image_is_refused_by_name(scene, tmp_path):
    """No frame is made up, and no file is left."""
    (scene / NAMES[5]).write_bytes(b"no image")
    with pytest.raises(InputError, match=r"frame00005.png: cannot be read as an image"):
        run(scene, tmp_path / "dataset.h5", width_px=80)
    assert not list(tmp_path.glob("dataset.h5*"))


@pytest.mark.parametrize("distortion", [-0.08, 0.06])
def test_visualsfms_distortion_becomes_colmaps(distortion):
    """The fitted camera leads each ray to where VisualSFM's model measures it, to a tenth of a pixel."""
    camera = camera_from_visualsfm(1670.0, distortion, 1920, 1080)
    x, y = np.meshgrid(np.linspace(0, 1920, 30), np.linspace(0, 1080, 20))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    measured = (pixels - [960, 540]) / 1670
    ray = measured * (1 + distortion * (measured**2).sum(axis=1, keepdims=True))
    found = camera.project(np.column_stack([ray, np.ones(len(ray))]))
    assert np.abs(found - pixels).max() < 0.1
    assert np.abs(ray - measured).max() * 1670 > 20  # it is no small matter


def test_a_lens_that_cannot_be_is_refused():
    """A focal length of zero, or a distortion that folds the image, is no camera."""
    for focal_px, distortion in ((0.0, 0.0), (np.nan, 0.0), (900.0, -0.9), (900.0, 3.0)):
        with pytest.raises(GeometryError):
            camera_from_visualsfm(focal_px, distortion, 1920, 1080)


def test_the_command_tells_what_it_did(scene, tmp_path):
    """Notes, counts, and a second run is refused until it may overwrite."""
    target = tmp_path / "scene.h5"
    words = ["import", str(scene), "--to", str(target), "--size", "80"]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 0, done.output
    assert "train 4, test 2; 6 with a known focal length" in " ".join(done.output.split())
    assert "unknown origin and up direction" in " ".join(done.output.split())
    again = CliRunner().invoke(main, words)
    assert again.exit_code == 1
    assert "already exists; use --overwrite to replace it" in again.output
    assert CliRunner().invoke(main, [*words, "--overwrite"]).exit_code == 0


def test_every_option_of_import_is_documented():
    """docs/dataset.md has a row for every option, with its default, and names every list."""
    text = (Path(__file__).resolve().parents[3] / "docs" / "dataset.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^- `(--[a-z-]+)` \(([^)]*)\)", text, re.MULTILINE))
    options = {p.opts[-1]: p for p in import_.params if p.opts[-1].startswith("--")}
    assert set(rows) == set(options)
    for flag, option in options.items():
        if option.show_default is True:
            assert rows[flag] == str(option.default)
    assert all(name in text for name in LISTS.values())


def test_lists_read_as_they_are(shared_data):
    """The lists behind these tests are those published: 231 and 103, 1532 and 760 images."""
    counts = [
        len(read_cambridge(shared_data / "cambridge" / scene / f"dataset_{name}.txt"))
        for scene in ("ShopFacade", "GreatCourt")
        for name in ("train", "test")
    ]
    assert counts == [231, 103, 1532, 760]


def test_only_files_that_are_data_sets_are_replaced(scene, tmp_path):
    """A mistyped --to does not cost the user a list, nor a photo."""
    mistyped = scene / "dataset_train.txt"
    before = mistyped.read_bytes()
    with pytest.raises(InputError, match="is not the name of an HDF5 file"):
        run(scene, mistyped, overwrite=True)
    assert mistyped.read_bytes() == before


def test_lists_without_a_frame_are_refused(tmp_path):
    write_cambridge(tmp_path / "dataset_train.txt", [], Poses(np.zeros((0, 3)), np.zeros((0, 4))))
    with pytest.raises(InputError, match="contains no training frame"):
        run(tmp_path, tmp_path / "dataset.h5")
    assert not (tmp_path / "dataset.h5").exists()
