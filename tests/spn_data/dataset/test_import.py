"""Tests of importing Cambridge Landmarks folders: exact poses, and all anomalies reported."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import piexif
import pytest
from click.testing import CliRunner
from PIL import Image
from spn_cli.data import main
from spn_cli.import_ import import_

from spn_data.dataset.cambridge import HEADER, read_cambridge, write_cambridge
from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import Role
from spn_data.dataset.nvm import build_nvm_model, read_nvm, read_nvm_models, write_nvm
from spn_data.dataset.nvm_frames import camera_from_visualsfm, match_names
from spn_data.dataset.pose_agreement import name_disagreement
from spn_data.dataset.samples import open_samples
from spn_data.errors import GeometryError, InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses, Similarity
from spn_data.geometry.rotations import (
    quats_from_rotations,
    rotations_from_angles,
    rotations_from_vectors,
)
from spn_data.inputs.cambridge_frames import LISTS
from spn_data.pipeline.import_cambridge import Imported, ImportOptions, import_cambridge
from spn_model.examples.training_set import TrainingSet

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
    """Published lists come back byte by byte from text through HDF5 to text."""
    folder = shared_data / "cambridge" / scene
    run(folder, tmp_path / "dataset.h5", keep_outliers=True)
    with Dataset(tmp_path / "dataset.h5") as dataset:
        assert sorted(dataset.groups) == ["test", "train"]
        for name, group in dataset.groups.items():
            original = folder / f"dataset_{name}.txt"
            write_cambridge(tmp_path / name, group.names.tolist(), group.poses)
            assert (tmp_path / name).read_bytes() == original.read_bytes()


def test_the_second_round_trip_is_identical(shared_data, tmp_path):
    """Importing the exported lists gives bit-identical poses."""
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
    """Lists alone give no images, focal lengths, origin or up direction, and the notes say so."""
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
    """The frame three million kilometres away is left out and reported."""
    done = run(shared_data / "cambridge" / "GreatCourt", tmp_path / "dataset.h5")
    assert done.counts == {"train": 1531, "test": 760}
    notes = [note for note in done.notes if OUTLIER in note]
    assert any("from the median position" in note for note in notes)
    assert f"{OUTLIER}: left out because of its position; use --keep-outliers to keep it" in notes
    with Dataset(tmp_path / "dataset.h5") as dataset:
        assert OUTLIER not in dataset.groups["train"].names
        assert np.abs(dataset.groups["train"].poses.centers).max() < 1000


def poses() -> Poses:
    """Return six cameras in a row that look north."""
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
    """Write a folder with lists, images and a model; each point is a bright dot on black."""
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
    """A folder with a model gives RGB images, intrinsics, and points at their pixels."""
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
            assert (image[row, column, 0] > 40).all()  # a quarter of the red dot or more
            assert image[..., 2].max() == 0
            pose = group.poses[k : k + 1]
            in_camera = (points.xyz - pose.centers[0]) @ pose.rotations[0].T
            reduced = Camera("SIMPLE_PINHOLE", 80, 45, np.array([60, 40, 22.5]))
            assert np.abs(reduced.project(in_camera) - points.pixels).max() < 1e-3


def test_points_for_training_are_seen_by_two_training_frames(scene, tmp_path):
    """Training points are seen by at least two training frames; test frames keep all their points."""
    run(scene, tmp_path / "dataset.h5", width_px=80)
    with Dataset(tmp_path / "dataset.h5") as dataset:
        train, test = dataset.groups["train"], dataset.groups["test"]
        ids = np.concatenate([np.unique(train.training_points(k).ids) for k in range(4)])
        assert np.bincount(ids)[np.unique(ids)].min() >= 2
        of_test = np.concatenate([test.points(k).ids for k in range(2)])
        assert not np.isin(of_test, ids).all()


def test_a_model_of_another_world_is_refused(scene, tmp_path):
    """A model whose poses all differ from the lists is refused; two differing poses are only noted."""
    moved = Poses(poses().centers + np.array([0, 0, 5.0]), poses().quats_wxyz)
    for name, rows in (("train", TRAIN), ("test", TEST)):
        write_cambridge(
            scene / f"dataset_{name}.txt", [NAMES[k] for k in rows], moved[np.array(rows)]
        )
    with pytest.raises(InputError, match="for 6 of 6 images"):
        run(scene, tmp_path / "dataset.h5", width_px=80)
    write_cambridge(scene / "dataset_test.txt", [NAMES[k] for k in TEST], poses()[np.array(TEST)])
    write_cambridge(
        scene / "dataset_train.txt",
        [NAMES[k] for k in TRAIN],
        Poses.concatenate([moved[:2], poses()[2:4]]),
    )
    done = run(scene, tmp_path / "dataset.h5", width_px=80)
    assert done.with_focal == 6
    assert (
        f"{NAMES[0]} and 1 more: the pose in reconstruction.nvm is different, so its map points are left out"
        in (done.notes)
    )
    with Dataset(tmp_path / "dataset.h5") as dataset:
        assert [len(dataset.groups["train"].points(k).ids) for k in range(2)] == [0] * 2


def test_without_a_model_images_are_reduced_and_the_focal_length_is_unknown(scene, tmp_path):
    """Without a model, images are the same and the intrinsics are NaN."""
    run(scene, tmp_path / "with.h5", width_px=80)
    (scene / "reconstruction.nvm").unlink()
    done = run(scene, tmp_path / "without.h5", width_px=80)
    assert done.with_focal == 0
    with Dataset(tmp_path / "with.h5") as one, Dataset(tmp_path / "without.h5") as two:
        assert np.isnan(two.groups["train"].intrinsics).all()
        assert (two.groups["train"].image(1) == one.groups["train"].image(1)).all()


def test_a_missing_image_is_left_out_and_reported(scene, tmp_path):
    """A missing image is left out and reported; one converted to JPEG is found."""
    (scene / NAMES[1]).unlink()
    image = cv2.imread(str(scene / NAMES[2]))
    cv2.imwrite(str((scene / NAMES[2]).with_suffix(".jpg")), image)
    (scene / NAMES[2]).unlink()
    done = run(scene, tmp_path / "dataset.h5", width_px=80)
    assert done.counts == {"train": 3, "test": 2}
    assert f"{NAMES[1]}: left out because the image is missing" in done.notes


def test_a_name_too_long_for_the_file_system_is_a_missing_image(scene, tmp_path):
    """A name of 300 characters in a list is reported as a missing image."""
    path = scene / "dataset_train.txt"
    path.write_text(path.read_text().replace(NAMES[1], f"{'x' * 300}.png"))
    done = run(scene, tmp_path / "dataset.h5", width_px=80)
    assert any("left out because the image is missing" in note for note in done.notes)


def test_an_image_in_two_lists_is_refused(scene, tmp_path):
    """An image in both the training and the validation list is refused."""
    write_cambridge(scene / "dataset_validation.txt", [NAMES[0]], poses()[:1])
    with pytest.raises(InputError, match=r"seq1/frame00000.png is also in dataset_train.txt"):
        run(scene, tmp_path / "dataset.h5")
    assert not (tmp_path / "dataset.h5").exists()


def test_a_folder_without_a_training_list_is_refused(tmp_path):
    """The error names the missing training list."""
    with pytest.raises(InputError, match=r"dataset_train\.txt: does not exist"):
        run(tmp_path, tmp_path / "dataset.h5")
    with pytest.raises(InputError, match="is not a folder"):
        run(tmp_path / "nothing", tmp_path / "dataset.h5")


def test_a_damaged_image_is_refused_by_name(scene, tmp_path):
    """A damaged image is refused by name, and no output file remains."""
    (scene / NAMES[5]).write_bytes(b"no image")
    with pytest.raises(InputError, match=r"frame00005.png: cannot be read as an image"):
        run(scene, tmp_path / "dataset.h5", width_px=80)
    assert not list(tmp_path.glob("dataset.h5*"))


@pytest.mark.parametrize("distortion", [-0.08, 0.06])
def test_visualsfms_distortion_becomes_colmaps(distortion):
    """The fitted camera reproduces VisualSFM's distortion to a tenth of a pixel."""
    camera = camera_from_visualsfm(1670.0, distortion, 1920, 1080)
    x, y = np.meshgrid(np.linspace(0, 1920, 30), np.linspace(0, 1080, 20))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    measured = (pixels - [960, 540]) / 1670
    ray = measured * (1 + distortion * (measured**2).sum(axis=1, keepdims=True))
    found = camera.project(np.column_stack([ray, np.ones(len(ray))]))
    assert np.abs(found - pixels).max() < 0.1
    assert np.abs(ray - measured).max() * 1670 > 20  # the distortion is not negligible


def test_a_lens_that_cannot_be_is_refused():
    """A zero or unknown focal length, or a distortion that folds the image, is refused."""
    for focal_px, distortion in ((0.0, 0.0), (np.nan, 0.0), (900.0, -0.9), (900.0, 3.0)):
        with pytest.raises(GeometryError):
            camera_from_visualsfm(focal_px, distortion, 1920, 1080)


def test_the_command_tells_what_it_did(scene, tmp_path):
    """The command prints counts and notes; a second run needs --overwrite."""
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
    """docs/dataset.md lists every option with its default, and every pose list."""
    text = (Path(__file__).resolve().parents[3] / "docs" / "dataset.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^- `(--[a-z-]+)` \(([^)]*)\)", text, re.MULTILINE))
    options = {
        p.opts[-1]: p for p in import_.params if p.opts[-1].startswith("--") and p.expose_value
    }
    assert set(rows) == set(options)
    for flag, option in options.items():
        if option.show_default is True:
            assert rows[flag] == str(option.default)
    assert all(name in text for name in LISTS.values())


def test_lists_read_as_they_are(shared_data):
    """The test data are the published lists of 231 and 103, 1532 and 760 images."""
    counts = [
        len(read_cambridge(shared_data / "cambridge" / scene / f"dataset_{name}.txt"))
        for scene in ("ShopFacade", "GreatCourt")
        for name in ("train", "test")
    ]
    assert counts == [231, 103, 1532, 760]


def test_only_files_that_are_data_sets_are_replaced(scene, tmp_path):
    """A mistyped --to never overwrites a list or photo."""
    mistyped = scene / "dataset_train.txt"
    before = mistyped.read_bytes()
    with pytest.raises(InputError, match="is not the name of an HDF5 file"):
        run(scene, mistyped, overwrite=True)
    assert mistyped.read_bytes() == before


def test_lists_without_a_frame_are_refused(tmp_path):
    """A training list without images is refused."""
    write_cambridge(tmp_path / "dataset_train.txt", [], Poses(np.zeros((0, 3)), np.zeros((0, 4))))
    with pytest.raises(InputError, match="contains no training frame"):
        run(tmp_path, tmp_path / "dataset.h5")
    assert not (tmp_path / "dataset.h5").exists()


def listed(folder: Path, name: str) -> list[list[str]]:
    """Return the rows of a list as cells."""
    return [line.split() for line in (folder / f"dataset_{name}.txt").read_text().splitlines()[3:]]


def relist(folder: Path, change: Callable[[list[str]], list[str]], names=("train", "test")) -> None:
    for name in names:
        rows = [" ".join(change(cells)) for cells in listed(folder, name)]
        (folder / f"dataset_{name}.txt").write_text("\n".join([*HEADER, *rows, ""]))


def conjugate(cells: list[str]) -> list[str]:
    return [*cells[:5], *(str(-float(value)) for value in cells[5:])]


def scalar_last(cells: list[str]) -> list[str]:
    return [*cells[:4], *cells[5:], cells[4]]


def translation(cells: list[str]) -> list[str]:
    center, quat = np.array(cells[1:4], float), np.array([cells[4:]], float)
    return [cells[0], *map(str, -Poses(center[None], quat).rotations[0] @ center), *cells[4:]]


def turned_about(axis: np.ndarray) -> Callable[[list[str]], list[str]]:
    def change(cells: list[str]) -> list[str]:
        pose = Poses(np.zeros((1, 3)), np.array([cells[4:]], float))
        quat = quats_from_rotations(rotations_from_vectors(axis[None]) @ pose.rotations)[0]
        return [*cells[:4], *map(str, quat)]

    return change


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (conjugate, "if the quaternions rotate camera axes into world axes"),
        (scalar_last, r"if the quaternions are in the order x y z w \(write w first\);"),
        (
            lambda cells: scalar_last(conjugate(cells)),
            "order x y z w .* and rotate camera axes into world axes",
        ),
        (translation, r"if the positions are the translation t = -R C"),
        (turned_about(np.array([np.pi, 0, 0])), "if the camera's axes are y up and z backward"),
        (turned_about(np.array([0, 0, -np.pi / 2])), "turned by 90 degrees about their optical"),
        (turned_about(np.array([0, 0, np.pi / 2])), "turned by 270 degrees about their optical"),
        (
            lambda cells: [cells[0], *(str(2 * float(v)) for v in cells[1:4]), *cells[4:]],
            "no usual mistake of conventions explains that",  # collinear centres do not fix the axes
        ),
        (turned_about(np.array([0.2, 0, 0])), "no usual mistake of conventions explains that"),
    ],
)
def test_a_list_in_another_convention_is_refused_by_its_name(scene, tmp_path, change, cause):
    """If list and model disagree in all frames, the error names the convention that would explain it."""
    relist(scene, change)
    with pytest.raises(InputError, match=f"for 6 of 6 images; .*{cause}"):
        run(scene, tmp_path / "dataset.h5")
    assert not (tmp_path / "dataset.h5").exists()


def test_some_frames_in_another_convention_are_refused_too(scene, tmp_path):
    """Four of six conjugate quaternions are refused; two displaced frames are only noted."""
    relist(scene, conjugate, names=("train",))
    with pytest.raises(InputError, match="for 4 of 6 images; they agree if the quaternions rotate"):
        run(scene, tmp_path / "dataset.h5")
    relist(scene, conjugate, names=("train",))
    relist(scene, lambda c: [c[0], c[1], "0.3", *c[3:]], names=("test",))
    done = run(scene, tmp_path / "dataset.h5")
    assert any("the pose in reconstruction.nvm is different" in note for note in done.notes)


def textured(width: int, height: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 255, (height // 8, width // 8, 3), dtype=np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)


def resize_all(scene: Path, factor: float, names=NAMES) -> None:
    for name in names:
        image = cv2.imread(str(scene / name))
        size = (round(factor * 160), round(factor * 90))
        cv2.imwrite(str(scene / name), cv2.resize(image, size))


@pytest.mark.parametrize(
    ("factor", "message"),
    [
        (0.5, "the image is 80x45, but the model's measurements in it span"),
        (1.5, "other images of 240x135: the model's measurements reach only"),
        (2.0, "other images of 320x180: the model's measurements reach only"),
    ],
)
def test_images_of_another_size_than_the_models_are_refused(scene, tmp_path, factor, message):
    """Images of another size than those of the model are refused."""
    resize_all(scene, factor)
    with pytest.raises(InputError, match=message):
        run(scene, tmp_path / "dataset.h5")


def test_one_image_of_another_size_is_refused_by_name(scene, tmp_path):
    """A single thumbnail among the images is refused by name."""
    resize_all(scene, 0.5, NAMES[3:4])
    with pytest.raises(InputError, match=rf"{NAMES[3]}: the image is 80x45, but the model's"):
        run(scene, tmp_path / "dataset.h5")


def test_an_image_of_another_shape_is_refused_by_name(scene, tmp_path):
    """Without a model, the error names two images of different shape and suggests a remedy."""
    (scene / "reconstruction.nvm").unlink()
    cv2.imwrite(str(scene / NAMES[2]), np.zeros((160, 90, 3), np.uint8))
    message = (
        rf"{NAMES[2]}: the image is 90x160, but {NAMES[0]} is 160x90: all images of .* crop them"
    )
    with pytest.raises(InputError, match=message):
        run(scene, tmp_path / "dataset.h5")


def as_jpeg(scene: Path, orientation: int, *, rotate: int | None = None) -> None:
    """Rewrite all images as JPEG with an EXIF orientation, with pixels rotated by `rotate`."""
    exif = piexif.dump({"0th": {piexif.ImageIFD.Orientation: orientation}})
    for name in NAMES:
        image = cv2.imread(str(scene / name))
        (scene / name).unlink()
        image = image if rotate is None else cv2.rotate(image, rotate)
        rgb = Image.fromarray(image[..., ::-1].copy())
        rgb.save((scene / name).with_suffix(".jpg"), exif=exif, quality=95)


def test_exif_is_applied_only_where_the_model_is_of_upright_images(scene, tmp_path):
    """EXIF orientation is applied only if the model's measurements fit the upright images."""
    as_jpeg(scene, 6)
    done = run(scene, tmp_path / "stored.h5", width_px=160)
    assert any("read as stored, although the EXIF" in note for note in done.notes)
    for name in NAMES:
        image = cv2.imread(str((scene / name).with_suffix(".jpg")), cv2.IMREAD_IGNORE_ORIENTATION)
        (scene / name).with_suffix(".jpg").unlink()
        cv2.imwrite(str(scene / name), image)
    as_jpeg(scene, 6, rotate=cv2.ROTATE_90_COUNTERCLOCKWISE)
    done = run(scene, tmp_path / "upright.h5", width_px=160)
    assert any("turned upright by their EXIF, as the images" in note for note in done.notes)
    for file in ("stored.h5", "upright.h5"):
        with Dataset(tmp_path / file) as dataset:
            group = dataset.groups["train"]
            assert group.image_size == (160, 90)
            column, row = group.points(0).pixels.astype(int).T
            assert np.median(group.image(0)[row, column, 0]) > 50


def test_an_orientation_that_nothing_confirms_is_noted(scene, tmp_path):
    """An EXIF orientation of 180 degrees, which the measurements cannot confirm, is noted."""
    as_jpeg(scene, 3)
    done = run(scene, tmp_path / "half.h5", width_px=80)
    assert any("nothing shows whether the poses are of the upright" in n for n in done.notes)


def test_failed_frames_at_zero_are_left_out(scene, tmp_path):
    """Two frames at position 0 0 0 are left out as failed, and reported."""
    relist(scene, lambda c: [c[0], *"0001000"] if c[0] in NAMES[1:3] else c)
    done = run(scene, tmp_path / "dataset.h5", width_px=80)
    assert done.counts == {"train": 2, "test": 2}
    assert any(f"{NAMES[1]} and 1 more: left out because the pos" in note for note in done.notes)


def test_one_frame_at_zero_may_be_the_first_of_its_world(scene, tmp_path):
    """A single frame at 0 0 0 is kept if other frames are near, and left out otherwise."""
    (scene / "reconstruction.nvm").unlink()
    relist(scene, lambda c: [c[0], c[1], "0", "0", *c[4:]])
    done = run(scene, tmp_path / "near.h5", width_px=80)
    assert done.counts == {"train": 4, "test": 2}
    assert any(f"{NAMES[0]}: its position is 0 0 0; it is kept" in note for note in done.notes)
    relist(scene, lambda c: [c[0], c[1], "0", "0" if c[0] == NAMES[0] else "90", *c[4:]])
    assert run(scene, tmp_path / "far.h5", width_px=80).counts == {"train": 3, "test": 2}


def test_positions_that_are_all_equal_are_noted(scene, tmp_path):
    """Positions that are all equal are noted, because a network cannot learn from them."""
    (scene / "reconstruction.nvm").unlink()
    relist(scene, lambda c: [c[0], "1", "2", "3", *c[4:]])
    done = run(scene, tmp_path / "dataset.h5", width_px=80)
    assert any("all 4 positions are equal, so a network cannot learn" in n for n in done.notes)


def test_a_copy_of_a_training_image_among_the_test_images_is_refused(scene, tmp_path):
    """A test image with the pixels of a training image is refused; a lossy copy is noted."""
    (scene / "reconstruction.nvm").unlink()
    for k, name in enumerate(NAMES):
        cv2.imwrite(str(scene / name), textured(160, 90, k))
    assert not any("looks the same" in n for n in run(scene, tmp_path / "a.h5").notes)
    (scene / NAMES[4]).unlink()
    copy = (scene / NAMES[4]).with_suffix(".jpg")
    cv2.imwrite(str(copy), textured(160, 90, 0), [cv2.IMWRITE_JPEG_QUALITY, 95])
    done = run(scene, tmp_path / "b.h5")
    assert f"{NAMES[4]}: looks the same as the training image {NAMES[0]}" in done.notes
    copy.unlink()
    cv2.imwrite(str((scene / NAMES[4]).with_suffix(".bmp")), textured(160, 90, 0))
    with pytest.raises(InputError, match=rf"is a copy of {NAMES[0]}, which is in another list"):
        run(scene, tmp_path / "c.h5")
    assert not (tmp_path / "c.h5").exists()


def test_dark_images_are_noted_in_the_file_too(scene, tmp_path):
    """Nearly black images are noted, also in the notes of the file."""
    (scene / "reconstruction.nvm").unlink()
    for k, name in enumerate(NAMES):
        cv2.imwrite(str(scene / name), textured(160, 90, k)[..., 0] // 16)
    done = run(scene, tmp_path / "dataset.h5")
    assert any(f"{NAMES[0]} and 5 more: the image is nearly black" in n for n in done.notes)
    with Dataset(tmp_path / "dataset.h5") as dataset:
        assert dataset.info.notes == done.notes


@pytest.mark.parametrize(
    "offset",
    [(563247.0, 5934791.0, 323.0), (3771793.25, 140253.5, 5124304.125)],
    ids=["UTM", "Earth-centred"],
)
def test_coordinates_far_from_zero_are_stored_relative_to_an_offset(scene, tmp_path, offset):
    """Coordinates too coarse in float32 are small in the file, and read as given; --subtract removes them."""
    offset = np.array(offset)
    run(scene, tmp_path / "near.h5", width_px=80)
    relist(scene, lambda c: [c[0], *map(repr, (np.array(c[1:4], float) + offset).tolist()), *c[4:]])
    shift_model(scene, offset)
    done = run(scene, tmp_path / "utm.h5", width_px=80)
    assert any("far from zero: the file stores them relative to" in note for note in done.notes)
    listed = read_cambridge(scene / LISTS[Role.TRAIN]).poses.centers
    with Dataset(tmp_path / "near.h5") as one, Dataset(tmp_path / "utm.h5") as two:
        near, far = one.groups["train"], two.groups["train"]
        assert one.info.offset == (0, 0, 0)
        assert np.abs(two.info.offset - offset).max() < 10
        assert (far.poses.centers == listed).all()
        assert np.allclose(far.points(0).xyz - offset, near.points(0).xyz, rtol=0, atol=1e-8)
        samples = open_samples(tmp_path / "utm.h5", "train")
        assert (samples[0]["position"] == listed[0]).all()
        assert (samples.offset == two.info.offset).all()
        moved = np.array(two.info.offset) - offset
        (a, b), (c, d) = (
            (of.poses.centers, of.points(0).xyz) for of in map(TrainingSet, (near, far))
        )
        assert np.allclose(c + moved, a, rtol=0, atol=1e-8)
        assert np.allclose(d + moved, b, rtol=0, atol=1e-8)
    with h5py.File(tmp_path / "near.h5") as one, h5py.File(tmp_path / "utm.h5") as two:
        assert (one.attrs["version"], two.attrs["version"]) == (1, 2)
        assert "offset_x" not in one.attrs
        assert b"relative to offset_x" in two.attrs["conventions"]
        stored = [two["train/centers"], two["train/points/xyz"]]
        assert all(np.abs(values[:]).max() < 100 for values in stored)
        assert all(b"offset of the file" in values.attrs["description"] for values in stored)
        assert b"offset" not in one["train/centers"].attrs["description"]
    done = run(scene, tmp_path / "far.h5", width_px=80, subtract=tuple(offset.tolist()))
    assert any("was subtracted from all positions" in note for note in done.notes)
    with Dataset(tmp_path / "near.h5") as one, Dataset(tmp_path / "far.h5") as two:
        near, far = one.groups["train"], two.groups["train"]
        assert np.allclose(near.poses.centers, far.poses.centers, atol=1e-8)
        assert np.allclose(near.points(0).xyz, far.points(0).xyz, atol=1e-8)


def shift_model(scene: Path, offset: np.ndarray) -> None:
    model = read_nvm(scene / "reconstruction.nvm")
    moved = Poses(model.poses.centers + offset, model.poses.quats_wxyz)
    write_nvm(scene / "reconstruction.nvm", replace(model, poses=moved, xyz=model.xyz + offset))


def test_the_model_that_the_lists_belong_to_is_used(scene, tmp_path):
    """Of several models in a file, the one whose poses match the lists is used."""
    path = scene / "reconstruction.nvm"
    right = path.read_text().split("\n", 2)[2].strip().removesuffix("0").strip()
    shift_model(scene, np.array([50.0, 0, 0]))
    wrong = path.read_text().strip().removesuffix("0")
    unregistered = "1\nseq9/a b.jpg 100 0 0 0 0 0 0 0 0 0\n\n0"
    path.write_text(f"{wrong}\n{right}\n\n{unregistered}\n\n0\n\n#the last part\n0\n")
    assert [len(model.names) for model in read_nvm_models(path)] == [6, 6]
    done = run(scene, tmp_path / "dataset.h5", width_px=80)
    assert any("contains 2 models; number 2 is used, which has 6 of the 6" in n for n in done.notes)
    assert not any("different" in note for note in done.notes)


def test_names_are_matched_by_a_unique_ending_and_may_have_spaces():
    """Names match by unique path ending, across suffixes, Windows paths and VisualSFM's quotes."""
    given = [
        r"D:\scans\seq1\a.jpg",
        'D:/scans/my"seq/b.JPG',
        "c.jpg",
        "x/seq3/d.jpg",
        "y/seq3/d.jpg",
    ]
    names = ["seq1/a.png", "my seq/b.png", "seq2/c.png", "seq3/d.png", "eq1/a.png", "e.png"]
    assert match_names(names, given).tolist() == [0, 1, 2, -1, -1, -1]
    assert match_names(["seq1/c.png", "seq2/c.png"], ["c.jpg"]).tolist() == [-1, -1]
    assert match_names(["a.png"], ["a.jpg", "a.bmp"]).tolist() == [-1]
    assert match_names(["a.png", "a.jpg"], ["a.jpg"]).tolist() == [-1, 0]


def test_a_name_with_spaces_is_imported(scene, tmp_path):
    """Folder and file names with spaces are found in both list and model."""
    spaced = {name: name.replace("seq", "my seq ") for name in NAMES}
    for name in NAMES:
        (scene / spaced[name]).parent.mkdir(exist_ok=True)
        (scene / name).rename(scene / spaced[name])
    relist(scene, lambda c: [spaced[c[0]], *c[1:]])
    path = scene / "reconstruction.nvm"
    path.write_text(path.read_text().replace("seq", 'my"seq"'))
    done = run(scene, tmp_path / "dataset.h5", width_px=80)
    assert done.counts == {"train": 4, "test": 2}
    assert done.with_focal == 6


@pytest.mark.parametrize("suffix", [".bmp", ".webp"])
def test_bmp_and_webp_are_read(scene, tmp_path, suffix):
    """Images converted to BMP or WebP are found and read."""
    for name in NAMES:
        image = cv2.imread(str(scene / name))
        (scene / name).unlink()
        cv2.imwrite(str((scene / name).with_suffix(suffix)), image)
    assert run(scene, tmp_path / "dataset.h5", width_px=80).counts == {"train": 4, "test": 2}


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("01-nvm-of-other-image-size", "made of images of another size"),
        ("04-nvm-mixed-scale", "made of smaller images"),
        ("05-exif-turned-against-poses", "read as stored"),
        ("07-utm-labels", "relative to the offset 563238 5934792 324"),
        ("09-sixteen-bit-of-twelve", "uses only values 336 to 3904 of 16 bits"),
        (
            "10-failed-frames-at-origin",
            "and 2 more: left out because the position is exactly 0 0 0",
        ),
        ("11-all-poses-another-convention", "conjugate them"),
        ("14-nvm-second-model", "number 2 is used"),
        ("20-nvm-zero-quaternion", "reconstruction.nvm:9: seq1/frame00005.jpg"),
        ("21-size-unnamed", "seq2/frame00010.png and 9 more: the image is 320x180"),
        ("base", ""),
    ],
)
def test_cases_from_outside_are_reported(shared_cases, tmp_path, case, message):
    """Externally damaged scenes are refused or noted with the documented message."""
    folder = tmp_path / case
    shutil.copytree(shared_cases / "labels" / "base", folder)
    shutil.copytree(shared_cases / "labels" / case, folder, dirs_exist_ok=True)
    if case.startswith("05"):
        for path in folder.rglob("*.png"):
            path.unlink()
    try:
        notes = run(folder, tmp_path / "dataset.h5", width_px=160).notes
    except InputError as error:
        notes = (str(error),)
    assert message in "\n".join(notes)
    if case == "base":
        assert len(notes) == 1


def test_a_model_in_another_world_is_named():
    """A similarity between list and model is distinguished from a wrong convention."""
    rng = np.random.default_rng(3)
    rotations = rotations_from_vectors(rng.normal(0, 1, (12, 3)))
    model = Poses.from_rotations(rng.normal(0, 5, (12, 3)), rotations)
    listed_from_model = Similarity(
        2.5, rotations_from_vectors(np.array([[0.1, 0.2, 0.3]]))[0], np.array([7.0, 8, 9])
    )
    message = name_disagreement(listed_from_model.apply_to_poses(model), model)
    assert "1 unit of the model is 2.5 of the list" in message
    others = Poses.from_rotations(rng.normal(0, 5, (12, 3)), rotations)
    assert name_disagreement(others, model) == ""
