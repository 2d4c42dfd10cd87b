"""Telemetry tracks: interpolation, gaps, ends, angles, summary."""

from __future__ import annotations

import numpy as np
import pytest

from spn_data.telemetry.track import Telemetry, coordinate_step_m, summarize, time_order

RNG = np.random.default_rng(7)


def track(time_s, **columns) -> Telemetry:
    time_s = np.asarray(time_s, dtype=np.float64)
    columns.setdefault("lat_lon_deg", np.stack([50 + time_s * 1e-5, 8 - time_s * 1e-5], axis=1))
    return Telemetry.from_columns(time_s, **columns)


def test_at_is_linear_between_records():
    """Half-way between two records, position, height and clock are half-way between theirs."""
    t = track([0.0, 1.0, 2.0], rel_alt_m=[0.0, 4.0, 6.0], utc_s=[100.0, 101.0, 102.0])
    at = t.at(np.array([0.5, 1.25]))
    np.testing.assert_allclose(at.rel_alt_m, [2.0, 4.5])
    np.testing.assert_allclose(
        at.lat_lon_deg[:, 0], [50 + 0.5e-5, 50 + 1.25e-5], rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(at.utc_s, [100.5, 101.25])


def test_at_the_records_own_times_returns_them():
    """Interpolating at the records' own times changes nothing, whatever the gaps between them."""
    time_s = np.cumsum(RNG.uniform(0.01, 6.0, 200))
    t = track(time_s, rel_alt_m=RNG.normal(size=200), gimbal_deg=RNG.uniform(0, 80, (200, 3)))
    at = t.at(time_s)
    np.testing.assert_allclose(at.rel_alt_m, t.rel_alt_m, rtol=0, atol=1e-12)
    np.testing.assert_allclose(at.gimbal_deg, t.gimbal_deg, rtol=0, atol=1e-9)
    np.testing.assert_allclose(at.lat_lon_deg, t.lat_lon_deg, rtol=0, atol=1e-12)


def test_no_value_is_made_up_outside_the_neighbouring_records():
    """Every interpolated value is between the known values on both sides of its time."""
    time_s = np.cumsum(RNG.uniform(0.05, 2.0, 100))
    height = RNG.normal(size=100)
    height[RNG.random(100) < 0.3] = np.nan
    wanted = RNG.uniform(time_s[0], time_s[-1], 2000)
    got = track(time_s, rel_alt_m=height).at(wanted).rel_alt_m
    known = np.isfinite(height)
    kt, kv = time_s[known], height[known]
    right = np.clip(np.searchsorted(kt, wanted), 1, len(kt) - 1)
    low, high = np.minimum(kv[right - 1], kv[right]), np.maximum(kv[right - 1], kv[right])
    seen = np.isfinite(got)
    assert 0.5 < seen.mean() < 1
    assert np.all((got[seen] >= low[seen] - 1e-12) & (got[seen] <= high[seen] + 1e-12))
    inside = (wanted > kt[0]) & (wanted < kt[-1])
    np.testing.assert_array_equal(seen[inside], (kt[right] - kt[right - 1] <= 2.5)[inside])


def test_a_gap_gives_no_position():
    """Inside a gap longer than the limit there is no position, but at its edges there is."""
    at = track([0.0, 1.0, 2.0, 10.0, 11.0]).at(np.array([1.9, 2.0, 2.1, 6.0, 9.9, 10.0, 10.1]))
    np.testing.assert_array_equal(at.has_fix, [True, True, False, False, False, True, True])


def test_records_without_a_fix_are_a_gap_of_the_position_only():
    """Heights are interpolated through records whose position is unknown."""
    time_s = np.arange(8.0)
    lat_lon = np.full((8, 2), 50.0)
    lat_lon[2:6] = np.nan
    at = track(time_s, lat_lon_deg=lat_lon, rel_alt_m=time_s).at(np.array([0.5, 3.5]))
    np.testing.assert_array_equal(at.has_fix, [True, False])
    np.testing.assert_allclose(at.rel_alt_m, [0.5, 3.5])


def test_edges_stay_sharp_late_in_a_long_flight():
    """An hour into a flight, a time 10 ms beyond the edge of a gap is still in the gap."""
    at = track([3600.0, 3601.0, 3700.0, 3701.0]).at(np.array([3601.0, 3601.01]))
    np.testing.assert_array_equal(at.has_fix, [True, False])


def test_ends_hold_for_half_an_interval():
    """Before the first and after the last record, their value holds for half an interval only."""
    at = track([0.0, 1.0, 2.0], rel_alt_m=[3.0, 4.0, 5.0]).at(np.array([-0.6, -0.4, 2.4, 2.6]))
    np.testing.assert_array_equal(at.rel_alt_m, [np.nan, 3.0, 5.0, np.nan])


def test_one_record_is_known_at_its_time_only():
    """A single record has no interval and is valid only at its own time."""
    at = track([3.0], rel_alt_m=[9.0]).at(np.array([2.9, 3.0, 3.1]))
    np.testing.assert_array_equal(at.rel_alt_m, [np.nan, 9.0, np.nan])


def test_no_record_gives_no_value():
    """Telemetry without records is unknown at all times."""
    assert not track([]).at(np.array([0.0, 1.0])).has_fix.any()


def test_hovering_stays_in_place():
    """Equal positions interpolate to exactly the same position."""
    at = track([0.0, 1.0, 2.0], lat_lon_deg=np.full((3, 2), 47.123456)).at(np.linspace(0, 2, 41))
    np.testing.assert_allclose(at.lat_lon_deg, 47.123456, rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("first", "second", "fraction", "expected"),
    [
        (359.0, 1.0, 0.5, 0.0),
        (350.0, 20.0, 0.25, 357.5),
        (10.0, 350.0, 0.75, 355.0),
        (0.0, 90.0, 0.25, 22.5),  # uniform along the arc; a chord would give 18.4
    ],
)
def test_heading_turns_along_the_shorter_arc(first, second, fraction, expected):
    """Between two headings the camera turns through the smaller angle, at a steady rate."""
    t = track([0.0, 1.0], gimbal_deg=[(first, -90.0, 0.0), (second, -90.0, 0.0)])
    heading = t.at(np.array([fraction])).gimbal_deg[0, 0]
    assert (heading - expected + 180) % 360 - 180 == pytest.approx(0, abs=1e-9)
    assert 0 <= heading < 360


def test_pitch_and_roll_keep_their_sign():
    """Pitch and roll come back in (-180, 180], also across 180 degrees of roll."""
    t = track([0.0, 1.0], gimbal_deg=[(0.0, -90.0, 179.0), (0.0, -80.0, -179.0)])
    np.testing.assert_allclose(t.at(np.array([0.5])).gimbal_deg, [(0.0, -85.0, 180.0)])


def test_the_date_line_is_no_jump():
    """A flight across longitude 180 is interpolated there instead of around the Earth."""
    t = track([0.0, 1.0], lat_lon_deg=[(-17.0, 179.999), (-17.0, -179.997)])
    np.testing.assert_allclose(t.at(np.array([0.5])).lat_lon_deg[0], (-17.0, -179.999), atol=1e-9)


def test_shifted_and_select_keep_rows_together():
    """Shifting changes times only, and selecting keeps each record's values together."""
    t = track([0.0, 1.0, 2.0], rel_alt_m=[5.0, 6.0, 7.0]).shifted(0.5).select(np.array([2, 0]))
    np.testing.assert_allclose(t.time_s, [2.5, 0.5])
    np.testing.assert_allclose(t.rel_alt_m, [7.0, 5.0])


def test_a_column_of_the_wrong_length_is_refused():
    """A column that does not fit the times raises ValueError with both shapes."""
    with pytest.raises(ValueError, match=r"\(2,\), expected \(3,\)"):
        Telemetry.from_columns(np.arange(3.0), rel_alt_m=np.zeros(2))


def test_summary_counts_fixes_gaps_and_rate():
    """The summary names gaps at the start, in the middle and at the end."""
    time_s = np.arange(30.0)
    lat_lon = np.full((30, 2), 50.0)
    lat_lon[:4] = lat_lon[10:15] = lat_lon[26:] = np.nan
    summary = summarize(track(time_s, lat_lon_deg=lat_lon))
    assert (summary.records, summary.with_fix, summary.rate_hz) == (30, 17, 1.0)
    assert summary.gaps == ((0.0, 4.0), (9.0, 15.0), (25.0, 29.0))
    assert not summary.has_rel_alt
    assert not summary.has_gimbal


def test_photos_seconds_apart_are_no_gaps():
    """Regular photos every 6 s have no gap, and a pause of 60 s is one."""
    time_s = np.concatenate([np.arange(0, 60, 6.0), np.arange(120, 180, 6.0)])
    assert summarize(track(time_s)).gaps == ((54.0, 120.0),)


def test_a_source_without_any_fix_is_one_gap():
    """If no record has a fix, the whole track is a gap and there is no rate."""
    summary = summarize(track(np.arange(5.0), lat_lon_deg=np.full((5, 2), np.nan)))
    assert summary.gaps == ((0.0, 4.0),)
    assert np.isnan(summary.rate_hz)


def test_coordinate_step_is_read_from_the_decimals():
    """Four decimals are steps of 11.1 m and six of 0.11 m; if none are known, the step is NaN."""
    assert coordinate_step_m(np.array([[48.0771, -121.7458]])) == pytest.approx(11.12, abs=0.01)
    assert coordinate_step_m(np.array([[48.077123, -121.5]])) == pytest.approx(0.1112, abs=1e-4)
    assert np.isnan(coordinate_step_m(np.full((2, 2), np.nan)))


def test_increasing_sorts_and_keeps_the_first_of_equal_times():
    """Records are sorted, and of two with the same time the first is kept; both cases get a note."""
    index, notes = time_order(np.array([2.0, 1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(index, [1, 0, 3])
    assert len(notes) == 2
    assert time_order(np.array([1.0, 2.0]))[1] == []


def test_one_rule_of_gaps_for_summary_and_interpolation():
    """A point each 5 s has no gap and is interpolated, with a sigma that grows towards the middle."""
    t = track(np.arange(0, 51, 5.0), sigma_m=np.full((11, 3), 2.0))
    assert summarize(t).gaps == ()
    at = t.at(np.array([5.0, 6.0, 7.5]))
    assert at.has_fix.all()
    np.testing.assert_allclose(at.sigma_m[:, 0], np.hypot(2.0, [0.0, 1.0, 1.5625]))
    with_hole = t.select(np.array([0, 1, 2, 3, 4, 8, 9, 10]))
    assert summarize(with_hole).gaps == ((20.0, 40.0),)
    assert not with_hole.at(np.array([30.0])).has_fix.any()


def test_sigma_stays_at_usual_rates():
    """Between records up to 2.5 s apart, sigma is that of the fixes."""
    t = track([0.0, 1.0, 3.4], sigma_m=np.full((3, 3), 2.0))
    np.testing.assert_allclose(t.at(np.array([0.5, 2.2])).sigma_m, 2.0)
