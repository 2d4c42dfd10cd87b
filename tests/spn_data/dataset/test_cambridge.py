"""Tests of Cambridge Landmarks pose lists."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from spn_data.dataset.cambridge import (
    find_anomalies,
    position_outliers,
    read_cambridge,
    write_cambridge,
)
from spn_data.errors import InputError
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles

HEADER = "Visual Landmark Dataset V1\nImageFile, Camera Position [X Y Z W P Q R]\n\n"
ROW = "seq1/frame00001.png 1.000000 2.000000 3.000000 1.000000 0.000000 0.000000 0.000000\n"
REAL = [
    f"{scene}/dataset_{part}.txt"
    for scene in ("ShopFacade", "GreatCourt")
    for part in ("train", "test")
]
COUNTS = dict(zip(REAL, (231, 103, 1532, 760), strict=True))


@pytest.mark.parametrize("name", REAL)
def test_a_real_list_is_written_again_to_the_last_digit(
    name: str, shared_data: Path, tmp_path: Path
) -> None:
    """Published lists are rewritten byte by byte, and read back with identical poses."""
    source = shared_data / "cambridge" / name
    found = read_cambridge(source)
    assert len(found) == COUNTS[name]
    write_cambridge(tmp_path / "list.txt", found.names, found.poses)
    assert (tmp_path / "list.txt").read_bytes() == source.read_bytes()
    again = read_cambridge(tmp_path / "list.txt")
    assert np.array_equal(again.poses.centers, found.poses.centers)
    assert np.array_equal(again.poses.quats_wxyz, found.poses.quats_wxyz)


def test_the_outlier_in_great_court_is_reported_and_kept(shared_data: Path) -> None:
    """The outlier position in GreatCourt is reported, but kept in the list."""
    found = read_cambridge(shared_data / "cambridge/GreatCourt/dataset_train.txt")
    row = found.names.index("seq5/frame00297.png")
    assert found.poses.centers[row, 0] == 3117382476.41
    assert np.flatnonzero(position_outliers(found.poses.centers)).tolist() == [row]
    (sentence,) = find_anomalies(found)
    assert sentence.startswith("seq5/frame00297.png: position (3.11738e+09, -1.37673e+08, -1.24")


def test_a_position_is_far_beyond_20_times_what_is_usual() -> None:
    """A position is an outlier beyond 20 times the usual spread; nine centres are too few."""
    usual = np.zeros((20, 3))
    usual[:, 0] = np.linspace(-1, 1, 20)
    for distance, is_far in ((15.0, False), (30.0, True)):
        centers = np.vstack([usual, [[0, 0, distance]]])
        assert position_outliers(centers).tolist() == [False] * 20 + [is_far]
    assert not position_outliers(np.vstack([usual[:8], [[0, 0, 1e9]]])).any()
    assert not position_outliers(np.zeros((20, 3))).any()


def test_an_ordinary_real_list_has_no_oddities(shared_data: Path) -> None:
    """The other published lists have no anomalies."""
    for name in REAL:
        if name != "GreatCourt/dataset_train.txt":
            assert find_anomalies(read_cambridge(shared_data / "cambridge" / name)) == []


def test_the_real_cameras_stand_upright_in_their_convention(shared_data: Path) -> None:
    """Read as world-to-camera, scalar first, the hand-held cameras are level and upright."""
    found = read_cambridge(shared_data / "cambridge/ShopFacade/dataset_train.txt")
    down_in_world, forward_in_world = found.poses.rotations[:, 1], found.poses.rotations[:, 2]
    assert np.median(down_in_world[:, 2]) < -0.99
    assert np.median(np.abs(forward_in_world[:, 2])) < 0.1


def test_a_known_pose_has_its_known_line(tmp_path: Path) -> None:
    """A level camera looking north, 10 m up, is written as a 90-degree rotation about x."""
    poses = Poses.from_rotations(
        np.array([[0.0, 0.0, 10.0]]), rotations_from_angles(np.zeros((1, 3)))
    )
    write_cambridge(tmp_path / "list.txt", ["flight/a.png"], poses)
    line = "flight/a.png 0.000000 0.000000 10.000000 0.707107 0.707107 0.000000 0.000000\n"
    assert (tmp_path / "list.txt").read_text().replace("-0.000000", "0.000000") == HEADER + line


def test_line_ends_of_windows_a_byte_order_mark_tabs_and_empty_lines_are_read(
    tmp_path: Path,
) -> None:
    """Windows line ends, a byte-order mark, tabs and empty lines are accepted."""
    path = tmp_path / "list.txt"
    text = HEADER + ROW.replace(" ", "\t") + "\n \n"
    path.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    found = read_cambridge(path)
    assert found.names == ("seq1/frame00001.png",)
    assert found.poses.centers.tolist() == [[1, 2, 3]]


def test_a_list_of_no_images_is_read_as_such(tmp_path: Path) -> None:
    """A list with only its header gives no images and no anomalies."""
    (tmp_path / "list.txt").write_text(HEADER)
    found = read_cambridge(tmp_path / "list.txt")
    assert len(found) == len(found.poses) == 0
    assert find_anomalies(found) == []


def test_a_flipped_or_long_quaternion_is_reported_and_round_trips(
    tmp_path: Path,
) -> None:
    """Quaternions of negative w or wrong length are reported and normalised, then stay stable."""
    path = tmp_path / "list.txt"
    rows = ["a/1.png 0 0 0 -0.5 0.5 0.5 0.5", "a/2.png 1 0 0 1.001 0 0 0", "a/3.png 1 0 0 1 0 0 0"]
    path.write_text(HEADER + "\n".join(rows))
    found = read_cambridge(path)
    assert found.poses.quats_wxyz.tolist() == [[0.5, -0.5, -0.5, -0.5], [1, 0, 0, 0], [1, 0, 0, 0]]
    sentences = find_anomalies(found)
    assert [sentence.split(":")[0] for sentence in sentences] == ["a/2.png", "a/1.png", "a/3.png"]
    write_cambridge(tmp_path / "first.txt", found.names, found.poses)
    second = read_cambridge(tmp_path / "first.txt")
    write_cambridge(tmp_path / "second.txt", second.names, second.poses)
    assert (tmp_path / "second.txt").read_bytes() == (tmp_path / "first.txt").read_bytes()


def _with(old: str, new: str) -> bytes:
    return (HEADER + ROW).replace(old, new).encode()


@pytest.mark.parametrize(
    ("content", "line", "words"),
    [
        (b"", 1, "nothing instead of"),
        (ROW.encode() * 5, 1, "begins with three header lines"),
        (HEADER.strip().encode(), 3, "nothing instead of"),
        (HEADER.strip().encode() + b"\n" + ROW.encode(), 3, "begins with three header lines"),
        (_with(" 0.000000\n", "\n"), 4, "7 fields, expected 8"),
        (_with("frame00001.png", "frame00001.png 1"), 4, "9 fields, expected 8"),
        (_with("2.000000", "nan"), 4, "'nan' is not a number"),
        (_with("2.000000", "1_0"), 4, "'1_0' is not a number"),
        (_with("2.000000", "1e400"), 4, "a number exceeds 1e15"),
        (
            _with(" 1.000000 0.000000", " 0.000000 0.000000"),
            4,
            "frame00001.png: the quaternion is zero",
        ),
        (_with("seq1/", "../"), 4, "is not a path below"),
        (_with("seq1/", "/etc/"), 4, "is not a path below"),
        (_with("seq1/", "seq1/./../"), 4, "is not a path below"),
        (_with("seq1/", "c:\\"), 4, "is not a path below"),
        (_with("seq1/", "seq1\x1b/"), 4, "is not a path below"),
        (_with("\n\n", "\n\n" + ROW), 5, "is listed twice"),
        (_with("seq1", "s" * 5000), 4, "longer than 4096 bytes"),
        (_with("seq1", "seq1").replace(b"seq1", b"\xff"), 4, "not UTF-8"),
    ],
)
def test_a_broken_list_is_refused_with_its_line(
    content: bytes, line: int, words: str, tmp_path: Path
) -> None:
    """The error for a malformed list names file and line."""
    path = tmp_path / "list.txt"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        read_cambridge(path)
    assert caught.value.line == line
    assert str(caught.value).startswith(f"{path}:{line}: ")


def test_a_missing_list_or_a_folder_is_refused(tmp_path: Path) -> None:
    """A missing list, or a folder in its place, is refused."""
    with pytest.raises(InputError, match="does not exist"):
        read_cambridge(tmp_path / "list.txt")
    with pytest.raises(InputError, match="is not a file"):
        read_cambridge(tmp_path)


@pytest.mark.parametrize("name", ["../a.png", "/a.png", "a b.png", "a//b.png", ""])
def test_a_name_that_no_reader_takes_is_not_written(name: str, tmp_path: Path) -> None:
    """Invalid names and unknown poses are refused before anything is written."""
    poses = Poses(np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]))
    with pytest.raises(ValueError, match="is not a path"):
        write_cambridge(tmp_path / "list.txt", [name], poses)
    with pytest.raises(ValueError, match="not finite"):
        write_cambridge(
            tmp_path / "list.txt", ["a.png"], Poses(np.full((1, 3), np.nan), poses.quats_wxyz)
        )
    assert list(tmp_path.iterdir()) == []
