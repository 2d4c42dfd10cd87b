"""Telemetry that a camera recorded as a data track inside the video."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from spn_data.errors import InputError
from spn_data.telemetry.camm import read_camm
from spn_data.telemetry.data_tracks import DataTrack, TrackFormat, read_data_tracks
from spn_data.telemetry.gpmf import read_gpmf
from spn_data.telemetry.misb_klv import read_misb
from spn_data.telemetry.track import Telemetry

_logger = logging.getLogger(__name__)

_ORDER = (TrackFormat.GPMF, TrackFormat.CAMM, TrackFormat.KLV, TrackFormat.DJI)
_READERS = {TrackFormat.GPMF: read_gpmf, TrackFormat.CAMM: read_camm, TrackFormat.KLV: read_misb}
_DJI_REMEDY = (
    "its telemetry is DJI's own track (djmd), which is not read: record with subtitles switched on, or "
    "export the flight log as CSV or GPX"
)


def read_embedded(path: Path) -> Telemetry | None:
    """Read the telemetry of the first data track that has any: GPMF, CAMM, KLV.

    Parameters
    ----------
    path : Path
        The video file.

    Returns
    -------
    Telemetry or None
        time_s is 0 at the first frame. None if the video has no data track of a recognized format.

    Raises
    ------
    InputError
        If there is such a track, but none gives a position: what is wrong with the first, and the remedy.
    """
    tracks = sorted(read_data_tracks(path), key=lambda track: _ORDER.index(track.format))
    failure: InputError | None = None
    for number, track in enumerate(tracks):
        try:
            telemetry = _read(track, path)
        except InputError as error:
            _logger.debug("%s: %s", track.format, error)
            failure = failure or error
            continue
        others = [other.format.value for k, other in enumerate(tracks) if k != number]
        if others:
            note = f"other data tracks not used: {', '.join(others)}"
            telemetry = replace(telemetry, notes=(*telemetry.notes, note))
        return telemetry
    if failure is not None:
        raise failure
    return None


def _read(track: DataTrack, path: Path) -> Telemetry:
    """Read one track; one that never has a fix is a failure too."""
    if track.format is TrackFormat.DJI:
        raise InputError(_DJI_REMEDY, path=path)
    telemetry = _READERS[track.format](track.packets, str(path))
    if not telemetry.has_fix.any():
        raise InputError(
            f"its {track.format.value} track has {len(telemetry)} records, none with a fix: the receiver "
            "had no satellites",
            path=path,
        )
    return telemetry
