"""Telemetry from any supported file, detected by name and content."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from spn_data.errors import InputError
from spn_data.telemetry.ass_file import read_ass
from spn_data.telemetry.csv_log import read_csv_log
from spn_data.telemetry.dataflash import read_dataflash
from spn_data.telemetry.dji_srt import read_dji_srt
from spn_data.telemetry.embedded import read_embedded
from spn_data.telemetry.fit import read_fit
from spn_data.telemetry.gpx import read_gpx
from spn_data.telemetry.mavlink_tlog import read_tlog
from spn_data.telemetry.nmea import is_nmea, read_nmea
from spn_data.telemetry.px4_ulog import read_ulog
from spn_data.telemetry.subtitles import read_subtitles
from spn_data.telemetry.track import Telemetry

# Logs that are read through optional packages.
LOG_READERS: dict[str, Callable[[Path], Telemetry]] = {
    ".ulg": read_ulog,
    ".bin": read_dataflash,
    ".tlog": read_tlog,
    ".fit": read_fit,
    ".nmea": read_nmea,
}
TELEMETRY_SUFFIXES = (".srt", ".ass", ".gpx", ".csv", ".tsv", ".txt", *LOG_READERS)
VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".m4v", ".ts", ".avi")


def read_telemetry(path: Path | str) -> Telemetry:
    """Read telemetry from an .srt, .ass, .gpx, .csv (.tsv, .txt), a flight log or a track of a video.

    Parameters
    ----------
    path : Path or str
        The file.

    Returns
    -------
    Telemetry
        Its records.

    Raises
    ------
    InputError
        If the file is of another kind or contains no telemetry.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix in VIDEO_SUFFIXES:
        telemetry = read_subtitles(path)
        if telemetry is None:
            telemetry = read_embedded(path)
        if telemetry is None:
            raise InputError(
                "the video has no subtitle or data track to read telemetry from", path=path
            )
        return telemetry
    if suffix not in TELEMETRY_SUFFIXES:
        raise InputError(
            f"{suffix or 'a file without a suffix'} is not a telemetry format; supported are "
            "subtitles of drones (.srt, .ass), GPX (.gpx), CSV with named columns (.csv, .tsv, .txt), "
            f"logs ({', '.join(LOG_READERS)}) and videos with a subtitle or data track "
            f"({', '.join(VIDEO_SUFFIXES)})",
            path=path,
        )
    if suffix in LOG_READERS:
        return LOG_READERS[suffix](path)
    if suffix == ".gpx":
        return read_gpx(path)
    if suffix == ".ass":
        return read_ass(path)
    # Subtitles and GPX are often saved as .txt, and logs from the web with a wrong suffix.
    start = _head(path)
    if start.startswith("<") and "<gpx" in start:
        return read_gpx(path)
    if suffix == ".srt" or "-->" in start:
        return read_dji_srt(path)
    if is_nmea(start):
        return read_nmea(path)
    return read_csv_log(path)


def _head(path: Path) -> str:
    """Read the first 2,000 characters, only to tell formats apart."""
    try:
        with path.open("rb") as file:
            return file.read(2000).decode("utf-8-sig", errors="replace").lstrip()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=path) from error
