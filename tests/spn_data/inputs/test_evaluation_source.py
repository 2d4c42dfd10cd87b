"""Sampling of the frames of an evaluation flight."""

from __future__ import annotations

import numpy as np

from spn_data.capture.sources import discover
from spn_data.inputs.evaluation_source import sample_frames
from spn_data.telemetry.read import read_telemetry


def test_a_given_time_offset_moves_the_telemetry(flight1, tmp_path):
    """Frames get the fixes whose times plus the offset are theirs, and the stored track is moved too."""
    (source,) = discover(flight1).sources
    sampled = sample_frames(
        tmp_path,
        source,
        None,
        lambda *_: None,
        rate_hz=1.0,
        fov_deg=72.0,
        fixed_lens=False,
        any_telemetry=False,
        time_offset_s=2.0,
    )
    plain = read_telemetry(flight1 / "flight1.SRT")
    chosen = sampled.frames.select(sampled.frames.chosen & sampled.frames.has_fix)
    assert len(chosen) >= 3
    assert chosen.time_s.min() >= 1.5
    np.testing.assert_allclose(
        chosen.lat_lon_deg, plain.at(chosen.time_s - 2.0).lat_lon_deg, atol=1e-9
    )
    np.testing.assert_allclose(sampled.track.time_s, plain.time_s + 2.0)
