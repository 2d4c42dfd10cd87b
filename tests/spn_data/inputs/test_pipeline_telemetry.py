"""Notes on data tracks of videos that cannot be read as telemetry."""

from __future__ import annotations

from pathlib import Path

from spn_data.capture.sources import discover
from spn_data.inputs.flight_telemetry import unread_tracks


def test_a_gopro_video_is_told_to_carry_a_track_that_is_not_read(shared_data: Path) -> None:
    """A note names the GoPro metadata track of a video, which is not read."""
    (source,) = discover(shared_data / "video" / "gopro-karma.mp4").sources
    (note,) = unread_tracks(source)
    assert note.startswith("gopro-karma: its data tracks (")
    assert "GoPro MET" in note


def test_nothing_is_said_of_a_video_without_data_tracks(flight1: Path) -> None:
    """A video without data tracks gives no note."""
    (source,) = discover(flight1).sources
    assert unread_tracks(source) == []
