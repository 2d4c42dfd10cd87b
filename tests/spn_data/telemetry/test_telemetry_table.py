"""Telemetry track files, joined parts, and zoom."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from spn_data.errors import FormatError
from spn_data.geometry.geodesy import HeightReference
from spn_data.telemetry.dji_srt import parse_dji_srt, read_dji_srt
from spn_data.telemetry.table import read_track, write_track
from spn_data.telemetry.track import Telemetry


def full_track(n: int = 5, start_s: float = 0.0) -> Telemetry:
    rng = np.random.default_rng(n)
    lat_lon = rng.uniform(-80, 80, (n, 2))
    lat_lon[1] = np.nan
    return Telemetry.from_columns(
        start_s + np.arange(n) / 3,
        lat_lon_deg=lat_lon,
        rel_alt_m=rng.normal(size=n),
        abs_alt_m=rng.normal(size=n),
        sigma_m=rng.uniform(size=(n, 3)),
        gimbal_deg=rng.uniform(0, 90, (n, 3)),
        utc_s=1.7e9 + rng.uniform(size=n),
        zoom=np.full(n, 24.0),
        abs_reference=HeightReference.AMSL,
        utc_is_local=True,
        kind="dji-srt",
        source='a "quoted", name.SRT',
        notes=("one, two", "three\nfour"),
    )


def test_a_track_comes_back_exactly(tmp_path: Path) -> None:
    """A track read back from its file equals the one written."""
    track = full_track()
    write_track(tmp_path / "track.csv", track)
    again = read_track(tmp_path / "track.csv")
    for field in fields(Telemetry):
        first, second = getattr(track, field.name), getattr(again, field.name)
        if isinstance(first, np.ndarray):
            assert np.array_equal(first, second, equal_nan=True), field.name
        else:
            assert first == second


@pytest.mark.parametrize("damage", ["", "# {}\n", "not a track\nx\n", "cut"])
def test_a_damaged_track_is_a_format_error(tmp_path: Path, damage: str) -> None:
    """A truncated or foreign track file raises FormatError."""
    path = tmp_path / "track.csv"
    write_track(path, full_track())
    text = path.read_text()
    path.write_text(text[:-30] if damage == "cut" else damage)
    with pytest.raises(FormatError, match=r"track\.csv: not a telemetry track"):
        read_track(path)


def test_parts_of_one_recording_are_joined_and_overlap_is_dropped() -> None:
    """Parts of a recording are joined in time order, and overlapping records are dropped."""
    joined = Telemetry.concatenate([full_track(5), full_track(4, start_s=1.0)])
    assert np.all(np.diff(joined.time_s) > 0)
    assert joined.time_s[0] == 0.0
    assert joined.time_s[-1] == pytest.approx(2.0)
    assert joined.notes == full_track().notes


def test_a_change_of_focal_length_or_digital_zoom_shows(shared_data: Path) -> None:
    """A real file has 24 mm throughout; optical or digital zoom in a record doubles its focal length."""
    real = read_dji_srt(shared_data / "srt" / "air3S.SRT")
    assert np.array_equal(real.zoom, np.full(len(real), 24.0))
    record = "{0}\n00:00:0{0},000 --> 00:00:0{0},900\n[latitude: 1.5] [longitude: 2.5] {1}\n\n"
    zooms = (
        "[focal_len: 24.00]",
        "[focal_len: 48.00]",
        "[focal_len: 24.00] [dzoom_ratio: 2.0, delta:0]",
        "",
    )
    text = "".join(record.format(k, zoom) for k, zoom in enumerate(zooms))
    track = parse_dji_srt(text, source="x.SRT")
    assert np.array_equal(track.zoom, [24.0, 48.0, 48.0, np.nan], equal_nan=True)
