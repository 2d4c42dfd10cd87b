"""Telemetry in data tracks of videos: GPMF, CAMM and MISB KLV."""

from __future__ import annotations

import random
import struct
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import av
import numpy as np
import pytest

from spn_data.capture.candidates import analyse, build_frames
from spn_data.capture.selection import SelectionOptions, choose_all
from spn_data.capture.sources import discover
from spn_data.capture.video import decode_gray
from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.inputs.flight_telemetry import source_telemetry, unread_tracks
from spn_data.inputs.initial_cameras import start_lenses
from spn_data.media.container import open_container
from spn_data.telemetry.camm import read_camm
from spn_data.telemetry.data_tracks import DataPacket, DataTrack, TrackFormat, read_data_tracks
from spn_data.telemetry.embedded import read_embedded
from spn_data.telemetry.gpmf import read_gpmf
from spn_data.telemetry.misb_klv import read_misb
from spn_data.telemetry.subtitles import read_subtitles
from tests.worlds.data_track_videos import (
    camm_packet,
    gpmf_item,
    gpmf_payload,
    gps5_payload,
    gps9_payload,
    misb_height,
    misb_items,
    misb_set,
    write_data_video,
)

_UTC_S = datetime(2024, 5, 1, 12, tzinfo=UTC).timestamp()
# Examples of the standards (MISB ST 0601 section 8, ST 0902 annex C): the bytes of an item and its value.
_EXAMPLES = {
    5: ("71c2", 159.97436484321355),
    6: ("fd3d", -0.4315317239906),
    7: ("08b8", 3.4058656575212893),
    13: ("5595b66d", 60.1768229669783),
    14: ("5b5360c4", 128.426759042045),
    15: ("c221", 14190.72),
    16: ("cd9c", 144.5713),
    18: ("724a0a20", 160.719211474396),
    19: ("87f84b86", -168.792324833941),
    20: ("7dc58458", 0x7DC58458 * 360 / 0xFFFFFFFF),  # no published example
}
_EXAMPLE_ITEMS = {tag: bytes.fromhex(raw) for tag, (raw, _) in _EXAMPLES.items()}


def _klv(items: dict[int, bytes], second: float = 0.0) -> bytes:
    return misb_set(round(1e6 * (_UTC_S + second)), items)


def _packet(payload: bytes, second: float = 0.0, near_s: float = 0.0) -> DataPacket:
    return DataPacket(second, 1.0, payload, near_s)


def _gps5(fix: int, *, reference: bytes = b"", second: float = 0.0) -> DataPacket:
    return _packet(gps5_payload(fix, reference=reference), second)


def test_gps5_has_the_values_times_and_accuracy_of_its_payload() -> None:
    """A GPS5 payload gives its positions over its second, its UTC, and a sigma from its dilution."""
    track = read_gpmf([_gps5(3), _gps5(3, second=1.0)], "a.mp4")
    np.testing.assert_allclose(track.time_s, np.arange(8) / 4)
    np.testing.assert_allclose(track.lat_lon_deg[:4, 0], 48.1 + 1e-5 * np.arange(4), atol=1e-12)
    np.testing.assert_allclose(track.abs_alt_m, 500.0)
    np.testing.assert_allclose(track.utc_s[:4], _UTC_S + 0.5 + np.arange(4) / 4)
    # A position dilution of 1.5 with 2 m range error, split over two horizontal axes and 1.5 for up.
    np.testing.assert_allclose(track.sigma_m[0], np.array([1, 1, 1.5]) * 3.0 / np.sqrt(4.25))


@pytest.mark.parametrize(
    ("stated", "expected"),
    [
        (b"", HeightReference.ELLIPSOID),
        (b"MSLV", HeightReference.AMSL),
        (b"ABCD", HeightReference.UNKNOWN),
    ],
)
def test_the_height_reference_of_gps5_is_what_gpsa_says(
    stated: bytes, expected: HeightReference
) -> None:
    """GPS5 heights are above the ellipsoid without GPSA, and unknown if GPSA is not known."""
    assert read_gpmf([_gps5(3, reference=stated)], "a.mp4").abs_reference is expected


def test_gps5_without_a_lock_has_no_position() -> None:
    """Records without a lock are NaN and counted, and those of a flat fix have no height."""
    track = read_gpmf([_gps5(0), _gps5(2, second=1.0)], "a.mp4")
    assert track.has_fix.tolist() == [False] * 4 + [True] * 4
    assert np.isnan(track.abs_alt_m).all()
    assert "records without a fix in its GoPro track: 4" in track.notes


def test_gps9_states_time_dilution_and_lock_for_each_record() -> None:
    """A GPS9 record has its own days and seconds, dilution and lock."""
    track = read_gpmf([_packet(gps9_payload())], "a.mp4")
    assert track.has_fix.tolist() == [False, True]
    np.testing.assert_allclose(track.utc_s, _UTC_S + np.array([0.25, 0.251]))
    np.testing.assert_allclose(track.sigma_m[1, 0], 2.4 / np.sqrt(4.25))
    assert track.abs_reference is HeightReference.AMSL


def _karma_rows(path: Path) -> tuple[list[tuple[int, ...]], list[tuple[int, ...]]]:
    """Decode GPRI and GLPI of the Karma clip by searching for their headers."""
    with av.open(str(path)) as container:
        blob = b"".join(bytes(p) for p in container.demux(container.streams[3]))
    found: dict[bytes, list[tuple[int, ...]]] = {b"GPRI": [], b"GLPI": []}
    for key, form in ((b"GPRI", ">QlllHHHHBB"), (b"GLPI", ">LllllhhhH")):
        at = blob.find(key)
        while at >= 0:
            size, count = struct.unpack_from(">BH", blob, at + 5)
            found[key] += [struct.unpack_from(form, blob, at + 8 + size * i) for i in range(count)]
            at = blob.find(key, at + 8)
    return found[b"GPRI"], found[b"GLPI"]


def test_the_karma_clip_gives_the_fixes_of_its_drone(shared_data: Path) -> None:
    """The reader agrees with an independent decoding of the drone's raw fixes and their own stamps."""
    path = shared_data / "video" / "gopro-karma.mp4"
    track = read_embedded(path)
    raw, fused = _karma_rows(path)
    assert track is not None
    assert len(track) == len(raw) == 47
    table = np.array(raw, float)
    np.testing.assert_allclose(track.lat_lon_deg, table[:, 1:3] / 1e7, atol=1e-9)
    np.testing.assert_allclose(track.abs_alt_m, table[:, 3] / 1000)
    np.testing.assert_allclose(track.sigma_m[:, [0, 2]], table[:, 4:6] / 100)
    np.testing.assert_allclose(np.diff(track.time_s), np.diff(table[:, 0]) / 1e6, atol=1e-6)
    assert track.abs_reference is HeightReference.AMSL
    expected = np.interp(
        table[:, 0] / 1e6, [r[0] / 1e3 for r in fused], [r[4] / 1e3 for r in fused]
    )
    known = np.isfinite(track.rel_alt_m)
    assert known.sum() == 46
    np.testing.assert_allclose(track.rel_alt_m[known], expected[known], atol=1e-6)
    # The clip was recorded at 19:27:57 UTC by its container, which is rounded to a second.
    assert (
        abs(
            track.utc_s[0]
            - track.time_s[0]
            - datetime(2017, 4, 17, 19, 27, 57, tzinfo=UTC).timestamp()
        )
        < 1
    )


@pytest.mark.skipif(not Path("/proc/self/io").exists(), reason="only Linux counts what is read")
def test_pictures_are_skipped_while_data_tracks_are_read(shared_data: Path) -> None:
    """The track of a video, of a few percent of its bytes, is read without the rest."""

    def bytes_read() -> int:
        words = Path("/proc/self/io").read_text().split()
        return int(words[words.index("rchar:") + 1])

    path = shared_data / "video" / "gopro-karma.mp4"
    before = bytes_read()
    assert read_data_tracks(path)
    assert bytes_read() - before < path.stat().st_size / 4


def test_camm_positions_have_accuracy_lock_and_height_reference() -> None:
    """A CAMM packet with accuracy gives position and sigma; one without a lock has no position."""
    track = read_camm([_packet(camm_packet(3)), _packet(camm_packet(0), 1.0)], "a.mp4")
    assert track.has_fix.tolist() == [True, False]
    np.testing.assert_allclose(track.lat_lon_deg[0], [48.1, 11.5])
    np.testing.assert_allclose(track.sigma_m[0], [2, 2, 3])
    assert track.abs_reference is HeightReference.ELLIPSOID
    short = read_camm([_packet(struct.pack("<HHddd", 0, 5, 48.1, 11.5, -1.0))], "a.mp4")
    assert np.isnan(short.abs_alt_m).all()
    assert short.abs_reference is HeightReference.UNKNOWN
    other = camm_packet(3)[:3] + b"\1" + camm_packet(3)[4:]  # of type 262
    with pytest.raises(InputError, match="CAMM track holds no positions"):
        read_camm([_packet(other)], "a.mp4")


def test_misb_items_have_the_values_of_the_standard() -> None:
    """Items decode to the values that the standard gives as examples."""
    track = read_misb([_packet(_klv(_EXAMPLE_ITEMS))], "a.ts")
    np.testing.assert_allclose(
        track.lat_lon_deg[0], [_EXAMPLES[13][1], _EXAMPLES[14][1]], atol=1e-8
    )
    assert track.abs_alt_m[0] == pytest.approx(14190.72, abs=0.01)
    assert track.abs_reference is HeightReference.AMSL
    assert track.utc_s[0] == _UTC_S
    assert 2 * np.degrees(np.arctan(0.5 / track.zoom[0])) == pytest.approx(144.5713, abs=1e-4)
    # The camera's axes by successive turns about down, right and forward.
    heading, pitch, roll, azimuth, elevation, turn = (
        _EXAMPLES[tag][1] for tag in (5, 6, 7, 18, 19, 20)
    )
    axes = _turned(heading, pitch, roll) @ _turned(azimuth, elevation, turn)
    enu = axes[[1, 0, 2]] * [[1], [1], [-1]]
    expected = np.stack([enu[:, 1], enu[:, 2], enu[:, 0]])
    np.testing.assert_allclose(rotations_from_angles(track.gimbal_deg)[0], expected, atol=1e-5)


def _turned(heading: float, pitch: float, roll: float) -> np.ndarray:
    """Rotation of a body by elementary turns, in forward, right, down."""

    def turn(axis: int, angle: float) -> np.ndarray:
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        matrix = np.eye(3)
        matrix[i, i], matrix[j, j], matrix[i, j], matrix[j, i] = c, c, -s, s
        return matrix

    return turn(2, heading) @ turn(1, pitch) @ turn(0, roll)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, (90, -45, 0)),
        ({"azimuth": 90.0}, (180, -45, 0)),
        ({"pitch": 10.0}, (90, -35, 0)),
        ({"roll": 30.0, "elevation": 0.0}, (90, 0, 30)),
        ({"elevation": 0.0, "turn": 20.0}, (90, 0, 20)),
    ],
)
def test_sensor_angles_are_composed_with_those_of_the_platform(
    changes: dict[str, float], expected: tuple[float, ...]
) -> None:
    """The camera points where the sensor points on the turned platform."""
    track = read_misb([_packet(_klv(misb_items(**changes)))], "a.ts")
    np.testing.assert_allclose(track.gimbal_deg[0], expected, atol=0.01)


def test_misb_heights_above_the_ellipsoid_are_preferred_and_named() -> None:
    """Items 104 and 75 are heights above the ellipsoid; the former is exact."""
    items = {**misb_items(), 75: misb_height(745.0)}
    track = read_misb([_packet(_klv(items))], "a.ts")
    assert track.abs_reference is HeightReference.ELLIPSOID
    assert track.abs_alt_m[0] == pytest.approx(745.0, abs=0.2)
    items[104] = round((745.25 + 900) * 2**7).to_bytes(3, "big")
    assert read_misb([_packet(_klv(items))], "a.ts").abs_alt_m[0] == pytest.approx(745.25, abs=1e-6)


def test_a_misb_set_with_a_wrong_checksum_is_left_out_and_counted() -> None:
    """A flipped bit in a position leaves its set out instead of moving the camera."""
    good, bad = _klv(misb_items()), bytearray(_klv(misb_items(), 1.0))
    bad[60] ^= 0x40
    track = read_misb([_packet(good), _packet(bytes(bad), 1.0)], "a.ts")
    assert len(track) == 1
    assert "KLV packets with a wrong checksum or length left out: 1" in track.notes
    with pytest.raises(InputError, match="no sensor position"):
        read_misb([_packet(bytes(bad))], "a.ts")


@pytest.mark.parametrize("length", ["85ffffffffff", "80", "84ffffffff", "8200"])
def test_a_misb_length_beyond_its_packet_is_refused(length: str) -> None:
    """Lengths that are not allowed, or longer than the packet, leave the set out."""
    whole = _klv(misb_items())
    changed = whole[:16] + bytes.fromhex(length) + whole[17:]
    with pytest.raises(InputError, match="1 of its 1 packets"):
        read_misb([_packet(changed)], "a.ts")


def test_misb_packets_without_times_are_placed_by_their_stamps() -> None:
    """Asynchronous records keep the spacing of their stamps, beside the pictures they are stored with."""
    payloads = [_klv(misb_items(), second) for second in (0.0, 1.0, 2.5)]
    packets = [
        DataPacket(np.nan, 0.0, p, n) for p, n in zip(payloads, (0.1, 1.1, 2.6), strict=True)
    ]
    track = read_misb(packets, "a.ts")
    np.testing.assert_allclose(track.time_s, [0.1, 1.1, 2.6], atol=1e-6)
    assert "about a second" in " ".join(track.notes)


def test_a_transport_stream_gives_positions_angles_and_the_focal_length(tmp_path: Path) -> None:
    """A real MPEG-TS is read on the video's clock, and its field of view starts the camera."""
    path = tmp_path / "day.ts"
    packets = [(i / 2, _klv(misb_items(lat=48.1 + 1e-5 * i, fov=8.0), i / 2)) for i in range(8)]
    write_data_video(path, packets)
    (source,) = discover(path).sources
    candidates = analyse(source)
    track = source_telemetry(source, candidates)
    assert track is not None
    np.testing.assert_allclose(track.time_s, np.arange(8) / 2, atol=1e-4)
    np.testing.assert_allclose(track.lat_lon_deg[:, 0], 48.1 + 1e-5 * np.arange(8), atol=1e-7)
    np.testing.assert_allclose(track.gimbal_deg[:, :2], [[90, -45]] * 8, atol=0.01)
    assert "read from its KLV track (MISB ST 0601)" in track.notes
    (choice,) = choose_all([(candidates.measured, None)], SelectionOptions())
    frames = build_frames(candidates, choice, focal=track.at(candidates.measured.time_s).zoom)
    start = start_lenses(frames, None, {}, {}, track)[0]["day"]
    assert start.source == "field of view in the video's metadata"
    assert start.camera.params[0] == pytest.approx(32 / np.tan(np.radians(4.0)), rel=1e-3)
    assert start_lenses(frames, None, {}, {})[0]["day"].source == "guess"


def test_a_gopro_track_without_the_package_is_named_with_the_remedy(
    shared_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A missing extra is a note with the command that installs it."""
    monkeypatch.setitem(sys.modules, "mapillary_tools.gpmf.gpmf_parser", None)
    (source,) = discover(shared_data / "video" / "gopro-karma.mp4").sources
    (note,) = unread_tracks(source)
    assert "pip install 'squeezeposenet-toolkit[gopro]'" in note


def test_a_dji_track_and_all_round_videos_are_named_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A djmd track, .insv and .360 are named by their names, with what to do."""
    dji = DataTrack(TrackFormat.DJI, [_packet(b"\n\x10dvtm_ac203.proto")])
    monkeypatch.setattr("spn_data.telemetry.embedded.read_data_tracks", lambda path: [dji])
    with pytest.raises(InputError, match="djmd"):
        read_embedded(tmp_path / "DJI_0001.MP4")
    for name in ("a.insv", "b.360"):
        (tmp_path / name).write_bytes(b"x")
        with pytest.raises(InputError, match="export a flat view as MP4"):
            discover(tmp_path / name)


def _has_late_tracks(path: Path) -> bool:
    """Whether PyAV itself fails at a track that appears while the file is read."""
    try:
        with open_container(path) as container:
            for _ in container.demux([s for s in container.streams if s.type != "audio"]):
                pass
    except IndexError:
        return True
    except (InputError, av.FFmpegError):
        pass
    return False


def test_a_damaged_transport_stream_gives_fixes_or_one_line(tmp_path: Path) -> None:
    """An MPEG-TS with changed bytes, even with late tracks, gives fixes, pictures, or an InputError."""
    whole = tmp_path / "whole.ts"
    write_data_video(whole, [(i / 2, _klv(misb_items(), i / 2)) for i in range(8)])
    data = whole.read_bytes()
    random.seed(3)
    late = read = 0
    for _ in range(60):
        changed = bytearray(data)
        for _ in range(60):
            changed[random.randrange(len(changed))] = random.randrange(256)
        path = tmp_path / "changed.ts"
        path.write_bytes(changed)
        is_late = _has_late_tracks(path)
        late += is_late
        try:
            track = read_embedded(path)
            read += is_late and track is not None
            read_subtitles(path)
            list(decode_gray(path, threads=1) if is_late else ())
        except InputError:
            continue
    assert late > 0
    assert read > 0


def test_a_track_of_too_many_records_or_bytes_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bounds hold for packets of a file, for records within a packet, and for items of a GoPro payload."""
    monkeypatch.setattr("spn_data.telemetry.gpmf.MAX_RECORDS", 7)
    assert len(read_gpmf([_gps5(3)], "a.mp4")) == 4
    with pytest.raises(InputError, match="GoPro track has more than 7 records"):
        read_gpmf([_gps5(3), _gps5(3, second=1.0)], "a.mp4")
    monkeypatch.setattr("spn_data.telemetry.misb_klv.MAX_RECORDS", 2)
    with pytest.raises(InputError, match="KLV track has more than 2 records"):
        read_misb([_packet(b"".join(_klv(misb_items(), s) for s in range(3)))], "a.ts")
    path = tmp_path / "day.ts"
    write_data_video(path, [(i / 2, _klv(misb_items(), i / 2)) for i in range(8)])
    assert len(read_data_tracks(path)[0].packets) == 8
    monkeypatch.setattr("spn_data.telemetry.data_tracks.MAX_RECORDS", 7)
    with pytest.raises(InputError, match="its data tracks exceed"):
        read_data_tracks(path)


def test_a_height_reference_of_another_type_leaves_its_payload_out() -> None:
    """GPSA with numbers instead of letters is damage, not a traceback."""
    rows = struct.pack(">5l", 481_000_000, 115_000_000, 500_000, 1000, 100)
    scales = struct.pack(">5l", 10_000_000, 10_000_000, 1000, 1000, 100)
    payload = gpmf_payload(
        gpmf_item(b"SCAL", b"l", 4, scales),
        gpmf_item(b"GPSA", b"L", 4, b"MSLV"),
        gpmf_item(b"GPS5", b"l", 20, rows),
    )
    with pytest.raises(InputError, match="1 of its 1 payloads are damaged"):
        read_gpmf([_packet(payload)], "a.mp4")


def test_damaged_payloads_give_fixes_or_one_line() -> None:
    """Bytes changed at random give fixes or an InputError, in bounded time."""
    random.seed(1)
    claim = gpmf_payload(*[gpmf_item(b"GPS5", b"l", 0, b"", 65_535)] * 20_000)
    readers = [
        (read_gpmf, _gps5(3).payload),
        (read_misb, _klv({**misb_items(), 104: b"\0\1\2\3"})),
        (read_camm, struct.pack("<HHddd", 0, 5, 48.1, 11.5, 1.0)),
        (read_gpmf, claim),
    ]
    started = time.process_time()
    fixes = 0
    for reader, payload in readers:
        for _ in range(1 if payload is claim else 150):
            data = bytearray(payload)
            for _ in range(random.randrange(1, 5) if payload is not claim else 0):
                data[random.randrange(4, len(data))] = random.randrange(256)
            kept = bytes(data[: random.choice([None, random.randrange(4, len(data))])])
            try:
                fixes += int(reader([_packet(kept)], "a").has_fix.sum())
            except InputError:
                continue
    assert fixes > 50
    assert time.process_time() - started < 5
