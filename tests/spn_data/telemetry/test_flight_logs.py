"""Flight logs of autopilots, GNSS loggers and watches, written here and read back."""

from __future__ import annotations

import os
import random
import re
import struct
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spn_data.capture.sources import LOG_SUFFIXES, discover
from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.telemetry import ulog_messages
from spn_data.telemetry.accuracy import sigma_from_fix
from spn_data.telemetry.autopilot import pymavlink
from spn_data.telemetry.flight_log import camera_angles, utc_from_gps
from spn_data.telemetry.read import LOG_READERS, read_telemetry
from spn_data.telemetry.track import Telemetry
from tests.worlds.log_files import (
    UTC_S,
    Flight,
    make_flight,
    nmea_lines,
    quaternion,
    write_dataflash,
    write_fit,
    write_nmea,
    write_tlog,
    write_ulog,
)

WRITERS: dict[str, Callable[..., None]] = {
    "a.ulg": write_ulog,
    "a.bin": write_dataflash,
    "a.tlog": write_tlog,
    "a.nmea": write_nmea,
    "a.fit": write_fit,
}
PACKAGES = {
    "a.ulg": ("pyulog.core", "px4"),
    "a.bin": ("pymavlink.DFReader", "ardupilot"),
    "a.tlog": ("pymavlink.dialects.v20.ardupilotmega", "ardupilot"),
    "a.nmea": ("pynmea2", "nmea"),
    "a.fit": ("fitdecode", "fit"),
}


def written(folder: Path, name: str, flight: Flight, **options: object) -> Telemetry:
    """Write a flight in the format of a name, and read it."""
    WRITERS[name](folder / name, flight, **options)
    return read_telemetry(folder / name)


@pytest.mark.parametrize(
    ("name", "reference", "has_rel", "options"),
    [
        ("a.ulg", HeightReference.ELLIPSOID, True, {"old": True, "in_vehicle": True}),
        ("a.ulg", HeightReference.ELLIPSOID, True, {"old": False}),
        ("a.bin", HeightReference.AMSL, True, {"yaw_in_earth": True}),
        ("a.bin", HeightReference.AMSL, True, {"yaw_in_earth": False}),
        ("a.tlog", HeightReference.ELLIPSOID, True, {}),
        ("a.nmea", HeightReference.ELLIPSOID, False, {}),
        ("a.nmea", HeightReference.AMSL, False, {"geoid": False}),
    ],
)
def test_positions_heights_and_accuracy_are_those_of_the_flight(
    tmp_path, name, reference, has_rel, options
):
    """Each log gives the positions, heights with reference, accuracy and UTC that were written."""
    flight = make_flight()
    track = written(tmp_path, name, flight, **options)
    locked = flight.fix_type > 1
    np.testing.assert_array_equal(track.has_fix, locked)
    truth = np.stack([flight.lat_deg, flight.lon_deg], axis=1)
    np.testing.assert_allclose(track.lat_lon_deg[locked], truth[locked], atol=6e-8)
    assert track.abs_reference is reference
    height_m = flight.ellipsoid_m if reference is HeightReference.ELLIPSOID else flight.amsl_m
    np.testing.assert_allclose(track.abs_alt_m[locked], height_m[locked], atol=0.02)
    np.testing.assert_allclose(track.sigma_m[locked], [(0.6, 0.6, 0.9)] * locked.sum(), atol=1e-6)
    np.testing.assert_allclose(track.utc_s, UTC_S + flight.time_s, atol=2e-3)
    np.testing.assert_allclose(track.time_s, flight.time_s, atol=2e-3)
    if has_rel:
        np.testing.assert_allclose(track.rel_alt_m, flight.rel_m, atol=2e-3)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.ulg", {"in_vehicle": True}),
        ("a.ulg", {"in_vehicle": False}),
        ("a.bin", {"yaw_in_earth": True}),
        ("a.bin", {"yaw_in_earth": False}),
        ("a.tlog", {"gimbal": "device", "delay_s": 0.0}),
        ("a.tlog", {"gimbal": "status", "delay_s": 0.0}),
    ],
)
def test_camera_angles_are_those_of_the_gimbal(tmp_path, name, options):
    """Gimbal angles are read in the frame of the Earth, also if their yaw is relative to the vehicle."""
    flight = make_flight()
    track = written(tmp_path, name, flight, **options)
    np.testing.assert_allclose(track.gimbal_deg, flight.gimbal_deg, atol=0.02)


def test_a_watch_gives_its_records_with_an_unknown_height_reference(tmp_path):
    """A FIT file gives whole seconds, its accuracy, and altitudes whose reference FIT does not define."""
    flight = make_flight(no_lock=6)
    track = written(tmp_path, "a.fit", flight)
    rows = slice(None, None, 5)
    np.testing.assert_allclose(track.utc_s, UTC_S + flight.time_s[rows])
    np.testing.assert_allclose(track.lat_lon_deg[2:, 0], flight.lat_deg[rows][2:], atol=1e-7)
    np.testing.assert_array_equal(track.has_fix, flight.fix_type[rows] > 1)
    np.testing.assert_allclose(track.abs_alt_m[2:], flight.amsl_m[rows][2:], atol=0.11)
    assert track.abs_reference is HeightReference.UNKNOWN
    assert (track.sigma_m[2] == [3.0, 3.0, 4.5]).all()


def test_quality_and_dilution_give_the_accuracy_that_is_not_stated():
    """RTK has its typical figures, a differential fix half the error of a single one, nothing is NaN."""
    assert sigma_from_fix(6, hdop=0.8) == (0.02, 0.02, 0.04)
    single = sigma_from_fix(3, hdop=1.0, vdop=1.5)
    np.testing.assert_allclose(single, (2**0.5, 2**0.5, 3.0))
    np.testing.assert_allclose(sigma_from_fix(4, hdop=1.0, vdop=1.5), np.array(single) / 2)
    assert np.isnan(sigma_from_fix(3)).all()
    assert sigma_from_fix(6, horizontal_m=0.5, vertical_m=0.7) == (0.5, 0.5, 0.7)


@pytest.mark.parametrize(
    ("quality", "sigma_m"),
    [(4, 0.02), (5, 0.3), (2, 0.8 * 2**0.5 / 2), (1, 0.8 * 2**0.5), (6, None)],
)
def test_nmea_quality_decides_the_accuracy(tmp_path, quality, sigma_m):
    """Without GST the quality in GGA gives the accuracy, and an estimated position is none."""
    track = written(tmp_path, "a.nmea", make_flight(), gst=False, quality=quality)
    assert track.has_fix.any() == (sigma_m is not None)
    if sigma_m is not None:
        assert track.sigma_m[5, 0] == pytest.approx(sigma_m)
    else:
        assert any("estimated or simulated, not measured: 37" in note for note in track.notes)


def test_leap_seconds_between_gps_and_utc():
    """GPS time is ahead of UTC by 13 s in 2001, 17 s at the end of 2016 and 18 s after it."""
    second = np.array([1_000_000.0, 674_438_413.0, 1_167_264_016.0, 1_167_264_018.0])
    utc_s = utc_from_gps(
        np.array([2, 1115, 1930, 1930]), second - np.array([2, 1115, 1930, 1930]) * 604_800
    )
    assert (315_964_800 + second - utc_s).tolist() == [0, 13, 17, 18]
    assert np.isnan(utc_from_gps(np.array([0]), np.array([5.0]))).all()


def test_nmea_goes_on_after_midnight(tmp_path):
    """Sentences after midnight are of the next day, with dates in RMC and without any."""
    flight = replace(make_flight(), utc_s=UTC_S + 43_200 - 3)
    dated = written(tmp_path, "a.nmea", flight)
    np.testing.assert_allclose(dated.utc_s, flight.utc_s + flight.time_s, atol=1e-3)
    undated = written(tmp_path, "a.nmea", flight, date=False)
    np.testing.assert_allclose(undated.time_s, flight.time_s, atol=1e-3)
    assert np.isnan(undated.utc_s).all()
    assert any("its UTC is unknown" in note for note in undated.notes)


def test_nmea_sentences_with_a_wrong_checksum_are_left_out_and_counted(tmp_path):
    """A changed digit does not move a position; text saved as .txt is recognised."""
    lines = nmea_lines(make_flight())
    at = next(k for k, line in enumerate(lines) if k > 60 and "GGA" in line)
    lines[at] = re.sub(r",35(\d\d)", lambda found: f",36{found[1]}", lines[at], count=1)
    lines[at] = lines[at].replace(",3521", ",3522")
    lines[at] = lines[at].replace(",12,0.8", ",13,0.8")
    (tmp_path / "log.txt").write_text("\n".join(lines))
    track = read_telemetry(tmp_path / "log.txt")
    assert len(track) == 39
    assert any(
        re.search(rf"left out: 1, the first at line {at + 1}: checksum", n) for n in track.notes
    )


def test_a_jump_of_the_receivers_clock_does_not_move_records(tmp_path):
    """If the GNSS time of some records is wrong, the clock of the log decides, and a note says so."""
    flight = make_flight()
    write_ulog(tmp_path / "a.ulg", flight)
    data = (tmp_path / "a.ulg").read_bytes()
    good = struct.pack("<Q", round((UTC_S + flight.time_s[10]) * 1e6))
    assert data.count(good) == 1
    (tmp_path / "a.ulg").write_bytes(
        data.replace(good, struct.pack("<Q", round((UTC_S + 99) * 1e6)))
    )
    track = read_telemetry(tmp_path / "a.ulg")
    np.testing.assert_allclose(track.utc_s, UTC_S + flight.time_s, atol=1e-3)
    assert any("GNSS time of 1 records differs" in note for note in track.notes)


def test_equal_heights_above_sea_level_and_ellipsoid_have_no_reference(tmp_path):
    """A driver that copies one height into both fields states no reference."""
    track = written(tmp_path, "a.ulg", replace(make_flight(), geoid_m=0.0))
    assert track.abs_reference is HeightReference.UNKNOWN
    assert any("their reference is unknown" in note for note in track.notes)


def test_several_vehicles_are_refused(tmp_path):
    """A telemetry log of two autopilots is refused, as only one of them has the camera."""
    flight = make_flight()
    write_tlog(tmp_path / "a.tlog", flight)
    write_tlog(tmp_path / "b.tlog", replace(flight, lat_deg=flight.lat_deg + 0.1), system=2)
    both = (tmp_path / "a.tlog").read_bytes() + (tmp_path / "b.tlog").read_bytes()
    (tmp_path / "c.tlog").write_bytes(both)
    with pytest.raises(InputError, match=r"contains 2 vehicles \(systems 1, 2\)"):
        read_telemetry(tmp_path / "c.tlog")


def test_a_restarted_autopilot_does_not_mix_two_flights(tmp_path):
    """After a restart the time since boot begins again; the date keeps both flights apart."""
    flight = make_flight()
    later = replace(flight, utc_s=flight.utc_s + 500, lat_deg=flight.lat_deg + 0.01)
    write_tlog(tmp_path / "a.tlog", flight)
    write_tlog(tmp_path / "b.tlog", later)
    both = (tmp_path / "a.tlog").read_bytes() + (tmp_path / "b.tlog").read_bytes()
    (tmp_path / "c.tlog").write_bytes(both)
    track = read_telemetry(tmp_path / "c.tlog")
    assert len(track) == 79  # without the one that comes before any other message of the second run
    assert any("s or more behind: 1" in note for note in track.notes)
    assert any("was started 2 times" in note for note in track.notes)
    np.testing.assert_allclose(track.time_s[40:], 500 + flight.time_s[1:], atol=2e-3)
    np.testing.assert_allclose(track.lat_lon_deg[42:, 0], later.lat_deg[3:], atol=1e-7)


@pytest.mark.parametrize("name", list(WRITERS))
def test_records_before_the_cut_are_used(tmp_path, name):
    """Of a log that ends in the middle of a message, the records before it are used."""
    flight = make_flight(count=80)
    whole = written(tmp_path, name, flight)
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: int(0.7 * len(data)) + 1])
    track = read_telemetry(tmp_path / name)
    count = len(track)
    assert 0.5 * len(whole) < count < 0.8 * len(whole)
    np.testing.assert_array_equal(track.lat_lon_deg[: count - 1], whole.lat_lon_deg[: count - 1])


@pytest.mark.parametrize("name", ["a.ulg", "a.bin", "a.tlog"])
def test_damage_in_the_middle_is_skipped_with_a_note(tmp_path, name):
    """Bytes overwritten in the middle are skipped, and a note says so."""
    whole = written(tmp_path, name, make_flight(count=80))
    data = bytearray((tmp_path / name).read_bytes())
    middle = len(data) // 2
    data[middle : middle + 40] = bytes(40)
    (tmp_path / name).write_bytes(data)
    track = read_telemetry(tmp_path / name)
    assert len(track) >= 0.4 * len(whole)
    assert any("damaged" in note for note in track.notes)


@pytest.mark.parametrize("name", list(WRITERS))
def test_a_log_of_too_many_records_is_refused(tmp_path, monkeypatch, name):
    """The bound on position records holds for each kind of log."""
    WRITERS[name](tmp_path / name, make_flight(count=25))
    monkeypatch.setattr("spn_data.telemetry.flight_log.MAX_FIXES", 3)
    with pytest.raises(InputError, match="more than 3 position records"):
        read_telemetry(tmp_path / name)


def test_a_telemetry_log_of_too_many_messages_is_refused(tmp_path, monkeypatch):
    """The bound on all messages that are kept holds before the file has been read."""
    write_tlog(tmp_path / "a.tlog", make_flight(count=25))
    monkeypatch.setattr("spn_data.telemetry.mavlink_tlog._MAX_MESSAGES", 20)
    with pytest.raises(InputError, match="more than 20 messages"):
        read_telemetry(tmp_path / "a.tlog")


def test_logs_that_are_read_are_found_beside_videos():
    """The suffixes of logs are the same for finding and for reading them."""
    assert set(LOG_READERS) == LOG_SUFFIXES


@pytest.mark.parametrize("name", list(WRITERS))
def test_changed_bytes_give_a_track_or_one_line(tmp_path, name, capfd):
    """Whatever is changed in a log, the answer is a track or one line, and nothing is printed."""
    WRITERS[name](tmp_path / name, make_flight(count=25))
    data = (tmp_path / name).read_bytes()
    chance = random.Random(name)
    outcomes = set()
    for _ in range(60):
        changed = bytearray(data)
        for _ in range(chance.choice([1, 3, 30])):
            changed[chance.randrange(len(changed))] = chance.randrange(256)
        if chance.random() < 0.3:
            at = chance.randrange(len(changed))
            changed[at:at] = chance.randbytes(chance.randrange(300))
        (tmp_path / name).write_bytes(changed)
        try:
            track = read_telemetry(tmp_path / name)
            assert (np.diff(track.time_s) > 0).all()
            assert not np.isinf(track.lat_lon_deg).any()
            outcomes.add("track")
        except InputError as error:
            outcomes.add(f"error of {len(str(error).splitlines())} lines")
    assert "track" in outcomes
    assert outcomes <= {"track", "error of 1 lines"}
    assert capfd.readouterr() == ("", "")


def test_formats_that_contain_each_other_are_refused(tmp_path):
    """Formats of a ULog that nest themselves or multiply do not exhaust memory or stack."""
    for body in (b"sensor_gps:sensor_gps a;", b"sensor_gps:b[60000] a;"):
        fields = b"b:c[60000] a;"
        out = b"\x55\x4c\x6f\x67\x01\x12\x35\x01" + bytes(8)
        for kind, text in ((b"F", body), (b"F", fields), (b"F", b"c:float[9] x;")):
            out += struct.pack("<H", len(text)) + kind + text
        text = b"\0\0\0sensor_gps"
        out += struct.pack("<H", len(text)) + b"A" + text
        (tmp_path / "a.ulg").write_bytes(out)
        with pytest.raises(
            InputError, match=r"contains no positions|is not a ULog that can be read"
        ):
            read_telemetry(tmp_path / "a.ulg")


def test_a_log_beyond_the_limit_of_memory_is_cut_with_a_note(tmp_path, monkeypatch):
    """Records beyond the limit are left out, and a note says so."""
    monkeypatch.setattr(ulog_messages, "MAX_MESSAGE_BYTES", 5000)
    track = written(tmp_path, "a.ulg", make_flight(count=200))
    assert 0 < len(track) < 200
    assert any("only the first" in note for note in track.notes)


@pytest.mark.parametrize("name", list(WRITERS))
def test_a_missing_package_is_named_with_its_command(tmp_path, name, monkeypatch):
    """Without the optional package, the line says which command installs it."""
    WRITERS[name](tmp_path / name, make_flight())
    package, extra = PACKAGES[name]
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=rf"pip install 'squeezeposenet-toolkit\[{extra}\]'"):
        read_telemetry(tmp_path / name)


def test_pymavlink_ignores_and_keeps_the_environment(monkeypatch, tmp_path):
    """A dialect in the environment is not imported, and the environment stays as it is."""
    monkeypatch.setenv("MAVLINK_DIALECT", "of_someone_else")
    monkeypatch.setenv("MAV_IGNORE_CRC", "1")
    for name in [name for name in sys.modules if name.startswith("pymavlink")]:
        monkeypatch.delitem(sys.modules, name)
    before = dict(os.environ)
    dialect = pymavlink("dialects.v20.ardupilotmega", "logs", tmp_path)
    assert pymavlink("DFReader", "logs", tmp_path).mavutil.mavlink.DIALECT == "ardupilotmega"
    assert not dialect.MAVLINK_IGNORE_CRC
    assert dict(os.environ) == before


@pytest.mark.parametrize("name", list(WRITERS))
def test_logs_beside_a_video_belong_to_it(tmp_path, name):
    """A log of the video's name is its telemetry; a .bin that is no log, and raw data, are named as such."""
    suffix = Path(name).suffix
    for file in ("flight.mp4", "other.ubx", "other.bin"):
        (tmp_path / file).write_bytes(b"\0" * 10)
    WRITERS[name](tmp_path / f"flight{suffix}", make_flight())
    found = discover(tmp_path)
    assert [path.name for path in found.sources[0].telemetry] == [f"flight{suffix}"]
    reasons = {str(path): why for path, why in found.ignored}
    assert "not a video, photo or telemetry file" in reasons["other.bin"]
    assert "convert them to NMEA" in reasons["other.ubx"]


def test_camera_angles_of_quaternions_also_straight_down():
    """Rotations are those of the angles, and straight down the heading is that of the image's top."""
    angles = np.array(
        [(10.0, -20.0, 5.0), (350.0, -89.0, -3.0), (123.0, 30.0, 170.0), (77.0, -90.0, 0.0)]
    )
    found = camera_angles(np.array([quaternion(*one) for one in angles]))
    np.testing.assert_allclose(
        rotations_from_angles(found), rotations_from_angles(angles), atol=1e-6
    )
    np.testing.assert_allclose(found[3], angles[3], atol=1e-6)
    assert np.isnan(camera_angles(np.array([[0.0, 0, 0, 0], [np.nan, 0, 0, 1]]))).all()
