"""Height files on board: up in the world from heights above take-off, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from spn_data.errors import InputError
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.telemetry.table import write_track
from spn_data.telemetry.track import Telemetry
from spn_model.onboard.height import read_heights

TAKEOFF = GeoOrigin(49.0, 8.4, 2.0, HeightReference.TAKEOFF)
SEA = GeoOrigin(49.0, 8.4, 115.0, HeightReference.AMSL)


def test_heights_above_take_off_become_up_in_the_world(tmp_path):
    """The table of spn-data is read; a world above the sea needs the height of the place of take-off."""
    path = tmp_path / "t.csv"
    track = Telemetry.from_columns(np.arange(3.0), rel_alt_m=np.array([10.0, np.nan, 12.0]))
    write_track(path, track)
    found = read_heights(path, TAKEOFF, offset_s=0.5)
    assert found.time_s.tolist() == [0.5, 2.5]
    assert found.up_m.tolist() == [8.0, 10.0]
    assert [found.at(t) for t in (0.5, 1.5, 9.0)] == [8.0, None, None]
    assert read_heights(path, SEA, zero_m=110.0).up_m.tolist() == [5.0, 7.0]


@pytest.mark.parametrize(
    ("origin", "given", "told"),
    [
        (SEA, {}, "those of the world from 'amsl'; give the height of the place"),
        (
            GeoOrigin(49.0, 8.4, 2.0, HeightReference.UNKNOWN),
            {"zero_m": 5.0},
            "needs a world that states what its heights count from",
        ),
        (
            TAKEOFF,
            {"zero_m": float("nan")},
            "--height-zero nan or --height-offset 0 is out of range",
        ),
    ],
)
def test_heights_that_have_nothing_in_common_with_the_world_are_refused(
    tmp_path, origin, given, told
):
    """Nothing is assumed about what heights count from."""
    path = tmp_path / "t.csv"
    path.write_text("time_s,rel_alt_m\n0,1\n")
    with pytest.raises(InputError, match=told):
        read_heights(path, origin, **given)


def test_a_file_without_heights_is_refused(tmp_path):
    """The header, or the first bad line, is named."""
    path = tmp_path / "t.csv"
    path.write_text("time_s,abs_alt_m\n0,1\n")
    with pytest.raises(
        InputError, match=r"t\.csv:1: its header needs the columns time_s and rel_alt_m"
    ):
        read_heights(path, TAKEOFF)
    path.write_text("time_s,rel_alt_m\n0,1\n1,1e9\n")
    with pytest.raises(InputError, match=r"t\.csv:3: 1000000000\.0 is outside"):
        read_heights(path, TAKEOFF)
