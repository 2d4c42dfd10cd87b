"""Tables that state the positions of photos by their file names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import piexif
import pytest
from PIL import Image

from spn_data.capture.candidates import analyse
from spn_data.capture.sources import discover
from spn_data.errors import InputError
from spn_data.inputs.flight_telemetry import source_telemetry
from spn_data.telemetry.track import Telemetry

HEADER = "SourceFile,datetime,lat,lon,alt_ellipsoid_m,sigma_h_m\n"
ROWS = [
    "C:\\card\\100MEDIA\\DJI_0001.JPG,12:00,49.1,8.1,150.0,0.02",
    "C:\\card\\100MEDIA\\DJI_0003.JPG,12:02,49.3,8.3,153.0,0.02",
    "C:\\card\\101MEDIA\\DJI_0001.JPG,12:09,40.0,1.0,10.0,0.02",
]


def telemetry_of(folder: Path, table: str, *, own_lat: int | None = None) -> Telemetry:
    """Return the telemetry of three photos of 100MEDIA beside a table."""
    photos = folder / "100MEDIA"
    photos.mkdir()
    for k in (1, 2, 3):
        gps = {}
        if own_lat is not None:
            degrees = ((own_lat, 1), (6 * (2 * k - 1), 1), (0, 1))
            gps = {1: "N", 2: degrees, 3: "E", 4: ((8, 1), (6 * (2 * k - 1), 1), (0, 1))}
        exif = {36867: f"2026:05:01 12:00:0{k}"}
        data = piexif.dump({"Exif": exif, "GPS": gps})
        Image.new("RGB", (64, 48)).save(photos / f"DJI_000{k}.JPG", exif=data)
    (photos / "geotags.csv").write_text(table)
    (source,) = discover(photos).sources
    track = source_telemetry(source, analyse(source, threads=1))
    assert track is not None
    return track


def test_rows_are_matched_with_photos_by_their_names(tmp_path: Path) -> None:
    """The row whose path ends most alike is that of a photo; a photo without a row has no position."""
    track = telemetry_of(tmp_path, HEADER + "\n".join(ROWS) + "\n")
    assert track.kind == "exif"  # the photos' own: no time offset is estimated or applied
    np.testing.assert_array_equal(track.time_s, [0, 1, 2])
    np.testing.assert_array_equal(track.lat_lon_deg, [[49.1, 8.1], [np.nan] * 2, [49.3, 8.3]])
    np.testing.assert_array_equal(track.abs_alt_m, [150, np.nan, 153])
    assert track.abs_reference == "ellipsoid"
    assert track.sigma_m[0, 0] == 0.02
    (note,) = track.notes
    assert (
        note
        == "positions of 2 of 3 photos are from geotags.csv, by their file names; the others have none"
    )


def test_a_table_replaces_the_positions_of_the_photos(tmp_path: Path) -> None:
    """A table near the photos' own fixes, such as corrected ones, is used instead of them."""
    track = telemetry_of(tmp_path, HEADER + "DJI_0001.jpg,,49.1000001,8.1,150.0,0.02\n", own_lat=49)
    np.testing.assert_array_equal(track.lat_lon_deg[0], [49.1000001, 8.1])
    assert track.has_fix.tolist() == [True, False, False]


@pytest.mark.parametrize(
    ("rows", "own_lat", "message"),
    [
        ("DJI_0007.JPG,,49.1,8.1,1,1\n", None, "names none of the 3 photos"),
        (
            "DJI_0001.JPG,,49.1,8.1,1,1\nDJI_0001.JPG,,49.2,8.1,1,1\n",
            None,
            "lines 2 and 3 are both of",
        ),
        ("DJI_0001.JPG,,49.1,8.1,1,1\n", 51, "m from those that the photos state"),
        ("DJI_0001.JPG,,149.1,8.1,1,1\n", None, "is not a position on Earth"),
    ],
)
def test_a_table_that_does_not_fit_is_refused(
    tmp_path: Path, rows: str, own_lat: int | None, message: str
) -> None:
    """Tables of other photos, with two rows of one photo, or of another place are refused in one line."""
    with pytest.raises(InputError, match=message):
        telemetry_of(tmp_path, HEADER + rows, own_lat=own_lat)


def test_names_of_something_else_are_not_those_of_photos(tmp_path: Path) -> None:
    """A log whose column of names holds no photos is a log as before, here one without dates."""
    with pytest.raises(InputError, match="cannot be paired with the photos, as it has no dates"):
        telemetry_of(tmp_path, "name,time_s,lat,lon\nwaypoint,0,49.1,8.1\nhome,1,49.1,8.1\n")
