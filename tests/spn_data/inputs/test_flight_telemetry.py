"""Logs in the folder of a video or of photos, on the clock of the images."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import av
import numpy as np
import piexif
import pytest
from PIL import Image

from spn_data.capture.candidates import analyse
from spn_data.capture.sources import discover
from spn_data.inputs.flight_telemetry import source_telemetry
from spn_data.telemetry.track import Telemetry

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


def telemetry_in(folder: Path) -> Telemetry:
    """Return the telemetry of the only source in a folder."""
    (source,) = discover(folder).sources
    track = source_telemetry(source, analyse(source, threads=1))
    assert track is not None
    return track


@pytest.mark.parametrize("log", list(LOGS))
@pytest.mark.parametrize(
    ("created", "times_s"),
    [("2026-05-01T10:00:01Z", [2, 4, 6]), ("2026-05-01T10:00:04Z", [-1, 1, 3]), (None, [0, 2, 4])],
)
def test_a_log_is_put_on_the_clock_of_its_video(
    tmp_path: Path, log: str, created: str | None, times_s: list[float]
) -> None:
    """Times are UTC minus the creation time of the video; without one, the log starts with the video."""
    with av.open(str(tmp_path / "flight.mp4"), "w") as container:
        if created is not None:
            container.metadata["creation_time"] = created
        stream = container.add_stream("libx264", rate=1)
        stream.width, stream.height, stream.pix_fmt = 64, 32, "yuv420p"
        for k in range(6):
            image = np.full((32, 64, 3), 10 * k, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode())
    (tmp_path / log).write_text(LOGS[log])
    track = telemetry_in(tmp_path)
    assert track.time_s.tolist() == times_s
    assert track.lat_lon_deg[:, 1].tolist() == [8.3, 8.5, 8.7]


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
