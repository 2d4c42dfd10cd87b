"""Notes on data tracks of videos that cannot be read as telemetry."""

from __future__ import annotations

from pathlib import Path

from spn_data.capture.sources import discover
from spn_data.inputs.flight_telemetry import unread_tracks
from tests.worlds.data_track_videos import write_data_video


def test_a_gopro_video_whose_track_is_read_has_no_note(shared_data: Path) -> None:
    """No note says that the GoPro metadata track of a video is unread, for it is read."""
    (source,) = discover(shared_data / "video" / "gopro-karma.mp4").sources
    assert unread_tracks(source) == []


def test_a_klv_track_without_positions_is_named(tmp_path: Path) -> None:
    """A note names a KLV track that holds no position."""
    write_data_video(tmp_path / "a.ts", [(0.0, b"not a MISB set")])
    (source,) = discover(tmp_path / "a.ts").sources
    (note,) = unread_tracks(source)
    assert note.startswith("a: ")
    assert "no sensor position (MISB ST 0601)" in note


def test_nothing_is_said_of_a_video_without_data_tracks(flight1: Path) -> None:
    """A video without data tracks gives no note."""
    (source,) = discover(flight1).sources
    assert unread_tracks(source) == []
