"""EXIF and XMP of photos: real ones, synthetic ones with known tags, and damaged ones."""

from __future__ import annotations

import contextlib
import io
import math
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import piexif
import pytest
from PIL import Image, PngImagePlugin

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.telemetry.exif import PhotoMetadata, read_photo, telemetry_from_photos
from spn_data.telemetry.track import summarize

NAN = float("nan")
XMP = (
    "<x:xmpmeta xmlns:x='adobe:ns:meta/'><rdf:RDF "
    "xmlns:rdf='http://www.w3.org/1999/02/22-rdf-syntax-ns#'>"
    "<rdf:Description xmlns:d='http://www.dji.com/drone-dji/1.0/' {}/></rdf:RDF></x:xmpmeta>"
)
GPS = {
    piexif.GPSIFD.GPSLatitudeRef: "S",
    piexif.GPSIFD.GPSLatitude: ((33, 1), (30, 1), (36, 1)),  # 33.51
    piexif.GPSIFD.GPSLongitudeRef: "W",
    piexif.GPSIFD.GPSLongitude: ((70, 1), (15, 1), (3600, 100)),  # 70.26
    piexif.GPSIFD.GPSAltitudeRef: 0,
    piexif.GPSIFD.GPSAltitude: (1234, 10),
}


def jpeg(path, *, gps=None, exif=None, main=None, xmp=None, size=(40, 30)):
    tags = {"0th": main or {}, "Exif": exif or {}, "GPS": GPS if gps is None else gps}
    more = (
        {} if xmp is None else {"xmp": xmp if isinstance(xmp, bytes) else XMP.format(xmp).encode()}
    )
    Image.new("RGB", size).save(path, "JPEG", exif=piexif.dump(tags), **more)
    return path


def test_real_photo_of_the_first_pass(shared_data):
    """A DJI photo without XMP gives its position, lens and the negative altitude unchanged."""
    photo = read_photo(shared_data / "photos-two-passes" / "DJI_0054.JPG")
    assert (photo.width, photo.height, photo.orientation) == (800, 600, 1)
    assert (photo.make, photo.model) == ("DJI", "FC300S")  # padded with zero bytes in the file
    assert (photo.focal_mm, photo.focal_35mm) == (3.61, 20.0)
    assert photo.lat_deg == pytest.approx(28 + 2 / 60 + 28.5116 / 3600, abs=1e-12)
    assert photo.lon_deg == pytest.approx(-(82 + 41 / 60 + 54.5072 / 3600), abs=1e-12)
    assert photo.altitude_m == -5.677
    assert photo.local_s == 1525003606.0  # 2018-04-29 12:06:46 as if it were UTC
    assert math.isnan(photo.utc_s)
    assert math.isnan(photo.relative_altitude_m)
    assert photo.notes == ()


def test_real_photo_with_xmp(shared_data):
    """DJI's XMP gives height above take-off and the gimbal angles, here straight down."""
    photo = read_photo(shared_data / "photos-dji-xmp" / "DJI_0018.JPG")
    assert photo.relative_altitude_m == 39.8
    assert photo.gimbal_deg == (45.0, -89.9, 0.0)
    assert photo.altitude_m == pytest.approx(198.309, abs=1e-3)
    assert photo.altitude_reference is HeightReference.UNKNOWN


def test_two_passes_are_one_track_with_a_pause(shared_data):
    """All 172 photos have a fix, and the pause between the passes is the only gap."""
    paths = sorted((shared_data / "photos-two-passes").glob("*.JPG"))
    t = telemetry_from_photos([read_photo(path) for path in paths], source="photos")
    summary = summarize(t)
    assert (summary.records, summary.with_fix, summary.gaps) == (172, 172, ((494.0, 766.0),))
    assert t.time_s[0] == 0.0
    assert t.utc_is_local
    assert t.abs_reference is HeightReference.UNKNOWN
    assert (t.abs_alt_m.min(), t.abs_alt_m.max()) == (-6.886, -5.277)
    assert any("-6.9 m, below sea level" in note for note in t.notes)


def test_hemispheres_and_clock_with_zone(tmp_path):
    """South and west are negative, an offset tag gives UTC, and fractions of a second are kept."""
    exif = {
        piexif.ExifIFD.DateTimeOriginal: "2024:05:01 12:00:00",
        piexif.ExifIFD.SubSecTimeOriginal: "250",
        piexif.ExifIFD.OffsetTimeOriginal: "+02:00",
    }
    photo = read_photo(jpeg(tmp_path / "a.jpg", exif=exif))
    assert (photo.lat_deg, photo.lon_deg) == pytest.approx((-33.51, -70.26), abs=1e-9)
    assert photo.local_s == 1714564800.25
    assert photo.utc_s == 1714564800.25 - 7200
    assert photo.altitude_m == 123.4
    t = telemetry_from_photos([photo])
    assert not t.utc_is_local
    assert t.utc_s[0] == photo.utc_s


@pytest.mark.parametrize(
    ("code", "altitude_m", "reference"),
    [
        (0, 123.4, HeightReference.UNKNOWN),
        (1, -123.4, HeightReference.UNKNOWN),
        (2, 123.4, HeightReference.AMSL),
        (3, -123.4, HeightReference.AMSL),
    ],
)
def test_altitude_reference(tmp_path, code, altitude_m, reference):
    """Odd codes are below zero; only the codes added in EXIF 3 certainly mean sea level."""
    photo = read_photo(jpeg(tmp_path / "a.jpg", gps=GPS | {piexif.GPSIFD.GPSAltitudeRef: code}))
    assert (photo.altitude_m, photo.altitude_reference) == (altitude_m, reference)


@pytest.mark.parametrize(
    ("gps", "xmp", "sigma_m"),
    [
        ({}, "d:RtkFlag='50' d:RtkStdLon='0.012' d:RtkStdLat='0.014' d:RtkStdHgt='0.025'",
         (0.012, 0.014, 0.025)),
        ({}, "d:RtkFlag='0' d:RtkStdLon='0.012' d:RtkStdLat='0.014' d:RtkStdHgt='0.025'", (NAN, NAN, NAN)),
        ({}, "d:RtkStdLon='0.0' d:RtkStdLat='0.014' d:RtkStdHgt='0.025'", (NAN, NAN, NAN)),
        ({}, "xmlns:c='http://pix4d.com/camera/1.0' c:GPSXYAccuracy='0.5' c:GPSZAccuracy='0.9'",
         (0.5, 0.5, 0.9)),
        ({piexif.GPSIFD.GPSHPositioningError: (15, 10)}, "", (1.5, 1.5, NAN)),
        ({piexif.GPSIFD.GPSDOP: (2, 1), piexif.GPSIFD.GPSMeasureMode: "2"}, "", (2.8284, 2.8284, 4.2426)),
        ({piexif.GPSIFD.GPSDOP: (2, 1), piexif.GPSIFD.GPSMeasureMode: "3"}, "", (1.9403, 1.9403, 2.9104)),
        ({}, "", (NAN, NAN, NAN)),
    ],
)  # fmt: skip
def test_stated_accuracy(tmp_path, gps, xmp, sigma_m):
    """RTK deviations, accuracies and dilutions (2 m range error) become sigma; unstated values stay NaN."""
    photo = read_photo(jpeg(tmp_path / "a.jpg", gps=GPS | gps, xmp=xmp))
    np.testing.assert_allclose(photo.sigma_m, sigma_m, rtol=1e-4, equal_nan=True)


def test_xmp_position_serves_where_exif_has_none(tmp_path):
    """XMP's position, even under its misspelt name, is used only if EXIF has none."""
    xmp = "d:GpsLatitude='-33.5' d:GpsLongtitude='+70.5' d:AbsoluteAltitude='+88.5' d:AltitudeType='RtkAlt'"
    photo = read_photo(jpeg(tmp_path / "a.jpg", gps={}, xmp=xmp))
    assert (photo.lat_deg, photo.lon_deg, photo.altitude_m) == (-33.5, 70.5, 88.5)
    assert photo.altitude_reference is HeightReference.ELLIPSOID
    assert read_photo(jpeg(tmp_path / "b.jpg", xmp=xmp)).lat_deg == pytest.approx(-33.51, abs=1e-9)


@pytest.mark.parametrize(
    ("kind", "absolute", "reference", "height_m"),
    [
        ("RtkAlt", "+123.40", HeightReference.ELLIPSOID, 123.4),
        ("RtkAlt", "+80.00", HeightReference.UNKNOWN, 123.4),  # a program rewrote the EXIF altitude
        ("GpsFusionAlt", "+123.40", HeightReference.UNKNOWN, 123.4),
    ],
)
def test_rtk_heights_are_above_the_ellipsoid(tmp_path, kind, absolute, reference, height_m):
    """Only an altitude of DJI's type RtkAlt that EXIF repeats is above the ellipsoid; others are unknown."""
    xmp = f"d:AbsoluteAltitude='{absolute}' d:AltitudeType='{kind}'"
    found = read_photo(jpeg(tmp_path / "a.jpg", xmp=xmp))
    assert (found.altitude_m, found.altitude_reference) == (height_m, reference)
    said = any(f"of type {kind} (DJI)" in note for note in telemetry_from_photos([found]).notes)
    assert said == (reference is HeightReference.UNKNOWN)


def test_a_fix_that_is_called_invalid_is_none(tmp_path):
    """A position that DJI marks as Invalid is left out with a note; RTK states are counted."""
    invalid = read_photo(jpeg(tmp_path / "a.jpg", xmp="d:GpsStatus='Invalid' d:RtkFlag='0'"))
    assert math.isnan(invalid.lat_deg)
    assert invalid.notes == ("GpsStatus is Invalid, so its position is left out",)
    fixed = read_photo(jpeg(tmp_path / "b.jpg", xmp="d:GpsStatus='RTK' d:RtkFlag='50'"))
    notes = telemetry_from_photos([fixed, fixed, invalid]).notes
    assert "RTK: 2 fixed, 1 single or none" in notes


OTHER_MAKERS = """<x:xmpmeta xmlns:x='adobe:ns:meta/'><r:RDF
 xmlns:r='http://www.w3.org/1999/02/22-rdf-syntax-ns#'><r:Description
 xmlns:p='http://www.parrot.com/drone-parrot/1.0/' xmlns:c='http://pix4d.com/camera/1.0/'
 xmlns:s='https://www.skydio.com/drone-skydio/1.0/'>{}</r:Description></r:RDF></x:xmpmeta>"""


@pytest.mark.parametrize(
    ("body", "gimbal", "sigma"),
    [
        (
            "<p:CameraYawDegree>-176.5</p:CameraYawDegree><p:CameraPitchDegree>-78.25</p:CameraPitchDegree>"
            "<p:CameraRollDegree>-0.5</p:CameraRollDegree><c:Pitch>11</c:Pitch>"
            "<c:GPSXYAccuracy>5/2</c:GPSXYAccuracy><c:GPSZAccuracy>4.5</c:GPSZAccuracy>",
            (183.5, -78.25, -0.5),
            (2.5, 2.5, 4.5),
        ),
        (
            "<s:VehicleOrientationNED r:parseType='Resource'><s:Yaw>1</s:Yaw></s:VehicleOrientationNED>"
            "<s:CameraOrientationNED r:parseType='Resource'><s:Roll>0.25</s:Roll><s:Pitch>-84</s:Pitch>"
            "<s:Yaw>146.5</s:Yaw></s:CameraOrientationNED>",
            (146.5, -84, 0.25),
            (NAN, NAN, NAN),
        ),
        (
            "<s:CameraOrientationNED><r:Description s:Roll='0.25' s:Pitch='-84' s:Yaw='146.5'/>"
            "</s:CameraOrientationNED>",
            (146.5, -84, 0.25),
            (NAN, NAN, NAN),
        ),
    ],
)
def test_xmp_of_other_makers(tmp_path, body, gimbal, sigma):
    """Parrot's and Skydio's camera angles and accuracies are read, structures in both XML forms."""
    found = read_photo(jpeg(tmp_path / "a.jpg", xmp=OTHER_MAKERS.format(body).encode()))
    assert found.gimbal_deg == gimbal
    np.testing.assert_array_equal(found.sigma_m, sigma)
    assert found.notes == ()


def test_angles_of_an_unknown_convention_are_left_out(tmp_path):
    """Camera:Pitch alone gives no angles, with a note, because makers count it from different directions."""
    body = "<c:Yaw>10</c:Yaw><c:Pitch>1</c:Pitch><c:Roll>2</c:Roll>"
    found = read_photo(jpeg(tmp_path / "a.jpg", xmp=OTHER_MAKERS.format(body).encode()))
    assert np.isnan(found.gimbal_deg).all()
    assert "Camera:Pitch is left out" in found.notes[0]


def test_skydio_states_its_position(tmp_path):
    """Skydio's own latitude, longitude and altitude serve where EXIF has none."""
    body = (
        "<s:Latitude>48.5</s:Latitude><s:Longitude>-11.5</s:Longitude>"
        "<s:AbsoluteAltitude>512.5</s:AbsoluteAltitude>"
    )
    found = read_photo(jpeg(tmp_path / "a.jpg", gps={}, xmp=OTHER_MAKERS.format(body).encode()))
    assert (found.lat_deg, found.lon_deg, found.altitude_m) == (48.5, -11.5, 512.5)
    assert found.altitude_reference is HeightReference.UNKNOWN


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_other_formats_carry_the_same_tags(tmp_path, suffix):
    """PNG and TIFF give position and XMP like JPEG."""
    path = tmp_path / f"a.{suffix}"
    image = Image.new("RGB", (40, 30))
    exif = Image.Exif()
    exif.load(piexif.dump({"GPS": GPS}))
    xmp = XMP.format("d:RelativeAltitude='+39.80'")
    if suffix == "png":
        info = PngImagePlugin.PngInfo()
        info.add_itxt("XML:com.adobe.xmp", xmp)
        image.save(path, exif=exif, pnginfo=info)
    else:
        exif[700] = xmp.encode()
        image.save(path, exif=exif)
    photo = read_photo(path)
    assert (photo.lat_deg, photo.lon_deg) == pytest.approx((-33.51, -70.26), abs=1e-9)
    assert photo.relative_altitude_m == 39.8


def photo(name, **values) -> PhotoMetadata:
    return PhotoMetadata(Path(name), 10, 10, **values)


@pytest.mark.parametrize(
    ("times", "expected", "words"),
    [
        ([10.0, 10.0, 12.5], [0.0, 0.0, 2.5], ""),
        ([10.0, NAN, 12.0], [0.0, 1.0, 2.0], "1 photos have no time, the first is b.jpg"),
        ([10.0, 14.0, 12.0], [0.0, 1.0, 2.0], "c.jpg is older than the photo before it"),
    ],
)
def test_photo_times(times, expected, words):
    """Times count from the first photo; missing or decreasing ones are replaced, with a note."""
    photos = [photo(n, local_s=t) for n, t in zip(("a.jpg", "b.jpg", "c.jpg"), times, strict=True)]
    t = telemetry_from_photos(photos)
    np.testing.assert_allclose(t.time_s, expected)
    assert [words in note for note in t.notes] == ([True] if words else [])


def test_no_photos_are_no_records():
    """No photos give telemetry without records."""
    assert len(telemetry_from_photos([])) == 0


def test_mixed_references_are_unknown():
    """Photos whose altitudes have different references have no common reference."""
    both = [
        photo("a", altitude_m=1.0, altitude_reference=HeightReference.AMSL),
        photo("b", altitude_m=1.0),
    ]
    assert telemetry_from_photos(both).abs_reference is HeightReference.UNKNOWN
    assert telemetry_from_photos(both[:1] * 2).abs_reference is HeightReference.AMSL


@pytest.mark.parametrize(
    ("gps", "xmp", "words"),
    [
        ({}, b"<x:xmpmeta", "damaged XMP"),
        ({}, b"<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>", "damaged XMP"),
        ({piexif.GPSIFD.GPSLatitude: ((99, 1), (0, 1), (0, 1))}, None, "not a position on Earth"),
        ({piexif.GPSIFD.GPSLatitude: ((9, 0), (0, 1), (0, 1))}, None, ""),
        ({piexif.GPSIFD.GPSLatitudeRef: "?"}, None, ""),
        ({piexif.GPSIFD.GPSLatitude: ((9, 1), (400, 1), (0, 1))}, None, ""),
        ({piexif.GPSIFD.GPSLatitude: ((0, 1),) * 3, piexif.GPSIFD.GPSLongitude: ((0, 1),) * 3}, None, ""),
    ],
)  # fmt: skip
def test_damaged_metadata_is_left_out(tmp_path, gps, xmp, words):
    """Damaged tags give no invented value, and the photo is still used."""
    found = read_photo(jpeg(tmp_path / "a.jpg", gps=GPS | gps, xmp=xmp))
    assert found.width == 40
    assert math.isnan(found.lat_deg) == bool(gps)
    assert [words in note for note in found.notes] == ([True] if words else [])
    together = telemetry_from_photos([found, found], ["x", "y"]).notes
    assert any("damaged metadata: 2, the first is x: " in note for note in together) == bool(words)


def test_unset_clock_and_strange_orientation(tmp_path):
    """A clock that was never set gives no time, and an invalid orientation is read as 1."""
    exif = {piexif.ExifIFD.DateTimeOriginal: "0000:00:00 00:00:00"}
    found = read_photo(jpeg(tmp_path / "a.jpg", exif=exif, main={piexif.ImageIFD.Orientation: 77}))
    assert math.isnan(found.local_s)
    assert found.orientation == 1
    turned = jpeg(tmp_path / "b.jpg", main={piexif.ImageIFD.Orientation: 6})
    assert (read_photo(turned).orientation, read_photo(turned).width) == (6, 40)


def test_what_is_no_photo_is_refused(tmp_path):
    """Text under a photo's name, an empty file and a missing one each give one line with the path."""
    (tmp_path / "a.jpg").write_text("no photo")
    (tmp_path / "b.jpg").write_bytes(b"")
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        with pytest.raises(InputError, match=f"{name}: cannot be read as a photo") as error:
            read_photo(tmp_path / name)
        assert "\n" not in str(error.value)


def test_every_cut_and_flip_of_a_photo_is_survived(tmp_path, shared_data):
    """A truncated photo or one with damaged bytes is read or refused without crashing the reader."""
    whole = (shared_data / "photos-dji-xmp" / "DJI_0018.JPG").read_bytes()[:30_000]
    rng = np.random.default_rng(3)
    path = tmp_path / "a.jpg"
    read = 0
    for trial in range(150):
        data = bytearray(whole[: int(rng.integers(1, len(whole)))] if trial % 3 == 0 else whole)
        for position in rng.integers(0, min(len(data), 5000), 30 if trial % 3 else 0):
            data[position] = int(rng.integers(256))
        path.write_bytes(bytes(data))
        with contextlib.suppress(InputError):
            read_photo(path)
            read += 1
    assert read > 10


def test_a_large_photo_is_not_decoded(tmp_path):
    """A photo of 120 million pixels is read without a warning, from its header alone."""
    buffer = io.BytesIO()
    Image.new("1", (12_000, 10_000)).save(buffer, "PNG")
    (tmp_path / "a.png").write_bytes(buffer.getvalue()[:2000])
    assert read_photo(tmp_path / "a.png").width == 12_000


def test_a_position_without_letters_is_said(tmp_path):
    """Latitude and longitude without N/S and E/W give no position, and a note says what to write."""
    unsigned = {k: v for k, v in GPS.items() if k % 2 == 0 or k > 4}
    photo = read_photo(jpeg(tmp_path / "a.jpg", gps=unsigned))
    assert np.isnan([photo.lat_deg, photo.lon_deg]).all()
    note = telemetry_from_photos([photo]).notes[0]
    assert note.startswith("photos whose position does not say N or S, E or W, and is left out: 1")
    assert "exiftool -GPSLatitudeRef=N" in note
    signed = telemetry_from_photos([read_photo(jpeg(tmp_path / "b.jpg", gps=GPS))])
    assert not any("N or S" in other for other in signed.notes)


@pytest.mark.parametrize(
    ("zone_tag", "stamp", "fix", "utc"),
    [
        (piexif.ExifIFD.OffsetTime, "+02:00", None, 10),
        (None, None, ("2026:05:01", (10, 0, 3)), 10),  # 3 s after the exposure on a clock at UTC+2
        (None, None, ("2026:05:01", (9, 50, 0)), None),  # no zone is 2:10 from UTC
        (None, None, ("2026:04:01", (10, 0, 0)), None),
    ],
)
def test_the_zone_of_the_camera_clock(tmp_path, zone_tag, stamp, fix, utc):
    """UTC is known from any offset tag, or from the time of the fix if it differs by a time zone."""
    exif = {piexif.ExifIFD.DateTimeOriginal: "2026:05:01 12:00:00"}
    if zone_tag:
        exif[zone_tag] = stamp
    gps = {}
    if fix:
        gps = {
            piexif.GPSIFD.GPSDateStamp: fix[0],
            piexif.GPSIFD.GPSTimeStamp: [(n, 1) for n in fix[1]],
        }
    photo = read_photo(jpeg(tmp_path / "a.jpg", exif=exif, gps=gps))
    expected = NAN if utc is None else datetime(2026, 5, 1, utc, tzinfo=UTC).timestamp()
    np.testing.assert_equal(photo.utc_s, expected)


def test_photos_in_another_order_than_their_names_are_said():
    """Photos sorted by time keep their times, and a note names the first out of name order."""
    photos = [photo("DJI_0999.JPG", local_s=10.0), photo("DJI_0001.JPG", local_s=12.0)]
    t = telemetry_from_photos(photos)
    assert t.time_s.tolist() == [0.0, 2.0]
    assert any("not of their names, from DJI_0999.JPG on" in note for note in t.notes)


def test_gimbal_angles_of_zero_in_all_photos_are_left_out():
    """Gimbal angles that are exactly zero in all photos are dropped with a note."""
    photos = [photo(f"{i}.jpg", local_s=float(i), gimbal_deg=(0.0, 0.0, 0.0)) for i in range(3)]
    t = telemetry_from_photos(photos)
    assert np.isnan(t.gimbal_deg).all()
    assert any("all gimbal angles are exactly 0" in note for note in t.notes)
