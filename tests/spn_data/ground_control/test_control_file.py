"""Tests of files of ground control points: gcp_list.txt and CSV, and what is said of mistakes in them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from spn_data.errors import InputError
from spn_data.ground_control.control_file import ControlFile, PointRole, read_control_file

LIST = """WGS84 UTM 32N
# from the total station
500010.5 5400020.25 210.5 100.5 200.25 DJI_1.JPG A
500010.5 5400020.25 210.5 300 400 DJI_2.JPG A
500050 5400020 211 30 40 DJI_1.JPG
500050 5400020 211 31 41 DJI_2.JPG
"""
TABLE = """name;lat;lon;height;epsg;image;x;y;sigma_h;sigma_v;role
A;48,75;9,0001;210,5;4979;DJI_1.JPG;100,5;200,25;0,02;0,04;control
A;;;;;DJI_2.JPG;300;400;;;
B;48,7502;9,0003;211;4979;DJI_1.JPG;30;40;;;check
"""


def read(tmp_path: Path, text: str, name: str = "points.txt") -> ControlFile:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return read_control_file(path)


def test_odm_lists_group_marks_by_name_or_by_place(tmp_path: Path) -> None:
    """gcp_list.txt gives its system, and points with marks, named or told apart by coordinates."""
    found = read(tmp_path, LIST)
    assert found.crs == "WGS84 UTM 32N"
    first, second = found.points
    assert (first.name, first.east, first.north, first.height) == ("A", 500010.5, 5400020.25, 210.5)
    assert [(m.image, m.x, m.y, m.line) for m in first.marks] == [
        ("DJI_1.JPG", 100.5, 200.25, 3),
        ("DJI_2.JPG", 300.0, 400.0, 4),
    ]
    assert second.name == "point2"
    assert len(second.marks) == 2


def test_tables_name_their_columns(tmp_path: Path) -> None:
    """A CSV with semicolons and decimal commas gives sigmas, roles, and marks of points told once."""
    found = read(tmp_path, TABLE)
    assert found.crs == "EPSG:4979"
    first, second = found.points
    assert (first.east, first.north, first.sigma_h_m, first.sigma_v_m) == (
        9.0001,
        48.75,
        0.02,
        0.04,
    )
    assert len(first.marks) == 2
    assert (first.role, second.role) == (PointRole.CONTROL, PointRole.CHECK)
    assert np.isnan(read(tmp_path, TABLE.replace("211;", ";")).points[1].height)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("EPSG:32632\n", "contains no ground control point"),
        ("EPSG:32632\n1 2 3 4 5\n", r":2: 5 columns instead of: x y z pixel_x pixel_y image"),
        ("EPSG:32632\n1 2 x 4 5 a.jpg\n", r":2: geo_z is 'x', not a number"),
        ("EPSG:32632\n1 2 3 nan 5 a.jpg\n", r":2: im_x is 'nan', not a number"),
        (LIST + "1 2 3 4 5 DJI_9.JPG A\n", r":7: point 'A' has other coordinates than in line 3"),
        (LIST + "500050 5400020 211 9 9 DJI_2.JPG\n", r":7: point 'point2' is marked twice"),
        (TABLE.replace("check", "chek"), r":4: the role is 'chek': control or check"),
        (TABLE.replace("B;48,7502;9,0003;211", "B;;;"), r":4: point 'B' has no coordinates"),
        (TABLE.replace(";4979;DJI_1.JPG;30", ";32632;DJI_1.JPG;30"), r":4: the coordinate system is"),
        (TABLE.replace("0,02", "-1"), r":2: sigma_h is -1, not positive"),
        ("name,east,north,image,x,y\nA,1,2,a.jpg,3,4\n", "does not state the coordinate system"),
        ("name,lat,north,image,x,y\nA,1,2,a.jpg,3,4\n", "neither columns lat and lon nor east"),
        ("name,lat,lon,height\nA,1,2,3\n", "has no column image, x, y"),
    ],
)  # fmt: skip
def test_mistakes_are_named_with_their_line(tmp_path: Path, text: str, message: str) -> None:
    """Each mistake gives one error with file and line."""
    with pytest.raises(InputError, match=message):
        read(tmp_path, text)


def test_a_hostile_file_is_bounded(tmp_path: Path) -> None:
    """More points than anyone surveys, a binary file and a huge one are refused."""
    many = "EPSG:32632\n" + "".join(f"{k} 0 0 1 1 a{k}.jpg\n" for k in range(2_001))
    with pytest.raises(InputError, match="more than 2000 points"):
        read(tmp_path, many)
    (tmp_path / "b").write_bytes(b"\0" * 100)
    with pytest.raises(InputError, match="is binary"):
        read_control_file(tmp_path / "b")
    with (tmp_path / "c").open("wb") as file:
        file.truncate(21_000_000)
    with pytest.raises(InputError, match="has 21 MB"):
        read_control_file(tmp_path / "c")
