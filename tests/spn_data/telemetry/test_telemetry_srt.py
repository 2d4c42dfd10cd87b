"""Subtitle files of drones: real ones with their exact values, and damaged ones."""

from __future__ import annotations

import numpy as np
import pytest

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.telemetry.dji_srt import parse_dji_srt, read_dji_srt
from spn_data.telemetry.read import read_telemetry
from spn_data.telemetry.track import summarize

NAN = np.nan

# name: records, fixes, then time_s, lat, lon, rel_alt_m, abs_alt_m of the first and of the last record:
# all copied from the files.
REAL = {
    "mavic_pro.SRT": (
        (468, 468),
        (1.0, -20.2533, 149.0251, 1.9, NAN),
        (468.0, -20.2532, 149.0251, 0.0, NAN),
    ),
    "mavic_pro_buggy.SRT": (
        (546, 530),  # 16 records say GPS(N/A,N/A,...)
        (1.0, 42.4668, -1.2218, 0.0, NAN),
        (546.0, 42.4668, -1.2217, 15.8, NAN),
    ),
    "mavic_mini.SRT": (
        (117, 117),
        (0.0, 48.0771, -121.7458, 200.7, NAN),
        (116.0, 48.0775, -121.7476, 200.8, NAN),
    ),
    "mavic_2pro_new.SRT": (
        (8952, 8952),
        (0.0, -35.080155, -60.286702, NAN, NAN),
        (369.84, -35.077976, -60.314572, NAN, NAN),
    ),
    "mavic_air2.srt": (
        (25, 25),
        (0.0, 41.420684, 2.162162, NAN, 27.3),
        (0.4, 41.420686, 2.162162, NAN, 29.2),
    ),
    "matrice_300.srt": (
        (381, 381),
        (0.0, 36.6146, -6.1120, 0.3, NAN),
        (380.0, 36.6146, -6.1120, 0.0, NAN),
    ),
    "air3S.SRT": (
        (5, 5),
        (0.0, 34.270373, -84.176160, 0.0, 302.208),
        (0.066, 34.270373, -84.176160, 0.0, 302.208),
    ),
    "mini4pro.SRT": ((2, 2), (0.0, 59.0, 18.0, 1.0, 100.0), (0.033, 59.0001, 18.0001, 2.0, 101.0)),
    "neo2_nogps.SRT": (
        (6, 3),  # the first three say 0.000000
        (0.0, NAN, NAN, 0.4, 269.099),
        (0.165, 32.848932, -84.861966, 0.4, 269.099),
    ),
    "broken_incomplete.SRT": (
        (19, 19),
        (1.0, -34.7383, -58.4563, 20.1, NAN),
        (19.0, -34.7383, -58.4563, 7.7, NAN),
    ),
}


@pytest.mark.parametrize("name", REAL)
def test_real_file_gives_its_own_values(shared_data, name):
    """Counts and the first and last record are those in the file."""
    (records, fixes), *ends = REAL[name]
    t = read_dji_srt(shared_data / "srt" / name)
    assert (len(t), int(t.has_fix.sum())) == (records, fixes)
    for index, expected in zip((0, -1), ends, strict=True):
        found = (t.time_s[index], *t.lat_lon_deg[index], t.rel_alt_m[index], t.abs_alt_m[index])
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9, equal_nan=True)
    assert np.all(np.diff(t.time_s) > 0)
    assert t.abs_reference is HeightReference.UNKNOWN
    assert t.utc_is_local
    assert t.kind == "dji-srt"


# 2017-08-05 14:11:51, 2019-09-27 10:28:08,438,904, 2022-06-21 16:06:17 and 2026-05-17 08:28:30.219 as UTC.
@pytest.mark.parametrize(
    ("name", "utc_s"),
    [
        ("mavic_pro.SRT", 1501942311.0),
        ("mavic_2pro_new.SRT", 1569580088.438904),
        ("matrice_300.srt", 1655827577.0),
        ("air3S.SRT", 1779006510.219),
    ],
)
def test_date_stamps_are_read_to_their_last_digit(shared_data, name, utc_s):
    """Each dialect's date stamp becomes seconds, including its milli- and microseconds."""
    assert read_dji_srt(shared_data / "srt" / name).utc_s[0] == pytest.approx(utc_s, abs=2e-6)


def test_lost_fixes_are_a_gap_with_heights(shared_data):
    """Records without a fix keep time and height, and the summary shows the gap."""
    t = read_dji_srt(shared_data / "srt" / "mavic_pro_buggy.SRT")
    assert summarize(t).gaps == ((14.0, 31.0),)
    assert np.isfinite(t.rel_alt_m).all()
    assert t.rel_alt_m[25] == -0.4


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("mavic_pro_buggy.SRT", "read as longitude, latitude"),
        ("matrice_300.srt", "read as latitude, longitude"),
        ("matrice_300.srt", "steps of 11 m"),
        ("mavic_2pro_new.SRT", "changes 9.6 times per second, but there are 24.2 records"),
        ("mavic_2pro_new.SRT", "clock jumps against the video 11 times"),
        ("mavic_air2.srt", "unknown reference"),
        ("broken_incomplete.SRT", "left out: 1, the first at line 116"),
    ],
)
def test_what_a_user_should_know_is_in_the_notes(shared_data, name, words):
    """Guesses, rounding, repeated fixes, joined recordings and lost records get a note."""
    assert any(words in note for note in read_dji_srt(shared_data / "srt" / name).notes)


def test_an_order_that_the_numbers_decide_needs_no_note(shared_data):
    """A longitude beyond 90 degrees settles the order in GPS(a, b, c) without a guess."""
    notes = read_dji_srt(shared_data / "srt" / "mavic_mini.SRT").notes
    assert not any("GPS(a, b, c)" in note for note in notes)


def record(body: str, start: str = "00:00:01,000", count: int = 1) -> str:
    return f"{count}\n{start} --> 00:00:59,000\n{body}\n\n"


def one(body: str):
    return parse_dji_srt(record(body), source="x.srt")


KEYED = "[latitude: 50.5] [longitude: 8.25] [rel_alt: 12.500 abs_alt: 160.250]"
P4_RTK = (
    "F/6.3, SS 60, ISO 100, EV 0, RTK (120.083799, 30.213635, 28), HOME (120.084146, 30.214243, "
    "103.55m), D 75.36m, H 76.19m, H.S 0.30m/s, V.S 0.00m/s, F.PRY (-5.3°, 2.1°, 28.3°), "
    "G.PRY (-40.0°, 0.5°, 28.2°)"
)


@pytest.mark.parametrize(
    ("body", "lat_lon", "rel_alt_m", "gimbal_deg"),
    [
        (KEYED, (50.5, 8.25), 12.5, (NAN, NAN, NAN)),
        (KEYED + " [gb_yaw: -142.5 gb_pitch: -28.7 gb_roll: 0.1]", (50.5, 8.25), 12.5, (217.5, -28.7, 0.1)),
        (
            "[latitude : 40.7] [longtitude : -74.0] [gb_yaw : 45.2] [gb_pitch : -15.3] [gb_roll : 0.1]",
            (40.7, -74.0),
            NAN,
            (45.2, -15.3, 0.1),
        ),
        (P4_RTK, (30.213635, 120.083799), 76.19, (28.2, -40.0, 0.5)),
        ("GPS(39.906217,116.391305,69.800) BAROMETER(91.2) \nHOME(39.9,116.3) D=5.2m H=1.5m",
         (39.906217, 116.391305), 91.2, (NAN, NAN, NAN)),
        ("GPS(39.9,16.4,69.800) BAROMETER:-3.5M", (39.9, 16.4), -3.5, (NAN, NAN, NAN)),
        ("HOME(E: 120.0, S: 20.0)\nGPS(W: 120.5, S: 20.25, 001.01m)", (-20.25, -120.5), NAN, (NAN,) * 3),
        # HOME decides the order although the height is in third place.
        ("HOME(149.0,-20.0)\nGPS(49.5,-20.5,16.5)", (-20.5, 49.5), NAN, (NAN, NAN, NAN)),
        ("[latitude: 0.000000] [longitude: 0.000000] [rel_alt: 1.5 abs_alt: 2.5]",
         (NAN, NAN), 1.5, (NAN, NAN, NAN)),
        ("[latitude: 0.000000] [longitude: 8.5]", (0.0, 8.5), NAN, (NAN, NAN, NAN)),
    ],
)  # fmt: skip
def test_dialect(body, lat_lon, rel_alt_m, gimbal_deg):
    """Every known notation of position, height and gimbal angles is read correctly."""
    t = one(body)
    np.testing.assert_allclose(t.lat_lon_deg[0], lat_lon, atol=1e-12, equal_nan=True)
    np.testing.assert_allclose(t.rel_alt_m[0], rel_alt_m, atol=1e-12, equal_nan=True)
    np.testing.assert_allclose(t.gimbal_deg[0], gimbal_deg, atol=1e-9, equal_nan=True)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_layout_does_not_matter(tmp_path, encoding):
    """BOM, CRLF, blank lines inside a record, a missing end and dots in times change nothing."""
    text = record(KEYED) + record(KEYED.replace("50.5", "50.6"), "00:00:02,500", 2)
    odd = text.replace(" [lon", "\n\n[lon").replace(",500", ".500").rstrip()
    path = tmp_path / "odd.srt"
    path.write_bytes(odd.replace("\n", "\r\n").encode(encoding))
    for t in (parse_dji_srt(text, source="x"), read_dji_srt(path)):
        found = np.column_stack([t.time_s, t.lat_lon_deg, t.rel_alt_m, t.abs_alt_m])
        np.testing.assert_allclose(
            found, [(1.0, 50.5, 8.25, 12.5, 160.25), (2.5, 50.6, 8.25, 12.5, 160.25)]
        )
        assert t.notes == ("the coordinates are rounded to steps of 1112 m",)


def test_lines_are_counted_as_an_editor_counts_them(tmp_path):
    """In a file with CRLF, the line in a message is the one that an editor shows."""
    path = tmp_path / "a.srt"
    path.write_bytes((record(KEYED) + record("GPS(x,1,2)")).replace("\n", "\r\n").encode())
    assert any("the first at line 6: GPS is 'x'" in note for note in read_dji_srt(path).notes)


def times_of(starts):
    text = "".join(
        record(
            f"[latitude: 50.{i:03d}] [longitude: 8.0]", f"00:{int(s // 60):02d}:{s % 60:06.3f}", i
        )
        for i, s in enumerate(starts, 1)
    )
    return parse_dji_srt(text, source="x.srt")


def test_equal_and_stray_times_are_left_out():
    """A record whose time repeats, steps back or jumps far ahead is dropped, not its neighbours."""
    t = times_of([0.0, 1.0, 1.0, 0.9, 2.0, 900.0, 3.0, 4.0])
    np.testing.assert_allclose(t.time_s, [0.0, 1.0, 2.0, 3.0, 4.0])
    assert any("left out: 3, the first at line 10" in note for note in t.notes)


def test_times_that_start_over_end_the_recording():
    """Records of an appended second recording are not mixed into the first."""
    t = times_of([0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
    np.testing.assert_allclose(t.time_s, [0.0, 1.0, 2.0, 3.0])
    assert any("start over at line 18: the 6 records" in note for note in t.notes)


def test_without_subtitle_times_the_date_stamps_count():
    """Records without a '-->' line take their times from date stamps, and the notes say so."""
    text = "".join(
        f"{i}\nHOME(149.0,-20.0) 2017.08.05 14:11:{50 + i}\nGPS(149.0,-20.1,16)\n\n"
        for i in range(3)
    )
    t = parse_dji_srt(text, source="x.srt")
    np.testing.assert_allclose(t.time_s, [0, 1, 2])
    assert any("date stamps" in note for note in t.notes)


def test_without_subtitle_times_and_dates_the_durations_count():
    """Records with neither '-->' nor dates take their times from DiffTime."""
    text = "".join(f"{i}\nSrtCnt : {i}, DiffTime : 40ms\n{KEYED}\n" for i in range(1, 4))
    np.testing.assert_allclose(parse_dji_srt(text, source="x.srt").time_s, [0, 0.04, 0.08])


def test_garbage_among_good_records_is_counted():
    """Damaged records are dropped and counted with the first line; the good ones stay."""
    good = [record(KEYED, f"00:00:{i:02d},000", i) for i in range(1, 9)]
    good[3] = "4\n00:00:04,000 --> 00:00:05,000\n[latitude: 50.x] [longitude: 8.25]\n\n"
    good[5] = "\x01\x02 not a record ~~~\n\n"
    good[6] = "7\n00:00:07,000 --> 00:00:08,000\n[latitude: 98.0] [longitude: 8.25]\n\n"
    t = parse_dji_srt("".join(good), source="x.srt")
    assert len(t) == 6
    assert t.has_fix.sum() == 5
    assert any("left out: 1, the first at line 14: latitude is '50.x'" in n for n in t.notes)
    assert any("not on Earth: 1, the first is 98.0, 8.25 at line 24" in n for n in t.notes)


def test_heights_below_land_are_said():
    """An absolute height far below any land gets a note and is kept."""
    t = one("[latitude: 50.5] [longitude: 8.25] [rel_alt: 5.4 abs_alt: -124.7]")
    assert t.abs_alt_m[0] == -124.7
    assert any("-124.7 m" in note for note in t.notes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "x.srt: the file is empty"),
        ("  \n\n", "x.srt: the file is empty"),
        ("1\n2\n3\n", "x.srt: no subtitle record contains drone telemetry"),
        (
            record("Hello, and welcome") + record("to the film"),
            "x.srt:2: no subtitle record contains",
        ),
        ("just a text\nof two lines", "x.srt:1: no subtitle record contains"),
        (record("[latitude: abc] [longitude: 8]"), "x.srt:2: .*latitude is 'abc', not a number"),
        (record("GPS(500.0,20.0,3)"), "x.srt:2: .*not a position on Earth"),
        (record("GPS(5.0)"), "x.srt:2: .*is not a position"),
        (record("G.PRY (1.0, 2.0)"), "x.srt:2: .*not pitch, roll, yaw"),
        (f"1\n{KEYED}\n2\n{KEYED}\n", "x.srt:1: the records have neither subtitle times"),
    ],
)
def test_unusable_file_is_refused_with_place_and_reason(text, message):
    """A file without any usable record is refused in one line with file, line and reason."""
    with pytest.raises(InputError, match=f"^{message}") as error:
        parse_dji_srt(text, source="x.srt")
    assert "\n" not in str(error.value)


def test_empty_binary_and_missing_files_are_refused(shared_data, tmp_path):
    """An empty file, a binary one, a folder and a missing one each have their own message."""
    with pytest.raises(InputError, match=r"broken_empty.SRT: the file is empty"):
        read_dji_srt(shared_data / "srt" / "broken_empty.SRT")
    (tmp_path / "b.srt").write_bytes(b"\0\1\2")
    with pytest.raises(InputError, match=r"b.srt: is binary"):
        read_dji_srt(tmp_path / "b.srt")
    with pytest.raises(InputError, match=r"c.srt: cannot be read"):
        read_dji_srt(tmp_path / "c.srt")
    with pytest.raises(InputError, match="not a file"):
        read_dji_srt(tmp_path)


def test_a_hostile_file_takes_no_time():
    """Long inputs that nearly match the patterns are read in linear time."""
    text = record(
        "[latitude: 5.5] [longitude: 8.0] " + "GPS(" * 200_000 + "<a" * 200_000 + "H " * 100_000
    )
    assert len(parse_dji_srt(text, source="x.srt")) == 1


@pytest.mark.parametrize(
    ("position", "lat_lon"),
    [
        ("GPS(W: -20.5, N: 48.25, -37)", (48.25, -20.5)),
        ("GPS(W: 20.5, S: -48.25, -37)", (-48.25, -20.5)),
        ("GPS(E: 20.5, S: 48.25, -37)", (-48.25, 20.5)),
    ],
)
def test_a_letter_and_a_minus_say_the_same(position, lat_lon):
    """West or south with a minus sign is still west or south."""
    np.testing.assert_allclose(one(position).lat_lon_deg, [lat_lon])


@pytest.mark.parametrize("position", ["GPS(E: -20.5, N: 48.25, 3)", "GPS(N: 20.5, N: 48.25, 3)"])
def test_letters_that_contradict_are_refused(position):
    """East with a minus sign, or two latitudes, gives no position."""
    with pytest.raises(InputError, match=r"contradict each other|not one latitude"):
        one(position)


def test_a_height_named_reh_is_above_take_off():
    """Autel's ReH is the height above take-off."""
    assert one("GPS(W: -20.5000, N: 48.2654, -37) ReH:20 ").rel_alt_m.tolist() == [20.0]


def test_a_damaged_number_loses_its_record_only():
    """A damaged number such as -20.-5000 drops only its own record."""
    body = "GPS(W: {}, N: 48.25, -37) ReH:20"
    t = parse_dji_srt(
        "".join(
            record(body.format(n), f"00:00:0{i},000", i)
            for i, n in enumerate(["-20.5", "-20.-5000", "-20.4"])
        ),
        source="x.srt",
    )
    assert t.lat_lon_deg[:, 1].tolist() == [-20.5, -20.4]
    assert any("records left out: 1" in note and "-20.-5000" in note for note in t.notes)


def test_a_position_far_from_home_is_left_out():
    """A record with hemispheres whose position is far from its HOME is dropped."""
    t = one("HOME(20.5000, 48.2654)\nGPS(W: 20.5000, N: 48.2654, -37) ReH:20")
    assert not t.has_fix.any()
    assert any("HOME in the same record is in another place: 1" in note for note in t.notes)


@pytest.mark.parametrize(
    ("fix", "home", "distance_m", "lat_lon"),
    [
        # 0.001 degrees of longitude at 48 degrees north is 74.1 m, of latitude 111.2 m.
        ("GPS(11.672200, 48.265401, 103.55)", "HOME(11.671200, 48.265401)", 74.0, (48.265401, 11.6722)),
        ("GPS(48.265401, 11.672200, 17)", "HOME(48.265401, 11.671200)", 74.0, (48.265401, 11.6722)),
        # Without a distance, RTK means a Phantom 4 RTK, with longitude first.
        ("RTK(11.672200, 48.265401, 103.55)", "HOME(11.671200, 48.265401)", 0.0, (48.265401, 11.6722)),
    ],
)  # fmt: skip
def test_home_and_its_distance_decide_the_order(fix, home, distance_m, lat_lon):
    """Only one order of latitude and longitude gives the stated distance from HOME."""
    t = one(f"F/6.3, SS 60, {fix}, {home}, D {distance_m:.2f}m, H 76.19m, H.S 7.40m/s")
    np.testing.assert_allclose(t.lat_lon_deg, [lat_lon])
    assert any("is read as" in note for note in t.notes)


def test_zeros_in_all_records_are_no_measurement():
    """Gimbal angles and heights that are exactly zero in all records are dropped, each with a note."""
    zero = "[latitude: 50.5] [longitude: 8.2{}] [rel_alt: {} abs_alt: 160.0] [gb_yaw: {}"
    zero += " gb_pitch: 0.0 gb_roll: 0.0]"
    rows = [record(zero.format(i, "0.000", "0.0"), f"00:00:0{i},000", i) for i in range(3)]
    t = parse_dji_srt("".join(rows), source="x.srt")
    assert np.isnan(t.gimbal_deg).all()
    assert np.isnan(t.rel_alt_m).all()
    assert np.isfinite(t.abs_alt_m).all()
    assert sum("exactly 0 in all 3 records" in note for note in t.notes) == 2
    rows[1] = record(zero.format(1, "0.100", "0.1"), "00:00:01,000", 1)
    measured = parse_dji_srt("".join(rows), source="x.srt")
    assert np.isfinite(measured.gimbal_deg).all()
    assert measured.rel_alt_m.tolist() == [0.0, 0.1, 0.0]


def test_the_wrong_side_of_the_earth(shared_cases):
    """Files once read as east instead of west, or with axes swapped, are read correctly."""
    west = read_dji_srt(shared_cases / "input" / "01-west-letter-and-minus" / "MAX_0001.srt")
    np.testing.assert_allclose(west.lat_lon_deg[0], (48.2654, -20.5))
    assert set(west.rel_alt_m.tolist()) == {20.0}
    rtk = read_dji_srt(shared_cases / "input" / "13-rtk-third-is-a-height" / "DJI_0001.srt")
    np.testing.assert_allclose(rtk.lat_lon_deg[0], (48.2654, 11.6712))


def test_autel_writes_ass_beside_a_video(tmp_path):
    """Dialogue lines of an .ass file are records on the video's clock; one without a time is dropped."""
    line = (
        "Dialogue: 0,{},0:00:02.00,Default,,0,0,0,,GPS(W: -20.5, N: 48.25, -37)\\NReH:20 ISO:100\n"
    )
    head = "[Script Info]\n[V4+ Styles]\nFormat: Name\n[Events]\n"
    head += "Format: Layer, Start, End, Style, Name, MarginL, MarginR, MarginV, Effect, Text\n"
    path = tmp_path / "MAX_0001.ass"
    path.write_text(head + line.format("0:00:00.50") + line.format("x") + line.format("0:01:01.00"))
    t = read_telemetry(path)
    assert t.time_s.tolist() == [0.5, 61.0]
    np.testing.assert_allclose(t.lat_lon_deg, [(48.25, -20.5)] * 2)
    assert t.rel_alt_m.tolist() == [20.0, 20.0]
    assert any("records left out: 1, the first at line 7" in note for note in t.notes)
    path.write_text(head)
    with pytest.raises(InputError, match=r"MAX_0001.ass"):
        read_telemetry(path)
