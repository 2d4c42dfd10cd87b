"""DJI's .MRK files: exposures of an RTK drone, matched to photos and checked against them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.telemetry.mrk import Exposures, read_mrk, with_exposures
from spn_data.telemetry.track import Telemetry

NAN = float("nan")
NUMBERS = (3, 4, 5, 6)
LINE = (
    "{number}\t{second:.6f}\t[2364]\t  -339,N\t  -361,E\t   348,V\t{lat:.8f},Lat\t-115.38278248,Lon\t"
    "1368.634,Ellh\t0.012459, 0.010243, 0.020338\t{flag},Q"
)
SECONDS = (505369.172143, 505371.4, 505373.1, 505376.6)  # Friday of GPS week 2364
UTC_S = 315_964_800 + 604_800 * 2364 + np.array(SECONDS) - 18
LAT = 51.10917679 + np.arange(4) * 4e-5  # 4.4 m apart


def write(path: Path, numbers=NUMBERS, flags=(50, 50, 50, 50), seconds=SECONDS, lat=LAT) -> Path:
    lines = [
        LINE.format(number=n, second=s, lat=y, flag=f)
        for n, s, y, f in zip(numbers, seconds, lat, flags, strict=True)
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def exposures(tmp_path: Path) -> Exposures:
    return read_mrk(write(tmp_path / "DJI_202505021412_007_Timestamp.MRK"))


def photos(offset_m: float = 0.3, **columns) -> Telemetry:
    """Return four photos as their own EXIF states them, `offset_m` north of their exposures."""
    lat_lon = np.column_stack([LAT + offset_m / 111_200, np.full(4, -115.38278248)])
    utc_s = np.floor(UTC_S - 7 * 3600)  # the camera's clock: another zone, whole seconds
    values = {"lat_lon_deg": lat_lon, "utc_s": utc_s, "abs_alt_m": np.full(4, 1400.0)}
    return Telemetry.from_columns(np.arange(4.0), **values | columns)


NAMES = [f"DJI_20250502142325_{number:04d}_D.JPG" for number in NUMBERS]


def test_exposures_are_read(exposures: Exposures) -> None:
    """Time, position of the sensor, ellipsoidal height and deviations (north first) are read."""
    assert exposures.number.tolist() == list(NUMBERS)
    assert exposures.lat_lon_deg[0].tolist() == [51.10917679, -115.38278248]
    assert exposures.height_m[0] == 1368.634
    assert exposures.sigma_m[0].tolist() == [0.010243, 0.012459, 0.020338]
    np.testing.assert_allclose(exposures.time_s, UTC_S + 18)


@pytest.mark.parametrize("stem", ["DJI_20250502142325_{:04d}_D", "100_0007_{:04d}", "DJI_{:04d}"])
def test_photos_get_the_positions_of_their_exposures(exposures: Exposures, stem: str) -> None:
    """Photos found by number get exactly the stated position: the offsets are contained in it already."""
    names = [stem.format(number) + ".JPG" for number in NUMBERS]
    track = with_exposures(photos(), names, [exposures])
    np.testing.assert_array_equal(track.lat_lon_deg, exposures.lat_lon_deg)
    np.testing.assert_array_equal(track.abs_alt_m, exposures.height_m)
    np.testing.assert_array_equal(track.sigma_m, exposures.sigma_m)
    assert track.abs_reference is HeightReference.ELLIPSOID
    assert "4 of 4 photos are from DJI_202505021412_007_Timestamp.MRK (4 fixed)" in track.notes[-1]


def test_exposures_without_a_position_are_not_used(tmp_path: Path) -> None:
    """A photo whose exposure had no position keeps its own, without a height of another reference."""
    path = write(tmp_path / "a.MRK", flags=(50, 0, 34, 16))
    track = with_exposures(photos(), NAMES, [read_mrk(path)])
    assert track.lat_lon_deg[1].tolist() == photos().lat_lon_deg[1].tolist()
    assert np.isnan(track.abs_alt_m).tolist() == [False, True, False, False]
    assert "3 of 4 photos" in track.notes[-1]
    assert "(1 fixed, 1 float, 1 single or none); the others have no" in track.notes[-1]


@pytest.mark.parametrize(
    ("own", "names", "message"),
    [
        (photos(offset_m=40), NAMES, r"0003_D\.JPG is 40 m from exposure 3: it is of another"),
        (photos(), ["a.JPG", "b.JPG", "c.JPG"], "none of its 4 exposures has the number"),
        (photos(), ["1_0004.JPG", "1_0005.JPG", "1_0006.JPG", "x.JPG"], "nearer to another exposure"),
        (
            replace(photos(), utc_s=photos().utc_s + np.array([0, 0, 60, 0])),
            NAMES,
            r"0005_D\.JPG was taken 60 s from exposure 5",
        ),
        (
            photos(lat_lon_deg=np.full((4, 2), NAN), utc_s=np.full(4, NAN)),
            NAMES,
            "neither positions nor times in the photos confirm",
        ),
        (photos(), [NAMES[0], NAMES[0].replace("2325", "2326"), *NAMES[2:]], "both have the number"),
    ],
)  # fmt: skip
def test_exposures_of_other_photos_are_refused(
    exposures: Exposures, own: Telemetry, names: list[str], message: str
) -> None:
    """Files whose exposures contradict the photos, or that nothing confirms, are refused by name."""
    own = own.select(np.arange(len(names))) if len(names) < 4 else own
    with pytest.raises(InputError, match=message) as error:
        with_exposures(own, names, [exposures])
    assert str(error.value).startswith("DJI_202505021412_007_Timestamp.MRK: ")


def test_renamed_photos_are_matched_by_order(exposures: Exposures) -> None:
    """As many photos as exposures are matched by order if places and times agree."""
    track = with_exposures(photos(), ["a.JPG", "b.JPG", "c.JPG", "d.JPG"], [exposures])
    np.testing.assert_array_equal(track.lat_lon_deg, exposures.lat_lon_deg)


def test_post_processed_photos_keep_their_positions(exposures: Exposures) -> None:
    """Photos that state better positions than the file keep all of their own, with a note."""
    own = photos(sigma_m=np.full((4, 3), 0.003))
    track = with_exposures(own, NAMES, [exposures])
    np.testing.assert_array_equal(track.lat_lon_deg, own.lat_lon_deg)
    assert track.abs_reference is HeightReference.UNKNOWN
    assert "not used, as the photos state more accurate positions" in track.notes[-1]


def test_numbers_of_two_flights_are_told_apart(tmp_path: Path, exposures: Exposures) -> None:
    """With two flights in a folder, each photo gets the exposure of its number that is near it."""
    far = read_mrk(write(tmp_path / "b.MRK", lat=LAT + 0.01))
    track = with_exposures(photos(), NAMES, [far, exposures])
    np.testing.assert_array_equal(track.lat_lon_deg, exposures.lat_lon_deg)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no exposure"),
        ("garbage\n", "a.MRK:1: is not an exposure of DJI"),
        (LINE.format(number=1, second=9e5, lat=51.0, flag=50), "a.MRK:1: states no position or time"),
        (LINE.format(number=1, second=5.0, lat=151.0, flag=50), "a.MRK:1: states no position or time"),
    ],
)  # fmt: skip
def test_damaged_files_are_refused_by_line(tmp_path: Path, text: str, message: str) -> None:
    """A line that is no exposure is refused with its number."""
    (tmp_path / "a.MRK").write_text(text)
    with pytest.raises(InputError, match=message):
        read_mrk(tmp_path / "a.MRK")
