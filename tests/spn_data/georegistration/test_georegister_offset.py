"""Tests of the time offset between telemetry and video, on simulated flights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spn_data.geometry.pose import Poses, Similarity
from spn_data.geometry.rotations import rotations_from_angles, rotations_from_vectors
from spn_data.georegistration import TimeOffset, estimate_time_offset
from spn_data.simulate.flight import FlightPath, simulate_paths, simulate_telemetry
from spn_data.simulate.presets import preset
from spn_data.telemetry.track import Telemetry

STANDARD = preset("standard", seed=3)
MODEL_FROM_WORLD = Similarity(0.2, rotations_from_vectors(np.array([1.0, -0.7, 0.2])), np.ones(3))


def _track(path: FlightPath, seed: int, offset_s: float, *, gimbal: bool = True) -> Telemetry:
    drawn = simulate_telemetry(path, replace(STANDARD, seed=seed, time_offset_s=offset_s))
    return Telemetry.from_columns(
        drawn.time_s,
        lat_lon_deg=np.round(drawn.lat_lon_deg, 6),
        rel_alt_m=drawn.rel_alt_m,
        gimbal_deg=np.round(drawn.gimbal_deg, 1) if gimbal else None,
        kind="dji-srt",
    )


@pytest.fixture(scope="module")
def path() -> FlightPath:
    return simulate_paths(STANDARD)["flight2"]


def _frames(path: FlightPath) -> tuple[Poses, np.ndarray]:
    rows = np.arange(0, len(path.time_s), 8)
    return MODEL_FROM_WORLD.apply_to_poses(path.poses[rows]), path.time_s[rows]


@pytest.mark.parametrize("offset_s", [0.4, -2.3])
def test_an_offset_is_found_within_a_tenth_of_a_second(path, offset_s):
    """In six draws, the offset is within 0.1 s, and in all but one within 3 sigma."""
    model, time_s = _frames(path)
    errors, sigmas = [], []
    for seed in range(6):
        found = estimate_time_offset(model, time_s, _track(path, seed, offset_s))
        assert found.offset_s is not None
        errors.append(abs(found.offset_s - offset_s))
        sigmas.append(found.sigma_s)
    assert max(errors) < 0.1
    assert np.mean(np.array(errors) < 3 * np.array(sigmas)) > 0.8
    assert 0.0005 < np.median(sigmas) < 0.05


def test_the_offset_brings_telemetry_to_the_video_s_time(path):
    """Telemetry shifted by the offset has the camera's heading at video time."""
    model, time_s = _frames(path)
    track = _track(path, 1, 1.5)
    found = estimate_time_offset(model, time_s, track)
    heading = track.shifted(found.applied_s).at(time_s).gimbal_deg[:, 0]
    true = path.motion.at(time_s)[1][:, 0]
    difference = (heading - true + 180) % 360 - 180
    known = np.isfinite(difference)
    # Only the constant error of the compass remains.
    assert np.std(difference[known]) < 0.5


def _even_flight(speed_m_s: float) -> tuple[Poses, np.ndarray, Telemetry]:
    """Simulate a flight east at constant speed, looking north, with GNSS drift and white noise."""
    rng = np.random.default_rng(4)
    time_s = np.arange(0, 60, 0.1)
    centers = np.column_stack([speed_m_s * time_s, 0 * time_s, 0 * time_s + 5])
    drift = np.cumsum(rng.standard_normal((len(time_s), 3)) * 0.04, axis=0)
    found = centers + drift + 0.05 * rng.standard_normal(centers.shape)
    angles = np.column_stack([0 * time_s, 0 * time_s + 3, 0 * time_s])
    track = Telemetry.from_columns(
        time_s,
        lat_lon_deg=STANDARD.origin.wgs84_from_enu(found)[:, :2],
        rel_alt_m=found[:, 2],
        gimbal_deg=angles,
        kind="dji-srt",
    )
    rows = np.arange(0, len(time_s), 8)
    shake = rotations_from_vectors(np.deg2rad(0.03) * rng.standard_normal((len(rows), 3)))
    poses = Poses.from_rotations(
        centers[rows] + 0.01 * rng.standard_normal((len(rows), 3)),
        shake @ rotations_from_angles(angles[rows]),
    )
    return MODEL_FROM_WORLD.apply_to_poses(poses), time_s[rows], track


@pytest.mark.parametrize("speed_m_s", [0.0, 2.0])
def test_a_hover_and_an_even_line_leave_the_offset_undetermined(speed_m_s):
    """If a time shift has no effect, no offset is returned and the reason is given."""
    found = estimate_time_offset(*_even_flight(speed_m_s))
    assert found.offset_s is None
    assert found.applied_s == 0.0
    assert "undetermined" in found.describe("flight1")


def test_a_straight_line_without_gimbal_angles_leaves_it_undetermined():
    """A straight flight without gimbal angles has no offset, but raises no error."""
    model, time_s, track = _even_flight(2.0)
    track = replace(track, gimbal_deg=np.full((len(track), 3), np.nan))
    assert estimate_time_offset(model, time_s, track).offset_s is None


def test_too_little_telemetry_leaves_it_undetermined(path):
    """Without fixes, or with only five frames, no offset is returned."""
    model, time_s = _frames(path)
    track = _track(path, 1, 0.0)
    empty = replace(track, lat_lon_deg=np.full((len(track), 2), np.nan))
    assert estimate_time_offset(model, time_s, empty).offset_s is None
    found = estimate_time_offset(model[:5], time_s[:5], track)
    assert found.reason.startswith("5 frames")


def test_an_offset_is_described_with_its_sigma():
    """The description gives the signed offset and its sigma in seconds."""
    sentence = TimeOffset(0.4, 0.02).describe("flight1")
    assert sentence == "flight1: time offset of the telemetry +0.40 s (sigma 0.02 s)."
