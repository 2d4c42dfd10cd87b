"""`spn-data split` and `audit` on an area with an evaluation sequence and tracked frames."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from spn_cli.data import main

from spn_data.area.area import Area
from spn_data.area.names import EVALUATION, FRAMES, MODEL, SPLIT
from spn_data.dataset.cambridge import read_cambridge
from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import Role
from spn_data.dataset.nvm import read_nvm
from spn_data.inputs.area_labels import read_labelled_area
from spn_data.labels.labels import LabelStatus, read_labels, write_labels
from spn_data.split.split_file import read_split
from spn_data.storage.json_files import read_json, write_json

pytestmark = pytest.mark.slow


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments], terminal_width=200)


@pytest.fixture(scope="module")
def registered_area(
    finished_area: Path, flight2: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The area with the second flight registered at 1 fps and its other frames tracked."""
    area = tmp_path_factory.mktemp("evaluated") / "area"
    shutil.copytree(finished_area, area)
    options = ("--name", "medium", "--rate", 1, "--all-frames", "--any-telemetry", "--threads", 1)
    result = run("register", flight2 / "flight2.mp4", "--area", area, *options)
    assert result.exit_code == 0, result.output
    return area


@pytest.fixture(scope="module")
def split_area(registered_area: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same area, split with the default options; no test may change it."""
    area = Path(shutil.copytree(registered_area, tmp_path_factory.mktemp("split") / "area"))
    result = run("split", "--area", area)
    assert result.exit_code == 0, result.output
    assert "Audit passed: " in result.output
    return area


@pytest.fixture
def area(split_area: Path, tmp_path: Path) -> Path:
    """A copy of the split area that a test may change."""
    return Path(shutil.copytree(split_area, tmp_path / "area"))


def rewrite(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Modify a JSON file of the area with a function of its value."""
    value = read_json(path)
    change(value)
    write_json(path, value)


def test_the_evaluation_sequence_is_a_test_set_of_its_own_name(split_area: Path) -> None:
    """The evaluation sequence, with its tracked frames, is the only test group, and it is not optimistic."""
    split = read_split(split_area / SPLIT / "split.json")
    assert split.groups() == ("train", "validation", "medium")
    assert not split.optimistic
    labelled = read_labelled_area(Area(split_area))
    with Dataset(split_area / SPLIT / "dataset.h5") as dataset:
        assert not dataset.info.optimistic
        (medium,) = (g for g in dataset.groups.values() if g.role is Role.TEST)
        assert medium.name == "medium"
        assert not medium.points_for_training
        assert 0 < medium.tracked.sum() < len(medium)
        assert len(medium) == labelled.evaluation["medium"].registered.sum()
        assert set(medium.strata.tolist()) <= {"high", "medium", "low"}
        assert len(medium.points(0).ids) > 50
        camera = dataset.info.camera
        for group in dataset.groups.values():
            assert camera is not None
            assert np.allclose(group.intrinsics, camera.matrix)


def test_dense_images_are_those_of_the_video(split_area: Path, flight2: Path) -> None:
    """The stored image of a tracked frame resembles its neighbour in time more than a distant one."""
    with Dataset(split_area / SPLIT / "dataset.h5") as dataset:
        medium = dataset.groups["medium"]
        order = np.argsort(medium.time_s)
        rows = [k for k in range(1, len(order) - 1) if medium.tracked[order[k]]]
        for k in rows:
            image, near, far = (
                medium.image(int(row)).astype(float)[::4, ::4].ravel()
                for row in (order[k], order[k - 1], order[(k + len(order) // 2) % len(order)])
            )
            assert np.corrcoef(image, near)[0, 1] > np.corrcoef(image, far)[0, 1]


def test_the_test_list_holds_the_sequence_and_the_model_no_measurement_of_it(
    split_area: Path,
) -> None:
    """dataset_test.txt lists the chosen frames; the NVM model has their poses but no measurements."""
    folder = split_area / SPLIT / "cambridge"
    listed = read_cambridge(folder / "dataset_test.txt")
    labels = read_labels(split_area / EVALUATION / "medium" / "poses.csv")
    wanted = [name.replace(".jpg", ".png") for name in labels.names[labels.registered].tolist()]
    assert list(listed.names) == wanted
    model = read_nvm(folder / "reconstruction.nvm")
    assert set(wanted) <= set(model.names)
    assert not {model.names[k] for k in model.image_idx} & set(wanted)


def test_dense_frames_may_stand_in_all_lists_or_nowhere(area: Path) -> None:
    """Tracked frames are in the test list with --cambridge all, and in no group with --no-tracked."""
    every = run("split", "--area", area, "--cambridge", "all", "--overwrite")
    assert every.exit_code == 0, every.output
    listed = read_cambridge(area / SPLIT / "cambridge" / "dataset_test.txt")
    assert len(listed) == read_split(area / SPLIT / "split.json").counts()["medium"]
    none = run("split", "--area", area, "--no-tracked", "--overwrite")
    assert none.exit_code == 0, none.output
    with Dataset(area / SPLIT / "dataset.h5") as dataset:
        assert not any(group.tracked.any() for group in dataset.groups.values())


def test_a_copy_of_the_mapping_flight_is_noticed(split_area: Path) -> None:
    """A flight with the poses of the mapping flight is noticed, although no image fingerprint matches."""
    result = run("audit", "--area", split_area, "--all")
    assert result.exit_code == 0
    assert "cut or re-encoded" in " ".join(result.output.split())


def map_the_evaluation_video(area: Path) -> None:
    """Make the evaluation video look like a source of the map."""
    mapped = next(iter(Area(area).record(FRAMES).inputs.values()))
    rewrite(
        area / EVALUATION / "medium" / "stage.json",
        lambda value: value["inputs"].update({"medium/flight2.mp4": mapped}),
    )


def change_the_map(area: Path) -> None:
    """Flip a bit in the colour of a point of the map."""
    path = area / MODEL / "points3D.bin"
    data = bytearray(path.read_bytes())
    data[8 + 8 + 24] ^= 1
    path.write_bytes(bytes(data))


def forge_a_hash(area: Path) -> None:
    """Record a different map after the registration."""
    rewrite(
        area / EVALUATION / "medium" / "registration.json",
        lambda value: value.update(map_after="0" * 64),
    )


def lose_a_label(area: Path) -> None:
    """Remove the pose of a frame of the test set."""
    path = area / EVALUATION / "medium" / "poses.csv"
    labels = read_labels(path)
    labels.status[0], labels.reason[0] = LabelStatus.FAILED, "lost"
    labels.poses.centers[0], labels.poses.quats_wxyz[0] = np.nan, np.nan
    write_labels(path, labels)


@pytest.mark.parametrize(
    ("plant", "check"),
    [
        (map_the_evaluation_video, "no evaluation frame in the map"),
        (change_the_map, "map unchanged"),
        (forge_a_hash, "map unchanged"),
        (lose_a_label, "every frame once"),
    ],
)
def test_what_was_planted_fails_the_audit(
    area: Path, plant: Callable[[Path], None], check: str
) -> None:
    """Each planted fault fails exactly the expected check of the audit."""
    plant(area)
    for stage in ("4-tracked/medium", SPLIT):  # a forger would also update these records
        now = {s: Area(area).record(s).fingerprint() for s in Area(area).record(stage).upstream}
        rewrite(area / stage / "stage.json", lambda value, now=now: value.update(upstream=now))
    result = run("audit", "--area", area)
    assert result.exit_code == 1, result.output
    assert result.stderr == f"Error: the audit failed: {check}\n"


def as_version_0_1_left_it(area: Path) -> None:
    """Convert an area to the names and files of version 0.1."""
    (area / "4-tracked").rename(area / "4-dense")
    for name in ("poses.csv", "observations.npz"):
        (area / MODEL / name).unlink()

    def old_names(value: dict[str, Any]) -> None:
        for record in (value, value.get("made_of", {})):
            if "upstream" in record:
                found = {
                    k.replace("4-tracked", "4-dense"): v for k, v in record["upstream"].items()
                }
                record["upstream"] = found
        if "stage" in value:
            value["stage"] = value["stage"].replace("4-tracked", "4-dense")
        options = value.get("options", {})
        options = options.get("split", options)
        if "tracked" in options:
            options["dense"] = options.pop("tracked")

    for path in (*area.glob("*/stage.json"), *area.glob("*/*/stage.json")):
        rewrite(path, old_names)
    rewrite(area / SPLIT / "split.json", old_names)


def test_an_area_of_version_0_1_is_read_and_left_as_it_is(area: Path) -> None:
    """An area of version 0.1 (4-dense, no stored mapping labels) gives the same frames and is not redone."""
    before = read_labelled_area(Area(area))
    as_version_0_1_left_it(area)
    assert read_json(area / SPLIT / "stage.json")["upstream"].keys() >= {"4-dense/medium"}
    after = read_labelled_area(Area(area))
    assert after.mapping.names.tolist() == before.mapping.names.tolist()
    posed = after.mapping.registered
    np.testing.assert_allclose(
        after.mapping.poses.centers[posed], before.mapping.poses.centers[posed], atol=1e-9
    )
    np.testing.assert_allclose(
        after.mapping.covariance[posed], before.mapping.covariance[posed], rtol=1e-5, atol=1e-12
    )
    assert after.evaluation["medium"].tracked.sum() == before.evaluation["medium"].tracked.sum()
    status = run("status", "--area", area)
    assert status.exit_code == 0, status.output
    assert "4-tracked/medium" in status.output
    assert "stale" not in status.output
    again = run("split", "--area", area)
    assert again.exit_code == 0, again.output
    assert "unchanged" in again.output
    for command in ("coverage", "report"):
        result = run(command, "--area", area)
        assert result.exit_code == 0, result.output
    assert not (area / "4-tracked").exists()
