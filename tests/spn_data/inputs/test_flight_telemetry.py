"""Telemetry logs in the folder of a video or photos, put on the clock of the images."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import av
import numpy as np
import piexif
import pytest
from PIL import Image

from spn_data.capture.candidates import analyse
from spn_data.capture.sources import discover
from spn_data.errors import InputError
from spn_data.inputs.flight_telemetry import check_telemetry, source_telemetry
from spn_data.telemetry.read import read_telemetry
from spn_data.telemetry.track import Telemetry
from tests.worlds.log_files import (
    make_flight,
    write_dataflash,
    write_fit,
    write_nmea,
    write_tlog,
    write_ulog,
)

# Three fixes at 10:00:03, 10:00:05 and 10:00:07 UTC, as GPX and as CSV.
TRACK = "".join(
    f'<trkpt lat="49.0" lon="8.{second}"><time>2026-05-01T10:00:0{second}Z</time></trkpt>'
    for second in (3, 5, 7)
)
LOGS = {
    "flight.gpx": f"<gpx><trk><trkseg>{TRACK}</trkseg></trk></gpx>",
    "flight.csv": "datetime(utc),latitude,longitude\n"
    + "".join(f"2026-05-01 10:00:0{second},49.0,8.{second}\n" for second in (3, 5, 7)),
}


def telemetry_in(folder: Path, **options: Any) -> Telemetry:
    """Return the telemetry of the only source in a folder."""
    (source,) = discover(folder).sources
    track = source_telemetry(source, analyse(source, threads=1), **options)
    assert track is not None
    return track


def write_video(path: Path, created: str | None, frames: int = 6) -> None:
    """Write a video of uniform frames at one frame per second."""
    with av.open(str(path), "w") as container:
        if created is not None:
            container.metadata["creation_time"] = created
        stream = container.add_stream("libx264", rate=1)
        stream.width, stream.height, stream.pix_fmt = 64, 32, "yuv420p"
        for k in range(frames):
            image = np.full((32, 64, 3), 10 * k, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode())


def write_photos(folder: Path, *, zone: str | None, hour: int = 12) -> None:
    """Write photos taken at 4 and 6 seconds after an hour."""
    for second in (4, 6):
        exif = {piexif.ExifIFD.DateTimeOriginal: f"2026:05:01 {hour}:00:0{second}"}
        if zone is not None:
            exif[piexif.ExifIFD.OffsetTimeOriginal] = zone
        path = folder / f"{second}.jpg"
        Image.new("RGB", (64, 48)).save(path, exif=piexif.dump({"Exif": exif}))


def gpx(first: datetime, minutes: int, step_s: int = 1) -> str:
    """Return a GPX track that moves east."""
    point = '<trkpt lat="49.0" lon="{}"><time>{:%Y-%m-%dT%H:%M:%SZ}</time></trkpt>'
    seconds = range(0, 60 * minutes + 1, step_s)
    points = [point.format(8 + 1e-5 * s, first + timedelta(seconds=s)) for s in seconds]
    return f"<gpx><trk><trkseg>{''.join(points)}</trkseg></trk></gpx>"


@pytest.mark.parametrize("log", list(LOGS))
@pytest.mark.parametrize(
    ("created", "times_s"),
    [("2026-05-01T10:00:01Z", [2, 4, 6]), ("2026-05-01T10:00:04Z", [-1, 1, 3]), (None, [0, 2, 4])],
)
def test_a_log_is_put_on_the_clock_of_its_video(
    tmp_path: Path, log: str, created: str | None, times_s: list[float]
) -> None:
    """Log times are UTC minus the video's creation time; without one, the log starts with the video."""
    write_video(tmp_path / "flight.mp4", created)
    (tmp_path / log).write_text(LOGS[log])
    track = telemetry_in(tmp_path)
    assert track.time_s.tolist() == times_s
    assert track.lat_lon_deg[:, 1].tolist() == [8.3, 8.5, 8.7]


@pytest.mark.parametrize("write", [write_ulog, write_dataflash, write_tlog, write_nmea, write_fit])
def test_a_flight_log_is_put_on_the_clock_of_its_video(tmp_path: Path, write: Any) -> None:
    """A log that begins 3 s before its video has its fixes at their times in the video."""
    flight = make_flight(count=60, no_lock=1)
    suffix = {"ulog": ".ulg", "dataflash": ".bin"}.get(name := write.__name__[6:], f".{name}")
    write(tmp_path / f"flight{suffix}", flight)
    write_video(tmp_path / "flight.mp4", "2024-05-01T12:00:03Z")
    check_telemetry(discover(tmp_path).sources[0])
    track = telemetry_in(tmp_path)
    at = track.at(np.array([0.0, 1.0, 5.0]))
    np.testing.assert_allclose(track.time_s[0], -3.0, atol=1e-3)
    np.testing.assert_allclose(at.lat_lon_deg[:, 1], flight.lon_deg[[15, 20, 40]], atol=2e-7)


def test_of_several_logs_those_not_used_are_named(tmp_path: Path) -> None:
    """A video with two logs of its name says which one is used and which is not."""
    write_video(tmp_path / "flight.mp4", "2026-05-01T10:00:05Z")
    for name in ("flight.gpx", "flight.csv"):
        (tmp_path / name).write_text(LOGS[name])
    assert "read from flight.csv; not used: flight.gpx" in telemetry_in(tmp_path).notes


def test_a_log_is_put_on_the_clock_of_its_photos(tmp_path: Path) -> None:
    """Times of a log in a folder of photos count from the time of the first photo."""
    for second in (4, 6):
        taken = datetime(2026, 5, 1, 10, 0, second).strftime("%Y:%m:%d %H:%M:%S")
        exif = {piexif.ExifIFD.DateTimeOriginal: taken, piexif.ExifIFD.OffsetTimeOriginal: "+00:00"}
        Image.new("RGB", (64, 48)).save(
            tmp_path / f"{second}.jpg", exif=piexif.dump({"Exif": exif})
        )
    (tmp_path / "flight.gpx").write_text(LOGS["flight.gpx"])
    assert telemetry_in(tmp_path).time_s.tolist() == [-1, 1, 3]


def test_a_clock_without_zone_is_not_taken_as_utc(tmp_path: Path) -> None:
    """Photos at 12:00 without time zone do not match 12:00 UTC in a log from 08:00 to 14:00."""
    write_photos(tmp_path, zone=None)
    (tmp_path / "log.gpx").write_text(gpx(datetime(2026, 5, 1, 8), 360, 10))
    with pytest.raises(
        InputError, match=r"log.gpx: cannot be paired with the photos.* zones fit, from"
    ) as error:
        telemetry_in(tmp_path)
    assert "from UTC-1 to UTC+4" in str(error.value)
    assert "-OffsetTimeOriginal" in str(error.value)
    accepted = telemetry_in(tmp_path, any_telemetry=True)
    assert any("read as UTC (--any-telemetry)" in note for note in accepted.notes)
    given = telemetry_in(tmp_path, time_offset_s=7200.0)
    assert given.time_s[0] == -4 * 3600 - 4
    assert any("plus --time-offset" in note for note in given.notes)


def test_the_only_zone_that_fits_is_found(tmp_path: Path) -> None:
    """If only one time zone puts a ten-minute log over the photos, it is used and a note names it."""
    write_photos(tmp_path, zone=None)
    (tmp_path / "log.gpx").write_text(gpx(datetime(2026, 5, 1, 9, 55), 10))
    track = telemetry_in(tmp_path)
    assert track.time_s[0] == -5 * 60 - 4  # 09:55 UTC is 11:55 on the camera's clock
    assert track.at(np.array([0.0, 2.0])).has_fix.all()
    assert any("it is read as UTC+2, the only one that fits" in note for note in track.notes)


def test_a_log_without_zone_is_not_taken_as_utc(tmp_path: Path) -> None:
    """A CSV in local time gets the only zone that fits the creation time of its video."""
    write_video(tmp_path / "flight.mp4", "2026-05-01T10:00:01Z")
    text = LOGS["flight.csv"].replace("(utc)", "").replace(" 10:", " 12:")
    (tmp_path / "flight.csv").write_text(text)
    track = telemetry_in(tmp_path)
    assert track.time_s.tolist() == [2, 4, 6]
    assert any(
        "flight.csv states no time zone; it is read as UTC+2" in note for note in track.notes
    )


@pytest.mark.parametrize(
    ("created", "words"),
    [
        (
            "2026-05-01T02:00:00Z",
            r"7:59:55 apart; a shift by 8:00:00, a time zone.* --time-offset -28800",
        ),
        (
            "2026-05-01T10:00:09Z",
            r"end of the recording as its creation time, give --time-offset 5",
        ),
        ("2026-05-03T12:34:56Z", r"apart; remove the file, give --time-offset"),
    ],
)
def test_a_log_of_another_time_is_refused_before_mapping(
    tmp_path: Path, created: str, words: str
) -> None:
    """If no frame gets a fix, the error gives the time difference and its likely cause, unless accepted."""
    write_video(tmp_path / "flight.mp4", created)
    (tmp_path / "flight.gpx").write_text(LOGS["flight.gpx"].replace("10:00:03", "10:00:00"))
    with pytest.raises(InputError, match=r"flight.gpx: 0 of \d+ images get a fix.*" + words):
        telemetry_in(tmp_path)
    (source,) = discover(tmp_path).sources
    with pytest.raises(InputError, match="images get a fix"):
        check_telemetry(source)
    accepted = telemetry_in(tmp_path, any_telemetry=True)
    assert any("0 of 6 images get a fix" in note for note in accepted.notes)


def test_subtitles_that_start_late_are_refused(tmp_path: Path) -> None:
    """Subtitles from an editor's timeline at 1:00:00 are refused with the offset that makes them fit."""
    write_video(tmp_path / "flight.mp4", None)
    record = "{}\n01:00:0{},000 --> 01:00:59,000\n[latitude: 50.5] [longitude: 8.25{}]\n\n"
    (tmp_path / "flight.srt").write_text("".join(record.format(k, k, k) for k in range(6)))
    with pytest.raises(InputError, match=r"from 1:00:00 to 1:00:05 .*--time-offset -3600"):
        telemetry_in(tmp_path)
    track = telemetry_in(tmp_path, time_offset_s=-3600.0)
    assert track.time_s[0] == 3600.0
    assert not any("get a fix" in note for note in track.notes)


def test_partial_fixes_are_said(tmp_path: Path) -> None:
    """If a log covers only part of the video, a note counts the images with a fix."""
    write_video(tmp_path / "flight.mp4", "2026-05-01T10:00:01Z")
    (tmp_path / "flight.gpx").write_text(LOGS["flight.gpx"])
    track = telemetry_in(tmp_path)
    assert any(
        "5 of 6 images get a fix: its fixes last from 0:00:02" in note for note in track.notes
    )


def test_a_log_without_dates_is_not_left_out_silently(tmp_path: Path) -> None:
    """A log in seconds is refused for photos because nothing relates their clocks."""
    write_photos(tmp_path, zone="+02:00")
    (tmp_path / "log.csv").write_text("time_s,lat,lon\n0,49,8\n1,49,8.001\n")
    with pytest.raises(
        InputError, match=r"log.csv: cannot be paired with the photos, as it has no dates"
    ):
        telemetry_in(tmp_path)


def test_inputs_whose_clocks_differ(shared_cases: Path) -> None:
    """Inputs on different clocks are refused with the reason, and a GPX log with 5 s intervals is used."""
    cases = shared_cases / "input"
    with pytest.raises(InputError, match=r"cannot be paired .* zones fit"):
        telemetry_in(cases / "02-photos-local-time-gpx-utc" / "photos")
    (source,) = discover(cases / "03-creation-time-is-local" / "GX010021.mp4").sources
    with pytest.raises(InputError, match=r"8:00:00, a time zone, fits.*--time-offset -28800"):
        check_telemetry(source)
    track = read_telemetry(cases / "04-gpx-every-5s" / "karma.gpx")
    assert track.at(np.array([10.0, 12.5])).has_fix.all()


def test_ass_subtitles_beside_a_video_are_on_its_clock(tmp_path: Path) -> None:
    """An .ass file with the name of the video is read as its telemetry, as an .srt file is."""
    write_video(tmp_path / "MAX_0001.mp4", "2026-05-01T10:00:01Z")
    line = (
        "Dialogue: 0,0:00:0{}.00,0:00:09.00,Default,,0,0,0,,GPS(W: -20.5, N: 48.25, 1)\\NReH:20\n"
    )
    (tmp_path / "MAX_0001.ass").write_text("[Events]\n" + "".join(line.format(k) for k in range(6)))
    track = telemetry_in(tmp_path)
    assert track.time_s.tolist() == [0, 1, 2, 3, 4, 5]
    assert track.has_fix.all()
