"""End-to-end tests of `spn-data register`: evaluation sequences and tracked frames in a frozen map."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import av
import click
import cv2
import numpy as np
import pytest
from click.testing import CliRunner, Result
from spn_cli.data import main

from spn_data.area.area import Area
from spn_data.area.names import EVALUATION, GEO, MODEL, TRACKED
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_from_json, camera_to_json
from spn_data.geometry.pose import Poses, Similarity, pose_errors
from spn_data.inputs.area_labels import (
    LabelledArea,
    read_labelled_area,
    read_world_from_model,
)
from spn_data.labels.labels import _COLUMNS, Labels, read_label_observations, read_labels
from spn_data.labels.map_hash import map_hash
from spn_data.pipeline.frames_stage import FramesOptions, plan
from spn_data.registration.register_options import CheckOptions
from spn_data.simulate.truth import read_truth
from spn_data.storage.json_files import read_json

DOC = Path(__file__).resolve().parents[3] / "docs" / "registration.md"
FAST = ("--rate", "1", "--threads", "1")


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments])


def register(area: Path, *arguments: object) -> Result:
    result = run("register", *arguments, "--area", area)
    assert result.exit_code == 0, result.output
    return result


@pytest.fixture(scope="module")
def registered(
    finished_area: Path, flight2: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Area with a registered evaluation sequence, at one frame per second and in between; read-only."""
    area = tmp_path_factory.mktemp("registered") / "area"
    shutil.copytree(finished_area, area)
    register(area, flight2 / "flight2.mp4", "--name", "medium", *FAST, "--all-frames")
    return area


@pytest.fixture
def area(registered: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(registered, tmp_path / "area"))


@pytest.fixture
def bare(finished_area: Path, tmp_path: Path) -> Path:
    """Area without evaluation sequences."""
    return Path(shutil.copytree(finished_area, tmp_path / "area"))


@pytest.fixture(scope="module")
def other_place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Video of a place that is not in the map: a camera gliding over blobs."""
    file = tmp_path_factory.mktemp("other") / "elsewhere.mp4"
    rng = np.random.default_rng(3)
    ground = np.zeros((400, 700, 3), np.float32)
    for size in (20, 60, 200):
        noise = rng.random((size * 4 // 7, size, 3), np.float32)
        ground += cv2.resize(noise, (700, 400), interpolation=cv2.INTER_CUBIC)
    ground = cv2.normalize(ground, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    with av.open(str(file), "w") as container:
        stream = container.add_stream("libx264", rate=2)
        stream.width, stream.height, stream.pix_fmt = 320, 180, "yuv420p"
        for k in range(8):
            image = np.ascontiguousarray(ground[5 * k :][:180, 30 * k :][:, :320])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode())
    return file


def poses_file(area: Path, name: str = "medium", group: str = EVALUATION) -> Path:
    return area / group / name / "poses.csv"


def true_poses(labels: Labels, flight1: Path) -> Poses:
    """Return the exact poses; flight2 is flight1 played backwards, starting at its last frame."""
    true = read_truth(flight1.parent / "truth", "flight1").poses
    last = len(true) - 1
    backwards = labels.sequences != "flight1"
    return true[np.where(backwards, last - labels.video_frame, labels.video_frame)]


def errors(labelled: LabelledArea, labels: Labels, flight1: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return position errors (m) and rotation errors (degrees) after the map's similarity to the truth."""
    mapping = labelled.mapping.select(labelled.mapping.registered)
    world_from_map = Similarity.fit(mapping.poses.centers, true_poses(mapping, flight1).centers)
    found = labels.select(labels.registered)
    return pose_errors(world_from_map.apply_to_poses(found.poses), true_poses(found, flight1))


def test_an_evaluation_flight_gets_true_poses_with_covariances(
    registered: Path, flight1: Path
) -> None:
    """All frames of an evaluation flight, tracked ones too, get correct labels with an unknown lens."""
    labelled = read_labelled_area(Area(registered))
    labels = labelled.evaluation["medium"]
    chosen = labels.select(~labels.tracked)
    assert len(chosen) == 7
    assert chosen.registered.all()
    error_m, error_deg = errors(labelled, labels, flight1)
    assert np.median(error_m) < 0.1
    assert error_m.max() < 0.5
    assert error_deg.max() < 2.0
    true = read_truth(flight1.parent / "truth", "flight1").camera
    assert labelled.cameras["medium"].focal_px[0] == pytest.approx(true.focal_px[0], rel=0.03)
    good = labels.select(labels.registered)
    assert np.linalg.eigvalsh(good.covariance).min() > 0
    assert np.sqrt(np.trace(good.covariance[:, :3, :3], axis1=1, axis2=2)).max() < 0.5
    assert good.inliers.min() >= 30
    assert good.coverage.min() > 0.05
    assert np.nanmax(good.error_px) < 4


def test_the_map_is_not_touched(registered: Path, finished_area: Path) -> None:
    """Registration leaves every map file unchanged, and stages record its hash before and after."""
    for stage in (MODEL, GEO):
        for path in (finished_area / stage).rglob("*"):
            same = registered / path.relative_to(finished_area)
            assert path.is_dir() or path.read_bytes() == same.read_bytes(), path
        names = {p.name for p in (registered / stage).iterdir()}
        assert names == {p.name for p in (finished_area / stage).iterdir()}
    for group in (EVALUATION, TRACKED):
        told = read_json(registered / group / "medium" / "registration.json")
        assert told["map_before"] == told["map_after"] == map_hash(finished_area / MODEL)
    told = read_json(registered / EVALUATION / "medium" / "registration.json")
    assert told["geo_before"] == told["geo_after"] == map_hash(finished_area / GEO)


def test_the_points_that_frames_see_are_where_their_poses_put_them(registered: Path) -> None:
    """observations.npz, poses.csv and camera.json agree with each other and with the map."""
    labelled = read_labelled_area(Area(registered))
    labels, seen = labelled.evaluation["medium"], labelled.evaluation_seen["medium"]
    for row in np.flatnonzero(labels.registered):
        point_ids, pixels = seen.of_frame(row)
        xyz = labelled.points.xyz[labelled.points.rows_of(point_ids)]
        in_camera = (xyz - labels.poses.centers[row]) @ labels.poses.rotations[row].T
        error = labelled.cameras["medium"].project(in_camera) - pixels
        rms_px = np.sqrt((error**2).sum(axis=1).mean())
        assert rms_px == pytest.approx(labels.error_px[row], rel=0.05)
    nothing = np.flatnonzero(~labels.registered)
    assert not any(len(seen.of_frame(row)[0]) for row in nothing)


def test_the_same_again_is_left_alone(area: Path, flight2: Path) -> None:
    """Registering the same sequence again changes no file."""
    before = {p: p.stat().st_mtime_ns for p in (area / EVALUATION).rglob("*")}
    again = register(area, flight2 / "flight2.mp4", "--name", "medium", *FAST, "--all-frames")
    assert f"{EVALUATION}/medium: unchanged since" in again.stdout
    assert f"{TRACKED}/medium: unchanged since" in again.stdout
    assert {p: p.stat().st_mtime_ns for p in (area / EVALUATION).rglob("*")} == before


def test_another_place_fails_entirely_and_says_so(bare: Path, other_place: Path) -> None:
    """No frame of another place gets a pose, each has a reason, and the command still succeeds."""
    result = register(bare, other_place, *FAST, "--all-frames")
    assert "0 of 4 (0.0%) frames" in " ".join(result.stdout.split())
    labels = read_labels(poses_file(bare, "elsewhere"))
    assert not labels.registered.any()
    assert all(labels.reason.tolist())
    assert np.isnan(labels.poses.centers).all()
    between = read_labels(poses_file(bare, "elsewhere", TRACKED))
    assert len(between) == 4
    assert not between.registered.any()
    labelled = read_labelled_area(Area(bare), mapping_covariance=False)
    assert len(labelled.evaluation_seen["elsewhere"].point_ids) == 0


@pytest.mark.slow
def test_real_photos_of_another_place_fail_entirely(
    bare: Path, shared_data: Path, tmp_path: Path
) -> None:
    """Real photos of another place all fail, each with a reason."""
    photos = tmp_path / "beach"
    photos.mkdir()
    for file in sorted((shared_data / "photos-dji-xmp").glob("*.JPG"))[:5]:
        shutil.copy(file, photos)
    result = register(bare, photos, *FAST)
    assert "0 of 5 (0.0%) frames" in " ".join(result.stdout.split())
    labels = read_labels(poses_file(bare, "beach"))
    assert all(labels.reason.tolist())
    assert np.isnan(labels.poses.centers).all()


@pytest.mark.slow
def test_other_options_need_overwrite_and_the_first_ones_give_the_first_result(
    area: Path, flight2: Path
) -> None:
    """Other options need --overwrite, and the original options reproduce the original poses."""
    first = poses_file(area).read_bytes()
    options = (flight2 / "flight2.mp4", "--name", "medium", "--threads", "1")
    refused = run("register", *options, "--rate", "2", "--area", area)
    assert refused.exit_code == 1
    assert "4-eval/medium already exists but" in refused.stderr
    assert "--overwrite" in refused.stderr
    assert poses_file(area).read_bytes() == first
    register(area, *options, "--rate", "2", "--overwrite")
    assert len(read_labels(poses_file(area))) == 14
    register(area, *options, "--rate", "1", "--overwrite")
    assert poses_file(area).read_bytes() == first


@pytest.mark.slow
def test_the_order_of_sequences_and_the_number_of_workers_change_nothing(
    area: Path, finished_area: Path, flight2: Path, tmp_path: Path
) -> None:
    """Registering `medium` before or after `fast`, with any number of workers, gives the same bytes."""
    bare = Path(shutil.copytree(finished_area, tmp_path / "turned"))
    fast = (flight2 / "flight2.mp4", "--name", "fast", "--rate", "0.5")
    register(bare, *fast, "--threads", "2")
    register(bare, flight2 / "flight2.mp4", "--name", "medium", "--rate", "1", "--threads", "2")
    register(area, *fast, "--threads", "1")
    for name in ("fast", "medium"):
        for file in ("poses.csv", "camera.json"):
            one, other = (a / EVALUATION / name / file for a in (area, bare))
            assert one.read_bytes() == other.read_bytes()
        seen = [
            read_label_observations(a / EVALUATION / name / "observations.npz")
            for a in (area, bare)
        ]
        assert np.array_equal(seen[0].pixels, seen[1].pixels)
        assert np.array_equal(seen[0].point_ids, seen[1].point_ids)


def test_what_is_part_of_the_map_is_refused(bare: Path, flight1: Path, flight2: Path) -> None:
    """A mapping video is refused under any name, and so is a sequence that takes a mapping flight's name."""
    result = run("register", flight1, "--name", "fresh", "--area", bare)
    assert result.exit_code == 1
    assert "is part of the map, so its labels would not be an independent test" in result.stderr
    for name in ("flight1", "FLIGHT1"):
        result = run("register", flight2, "--name", name, "--area", bare)
        assert result.exit_code == 1
        assert f"{name} is the name of a mapping sequence" in result.stderr
    assert not (bare / EVALUATION).exists()


@pytest.mark.parametrize("name", ["../medium", "two words", ".hidden", "", "a/b", "x" * 81])
def test_a_name_that_cannot_be_a_folder_is_refused(bare: Path, flight2: Path, name: str) -> None:
    """A sequence name that is not a valid folder name is refused before anything is written."""
    result = run("register", flight2, "--name", name, "--area", bare)
    assert result.exit_code == 1
    assert "is not a valid sequence name" in result.stderr
    assert not (bare / EVALUATION).exists()


def test_several_sequences_are_registered_one_at_a_time(
    bare: Path, flight2: Path, other_place: Path, tmp_path: Path
) -> None:
    """A folder with two sequences is refused, and the error names both."""
    folder = tmp_path / "day"
    folder.mkdir()
    shutil.copy(flight2 / "flight2.mp4", folder)
    shutil.copy(other_place, folder)
    result = run("register", folder, "--area", bare)
    assert result.exit_code == 1
    assert "contains 2 sequences (elsewhere, flight2); register them one at a time" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give a VIDEO to register, or --all-frames"),
        (["--fixed-lens", "--all-frames"], "--fixed-lens needs --camera"),
    ],
)
def test_half_a_command_is_a_usage_error(bare: Path, arguments: list[str], message: str) -> None:
    """Incomplete option combinations are usage errors with exit code 2."""
    result = run("register", *arguments, "--area", bare)
    assert result.exit_code == 2
    assert message in result.stderr


def test_an_area_without_a_map_is_told_what_comes_first(flight2: Path, tmp_path: Path) -> None:
    """Without a map, the error says to run `spn-data reconstruct` first."""
    result = run("register", flight2, "--area", tmp_path)
    assert result.exit_code == 1
    assert "is missing; run spn-data reconstruct first" in result.stderr


@pytest.mark.slow
def test_frames_between_those_of_the_map_get_labels(flight1: Path, tmp_path: Path) -> None:
    """--all-frames alone labels the frames of every registered sequence, including mapping flights."""
    area = tmp_path / "area"
    options = ("--frames", "11", "--max-features", "1500", "--threads", "1", "--fov", "72")
    made = run("reconstruct", flight1, "--area", area, *options)
    assert made.exit_code == 0, made.output
    register(area, "--all-frames", "--threads", "1")
    labelled = read_labelled_area(Area(area))
    between = labelled.tracked
    total = len(read_truth(flight1.parent / "truth", "flight1").poses)
    assert len(between) == total - len(labelled.mapping) > 4
    assert between.registered.sum() > 2
    error_m, error_deg = errors(labelled, between, flight1)
    assert error_m.max() < 0.5
    assert error_deg.max() < 2
    good = between.select(between.registered)
    assert np.linalg.eigvalsh(good.covariance).min() > 0
    assert not np.isin(between.names, labelled.mapping.names).any()


def test_a_video_that_has_moved_is_found_where_it_is_said_to_be(
    area: Path, flight2: Path, tmp_path: Path
) -> None:
    """If the recorded video is no longer where it was, --video gives its new location."""
    shutil.rmtree(area / TRACKED)
    facts = area / "area.toml"
    facts.write_text(facts.read_text().replace(str(flight2), str(tmp_path / "gone")))
    lost = run("register", "--all-frames", "--name", "medium", "--threads", "1", "--area", area)
    assert lost.exit_code == 1
    assert "flight2.mp4 of medium was not found with its former content" in lost.stderr
    assert "--video" in lost.stderr
    options = ("--all-frames", "--name", "medium", "--threads", "1", "--video", flight2)
    register(area, *options)
    assert read_labels(poses_file(area, group=TRACKED)).registered.sum() > 3


def test_a_relative_video_is_found_from_any_folder_and_with_the_area_moved_along(
    bare: Path, flight2: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """area.toml stores the video's path relative to the area, so any working directory works.

    It still resolves after the area and the video have been moved together.
    """
    both = tmp_path / "together"
    shutil.copytree(bare, both / "area")
    shutil.copytree(flight2, both / "second day")
    monkeypatch.chdir(both)
    register(Path("area"), Path("second day") / "flight2.mp4", "--name", "medium", *FAST)
    monkeypatch.chdir(tmp_path)
    both.rename(tmp_path / "moved")
    register(tmp_path / "moved" / "area", "--name", "medium", "--all-frames", "--threads", "1")


def test_a_remembered_folder_without_videos_does_not_hide_the_one_named(
    bare: Path, flight1: Path, tmp_path: Path
) -> None:
    """A recorded folder that is now empty does not take precedence over --video."""
    emptied = tmp_path / "emptied"
    emptied.mkdir()
    facts = bare / "area.toml"
    facts.write_text(facts.read_text().replace(str(flight1), str(emptied)))
    register(bare, "--name", "flight1", "--all-frames", "--threads", "1", "--video", flight1)


def test_frames_between_follow_a_lens_that_was_kept(
    bare: Path, flight2: Path, tmp_path: Path
) -> None:
    """With --fixed-lens the lens is not estimated and has no covariance, but the frames do."""
    lens = tmp_path / "lens.json"
    lens.write_text(
        json.dumps(
            {"model": "PINHOLE", "width": 320, "height": 180, "params": [220.2, 220.2, 160, 90]}
        )
    )
    options = ("--name", "medium", *FAST, "--all-frames", "--camera", lens, "--fixed-lens")
    register(bare, flight2 / "flight2.mp4", *options)
    assert read_json(bare / EVALUATION / "medium" / "camera.json")["estimated"] == []
    between = read_labels(poses_file(bare, group=TRACKED))
    assert between.registered.sum() > 2
    assert np.isfinite(between.covariance[between.registered]).all()


def test_groups_of_the_split_are_no_names_of_sequences(bare: Path, flight2: Path) -> None:
    """The names of split groups are refused as sequence names."""
    for name in ("train", "validation", "test"):
        result = run("register", flight2, "--name", name, "--area", bare)
        assert result.exit_code == 1
        assert f"may not be called '{name}'" in result.stderr


def test_an_evaluation_flight_stays_out_of_the_map(registered: Path, flight2: Path) -> None:
    """An evaluation flight stays out of the map, whether the map is extended or rebuilt."""
    for how in ("--add", "--overwrite"):
        result = run("reconstruct", flight2, how, "--area", registered)
        assert result.exit_code == 1
        assert "flight2.mp4: belongs to the evaluation sequence medium" in result.stderr
        assert "remove its folders" in result.stderr


def test_a_mapping_flight_does_not_take_an_evaluation_sequence_s_name(
    registered: Path, other_place: Path, tmp_path: Path
) -> None:
    """A new mapping flight named like an evaluation sequence gets a numbered name."""
    video = tmp_path / "Medium.mp4"
    shutil.copy(other_place, video)
    found = plan([video], FramesOptions(), extended=Area(registered), tested=Area(registered))
    assert [source.sequence for source in found.sources] == ["Medium-2"]


def test_what_is_left_of_a_removed_sequence_is_named(area: Path) -> None:
    """`split` reports the leftover of a removed sequence, and `register --all-frames` says what to remove."""
    shutil.rmtree(area / EVALUATION / "medium")
    refused = run("split", "--area", area)
    assert "4-tracked/medium is stale" in refused.stderr
    told = run("register", "--all-frames", "--name", "medium", "--area", area)
    assert told.exit_code == 1
    assert "4-tracked/medium is a leftover of it: remove that folder" in told.stderr


def test_frames_between_need_a_map(tmp_path: Path) -> None:
    """--all-frames without a map gives an error that names the missing stage."""
    result = run("register", "--all-frames", "--area", tmp_path)
    assert result.exit_code == 1
    assert "2-model is missing; run spn-data reconstruct first" in result.stderr


def test_an_unknown_sequence_is_named(bare: Path) -> None:
    """An unknown sequence name is repeated in the error."""
    result = run("register", "--all-frames", "--name", "nothing", "--area", bare)
    assert result.exit_code == 1
    assert "there is no sequence 'nothing'" in result.stderr


def test_labels_move_with_their_map(area: Path) -> None:
    """Georegistering with other heights and weights moves the labels, also on disk; nothing is stale."""
    before = read_labelled_area(Area(area))
    old = read_world_from_model(Area(area))
    made = run("georegister", "--area", area, "--gnss-sigma", "0.5", "3", "--overwrite")
    assert made.exit_code == 0, made.output
    new = read_world_from_model(Area(area))
    assert not np.allclose(new.translation, old.translation, atol=1e-6)
    after = read_labelled_area(Area(area))
    expected = before.evaluation["medium"].transformed(new @ old.inverse())
    found = after.evaluation["medium"]
    has = found.registered
    assert np.allclose(found.poses.centers[has], expected.poses.centers[has], atol=1e-9)
    error_deg = pose_errors(found.poses[has], expected.poses[has])[1]
    assert error_deg.max() < 1e-6
    assert np.allclose(found.covariance[has], expected.covariance[has], rtol=1e-6)
    for group in (EVALUATION, TRACKED):
        folder = area / group / "medium"
        stored = Similarity.from_json(read_json(folder / "registration.json")["world_from_model"])
        assert np.array_equal(stored.translation, new.translation)
        on_disk = read_labels(folder / "poses.csv")
        rows = np.flatnonzero(np.isin(found.names, on_disk.names))
        assert np.allclose(
            on_disk.poses.centers, found.poses.centers[rows], atol=1e-9, equal_nan=True
        )
        assert Area(area).stale_because(f"{group}/medium") is None


def test_labels_that_a_kill_kept_from_moving_are_right_all_the_same(area: Path) -> None:
    """If the map moved but poses.csv did not, readers transform it and the next `georegister` rewrites it."""
    left = area.parent / "left"
    for group in (EVALUATION, TRACKED):
        shutil.copytree(area / group, left / group)
    options = ("--gnss-sigma", "0.5", "3", "--overwrite")
    assert run("georegister", "--area", area, *options).exit_code == 0
    moved = read_labelled_area(Area(area), mapping_covariance=False).evaluation["medium"]
    for group in (EVALUATION, TRACKED):
        shutil.rmtree(area / group)
        shutil.copytree(left / group, area / group)
    assert poses_file(area).read_bytes() == poses_file(left).read_bytes()
    read = read_labelled_area(Area(area), mapping_covariance=False).evaluation["medium"]
    has = moved.registered
    assert np.allclose(read.poses.centers[has], moved.poses.centers[has], atol=1e-9)
    assert run("georegister", "--area", area, *options).exit_code == 0
    assert poses_file(area).read_bytes() != poses_file(left).read_bytes()


@pytest.mark.slow
def test_a_lens_that_is_held_is_written_as_it_was_given(
    bare: Path, flight1: Path, flight2: Path, tmp_path: Path
) -> None:
    """--camera with --fixed-lens writes the given lens bit for bit, and labels are at least as accurate."""
    truth = read_json(flight1.parent / "truth" / "flight1_camera.json")
    (tmp_path / "lens.json").write_text(
        (flight1.parent / "truth" / "flight1_camera.json").read_text()
    )
    options = ("--camera", tmp_path / "lens.json", "--fixed-lens", *FAST)
    register(bare, flight2, "--name", "held", *options)
    written = read_json(bare / EVALUATION / "held" / "camera.json")
    assert camera_to_json(camera_from_json(written))["params"] == truth["params"]
    assert written["estimated"] == []
    labelled = read_labelled_area(Area(bare))
    error_m, _ = errors(labelled, labelled.evaluation["held"], flight1)
    assert error_m.max() < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("step", ["features", "map matches"])
def test_a_killed_run_goes_on_to_the_same_labels(
    bare: Path, flight2: Path, registered: Path, step: str
) -> None:
    """A run killed during feature extraction or matching resumes and ends with the same labels."""
    command = [sys.executable, "-c", "from spn_cli.data import main; main()", "register"]
    command += [str(flight2 / "flight2.mp4"), "--name", "medium", "--area", str(bare), *FAST]
    log = bare.parent / "log"
    with log.open("w") as out:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
        deadline = time.monotonic() + 60
        while f"\n{step}: " not in log.read_text() and process.poll() is None:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        assert process.wait(20) == -signal.SIGKILL, log.read_text()
    assert not (bare / EVALUATION / "medium").exists()
    result = register(bare, flight2 / "flight2.mp4", "--name", "medium", *FAST)
    assert "features: 1 of 7" not in result.output
    for file in ("poses.csv", "camera.json"):
        one, other = (a / EVALUATION / "medium" / file for a in (bare, registered))
        assert one.read_bytes() == other.read_bytes()
    assert {p.name for p in (bare / EVALUATION / "medium").iterdir()} == {
        p.name for p in (registered / EVALUATION / "medium").iterdir()
    }


def test_the_page_has_every_option_with_its_default() -> None:
    """docs/registration.md has one row for each option of the command, with its default, and no others."""
    rows = dict(re.findall(r"^\| `(--[a-z-]+)`[^|]*\|([^|]*)\|", DOC.read_text(), re.MULTILINE))
    parameters = {
        p.opts[0]: p
        for p in main.commands["register"].params
        if isinstance(p, click.Option) and p.expose_value
    }
    assert rows.keys() == parameters.keys()
    for flag, parameter in parameters.items():
        if parameter.show_default is True:
            assert float(rows[flag].strip("` ")) == parameter.default


def test_the_page_has_every_check_with_its_default() -> None:
    """docs/registration.md lists every check with the default that the program uses."""
    text = DOC.read_text().split("## Checks")[1].split("### Reasons")[0]
    rows = dict(re.findall(r"^\| `(\w+)` \| ([0-9.]+) \|", text, re.MULTILINE))
    options = CheckOptions()
    for name, value in rows.items():
        assert float(value) == getattr(options, name), name
    inside = {
        "same_place": f"within {options.same_place:g} *d* (`same_place`)",
        "same_rotation_deg": f"{options.same_rotation_deg:g}\u00b0 (`same_rotation_deg`)",
        "min_pair_matches": f"`min_pair_matches` ({options.min_pair_matches})",
    }
    assert rows.keys() | inside.keys() == vars(options).keys()
    assert [phrase for phrase in inside.values() if phrase not in text] == []


def test_the_page_has_every_field_of_the_files(registered: Path) -> None:
    """docs/registration.md lists the columns of poses.csv in order and all fields of the two JSON files."""
    text = DOC.read_text()
    part = text.split("### poses.csv")[1].split("### observations.npz")[0]
    cells = re.findall(r"^\| (`[^|]+) \|", part, re.MULTILINE)
    listed = re.findall(r"`([^`]+)`", " ".join(cells))
    plain = [name for name in _COLUMNS if not name.startswith("cov_")]
    assert listed == [*plain, "cov_00", "cov_55"]
    folder = registered / EVALUATION / "medium"
    told = read_json(folder / "registration.json")
    for name in (*told, *told["gnss"], *read_json(folder / "camera.json")):
        assert f"`{name}`" in text.split("## Files")[1], name
    files = text.split("## Files")[1].split("### poses.csv")[0]
    for path in folder.iterdir():
        assert f"`{path.name}" in files, path.name


def test_a_lens_that_may_be_the_maps_own_is_compared_with_it() -> None:
    """A focal length 10 % from the map's at the same image size gives a note; other cases give none."""
    from spn_data.pipeline.evaluation_stage import lens_notes

    def lens(focal_px: float, width: int = 800) -> Camera:
        return Camera("RADIAL", width, 600, np.array([focal_px, width / 2, 300.0, 0.0, 0.0]))

    (told,) = lens_notes(lens(486.0), {"east": lens(440.0)})
    assert "486 px" in told
    assert "east" in told
    assert "about 10%" in told
    for other in (lens(482.0), lens(800.0), lens(440.0, 1000)):
        assert lens_notes(lens(486.0), {"east": other}) == []
