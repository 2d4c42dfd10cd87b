"""Replay of a recording in real time."""

from __future__ import annotations

import time

import numpy as np
import pytest

from spn_data.errors import InputError
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_model.autopilot.datum import Datum
from spn_model.autopilot.link import unix_us
from spn_model.onboard.fly import above_sea
from spn_model.onboard.replay import RealTime

IMAGE = np.zeros((1, 1, 3), np.uint8)


def test_images_come_when_they_are_due_with_unix_time() -> None:
    """Images of a recording are stamped with the present time, as far apart as they were recorded."""
    clock, begin_us = RealTime(), unix_us()
    came = [
        (time_us, unix_us())
        for time_us, *_ in clock.paced(
            (t, IMAGE, None, None) for t in (1_000_000, 1_050_000, 1_200_000)
        )
    ]
    stamps = [stamp for stamp, _ in came]
    assert np.diff(stamps).tolist() == [50_000, 150_000]
    assert begin_us <= stamps[0]
    assert all(stamp <= now for stamp, now in came)
    assert clock.late == 0


def test_images_that_cannot_be_fetched_in_time_are_left_out_and_counted() -> None:
    """While an image takes 0.3 s, images that are more than 0.1 s late are left out."""
    clock, found = RealTime(), []
    for time_us, *_ in clock.paced((t, IMAGE, None, None) for t in range(0, 500_000, 50_000)):
        found.append(time_us)
        if len(found) == 1:
            time.sleep(0.3)
    assert clock.late >= 3
    assert len(found) + clock.late == 10


def test_heights_above_the_take_off_point_need_its_height_above_sea_level() -> None:
    """With the height of the take-off point an origin is one above sea level; others are refused."""
    origin = GeoOrigin(49.0, 8.4, 2.0, HeightReference.TAKEOFF)
    with pytest.raises(InputError, match="--takeoff-height"):
        Datum(origin=origin).require_amsl()
    lifted = above_sea(origin, 115.0)
    Datum(origin=lifted).require_amsl()
    assert lifted.alt_m == 117.0
    with pytest.raises(InputError, match="above 'amsl'"):
        above_sea(lifted, 115.0)
