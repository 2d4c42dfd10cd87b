"""`spn-data split` and `spn-data audit` on a reconstructed flight without an evaluation sequence."""

from __future__ import annotations

import re
import shutil
import time
from dataclasses import fields
from pathlib import Path

import click
import cv2
import h5py
import numpy as np
import pytest
from click.testing import CliRunner, Result
from spn_cli.data import main

from spn_data.area.area import Area
from spn_data.area.names import FRAMES, MODEL, SPLIT
from spn_data.dataset.cambridge import read_cambridge
from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.nvm import read_nvm
from spn_data.geometry.rendering import undistorted_camera
from spn_data.inputs.area_labels import read_labelled_area
from spn_data.pipeline.split_stage import SplitStageOptions
from spn_data.split.groups import LEFT_OUT, TRAIN, SplitOptions
from spn_data.split.split_file import read_split
from spn_data.storage.json_files import read_json, write_json

DOC = Path(__file__).resolve().parents[2] / "docs" / "split.md"


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments], terminal_width=200)


@pytest.fixture(scope="module")
def split_area(finished_area: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The flight, split with the default options; no test may change it."""
    area = tmp_path_factory.mktemp("split") / "area"
    shutil.copytree(finished_area, area)
    result = run("split", "--area", area)
    assert result.exit_code == 0, result.output
    assert "same flight as training: optimistic" in result.output
    assert "Audit passed: " in result.output
    return area


@pytest.fixture
def area(split_area: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(split_area, tmp_path / "area"))


def rewrite(path: Path, change: object) -> None:
    """Modify a JSON file of the area with a function of its value."""
    value = read_json(path)
    change(value)  # type: ignore[operator]
    write_json(path, value)


def test_a_flight_is_split_with_no_other_step(split_area: Path) -> None:
    """A reconstructed flight splits into three groups, and every output marks the test as optimistic."""
    folder = split_area / SPLIT
    split = read_split(folder / "split.json")
    assert split.groups() == ("train", "validation", "test")
    assert split.optimistic
    record = Area(split_area).record(SPLIT)
    assert record.counts["groups"] == split.counts()
    assert "same flight as training: optimistic" in record.notes
    with Dataset(folder / "dataset.h5") as dataset:
        assert dataset.info.optimistic
        assert {name: len(group) for name, group in dataset.groups.items()} == split.counts()


def test_every_frame_has_its_own_image_and_exact_pose(split_area: Path) -> None:
    """Images show the right frame in the canonical camera; poses are bitwise equal to the labels."""
    labelled = read_labelled_area(Area(split_area))
    with Dataset(split_area / SPLIT / "dataset.h5") as dataset:
        camera = dataset.info.camera
        assert camera is not None
        assert (camera.width, camera.height) == (480, 270)
        assert dataset.info.units == labelled.units == "m"
        for group in dataset.groups.values():
            assert group.all_valid
            assert np.allclose(group.intrinsics, camera.matrix)
            for row, name in enumerate(group.names.tolist()):
                (k,) = np.flatnonzero(labelled.mapping.names == name)
                assert (group.poses.centers[row] == labelled.mapping.poses.centers[k]).all()
                source = cv2.imread(str(split_area / FRAMES / name))
                seen = cv2.resize(source, (480, 270)).astype(float)
                image = group.image(row)[:, :, ::-1].astype(float)
                same = np.corrcoef(seen[60:210, 120:360].ravel(), image[60:210, 120:360].ravel())
                assert same[0, 1] > 0.8


def test_points_lie_where_the_pose_projects_them(split_area: Path) -> None:
    """The reprojection error of points in dataset.h5 is small with the intrinsics and pose of the frame."""
    with Dataset(split_area / SPLIT / "dataset.h5") as dataset:
        for group in dataset.groups.values():
            errors = []
            for row in range(len(group)):
                points = group.points(row)
                rotation, center = group.poses.rotations[row], group.poses.centers[row]
                ray = (points.xyz - center) @ rotation.T @ group.intrinsics[row].T
                errors.append(np.linalg.norm(ray[:, :2] / ray[:, 2:] - points.pixels, axis=1))
            assert np.median(np.concatenate(errors)) < 1.5
            assert group.points_for_training == (group.name == TRAIN)


def test_the_cambridge_folder_is_complete(split_area: Path) -> None:
    """Every listed image exists at full size, and the points of the NVM model project to their pixels."""
    folder = split_area / SPLIT / "cambridge"
    split = read_split(split_area / SPLIT / "split.json")
    names: list[str] = []
    for group, file in (
        ("train", "dataset_train.txt"),
        ("validation", "dataset_validation.txt"),
        ("test", "dataset_test.txt"),
    ):
        listed = read_cambridge(folder / file)
        assert len(listed) == split.counts()[group]
        names += listed.names
    labelled = read_labelled_area(Area(split_area))
    camera = undistorted_camera(next(iter(labelled.cameras.values())))
    for name in names:
        image = cv2.imread(str(folder / name))
        assert image.shape == (camera.height, camera.width, 3)
    model = read_nvm(folder / "reconstruction.nvm")
    assert sorted(model.names) == sorted(names)
    assert model.focal_px == pytest.approx(camera.focal_px[0])
    assert (model.distortion == 0).all()
    ray = np.einsum(
        "nij,nj->ni",
        model.poses.rotations[model.image_idx],
        model.xyz[model.point_idx] - model.poses.centers[model.image_idx],
    )
    projected = model.focal_px[model.image_idx][:, None] * ray[:, :2] / ray[:, 2:]
    assert np.median(np.linalg.norm(projected - model.offsets_px, axis=1)) < 1.5
    train = set(read_cambridge(folder / "dataset_train.txt").names)
    assert {model.names[k] for k in model.image_idx} <= train


def test_run_again_it_is_left_as_it_is(split_area: Path) -> None:
    """An unchanged rerun reports the stage as unchanged and does not rewrite dataset.h5."""
    before = (split_area / SPLIT / "dataset.h5").stat().st_mtime_ns
    again = run("split", "--area", split_area)
    assert again.exit_code == 0, again.output
    assert f"{SPLIT}: unchanged since" in again.output
    assert (split_area / SPLIT / "dataset.h5").stat().st_mtime_ns == before


def test_other_options_need_overwrite_and_change_what_they_say(area: Path) -> None:
    """Changed options (native cameras, width 160, no cambridge, 1 s gap) need --overwrite and take effect."""
    options = ("--native", "--size", 160, "--cambridge", "none", "--gap", 1)
    refused = run("split", "--area", area, *options)
    assert refused.exit_code == 1
    assert "--overwrite" in refused.stderr
    result = run("split", "--area", area, *options, "--overwrite")
    assert result.exit_code == 0, result.output
    assert not (area / SPLIT / "cambridge").exists()
    split = read_split(area / SPLIT / "split.json")
    assert split.options.gap_s == 1.0
    with Dataset(area / SPLIT / "dataset.h5") as dataset:
        assert dataset.info.camera is None
        assert dataset.groups["train"].image_size == (160, 90)


@pytest.mark.parametrize("policy", ["space", "height"])
def test_a_policy_that_leaves_a_group_empty_is_one_line_and_leaves_nothing(
    area: Path, policy: str
) -> None:
    """A 30 s gap in a 9 s flight is rejected in one line, and the existing split is kept."""
    before = (area / SPLIT / "split.json").read_text()
    result = run("split", "--area", area, "--validation", policy, "--gap", 30, "--overwrite")
    assert result.exit_code == 1
    assert "leaves no frame for" in result.stderr
    assert result.stderr.splitlines()[-1].startswith("Error: ")
    assert not (area / f".{SPLIT}.partial").exists()
    assert (area / SPLIT / "split.json").read_text() == before


def test_an_interrupted_split_goes_on_and_comes_out_the_same(
    finished_area: Path, split_area: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C between two images leaves no stage and no partial file; a rerun gives the same split."""
    from spn_data.pipeline import split_stage as stage

    area = Path(shutil.copytree(finished_area, tmp_path / "area"))
    whole = stage.frame_images

    def interrupted(*arguments: object, **options: object) -> object:
        for k, item in enumerate(whole(*arguments, **options)):  # type: ignore[arg-type]
            if k == 4:
                raise KeyboardInterrupt
            yield item

    monkeypatch.setattr(stage, "frame_images", interrupted)
    stopped = run("split", "--area", area)
    assert stopped.exit_code == 130
    assert not (area / SPLIT).exists()
    partial = area / f".{SPLIT}.partial"
    written = sorted(partial.rglob("*.png"))
    assert len(written) == 4
    assert not list(partial.rglob("*.part"))
    monkeypatch.undo()
    first = written[0].stat().st_mtime_ns
    time.sleep(0.01)
    finished = run("split", "--area", area)
    assert finished.exit_code == 0, finished.output
    again = area / SPLIT / written[0].relative_to(partial)
    assert again.stat().st_mtime_ns == first
    for name in ("split.json", "audit.json", "cambridge/dataset_train.txt"):
        assert (area / SPLIT / name).read_bytes() == (split_area / SPLIT / name).read_bytes()


def test_the_audit_passes_again_and_changes_nothing(split_area: Path) -> None:
    """A second audit passes and modifies no file but the lock."""
    before = {p: p.stat().st_mtime_ns for p in split_area.rglob("*") if p.is_file()}
    result = run("audit", "--area", split_area)
    assert result.exit_code == 0, result.output
    assert "Audit passed: 14 of 15 checks passed" in result.stdout
    assert "notice" in result.output
    after = {p: p.stat().st_mtime_ns for p in split_area.rglob("*") if p.is_file()}
    assert {p for p in after if p.name != ".lock"} == {p for p in before if p.name != ".lock"}
    assert all(after[p] == before[p] for p in after if p.name != ".lock")


def test_an_audit_without_a_split_says_what_to_run(finished_area: Path) -> None:
    """An audit without a split is rejected; the message names the command to run."""
    result = run("audit", "--area", finished_area)
    assert result.exit_code == 1
    assert "spn-data split" in result.stderr


def guard_frame(folder: Path) -> str:
    split = read_split(folder / "split.json")
    return str(split.names[(split.group == LEFT_OUT) & (split.reason == "guard gap")][0])


def leak_guard_frame(area: Path) -> None:
    """Move a frame of the guard gap to the training group."""
    name = guard_frame(area / SPLIT)

    def move(value: dict[str, dict[str, list[str]]]) -> None:
        del value["left_out"][name]
        value["groups"]["train"].append(name)

    rewrite(area / SPLIT / "split.json", move)


def mark_test_points(area: Path) -> None:
    """Mark the points of the test group as usable for training."""
    with h5py.File(area / SPLIT / "dataset.h5", "r+") as file:
        file["test/points"].attrs["for_training"] = 1


def move_a_pose(area: Path) -> None:
    """Change a pose in dataset.h5, so that it differs from its label."""
    with h5py.File(area / SPLIT / "dataset.h5", "r+") as file:
        file["train/centers"][0] += 0.01


def swap_a_point(area: Path) -> None:
    """Give a training frame a point that only held-out frames observe."""
    labelled = read_labelled_area(Area(area))
    split = read_split(area / SPLIT / "split.json")
    trained = split.groups_of(labelled.mapping.names) == TRAIN
    seen = labelled.mapping_seen
    by_training = np.unique(seen.point_ids[trained[seen.frame_idx]])
    (never, *_) = np.setdiff1d(seen.point_ids, by_training)
    with h5py.File(area / SPLIT / "dataset.h5", "r+") as file:
        file["train/points/ids"][0] = never


def edit_a_list(area: Path) -> None:
    """Change the last printed digit of a position in a Cambridge list."""
    path = area / SPLIT / "cambridge" / "dataset_train.txt"
    lines = path.read_text().splitlines()
    cells = lines[3].split()
    cells[1] = f"{float(cells[1]) + 2e-6:.6f}"
    lines[3] = " ".join(cells)
    path.write_text("\n".join(lines) + "\n")


def cut_the_data_set(area: Path) -> None:
    """Truncate dataset.h5."""
    path = area / SPLIT / "dataset.h5"
    path.write_bytes(path.read_bytes()[:5000])


def remake_the_model(area: Path) -> None:
    """Make the split stale, as if the model had been redone since."""
    rewrite(area / FRAMES / "stage.json", lambda value: value["counts"].update(candidates=99))
    for stage in (MODEL, "3-geo"):
        now = {
            name: Area(area).record(name).fingerprint()
            for name in Area(area).record(stage).upstream
        }
        rewrite(area / stage / "stage.json", lambda value, now=now: value.update(upstream=now))


@pytest.mark.parametrize(
    ("plant", "check"),
    [
        (leak_guard_frame, "guard gap"),
        (mark_test_points, "files readable"),
        (move_a_pose, "dataset.h5 holds the split"),
        (swap_a_point, "points for training"),
        (edit_a_list, "Cambridge lists agree with dataset.h5"),
        (cut_the_data_set, "files readable"),
        (remake_the_model, "up to date"),
    ],
)
def test_what_was_planted_fails_the_audit(area: Path, plant: object, check: str) -> None:
    """Each planted fault fails the audit with exit code 1, and the error names the check."""
    plant(area)  # type: ignore[operator]
    result = run("audit", "--area", area, "--all")
    assert result.exit_code == 1, result.output
    assert result.stderr.splitlines()[-1].startswith("Error: the audit failed: ")
    assert check in result.stderr


def test_a_split_whose_audit_failed_is_told_again(area: Path) -> None:
    """A rerun of `split` shows the stored findings of a failed audit and exits with code 1."""
    rewrite(
        area / SPLIT / "audit.json",
        lambda value: value["findings"][0].update(verdict="fail", evidence=["one/two.jpg"]),
    )
    result = run("split", "--area", area)
    assert result.exit_code == 1
    assert "one/two.jpg" in result.output


def test_an_area_without_metres_is_split_in_time(finished_area: Path, tmp_path: Path) -> None:
    """Without 3-geo, units are those of the model, strata are empty, and a split by space is rejected."""
    area = Path(shutil.copytree(finished_area, tmp_path / "area"))
    shutil.rmtree(area / "3-geo")
    refused = run("split", "--area", area, "--validation", "space")
    assert refused.exit_code == 1
    assert "spn-data georegister" in refused.stderr
    result = run("split", "--area", area, "--cambridge", "none")
    assert result.exit_code == 0, result.output
    with Dataset(area / SPLIT / "dataset.h5") as dataset:
        assert dataset.info.units == "model"
        assert not dataset.info.up_is_known
        assert set(dataset.groups["test"].strata.tolist()) == {""}


def test_masked_pixels_are_not_valid(finished_area: Path, tmp_path: Path) -> None:
    """A mask that is black in its left half makes the left half of the images invalid."""
    area = Path(shutil.copytree(finished_area, tmp_path / "area"))
    mask = np.full((180, 320), 255, np.uint8)
    mask[:, :160] = 0
    (area / FRAMES / "masks").mkdir(exist_ok=True)
    cv2.imwrite(str(area / FRAMES / "masks" / "flight1.png"), mask)
    result = run("split", "--area", area, "--cambridge", "none")
    assert result.exit_code == 0, result.output
    with Dataset(area / SPLIT / "dataset.h5") as dataset:
        valid = dataset.groups["train"].valid(0)
        assert valid is not None
        assert not valid[:, :235].any()
        assert valid[:, 245:].all()


def test_every_option_is_documented_with_its_default() -> None:
    """docs/split.md lists every option of `split` with its default, and names those of `audit`."""
    text = DOC.read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(--[a-z-]+)` \|([^|]*)\|", text, re.MULTILINE))
    given = [p for p in main.commands["split"].params if isinstance(p, click.Option)]
    options = [p for p in given if p.expose_value]
    assert set(rows) == {option.opts[0] for option in options}
    for option in options:
        if option.show_default is True:
            shown = rows[option.opts[0]].strip("` ")
            is_number = isinstance(option.default, int | float)
            assert (float(shown) if is_number else shown) == option.default, option.opts
    for option in main.commands["audit"].params:
        assert not option.expose_value or f"`{option.opts[-1]}`" in text


def test_defaults_of_the_command_are_those_of_the_option_classes() -> None:
    """The defaults of the command equal those of the option classes of the library."""
    given = {p.name: p.default for p in main.commands["split"].params}
    for field in fields(SplitOptions):
        if field.name != "tracked":
            assert given[field.name] == field.default, field.name
    assert given["cambridge"] == SplitStageOptions().cambridge
    assert given["no_tracked"] is not SplitOptions().tracked


def test_checks_and_fields_are_documented(split_area: Path) -> None:
    """docs/split.md names every check of the audit and every field of split.json."""
    text = DOC.read_text(encoding="utf-8")
    findings = read_json(split_area / SPLIT / "audit.json")["findings"]
    listed = re.findall(r"^\| `([^`]+)` \|", text.split("## The audit")[1], re.MULTILINE)
    assert {finding["check"] for finding in findings} <= set(listed)
    assert set(read_json(split_area / SPLIT / "split.json")) <= set(listed)


def test_where_nothing_is_mapped_nothing_is_left_behind(tmp_path: Path) -> None:
    """A split of a missing area is rejected and creates nothing."""
    result = run("split", "--area", tmp_path / "new")
    assert result.exit_code == 1
    assert "1-frames is missing; run spn-data reconstruct first" in result.stderr
    assert not (tmp_path / "new").exists()
