"""GPX tracks, CSV logs, subtitle tracks in videos, and the choice of the reader."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.telemetry.accuracy import sigma_from_dop
from spn_data.telemetry.csv_log import read_csv_log
from spn_data.telemetry.dji_srt import read_dji_srt
from spn_data.telemetry.gpx import read_gpx
from spn_data.telemetry.read import read_telemetry
from spn_data.telemetry.subtitles import read_subtitles

NAN = np.nan
UTC_S = 1714564800.0  # 2024-05-01 12:00:00 UTC


def write(tmp_path, text, name="log.csv"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def gpx(*points, version="1/1", extra=""):
    segments = "</trkseg><trkseg>".join(points)
    return (
        f"<?xml version='1.0' encoding='UTF-8'?><gpx xmlns='http://www.topografix.com/GPX/{version}'>"
        f"{extra}<trk><trkseg>{segments}</trkseg></trk></gpx>"
    )


def point(second, lat="-33.5", lon="-70.25", more=""):
    return f"<trkpt lat='{lat}' lon='{lon}'>{more}<time>2024-05-01T12:00:{second}Z</time></trkpt>"


def test_dilutions_become_standard_deviations():
    """Sigma is dilution times a 2 m range error, over two axes, or three with a vertical factor of 1.5."""
    np.testing.assert_allclose(sigma_from_dop(hdop=1.0, vdop=1.2), (2**0.5, 2**0.5, 2.4))
    east, north, up = sigma_from_dop(pdop=1.7)
    assert up == pytest.approx(1.5 * east)
    assert np.hypot(np.hypot(east, north), up) == pytest.approx(2.0 * 1.7)
    assert np.isnan(sigma_from_dop(hdop=0.0)).all()


@pytest.mark.parametrize("version", ["1/0", "1/1"])
def test_gpx_of_several_segments(tmp_path, version):
    """Points of all segments count, in the southern and western hemisphere, with UTC and accuracy."""
    more = "<ele>512.5</ele><hdop>0.7</hdop><vdop>1.1</vdop>"
    text = gpx(point("00"), point("01.5", "-33.6", more=more), version=version)
    t = read_gpx(write(tmp_path, text, "a.gpx"))
    np.testing.assert_allclose(t.time_s, [0.0, 1.5])
    np.testing.assert_allclose(t.utc_s, [UTC_S, UTC_S + 1.5])
    np.testing.assert_allclose(t.lat_lon_deg, [(-33.5, -70.25), (-33.6, -70.25)])
    np.testing.assert_allclose(t.abs_alt_m, [NAN, 512.5])
    np.testing.assert_allclose(t.sigma_m[1], (0.98995, 0.98995, 2.2), rtol=1e-5)
    assert np.isnan(t.sigma_m[0]).all()
    assert t.abs_reference is HeightReference.UNKNOWN
    assert not t.utc_is_local
    assert any("offset to the video must be given" in note for note in t.notes)


def test_gpx_with_geoid_heights_is_above_sea_level(tmp_path):
    """If each point also states the geoid height, `ele` is above mean sea level."""
    more = "<ele>80.0</ele><geoidheight>47.5</geoidheight>"
    t = read_gpx(write(tmp_path, gpx(point("00", more=more), point("01", more=more)), "a.gpx"))
    assert t.abs_reference is HeightReference.AMSL


def test_gpx_out_of_order_and_with_damaged_points(tmp_path):
    """Points are sorted by time; duplicates in time and damaged points are dropped and counted."""
    bad = (
        "<trkpt lat='x' lon='1'><time>2024-05-01T12:00:09Z</time></trkpt>",
        "<trkpt lat='1' lon='1'/>",
    )
    t = read_gpx(write(tmp_path, gpx(point("02"), point("01"), point("01"), *bad), "a.gpx"))
    np.testing.assert_allclose(t.time_s, [0.0, 1.0])
    assert any("were sorted" in note for note in t.notes)
    assert any("duplicate time: 1" in note for note in t.notes)
    assert any("points left out: 2, the first is number 4: lat is 'x'" in note for note in t.notes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "a.gpx: the file is empty"),
        ("<gpx><trk>", "a.gpx:1: is not valid XML"),
        ("\n\n<gpx>\n<trk", "a.gpx:4: is not valid XML"),
        ("<kml/>", "a.gpx: is XML but not GPX: its root element is <kml>"),
        (gpx(extra="<wpt lat='1' lon='2'/>"), "a.gpx: contains no track points .*only wpt"),
        (gpx("<trkpt lat='1' lon='1'/>"), "a.gpx: none of its 1 track points is usable: .*no time"),
        (gpx(point("99")), "a.gpx: none of its 1 .*is not a time like"),
        (gpx(point("00", lat="91")), "a.gpx: none of its 1 .*not a position on Earth"),
        ("<!DOCTYPE g [<!ENTITY a 'b'>]><gpx>&a;</gpx>", "a.gpx: its XML is refused"),
    ],
)
def test_unusable_gpx_is_refused(tmp_path, text, message):
    """Malformed, foreign, empty and hostile XML each give one line with the path and the reason."""
    with pytest.raises(InputError, match=message) as error:
        read_gpx(write(tmp_path, text, "a.gpx"))
    assert "\n" not in str(error.value)


def test_csv_of_our_own_names(tmp_path):
    """All columns are read by their plain names, with a height reference and accuracies."""
    text = (
        "time_s,lat,lon,rel_alt_m,abs_alt_m,alt_reference,gimbal_heading,gimbal_pitch,gimbal_roll,"
        "sigma_e,sigma_n,sigma_u\n"
        "0.0,-33.5,-70.25,10.5,560.5,ellipsoid,-10,-45.5,0.5,0.02,0.03,0.05\n"
        "0.1,-33.6,-70.25,10.6,560.6,ellipsoid,350,-45.5,0.5,0,0,0\n"
    )
    t = read_csv_log(write(tmp_path, text))
    np.testing.assert_allclose(t.time_s, [0.0, 0.1])
    np.testing.assert_allclose(t.lat_lon_deg, [(-33.5, -70.25), (-33.6, -70.25)])
    np.testing.assert_allclose(t.rel_alt_m, [10.5, 10.6])
    np.testing.assert_allclose(t.abs_alt_m, [560.5, 560.6])
    np.testing.assert_allclose(t.gimbal_deg, [(350.0, -45.5, 0.5)] * 2)
    np.testing.assert_allclose(t.sigma_m, [(0.02, 0.03, 0.05), (NAN, NAN, NAN)])
    assert t.abs_reference is HeightReference.ELLIPSOID
    assert np.isnan(t.utc_s).all()


def test_csv_of_airdata(tmp_path):
    """Airdata's export has milliseconds, feet, UTC dates, its own names and recording marks."""
    text = (
        "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),"
        "altitude_above_seaLevel(feet),speed(mph),isVideo, compass_heading(degrees),"
        "gimbal_heading(degrees),gimbal_pitch(degrees),altitude(feet),flycState,message\n"
        "0,2024-05-01 12:00:00,0,0,0,100,3,0,90,5,-90,1,Motors,\n"
        "100,2024-05-01 12:00:00,40.5,-3.25,100,200,3,1,90,6,-89,1,P-GPS,\n"
        '200,2024-05-01 12:00:01,40.5,-3.25,101,201,3,1,90,7,-88,1,P-GPS,"one, two"\n'
    )
    t = read_csv_log(write(tmp_path, text))
    np.testing.assert_allclose(t.time_s, [0.0, 0.1, 0.2])
    np.testing.assert_array_equal(t.has_fix, [False, True, True])
    np.testing.assert_allclose(t.rel_alt_m, [0.0, 30.48, 30.7848])
    np.testing.assert_allclose(t.abs_alt_m, [30.48, 60.96, 61.2648])
    assert t.abs_reference is HeightReference.AMSL
    np.testing.assert_allclose(t.gimbal_deg[:, 0], [5, 6, 7])
    np.testing.assert_allclose(t.gimbal_deg[:, 1], [-90, -89, -88])
    np.testing.assert_allclose(t.utc_s, [UTC_S, UTC_S, UTC_S + 1])
    assert not t.utc_is_local
    assert any("not of the video" in note for note in t.notes)
    assert any("isVideo column: 1, starting at 0.1 s" in note for note in t.notes)


@pytest.mark.parametrize(
    ("header", "cells", "time_s", "utc_s", "is_local"),
    [
        ("datetime", ("2024-05-01 12:00:00", "2024-05-01T12:00:02.5"), 2.5, UTC_S, True),
        ("datetime(utc)", ("2024-05-01 12:00:00", "2024/05/01 12:00:02"), 2.0, UTC_S, False),
        ("datetime", ("2024-05-01 14:00:00+02:00", "2024-05-01T12:00:01Z"), 1.0, UTC_S, False),
        ("timestamp", ("1714564800", "1714564800.5"), 0.5, UTC_S, False),
        ("timestamp", ("1714564800000", "1714564800500"), 0.5, UTC_S, False),
        ("Time", ("1714564800000000", "1714564800500000"), 0.5, UTC_S, False),
        ("timestamp_ms", ("1714564800000", "1714564800500"), 0.5, UTC_S, False),
        ("time_ms", ("1000", "1500"), 1.5, NAN, False),
        ("time(us)", ("1000000", "1500000"), 1.5, NAN, False),
        ("t", ("1", "1.5"), 1.5, NAN, False),
        ("timestamp_us", ("1000000", "1500000"), 1.5, NAN, False),
    ],
)
def test_csv_clocks(tmp_path, header, cells, time_s, utc_s, is_local):
    """Dates and Unix times of any unit count from the first row; seconds of flight stay as they are."""
    text = f"{header},lat,lng\n{cells[0]},1,2\n{cells[1]},1,2\n"
    t = read_csv_log(write(tmp_path, text))
    assert t.time_s[1] == pytest.approx(time_s, abs=1e-6)
    np.testing.assert_allclose(t.utc_s[0], utc_s, equal_nan=True)
    assert t.utc_is_local == is_local
    assert any("its times are dates" in note for note in t.notes) == bool(np.isfinite(utc_s))


@pytest.mark.parametrize(
    ("columns", "row", "rel_alt_m", "abs_alt_m", "reference"),
    [
        ("alt_ellipsoid_m,altitude", "90.5,40", NAN, 90.5, HeightReference.ELLIPSOID),
        ("alt_amsl_ft", "1000", NAN, 304.8, HeightReference.AMSL),
        ("altitude", "40", NAN, 40.0, HeightReference.UNKNOWN),
        ("altitude,alt_reference", "40,takeoff", 40.0, NAN, HeightReference.UNKNOWN),
        ("altitude,alt_reference", "40,AMSL", NAN, 40.0, HeightReference.AMSL),
        ("rel_alt [ft]", "10", 3.048, NAN, HeightReference.UNKNOWN),
    ],
)
def test_csv_heights(tmp_path, columns, row, rel_alt_m, abs_alt_m, reference):
    """The height reference comes from the column name or an alt_reference column, or is unknown."""
    t = read_csv_log(write(tmp_path, f"time_s,lat,lon,{columns}\n0,1,2,{row}\n"))
    np.testing.assert_allclose(t.rel_alt_m, [rel_alt_m], equal_nan=True)
    np.testing.assert_allclose(t.abs_alt_m, [abs_alt_m], equal_nan=True)
    assert t.abs_reference is reference


@pytest.mark.parametrize(
    ("column", "cell", "sigma_m"),
    [
        ("accuracy(m)", "1.5", (1.5, 1.5, NAN)),
        ("accuracy,v_accuracy", "1.5,3", (1.5, 1.5, 3.0)),
        ("hdop,vdop", "1,1.2", (2**0.5, 2**0.5, 2.4)),
    ],
)
def test_csv_accuracy(tmp_path, column, cell, sigma_m):
    """Accuracies are taken as sigma of each axis, and dilutions are scaled by the range error."""
    t = read_csv_log(write(tmp_path, f"time_s,lat,lon,{column}\n0,1,2,{cell}\n"))
    np.testing.assert_allclose(t.sigma_m[0], sigma_m, equal_nan=True)


def test_csv_of_a_spreadsheet(tmp_path):
    """Semicolons, decimal commas, a "sep=" line, comments, BOM, CRLF and quotes read like plain CSV."""
    text = (
        '\ufeffsep=;\r\n# a log\r\n"time_s";"lat";"lon"\r\n0,5;50,25;8,5\r\n\r\n1,5;50,26;8,5\r\n'
    )
    path = tmp_path / "log.csv"
    path.write_bytes(text.encode())
    t = read_csv_log(path)
    np.testing.assert_allclose(t.time_s, [0.5, 1.5])
    np.testing.assert_allclose(t.lat_lon_deg, [(50.25, 8.5), (50.26, 8.5)])


def test_csv_with_few_damaged_rows(tmp_path):
    """Up to 5 % damaged rows are dropped and counted; rows are sorted by time."""
    rows = [f"{i},50.0,8.0" for i in range(60)]
    rows[10], rows[20], rows[30] = "10,abc,8.0", "20,50.0", "15.5,50.0,8.0"
    t = read_csv_log(write(tmp_path, "time_s,lat,lon\n" + "\n".join(rows)))
    assert len(t) == 58
    assert np.all(np.diff(t.time_s) > 0)
    assert any("rows left out: 2, the first at line 12: lat is 'abc'" in note for note in t.notes)
    assert any("were sorted" in note for note in t.notes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "log.csv: the file is empty"),
        ("# only a comment\n", "log.csv: the file is empty"),
        ("time_s,lat,lon\n", "log.csv:1: has a header but no rows"),
        ("time_s,lat\n0,1\n", "log.csv:1: has no column for longitude: found time_s, lat; expected long"),
        ("lat,lon\n0,1\n", "log.csv:1: has no column for time: .*time_s or datetime"),
        ("a,b\n0,1\n", "log.csv:1: has no column for time and latitude and longitude"),
        (",,\n", "log.csv:1: has no column .*found none"),
        ("hello world\n", "log.csv:1: has no column"),
        ("time_s,lat,lon\n0,x,1\n", "log.csv:2: lat is 'x', not a number; 1 of 1 rows"),
        ("time_s,lat,lon\n0,1,1\nnoon,1,1\n", "log.csv:3: time_s is 'noon', neither a number nor a date"),
        ("time_s,lat,lon\n0,inf,1\n", "log.csv:2: lat is 'inf', not a number"),
        ("time_s,lat,lon\n0,91,1\n", "log.csv:2: 91.0, 1.0 is not a position on Earth"),
        ("time_s,lat,lon\n0,1\n", "log.csv:2: 2 cells, but the header has 3"),
        ("time_s,lat,lon\n,1,1\n", "log.csv:2: the row has no time"),
        ("timestamp,lat,lon\n12,1,1\n", "log.csv:2: timestamp is 12, not a date"),
        ("time_s,lat,lon,altitude(furlong)\n0,1,1,1\n", "log.csv:1: unknown unit 'furlong' in column"),
        ("time_s,lat,lon,altitude,alt_reference\n0,1,1,1,moon\n", "log.csv:1: .* references are moon"),
        ('time_s,lat,lon\n"' + "9" * 200_000 + "\n", "log.csv:.: is not valid CSV"),
    ],
)  # fmt: skip
def test_unusable_csv_is_refused(tmp_path, text, message):
    """Each kind of unusable log gives one line with path, line and reason."""
    with pytest.raises(InputError, match=message) as error:
        read_csv_log(write(tmp_path, text))
    assert "\n" not in str(error.value)


def video(path, records, codec, *, first_frame=0, box=b"", title=""):
    """Write a tiny video with a subtitle track of (seconds, text) records; none if `codec` is None."""
    with av.open(str(path), "w") as out:
        out.metadata.update({"title": title} if title else {})
        stream = out.add_stream("mpeg4", rate=10)
        stream.width = stream.height = 64
        stream.pix_fmt = "yuv420p"
        track = None if codec is None else out.add_mux_stream(codec)
        for i in range(3):
            frame = av.VideoFrame.from_ndarray(np.zeros((64, 64, 3), np.uint8), format="rgb24")
            frame.pts = i + first_frame
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
        for seconds, text in records:
            data = text.encode()
            sized = len(data).to_bytes(2, "big") + data + box
            packet = av.Packet(sized if codec == "mov_text" else data)
            packet.stream, packet.time_base = track, Fraction(1, 1000)
            packet.pts = packet.dts = int(seconds * 1000)
            packet.duration = 100
            out.mux(packet)
    return path


KEYED = "[latitude: 50.5] [longitude: -8.25] [rel_alt: {} abs_alt: 160.25]"
RECORDS = [(i / 10, KEYED.format(i)) for i in range(5)]


@pytest.mark.parametrize(("name", "codec"), [("a.mp4", "mov_text"), ("a.mkv", "subrip")])
def test_subtitle_track_of_a_video(tmp_path, name, codec):
    """A track inside a video gives the same values as a subtitle file, on the video's clock."""
    t = read_subtitles(video(tmp_path / name, RECORDS, codec))
    np.testing.assert_allclose(t.time_s, [0.0, 0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(t.lat_lon_deg, [(50.5, -8.25)] * 5)
    np.testing.assert_allclose(t.rel_alt_m, np.arange(5))
    assert t.source.endswith(name)


def test_style_boxes_after_the_text_are_cut_off(tmp_path):
    """The binary data after the text in an MP4 subtitle sample is not read as telemetry."""
    path = video(tmp_path / "a.mp4", RECORDS, "mov_text", box=b"\0\0\0\x20styl [latitude: x]")
    assert len(read_subtitles(path)) == 5


def test_subtitle_track_counts_from_the_first_frame(tmp_path):
    """If the first frame is at 0.5 s in the container, a subtitle at 0.6 s is at 0.1 s."""
    records = [(s + 0.5, text) for s, text in RECORDS]
    t = read_subtitles(video(tmp_path / "a.mkv", records, "subrip", first_frame=5))
    np.testing.assert_allclose(t.time_s, [0.0, 0.1, 0.2, 0.3, 0.4], atol=1e-9)


def test_a_real_file_survives_the_way_through_a_video(tmp_path, shared_data):
    """A real subtitle file put into a video gives the telemetry of the file."""
    source = shared_data / "srt" / "mavic_mini.SRT"
    with av.open(str(source)) as given, av.open(str(tmp_path / "a.mkv"), "w") as out:
        track = out.add_stream_from_template(given.streams.subtitles[0])
        for packet in given.demux(given.streams.subtitles[0]):
            if packet.dts is not None:
                packet.stream = track
                out.mux(packet)
    expected, found = read_dji_srt(source), read_subtitles(tmp_path / "a.mkv")
    np.testing.assert_allclose(found.time_s, expected.time_s)
    np.testing.assert_array_equal(found.lat_lon_deg, expected.lat_lon_deg)
    np.testing.assert_array_equal(found.rel_alt_m, expected.rel_alt_m)


def test_video_without_subtitles_has_none(tmp_path, shared_data):
    """None is returned only if there is no subtitle track."""
    assert read_subtitles(video(tmp_path / "a.mp4", [], None)) is None
    assert read_subtitles(shared_data / "video" / "gopro-karma.mp4") is None


def test_subtitles_of_other_content_are_refused(tmp_path):
    """Subtitles of a film and files that are not videos are refused with the path."""
    path = video(tmp_path / "a.mp4", [(0.0, "Hello"), (1.0, "Bye")], "mov_text")
    with pytest.raises(InputError, match=r"a.mp4: no subtitle record contains drone telemetry"):
        read_subtitles(path)
    for name, data, why in (("b.mp4", b"text", "not a video"), ("c.mp4", b"", "is empty")):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match=f"{name}: .*{why}"):
            read_subtitles(tmp_path / name)
    with pytest.raises(InputError, match=r"d.mp4: can't be read: No such file"):
        read_subtitles(tmp_path / "d.mp4")


def test_a_path_that_looks_like_a_url_is_a_file(tmp_path, monkeypatch):
    """Subtitles are read from the file even if its relative path could be taken for a URL."""
    folder = tmp_path / "http:" / "127.0.0.1:9"
    folder.mkdir(parents=True)
    video(folder / "x.mp4", RECORDS, "mov_text")
    video(tmp_path / "a.mp4", RECORDS, "mov_text").rename(tmp_path / "flight:2.mp4")
    monkeypatch.chdir(tmp_path)
    assert len(read_subtitles(Path("http:/127.0.0.1:9/x.mp4"))) == 5
    assert len(read_subtitles(Path("flight:2.mp4"))) == 5


@pytest.mark.parametrize(
    "text", ["#EXTM3U\n#EXTINF:1,\na.mp4\n", "ffconcat version 1.0\nfile a.mp4\n"]
)
def test_a_playlist_named_as_a_video_is_refused(tmp_path, text):
    """A playlist is not opened for its subtitles because it refers to other files."""
    video(tmp_path / "a.mp4", RECORDS, "mov_text")
    (tmp_path / "b.mp4").write_text(text)
    with pytest.raises(InputError, match=r"b\.mp4: is not a video"):
        read_subtitles(tmp_path / "b.mp4")


def test_metadata_that_is_not_utf8_does_not_matter(tmp_path):
    """Subtitles are read even if the title is in Latin-1."""
    path = video(tmp_path / "a.mkv", RECORDS, "subrip", title="Zuerich")
    path.write_bytes(path.read_bytes().replace(b"Zuerich", b"Z\xfcrich "))
    assert len(read_subtitles(path)) == 5


def test_the_reader_is_chosen_by_name_and_content(tmp_path):
    """The file suffix, in any case, and the content determine the reader."""
    srt = "1\n00:00:00,000 --> 00:00:01,000\n" + KEYED.format(1)
    log = "time_s,lat,lon\n0,1,2\n"
    for name, text, kind in (
        ("a.SRT", srt, "dji-srt"),
        ("b.txt", srt, "dji-srt"),
        ("c.gpx", gpx(point("00")), "gpx"),
        ("d.txt", gpx(point("00")), "gpx"),
        ("e.csv", log, "csv"),
        ("f.TXT", log.replace(",", "\t"), "csv"),
    ):
        assert read_telemetry(write(tmp_path, text, name)).kind == kind
    assert read_telemetry(video(tmp_path / "g.mp4", RECORDS, "mov_text")).kind == "dji-srt"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "a.kml",
            r"a.kml: .kml is not a telemetry format; supported are subtitles of drones \(.srt, .ass\), GPX",
        ),
        ("a", "a: a file without a suffix is not a telemetry format"),
        ("a.csv", "a.csv: cannot be read: No such file"),
    ],
)
def test_unsupported_files_are_refused(tmp_path, name, message):
    """An unsupported file is refused with a list of supported types."""
    with pytest.raises(InputError, match=message):
        read_telemetry(tmp_path / name)


def test_a_video_without_track_is_refused(tmp_path):
    """A video given as telemetry without a subtitle track is refused."""
    with pytest.raises(InputError, match="has no subtitle or data track"):
        read_telemetry(video(tmp_path / "a.mp4", [], None))


PX4 = "timestamp,time_utc_usec,latitude_deg,longitude_deg,altitude_msl_m,eph,epv\n"


def test_csv_of_px4(tmp_path):
    """UTC comes from its own column, not from the microseconds since the start."""
    rows = [
        f"{112574307 + k},{1714564800000000 + k},48.2654,11.6712,500.0,0.9,1.4" for k in (0, 200000)
    ]
    t = read_csv_log(write(tmp_path, PX4 + "\n".join(rows)))
    np.testing.assert_allclose(t.utc_s, [UTC_S, UTC_S + 0.2])
    assert t.abs_reference is HeightReference.AMSL
    np.testing.assert_allclose(t.abs_alt_m, 500.0)
    np.testing.assert_allclose(t.sigma_m[0], (0.9, 0.9, 1.4))


@pytest.mark.parametrize("start", [112574307, 1_200_000_000])  # 112 s, and 20 min after the start
@pytest.mark.parametrize("name", ["timestamp", "time"])
def test_microseconds_since_the_start_are_no_dates(tmp_path, start, name):
    """Steps of 200,000 without a unit are not taken as seconds; with their unit they are read."""
    text = f"{name},lat,lon\n" + "".join(f"{start + 200000 * k},48.2,11.6\n" for k in range(5))
    with pytest.raises(InputError, match=r"time_us"):
        read_csv_log(write(tmp_path, text))
    t = read_csv_log(write(tmp_path, text.replace(name, "time_us", 1)))
    assert t.time_s[-1] - t.time_s[0] == pytest.approx(0.8)
    assert np.isnan(t.utc_s).all()


def test_csv_in_integers(tmp_path):
    """Coordinates in integers of 1e-7 degrees are recognised, and so are heights in millimetres."""
    t = read_csv_log(
        write(
            tmp_path,
            "time_s,lat,lon,alt\n0,482654000,116712000,66814\n1,482654100,116712000,66692\n",
        )
    )
    np.testing.assert_allclose(t.lat_lon_deg[0], (48.2654, 11.6712))
    np.testing.assert_allclose(t.abs_alt_m, [66.814, 66.692])
    assert any("read as 1e-7 degrees" in note for note in t.notes)


def test_of_equal_columns_the_one_that_parses_counts(tmp_path):
    """If several columns have the same meaning, the one that parses is used.

    Cases: time as text before time in seconds, and a flag in words.
    """
    text = (
        "sep=,\nCUSTOM.updateTime [local],OSD.flyTime,OSD.flyTime [s],OSD.latitude,OSD.longitude,"
        "OSD.height [ft],GIMBAL.pitch,GIMBAL.yaw,GIMBAL.yaw [360],CAMERA.isVideo\n"
        "7:05:08.00 PM,0m 0.0s,0.0,48.2,11.6,65.6168,-60.0,-178.0,182.0,\n"
        "7:05:08.10 PM,0m 0.1s,0.1,48.2,11.6,65.6168,-60.0,-178.0,182.0,True\n"
    )
    t = read_csv_log(write(tmp_path, text))
    np.testing.assert_allclose(t.time_s, [0.0, 0.1])
    np.testing.assert_allclose(t.rel_alt_m, 20.0, atol=1e-4)
    np.testing.assert_allclose(t.gimbal_deg[0, :2], (182.0, -60.0))
    assert any("isVideo column: 1, starting at 0.1 s" in note for note in t.notes)
    assert any(
        "updateTime [local] is left out: " in note and "(line 3)" in note for note in t.notes
    )


def test_an_optional_column_never_kills_a_log(tmp_path):
    """A column of words and a single damaged optional value are dropped with a note."""
    rows = [f"{k},48.2,11.6,broken,{'x' if k == 7 else k}.5" for k in range(10)]
    t = read_csv_log(write(tmp_path, "time_s,lat,lon,hdop,rel_alt\n" + "\n".join(rows)))
    assert len(t) == 10
    assert np.flatnonzero(np.isnan(t.rel_alt_m)).tolist() == [7]
    assert any(
        "column hdop is left out: hdop is 'broken', not a number (line 2)" in n for n in t.notes
    )
    assert any("column rel_alt: 1, the first at line 9: rel_alt is 'x.5'" in n for n in t.notes)


@pytest.mark.parametrize(
    ("pitch", "pitch_deg"),
    [(("-600", "-590"), -60.0), (("-60", "-59"), NAN), (("-60.5", "-59.0"), -60.5)],
)
def test_csv_of_litchi(tmp_path, pitch, pitch_deg):
    """Tenths of degrees are recognised by their size, and ambiguous integers are dropped."""
    text = "latitude,longitude,altitude(m),ascent(m),time(millisecond),isTakingVideo,gimbalPitch\n"
    text += "".join(f"48.2,11.6,{20 + k}.0,{20 + k}.0,{100 * k},1,{pitch[k]}\n" for k in range(2))
    t = read_csv_log(write(tmp_path, text))
    np.testing.assert_allclose(t.gimbal_deg[0, 1], pitch_deg, equal_nan=True)
    assert t.rel_alt_m.tolist() == [20.0, 21.0]
    assert np.isnan(t.abs_alt_m).all()  # Litchi's altitude is above take-off as well
    assert any("could be degrees or tenths" in note for note in t.notes) == math.isnan(pitch_deg)


def test_csv_of_flytrex(tmp_path):
    """Ascent is the height above take-off, and altitude has another reference."""
    text = "latitude,longitude,altitude(feet),ascent(feet),time(millisecond),datetime(utc)\n"
    text += "48.2,11.6,1640.42,65.617,334100.0,2016-07-23 22:50:10.000000\n"
    t = read_csv_log(write(tmp_path, text))
    np.testing.assert_allclose((t.rel_alt_m[0], t.abs_alt_m[0]), (20.0, 500.0), atol=1e-3)


@pytest.mark.parametrize(
    ("name", "duration_s"),
    [
        ("07-px4-csv/flight.csv", 13.8),
        ("07-px4-csv/real_sample_log_small.csv", 6.2),
        ("08-flightreader-csv/flight.csv", 13.9),
        ("08-flightreader-csv/txtlog.csv", 13.9),
        ("09-flytrex-litchi-csv/flytrex.csv", 13.8),
        ("09-flytrex-litchi-csv/litchi.csv", 13.9),
    ],
)
def test_logs_of_other_programs(shared_cases, name, duration_s):
    """Exports of other programs that once failed or were misread give the right place and duration."""
    t = read_csv_log(shared_cases / "input" / name)
    assert t.time_s[-1] - t.time_s[0] == pytest.approx(duration_s, abs=0.01)
    np.testing.assert_allclose(t.lat_lon_deg[0], (48.2654, 11.6712), atol=1e-6)
