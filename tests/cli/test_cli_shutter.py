"""A rolling shutter found in a video is noted in the record of the model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner
from spn_cli.data import main

from spn_data.area.area import Area
from spn_data.area.names import MODEL
from spn_data.simulate import preset, simulate


@pytest.mark.slow
def test_a_rolling_shutter_is_told_with_the_model(tmp_path: Path) -> None:
    """A rendered readout of 50 ms is noted; small images and few frames make the estimate a little short."""
    options = replace(
        preset("standard", seed=3),
        width=480,
        height=270,
        fps=2.0,
        length_factor=0.3,
        texels_per_m=40.0,
        only=("flight1",),
        readout_s=0.05,
    )
    simulate(tmp_path / "flights", options, workers=1)
    arguments = ["reconstruct", str(tmp_path / "flights" / "mapping"), "--fov", "72"]
    arguments += ["--area", str(tmp_path / "area"), "--max-features", "1500", "--threads", "1"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    record = Area(tmp_path / "area").record(MODEL)
    assert any(note.startswith("flight1: rolling shutter of about") for note in record.notes)
    assert 0.03 < record.counts["shutter"][0]["readout_s"] < 0.06
