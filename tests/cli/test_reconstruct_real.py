"""Reconstruction and georegistration of real drone data."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from click.testing import CliRunner
from spn_cli.data import main

from spn_data.area.area import Area
from spn_data.area.names import FRAMES, FRAMES_TABLE, GEO, MODEL
from spn_data.capture.frames import read_frames


def reconstruct(source: Path, area: Path) -> Area:
    """Reconstruct an area with the default options."""
    result = CliRunner().invoke(main, ["reconstruct", str(source), "--area", str(area)])
    assert result.exit_code == 0, result.output
    return Area(area)


@pytest.mark.slow
def test_photos_of_a_beach_become_one_georeferenced_model(
    shared_data: Path, tmp_path: Path
) -> None:
    """All 18 photos from 40 m with gimbal angles register; the one with least texture needs more features."""
    area = reconstruct(shared_data / "photos-dji-xmp", tmp_path / "area")
    model, geo = area.record(MODEL).counts, area.record(GEO).counts
    assert model["registered"] == model["frames"] == 18
    assert 0.1 < model["mean_error_px"] < 0.6
    notes = area.record(MODEL).notes
    assert "more features in the missing frames registered 1 more" in notes
    with (area.folder(MODEL) / "registration.csv").open(encoding="utf-8") as file:
        features = [int(row["keypoints"]) for row in csv.DictReader(file)]
    assert features.count(4096) == 17
    assert max(features) == 8192
    assert "gimbal" in geo["observations"]
    assert 0.05 < geo["horizontal_rmse_m"] < 1.0
    assert geo["outliers"] == 0


@pytest.mark.slow
def test_a_real_flight_video_with_its_own_fixes_becomes_one_model(
    shared_data: Path, tmp_path: Path
) -> None:
    """A 13 s video straight along a coast gives one model, whose tilt about the line stays unknown."""
    pytest.importorskip("mapillary_tools")
    source = shared_data / "video" / "gopro-karma.mp4"
    result = CliRunner().invoke(
        main, ["reconstruct", str(source), "--area", str(tmp_path / "area")]
    )
    assert result.exit_code == 1
    message = " ".join(result.output.split())
    assert "cannot be georegistered: the tilt about the line of azimuth" in message
    area = Area(tmp_path / "area")
    counts = area.record(MODEL).counts
    assert counts["frames"] >= 25
    assert counts["registered"] >= 0.95 * counts["frames"]
    (camera,) = counts["cameras"].values()
    assert 40 < camera["fov_deg"] < 127
    frames = read_frames(area.folder(FRAMES) / FRAMES_TABLE)
    assert frames.select(frames.chosen).has_fix.all()
    assert not area.has(GEO)
