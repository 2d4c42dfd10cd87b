"""Tests of planned waypoints as CSV: what is read, what is refused and where, and what is written."""

from __future__ import annotations

import re

import numpy as np
import pytest

from spn_data.coverage.waypoints import WaypointFrame, read_waypoints, waypoint_columns
from spn_data.errors import InputError
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.rotations import angles_from_rotations
from spn_data.storage.files import write_csv

LAT, LON = 49.0153, 8.4250
TAKEOFF = WaypointFrame(GeoOrigin(LAT, LON, 0.0, HeightReference.TAKEOFF), 0.0)
# An area with ellipsoidal heights whose zero is 2 m above the take-off point.
ELLIPSOID = WaypointFrame(GeoOrigin(LAT, LON, 112.0, HeightReference.ELLIPSOID), -2.0)
HEADER = "lat_deg,lon_deg,height_takeoff_m,heading_deg,pitch_deg"
GOOD = f"{LAT},{LON},10,90,-30"


def read(tmp_path, text: str | bytes, place: WaypointFrame = TAKEOFF):
    path = tmp_path / "plan.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_waypoints(path, place)


class TestReading:
    def test_latitude_longitude_and_height_above_take_off(self, tmp_path):
        """A latitude 1e-4 degrees north is 11.12 m north; heading and pitch are read as given."""
        found = read(tmp_path, f"{HEADER}\n{LAT + 1e-4},{LON},10,90,-30\n")
        np.testing.assert_allclose(found.poses.centers, [[0, 11.122, 10]], atol=2e-3)
        angles = angles_from_rotations(found.poses.rotations)
        np.testing.assert_allclose(angles, [[90, -30, 0]], atol=1e-9)
        assert found.cameras.tolist() == [""]
        assert found.lines.tolist() == [2]

    @pytest.mark.parametrize(
        ("column", "value", "up"),
        [("alt_ellipsoid_m", 120.0, 8.0), ("height_takeoff_m", 10.0, 8.0)],
    )
    def test_heights_by_what_they_count_from(self, tmp_path, column, value, up):
        """Ellipsoidal heights and heights above take-off are both converted to the area's zero."""
        text = f"lat_deg,lon_deg,{column},heading_deg,pitch_deg\n{LAT},{LON},{value},0,0\n"
        assert read(tmp_path, text, ELLIPSOID).poses.centers[0, 2] == pytest.approx(up, abs=1e-6)

    def test_east_north_up_roll_and_camera(self, tmp_path):
        """x, y, z, roll and camera key are read in any order, among unknown columns."""
        text = "note,Camera,z,y,x,roll,pitch,heading\nhello,wide,3,2,1,5,-10,350\n"
        found = read(tmp_path, text)
        assert found.poses.centers.tolist() == [[1.0, 2.0, 3.0]]
        angles = angles_from_rotations(found.poses.rotations)
        np.testing.assert_allclose(angles, [[350, -10, 5]], atol=1e-9)
        assert found.cameras.tolist() == ["wide"]

    @pytest.mark.parametrize(
        "text",
        [
            b"\xef\xbb\xbf" + f"{HEADER}\r\n{GOOD}\r\n".encode(),
            f"sep=;\n{HEADER}\n{GOOD}\n".replace(",", ";").replace(".", ",").encode(),
            f"# a plan\n\n{HEADER}\n\n{GOOD}\n\n".replace(",", "\t").encode(),
            f"{HEADER}\n{GOOD}".encode("utf-16"),
        ],
        ids=["byte-order mark", "semicolons and decimal commas", "tabs and comments", "UTF-16"],
    )
    def test_what_spreadsheets_write_is_read(self, tmp_path, text):
        """Byte-order marks, semicolons, decimal commas, tabs, comments and empty lines are accepted."""
        found = read(tmp_path, text)
        np.testing.assert_allclose(found.poses.centers, [[0, 0, 10]], atol=1e-6)

    def test_a_row_may_state_its_position_twice(self, tmp_path):
        """x, y, z take precedence; a row without them uses latitude and longitude."""
        text = f"{HEADER},x,y,z\n{GOOD},0.1,0.1,10.1\n{GOOD},,,\n"
        found = read(tmp_path, text)
        np.testing.assert_allclose(found.poses.centers, [[0.1, 0.1, 10.1], [0, 0, 10]], atol=1e-6)


class TestRefusing:
    @pytest.mark.parametrize(
        ("rows", "message"),
        [
            (f"{GOOD}\n{LAT},{LON},ten,90,-30", "3: height_takeoff_m is 'ten', not a number"),
            (f"{LAT},{LON},inf,90,-30", "2: height_takeoff_m is 'inf', not a number"),
            (f"252.75,{LAT},10,90,-30", "2: lat_deg is 252.75, outside -90 to 90"),
            (f"{LAT},{LON},10,90,-95", "2: pitch_deg is -95, outside -90 to 90"),
            (f"{LAT},{LON},10,400,-30", "2: heading_deg is 400, outside -360 to 360"),
            (f"{GOOD}\n{LAT},{LON},10,,-30", "3: heading_deg is missing"),
            (f"{LAT},,10,90,-30", "2: has no position"),
            (f"{LAT},{LON},,90,-30", "2: has no position"),
            (f"{GOOD},7", "2: 6 cells, but the header has 5"),
            (f"{LAT},{LON},10,90", "2: 4 cells, but the header has 5"),
            (f'{LAT},{LON},10,90,"-30\n{GOOD}', "4: pitch_deg is '-30"),
            (f"{LAT},{LON},1_0,90,-30", "2: height_takeoff_m is '1_0', not a number"),
            ("", "1: has a header but no rows"),
        ],
    )
    def test_a_bad_row_is_named_with_its_line(self, tmp_path, rows, message):
        """The error for a bad row names file and line, also after an unclosed quote."""
        text = f"{HEADER}\n{rows}\n"
        with pytest.raises(InputError, match=rf"plan\.csv:{re.escape(message)}"):
            read(tmp_path, text)

    @pytest.mark.parametrize(
        ("header", "message"),
        [
            ("lat_deg,lon_deg,heading_deg,pitch_deg,a", "no column for a position"),
            ("x,y,z,heading_deg,a", "no column for pitch_deg"),
            ("x,y,z,x_m,heading_deg", "has the column x_m twice"),
            ("a,b,c,d,e", "no column for a position .* and heading_deg and pitch_deg"),
        ],
    )
    def test_missing_columns_are_named(self, tmp_path, header, message):
        """The error names the missing columns of position or direction."""
        with pytest.raises(InputError, match=message):
            read(tmp_path, f"{header}\n1,2,3,4,5\n")

    def test_heights_of_another_reference_are_refused(self, tmp_path):
        """Heights above sea level are refused because no geoid model is available."""
        text = f"lat_deg,lon_deg,alt_amsl_m,heading_deg,pitch_deg\n{LAT},{LON},10,0,0\n"
        with pytest.raises(
            InputError, match="alt_amsl_m, but the area needs height_takeoff_m; no geoid"
        ):
            read(tmp_path, text)
        with pytest.raises(InputError, match="needs alt_ellipsoid_m or height_takeoff_m"):
            read(tmp_path, text, ELLIPSOID)
        unknown = WaypointFrame(GeoOrigin(LAT, LON, -6.0, HeightReference.UNKNOWN))
        with pytest.raises(InputError, match=r"needs x, y, z \(its height reference is unknown"):
            read(tmp_path, text, unknown)

    def test_positions_that_differ_are_refused(self, tmp_path):
        """A row whose x, y, z contradict its latitude and longitude is refused."""
        with pytest.raises(InputError, match=r"plan\.csv:2: its two positions differ"):
            read(tmp_path, f"{HEADER},x,y,z\n{GOOD},3,0,10\n")

    def test_half_a_position_is_refused(self, tmp_path):
        """x without y and z is refused even if latitude and longitude are given."""
        with pytest.raises(
            InputError, match=r"plan\.csv:2: has no position: x, y, z are incomplete"
        ):
            read(tmp_path, f"{HEADER},x,y,z\n{GOOD},0,,\n")

    def test_a_camera_is_a_key_not_a_path(self, tmp_path):
        """A camera cell that is not a valid key (such as a path) is refused."""
        with pytest.raises(InputError, match="not a valid camera key"):
            read(tmp_path, f"{HEADER},camera\n{GOOD},../../etc/passwd\n")

    @pytest.mark.parametrize(
        ("data", "message"),
        [
            (b"", "the file is empty: it contains no waypoint"),
            (b"\0\1\2\3", "is binary"),
            (b'"' + b"x" * 200_000, "is not valid CSV"),
            (b",,,\n" * 5, "no column for|is empty|has a header but no rows"),
        ],
        ids=["empty", "binary", "endless quote", "commas"],
    )
    def test_hostile_files_are_one_line(self, tmp_path, data, message):
        """Empty, binary and malformed files are refused with a one-line error."""
        with pytest.raises(InputError, match=message):
            read(tmp_path, data)

    def test_too_many_rows_are_refused(self, tmp_path, monkeypatch):
        """A file with more rows than the limit is refused, which bounds memory."""
        monkeypatch.setattr("spn_data.coverage.waypoints.MAX_WAYPOINTS", 2)
        with pytest.raises(InputError, match=r"plan\.csv:4: has more than 2 rows"):
            read(tmp_path, f"{HEADER}\n" + f"{GOOD}\n" * 3)


class TestWriting:
    @pytest.mark.parametrize("place", [TAKEOFF, ELLIPSOID], ids=["takeoff", "ellipsoid"])
    def test_what_is_written_is_read_back(self, tmp_path, place):
        """Positions survive a round trip within 0.7 mm, for each way of giving a position."""
        rng = np.random.default_rng(1)
        centers = rng.uniform(-400, 400, (20, 3))
        angles = rng.uniform((0, -90, -20), (360, 40, 20), (20, 3))
        columns = waypoint_columns(centers, angles, place)
        enu = ["x_m", "y_m", "z_m"]
        heights = list(place.columns())
        for left_out in ([], enu, ["lat_deg", "lon_deg", *heights], [*enu, *heights[1:]]):
            kept = {name: cells for name, cells in columns.items() if name not in left_out}
            write_csv(tmp_path / "plan.csv", kept)
            found = read_waypoints(tmp_path / "plan.csv", place)
            np.testing.assert_allclose(found.poses.centers, centers, atol=7e-4)
            np.testing.assert_allclose(
                np.cos(np.deg2rad(angles_from_rotations(found.poses.rotations) - angles)),
                1.0,
                atol=1e-9,
            )

    def test_full_turns_and_negative_zeros_are_printed_plainly(self):
        """359.9999 degrees is written as 0.000, and a roll of -1e-14 without a sign."""
        columns = waypoint_columns(np.zeros((1, 3)), np.array([[359.9999, -0.0, -1e-14]]), TAKEOFF)
        assert columns["heading_deg"] == ["0.000"]
        assert columns["pitch_deg"] == ["0.000"]
        assert columns["roll_deg"] == ["0.000"]
