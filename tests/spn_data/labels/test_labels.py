"""Labels as values and files, the hash of a map, and the read-only map."""

from __future__ import annotations

import sqlite3
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from spn_data.area.names import MODEL
from spn_data.colmap.map_features import MapFeatures
from spn_data.errors import FormatError, InputError
from spn_data.geometry.pose import Poses, Similarity, pose_errors
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.labels.labels import (
    LabelObservations,
    Labels,
    read_label_observations,
    read_labels,
    write_label_observations,
    write_labels,
)
from spn_data.labels.map_hash import map_hash
from spn_data.labels.map_points import MapPoints, covered_share
from spn_data.registration.frozen_map import FrozenMap


def labels(count: int = 4, name: str = "low") -> Labels:
    """Return labels of which the last one failed."""
    rng = np.random.default_rng(1)
    angles = rng.uniform(-60, 60, (count, 3))
    poses = Poses.from_rotations(rng.normal(0, 9, (count, 3)), rotations_from_angles(angles))
    root = rng.normal(0, 0.1, (count, 6, 6))
    has = np.arange(count) < count - 1
    return Labels(
        names=np.array([f"{name}/{k:06d}.jpg" for k in range(count)]),
        sequences=np.full(count, name),
        cameras=np.full(count, name),
        sources=np.full(count, f"{name}.mp4"),
        video_frame=np.arange(count) * 5,
        tracked=np.arange(count) % 2 == 1,
        time_s=np.arange(count) / 3,
        status=np.where(has, "registered", "failed"),
        reason=np.where(has, "", 'ambiguous: "two", or more'),
        poses=Poses(
            np.where(has[:, None], poses.centers, np.nan),
            np.where(has[:, None], poses.quats_wxyz, np.nan),
        ),
        covariance=np.where(has[:, None, None], root @ root.transpose(0, 2, 1), np.nan),
        inliers=np.arange(count) + 30,
        coverage=np.linspace(0.1, 0.9, count),
        error_px=np.where(has, 0.3, np.nan),
    )


def test_poses_csv_gives_back_every_bit(tmp_path: Path) -> None:
    """Numbers, quoted reasons and failed frames survive, and writing again gives the same bytes."""
    made = labels()
    write_labels(tmp_path / "poses.csv", made)
    read = read_labels(tmp_path / "poses.csv")
    for column in fields(Labels):
        if column.name != "poses":
            before, after = getattr(made, column.name), getattr(read, column.name)
            numbers = before.dtype.kind == "f"
            assert np.array_equal(before, after, equal_nan=numbers), column.name
    assert np.array_equal(made.poses.centers, read.poses.centers, equal_nan=True)
    assert np.allclose(made.poses.quats_wxyz, read.poses.quats_wxyz, atol=1e-16, equal_nan=True)
    write_labels(tmp_path / "again.csv", read)
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "poses.csv").read_bytes()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("name,time_s", "nom,time_s", "poses.csv:1: the header is not that of poses.csv"),
        (",registered,,", ",perhaps,,", "poses.csv:2: status 'perhaps' is none of"),
        ("low/000001.jpg", "../000001.jpg", "poses.csv:3"),
        ("low/000001.jpg", "low/000000.jpg", "frame names are not unique"),
        ("low.mp4", "../low.mp4", "is not the name of a file"),
        (",registered,,", ",failed,,", "poses.csv:2: a failed frame has a pose"),
        (",failed,", ",registered,", "poses.csv:5: a registered frame has no pose"),
        ("0.3333333333333333", "inf", "poses.csv:3: 'inf' is not a finite number"),
        ("low/000002.jpg,", "low/000002.jpg", "poses.csv:4: 38 cells, expected 39"),
    ],
)
def test_what_is_no_list_of_poses_is_refused_with_its_line(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    """A malformed poses.csv is refused with the line at fault."""
    path = tmp_path / "poses.csv"
    write_labels(path, labels())
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        read_labels(path)


def test_a_file_of_bytes_or_none_at_all_is_an_input_error(tmp_path: Path) -> None:
    """A missing file and a binary one each raise an InputError."""
    with pytest.raises(InputError, match="can't be read"):
        read_labels(tmp_path / "missing.csv")
    (tmp_path / "poses.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="is not UTF-8 text"):
        read_labels(tmp_path / "poses.csv")


def test_labels_move_with_their_world() -> None:
    """A similarity moves centres, rotations and covariances, except rotation covariances, in camera axes."""
    made = labels()
    has = made.registered
    b_from_a = Similarity(2.5, rotations_from_angles(np.array([[30.0, 10, -5]]))[0], np.ones(3))
    moved = made.transformed(b_from_a)
    assert np.allclose(moved.poses.centers[has], b_from_a.apply(made.poses.centers[has]))
    point = np.array([[3.0, 20, -1]])
    before = (point - made.poses.centers[:1]) @ made.poses.rotations[0].T
    after = (b_from_a.apply(point) - moved.poses.centers[:1]) @ moved.poses.rotations[0].T
    assert np.allclose(after, 2.5 * before)
    turn = 2.5 * b_from_a.rotation
    assert np.allclose(moved.covariance[0][:3, :3], turn @ made.covariance[0][:3, :3] @ turn.T)
    assert np.allclose(moved.covariance[0][3:, 3:], made.covariance[0][3:, 3:])
    back = moved.transformed(b_from_a.inverse())
    assert pose_errors(back.poses[has], made.poses[has])[0].max() < 1e-12
    assert np.allclose(back.covariance[has], made.covariance[has])
    assert np.isnan(moved.poses.centers[~has]).all()


def test_labels_are_selected_and_put_together() -> None:
    """Labels are concatenated and selected; duplicate names and columns of other lengths are refused."""
    one, other = labels(3), labels(2, "high")
    both = Labels.concatenate([one, other])
    assert both.names.tolist() == [*one.names.tolist(), *other.names.tolist()]
    last = both.select(both.sequences == "high")
    assert np.array_equal(last.poses.centers, other.poses.centers, equal_nan=True)
    with pytest.raises(ValueError, match="not unique"):
        Labels.concatenate([one, one])
    with pytest.raises(ValueError, match="2 rows, not 3"):
        replace(one, inliers=np.zeros(2, int))


def seen() -> LabelObservations:
    return LabelObservations(
        np.array([0, 0, 2, 2, 2]), np.array([7, 3, 3, 9, 7]), np.arange(10.0).reshape(5, 2)
    )


def test_seen_points_are_selected_by_frame_and_come_back_from_their_file(tmp_path: Path) -> None:
    """Observations are selected by frame, and reading them from a file gives the same arrays."""
    some = seen().select(np.array([2, 1, 0]))
    assert some.frame_idx.tolist() == [0, 0, 0, 2, 2]
    assert some.of_frame(0)[0].tolist() == [3, 9, 7]
    assert len(some.of_frame(1)[0]) == 0
    assert some.of_frame(2)[1].tolist() == [[0, 1], [2, 3]]
    write_label_observations(tmp_path / "o.npz", seen())
    read = read_label_observations(tmp_path / "o.npz")
    for column in fields(LabelObservations):
        assert np.array_equal(getattr(read, column.name), getattr(seen(), column.name))


def test_a_damaged_file_of_observations_is_refused(tmp_path: Path) -> None:
    """Truncated, empty, foreign and inconsistent observation files are refused."""
    path = tmp_path / "o.npz"
    write_label_observations(path, seen())
    whole = path.read_bytes()
    for bad in (whole[:100], b"", b"not an archive", whole[:60] + b"?" * 9 + whole[69:]):
        path.write_bytes(bad)
        with pytest.raises(InputError, match="is not an observations file"):
            read_label_observations(path)
    np.savez(path, frame_idx=[0, 1], point_ids=[1, 2], pixels=np.zeros((2, 3)))
    with pytest.raises(InputError, match="shapes differ"):
        read_label_observations(path)
    np.savez(path, frame_idx=[1, 0], point_ids=[1, 2], pixels=np.zeros((2, 2)))
    with pytest.raises(InputError, match="not sorted"):
        read_label_observations(path)
    np.savez(path, frame_idx=np.array([{}], dtype=object), point_ids=[1], pixels=np.zeros((1, 2)))
    with pytest.raises(InputError, match="is not an observations file"):
        read_label_observations(path)


def test_the_hash_of_a_map_knows_every_byte_and_name(tmp_path: Path) -> None:
    """A changed byte or a new, renamed or missing file changes the hash, but file times do not."""
    folder = tmp_path / "map"
    folder.mkdir()
    (folder / "a").write_bytes(b"12")
    (folder / "b").write_bytes(b"3")
    first = map_hash(folder)
    (folder / "a").touch()
    assert map_hash(folder) == first
    found = {first}
    for a, b, names in ((b"12", b"4", "ab"), (b"1", b"23", "ab"), (b"12", b"3", "ac")):
        for path in folder.iterdir():
            path.unlink()
        (folder / names[0]).write_bytes(a)
        (folder / names[1]).write_bytes(b)
        found.add(map_hash(folder))
    (folder / "d").touch()
    found.add(map_hash(folder))
    assert len(found) == 5


def test_points_are_found_by_their_id_and_strangers_are_not() -> None:
    """Map points are looked up by id, and an unknown id raises KeyError."""
    points = MapPoints(
        np.array([2, 5, 9]), np.zeros((3, 3)), np.zeros((3, 3), np.uint8), np.ones(3, int)
    )
    assert points.rows_of(np.array([9, 2, 9])).tolist() == [2, 0, 2]
    assert points.rows_of(np.zeros(0, int)).tolist() == []
    for stranger in (1, 4, 10):
        with pytest.raises(KeyError):
            points.rows_of(np.array([5, stranger]))


def test_the_share_of_an_image_counts_cells() -> None:
    """Coverage uses 64 cells; repeated pixels count once, and border pixels belong to the last cells."""
    assert covered_share(np.zeros((0, 2)), 640, 480) == 0
    assert covered_share(np.array([[1.0, 1], [2, 2], [640, 480]]), 640, 480) == 2 / 64
    x, y = np.meshgrid(np.arange(40, 640, 80), np.arange(30, 480, 60))
    assert covered_share(np.column_stack([x.ravel(), y.ravel()]).astype(float), 640, 480) == 1


@pytest.fixture
def database(finished_area: Path, tmp_path: Path) -> Path:
    path = tmp_path / "database.db"
    path.write_bytes((finished_area / MODEL / "database.db").read_bytes())
    return path


def test_descriptors_of_a_map_are_read_and_nothing_is_written(database: Path) -> None:
    """Descriptors of a map image are read without changing the database."""
    before = database.read_bytes()
    with MapFeatures.open(database) as features:
        found = features.descriptors("flight1/000000.jpg")
        assert found.dtype == np.uint8
        assert found.shape[1] == 128
        assert len(found) > 100
        with pytest.raises(FormatError, match="contains no features of flight1/none"):
            features.descriptors("flight1/none.jpg")
    assert database.read_bytes() == before
    assert [p.name for p in database.parent.iterdir()] == ["database.db"]


def test_a_damaged_database_of_a_map_is_told_in_one_line(database: Path) -> None:
    """Damaged descriptors and a damaged database each give a one-line error."""
    with sqlite3.connect(database) as connection:
        connection.execute("UPDATE descriptors SET data = substr(data, 1, 1000)")
    connection.close()
    with MapFeatures.open(database) as features, pytest.raises(FormatError, match="are damaged"):
        features.descriptors("flight1/000000.jpg")
    database.write_bytes(b"no database")
    with MapFeatures.open(database) as features, pytest.raises(FormatError, match="cannot be read"):
        features.descriptors("flight1/000000.jpg")
    database.unlink()
    with pytest.raises(FormatError, match="cannot be opened"), MapFeatures.open(database):
        pass


def test_a_frozen_map_finds_its_own_frames_by_what_they_look_like(finished_area: Path) -> None:
    """Each frame is most similar to itself, and its points are those that the model observes in it."""
    folder = finished_area / MODEL
    with FrozenMap.open(folder, folder / "database.db") as frozen:
        for k, name in enumerate(frozen.scene.names):
            with MapFeatures.open(folder / "database.db") as features:
                described = features.descriptors(name)
            assert frozen.similar(described, 3)[0] == name
            frame = frozen.frame(name)
            seen_by_model = frozen.observations.point_idx[frozen.observations.image_idx == k]
            assert sorted(frame.point_rows.tolist()) == sorted(seen_by_model.tolist())
            assert len(frame.descriptors) == len(frame.point_rows) < len(described)
