"""Tests of frames.csv: exact writing, strict reading, and names that cannot leave the folder."""

from __future__ import annotations

import csv
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from spn_data.capture.frames import Frames, check_name, read_frames, write_frames
from spn_data.errors import InputError
from spn_data.telemetry.track import Telemetry


def example() -> Frames:
    """Create three frames of one flight and an unreadable photo; half of the telemetry is unknown."""
    nan = np.nan
    return Frames(
        names=np.array(["a/000000.jpg", "a/000001.jpg", "a/000007.jpg", "pics/DJI_2.jpg"]),
        sequences=np.array(["a", "a", "a", "pics"]),
        cameras=np.array(["a", "a", "a-2", "pics"]),
        sources=np.array(["DJI 1.MP4", "DJI 1.MP4", "DJI 1.MP4", "DJI_2.JPG"]),
        video_frame=np.array([0, 1, 7, -1]),
        time_s=np.array([0.0, 1 / 3, 0.7, 0.0]),
        status=np.array(["chosen", "skipped", "chosen", "unreadable"]),
        reason=np.array(
            ["chosen: first", 'skipped: 3 px, "still"', "chosen: ü", "it is truncated"]
        ),
        sharpness=np.array([12.5, 3.1, 11.25, nan]),
        motion_px=np.array([nan, 3.2, 77.7, nan]),
        width=np.array([1280, 1280, 1920, 0]),
        height=np.array([720, 720, 1080, 0]),
        lat_lon_deg=np.array([[-33.8600001, 151.2], [nan, nan], [48.1, -0.000001], [nan, nan]]),
        rel_alt_m=np.array([1.5, nan, 0.0, nan]),
        abs_alt_m=np.array([nan, nan, -12.5, nan]),
        sigma_m=np.array([[0.7, 0.8, 1.1], [nan] * 3, [0.02, 0.02, nan], [nan] * 3]),
        gimbal_deg=np.array([[359.9, -90.0, 0.0], [nan] * 3, [10.0, -15.5, 0.1], [nan] * 3]),
    )


def assert_same(a: Frames, b: Frames) -> None:
    for column in fields(Frames):
        np.testing.assert_array_equal(getattr(a, column.name), getattr(b, column.name))


def test_what_is_written_is_read_exactly(tmp_path: Path) -> None:
    """All columns are read back bit-identical, unknown values included; rewriting gives the same bytes."""
    path = tmp_path / "frames.csv"
    write_frames(path, example())
    back = read_frames(path)
    assert_same(back, example())
    write_frames(tmp_path / "again.csv", back)
    assert (tmp_path / "again.csv").read_bytes() == path.read_bytes()
    assert not list(tmp_path.glob("*.part"))


def test_the_file_is_what_the_documentation_says(tmp_path: Path) -> None:
    """The file has a header with units, empty cells for unknown values, and one line per frame."""
    write_frames(tmp_path / "frames.csv", example())
    lines = (tmp_path / "frames.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0] == (
        "name,sequence,camera,source,video_frame,time_s,status,reason,sharpness,motion_px,"
        "width_px,height_px,lat_deg,lon_deg,rel_alt_m,abs_alt_m,"
        "sigma_e_m,sigma_n_m,sigma_u_m,heading_deg,pitch_deg,roll_deg"
    )
    assert lines[1] == (
        "a/000000.jpg,a,a,DJI 1.MP4,0,0.0,chosen,chosen: first,12.5,,1280,720,"
        "-33.8600001,151.2,1.5,,0.7,0.8,1.1,359.9,-90.0,0.0"
    )
    photo = "pics/DJI_2.jpg,pics,pics,DJI_2.JPG,-1,0.0,unreadable,it is truncated,,,0,0"
    assert lines[4] == photo + "," * 10
    page = Path(__file__).resolve().parents[3] / "docs" / "input.md"
    text = page.read_text(encoding="utf-8")
    assert all(f"`{column}`" in text for column in lines[0].split(","))


def test_no_frames_can_be_written_and_read(tmp_path: Path) -> None:
    """A table without rows keeps the shapes of its columns."""
    write_frames(tmp_path / "frames.csv", example().select(np.zeros(4, bool)))
    empty = read_frames(tmp_path / "frames.csv")
    assert len(empty) == 0
    assert empty.lat_lon_deg.shape == (0, 2)
    assert empty.chosen.shape == (0,)


@pytest.mark.parametrize(
    ("column", "cell", "message"),
    [
        ("name", "../etc/passwd.jpg", "is not <sequence>/<frame>.jpg in plain characters"),
        ("name", "/a/000001.jpg", "is not <sequence>/<frame>.jpg in plain characters"),
        ("name", "a/../../b.jpg", "is not <sequence>/<frame>.jpg in plain characters"),
        ("name", "a/..jpg", "is not <sequence>/<frame>.jpg in plain characters"),
        ("name", "a\\b.jpg", "is not <sequence>/<frame>.jpg in plain characters"),
        ("name", "b/000001.jpg", "does not start with its sequence 'a'"),
        ("name", "a/000000.jpg", "duplicate name 'a/000000.jpg'"),
        ("camera", "a b", "camera 'a b' contains characters other"),
        ("source", "../x.mp4", "source '../x.mp4' is not a file name"),
        ("status", "maybe", "status 'maybe' is not one of chosen, skipped, unreadable"),
        ("time_s", "", "time_s '' is not a number"),
        ("time_s", "nan", "time_s 'nan' is not a finite number"),
        ("video_frame", "1.5", "video_frame '1.5' is not a number"),
        ("width_px", "9" * 30, "is not a finite number"),
        ("lat_deg", "9x.1", "lat_deg '9x.1' is not a number"),
        ("sigma_u_m", "inf", "sigma_u_m 'inf' is not a finite number"),
    ],
)
def test_a_wrong_cell_is_told_with_its_line(
    tmp_path: Path, column: str, cell: str, message: str
) -> None:
    """The error for an invalid cell names the file, line 3 and the problem."""
    path = tmp_path / "frames.csv"
    write_frames(path, example())
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    rows[2][rows[0].index(column)] = cell
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows(rows)
    with pytest.raises(InputError) as caught:
        read_frames(path)
    assert str(caught.value).startswith(f"{path}:3: ")
    assert message in str(caught.value)


def test_what_is_not_a_frames_csv_is_refused(tmp_path: Path) -> None:
    """Missing or binary files, a wrong header, short rows and unclosed quotes are refused."""
    path = tmp_path / "frames.csv"
    with pytest.raises(InputError, match="can't be read: No such file"):
        read_frames(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="is not UTF-8 text"):
        read_frames(path)
    path.write_text("")
    with pytest.raises(InputError, match=r"frames\.csv:1: the header is not that of frames\.csv"):
        read_frames(path)
    write_frames(path, example())
    good = path.read_text(encoding="utf-8")
    path.write_text(good + "a/1.jpg,a\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"frames\.csv:6: 2 cells, expected 22"):
        read_frames(path)
    path.write_text(good + '"a/1.jpg,a\n', encoding="utf-8")
    with pytest.raises(InputError, match=r"frames\.csv:6: "):
        read_frames(path)


def test_names_are_checked_before_they_become_paths() -> None:
    """Frame names with special characters, extra folders or leading dots are refused."""
    check_name("DJI_0001/000012.jpg")
    for name in (
        "a.jpg",
        "a/b/c.jpg",
        "./b.jpg",
        ".a/b.jpg",
        "a/.b.jpg",
        "a/b.png",
        "ä/b.jpg",
        "a/b.jpg\n",
    ):
        with pytest.raises(ValueError, match="plain characters"):
            check_name(name)


def test_rows_are_selected_joined_and_given_telemetry() -> None:
    """Selecting and concatenating keep rows intact; telemetry must have one row per frame."""
    frames = example()
    both = Frames.concatenate([frames.select(frames.chosen), frames.select(~frames.chosen)])
    assert both.names.tolist() == [frames.names[i] for i in (0, 2, 1, 3)]
    assert frames.has_fix.tolist() == [True, False, True, False]
    track = Telemetry.from_columns(frames.time_s, rel_alt_m=np.array([1.0, 2.0, 3.0, np.nan]))
    filled = frames.with_telemetry(track)
    np.testing.assert_array_equal(filled.rel_alt_m, track.rel_alt_m)
    assert not filled.has_fix.any()
    with pytest.raises(ValueError, match="2 rows of telemetry for 4 frames"):
        frames.with_telemetry(track.select(np.array([0, 1])))
    with pytest.raises(ValueError, match="not unique"):
        Frames.concatenate([frames, frames])
