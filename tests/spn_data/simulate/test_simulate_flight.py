"""Simulated flights respect heights, angles and distances; telemetry is truth plus errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spn_data.errors import InputError
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import angles_from_rotations, rotation_errors_deg
from spn_data.simulate import (
    FlightPath,
    GnssOptions,
    MappingPaths,
    SimulateOptions,
    gnss_errors,
    preset,
    simulate_paths,
    simulate_telemetry,
)
from spn_data.simulate.scene import build_scene

CASES = [(1, 1.0), (2, 1.0), (3, 4.0)]


def options_of(seed: int, area_factor: float) -> SimulateOptions:
    return replace(preset("standard", seed=seed), area_factor=area_factor)


def mapping_poses(paths: dict[str, FlightPath]) -> Poses:
    flights = [path.poses for path in paths.values() if path.role == "mapping"]
    return Poses(
        np.concatenate([poses.centers for poses in flights]),
        np.concatenate([poses.quats_wxyz for poses in flights]),
    )


def distances(poses: Poses, others: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Return metres (N, M) and degrees (N, M) between all pairs of poses."""
    metres = np.linalg.norm(poses.centers[:, None] - others.centers, axis=2)
    degrees = rotation_errors_deg(poses.quats_wxyz[:, None], others.quats_wxyz[None])
    return metres, degrees


@pytest.mark.parametrize(("seed", "area_factor"), CASES)
def test_flights_keep_to_their_heights_and_angles(seed: int, area_factor: float) -> None:
    """Heights, pitch angles and rates are within bounds.

    Mapping flies 1.5-9 m high at -10 to +15 degrees and turns slowly; low flies 12-21 m at -45 to -70.
    """
    paths = simulate_paths(options_of(seed, area_factor))
    assert list(paths) == ["flight1", "flight2", "medium", "low"]
    ranges = {"low": ((12.0, 21.0), (-70.0, -45.0)), "medium": ((1.5, 9.0), (-10.0, 15.0))}
    for name, path in paths.items():
        (low_m, high_m), (low_deg, high_deg) = ranges.get(name, ranges["medium"])
        up = path.poses.centers[:, 2]
        angles = angles_from_rotations(path.poses.rotations)
        assert low_m < up.min()
        assert up.max() < high_m
        assert low_deg < angles[:, 1].min()
        assert angles[:, 1].max() < high_deg
        assert np.abs(angles[:, 2]).max() < 2.0
        speed = np.linalg.norm(np.diff(path.poses.centers, axis=0), axis=1) * 10.0
        assert speed.min() > 0.5
        assert speed.max() < 3.5
        turn_deg_s = np.abs(np.diff(np.unwrap(angles[:, 0], period=360.0))) * 10.0
        assert turn_deg_s.max() < 30.0
        assert np.count_nonzero(path.blurred) == round(0.12 * len(path.time_s))


@pytest.mark.parametrize(("seed", "area_factor"), CASES)
def test_low_flight_is_far_from_every_mapping_frame_and_medium_is_near(
    seed: int, area_factor: float
) -> None:
    """Each low frame is 5 m or 35 degrees from all mapping frames; most medium frames are near one."""
    paths = simulate_paths(options_of(seed, area_factor))
    mapping = mapping_poses(paths)
    metres, degrees = distances(paths["low"].poses, mapping)
    assert ((metres >= 5.0) | (degrees >= 35.0)).all()
    metres, degrees = distances(paths["medium"].poses, mapping)
    assert ((metres < 5.0) & (degrees < 25.0)).any(axis=1).mean() > 0.5
    focal = {path.role: path.camera.focal_px[0] for path in paths.values()}
    assert focal["mapping"] > 1.4 * focal["evaluation"]


@pytest.mark.parametrize("paths", list(MappingPaths))
def test_flights_stay_clear_of_walls_and_objects(paths: MappingPaths) -> None:
    """No camera is within 0.5 m of an obstacle, or within 2 m of a facade below its top."""
    for seed in (1, 2, 3):
        options = replace(preset("standard", seed=seed), mapping_paths=paths)
        place = build_scene(options.scene)
        low, high = place.obstacles[:, :3], place.obstacles[:, 3:]
        for path in simulate_paths(options).values():
            centers = path.poses.centers
            gaps = np.maximum(np.maximum(low - centers[:, None], centers[:, None] - high), 0.0)
            assert np.linalg.norm(gaps, axis=2).min() > 0.5
            inside = centers[centers[:, 2] < 18.5]
            assert (np.abs(inside[:, :2]) < np.array(options.scene.half_m) - 2.0).all()


def test_nadir_looks_down_in_lines_and_straight_is_straight() -> None:
    """The nadir path has parallel lines 45 m up; the straight path deviates by centimetres."""
    nadir = simulate_paths(
        replace(preset("standard"), mapping_paths=MappingPaths.NADIR, only=("mapping",))
    )
    assert list(nadir) == ["nadir"]
    down = nadir["nadir"].poses.rotations[:, 2]
    assert (down[:, 2] < -0.99).all()
    assert np.ptp(nadir["nadir"].poses.centers[:, 1]) > 50.0
    path = simulate_paths(replace(preset("standard"), mapping_paths=MappingPaths.STRAIGHT))[
        "straight"
    ]
    singular = np.linalg.svd(path.poses.centers - path.poses.centers.mean(axis=0))[1]
    assert singular[1] / singular[0] < 0.01


def test_paths_depend_on_the_seed_alone_and_not_on_which_are_asked_for() -> None:
    """Equal options give equal paths, `only` does not change the others, and another seed does."""
    options = preset("demo", seed=5)
    paths, again = (
        simulate_paths(options),
        simulate_paths(replace(options, only=("low", "flight2"))),
    )
    assert list(again) == ["flight2", "low"]
    for name, path in again.items():
        np.testing.assert_array_equal(path.poses.centers, paths[name].poses.centers)
        np.testing.assert_array_equal(path.blurred, paths[name].blurred)
    other = simulate_paths(preset("demo", seed=6))["low"]
    assert np.abs(other.poses.centers - paths["low"].poses.centers).max() > 0.5


def test_presets_differ_in_image_and_rate_only() -> None:
    """`demo` shows the flights of `standard` at 960 x 540 and 5 fps."""
    demo, standard = simulate_paths(preset("demo")), simulate_paths(preset("standard"))
    assert {name: len(path.time_s) for name, path in standard.items()} == {
        "flight1": 750,
        "flight2": 600,
        "medium": 300,
        "low": 250,
    }
    for name, path in demo.items():
        assert (path.camera.width, path.camera.height) == (960, 540)
        np.testing.assert_allclose(
            path.poses.centers, standard[name].poses.centers[::2], atol=1e-12
        )
    with pytest.raises(InputError, match="unknown preset 'large'; choose from demo, look-alike, "):
        preset("large")
    with pytest.raises(InputError, match="unknown flight 'flight3'"):
        simulate_paths(replace(preset("demo"), only=("flight3",)))


def test_telemetry_is_truth_plus_its_errors() -> None:
    """Positions and heights are truth plus the drawn error, and the gimbal bias is constant."""
    options = preset("standard", seed=4)
    path = simulate_paths(options)["flight1"]
    telemetry = simulate_telemetry(path, options)
    alt_m = telemetry.abs_alt_m + options.geoid_m
    enu = options.origin.enu_from_wgs84(np.column_stack([telemetry.lat_lon_deg, alt_m]))
    np.testing.assert_allclose(
        enu[:, :2], (path.poses.centers + telemetry.errors_m)[:, :2], atol=1e-4
    )
    np.testing.assert_allclose(
        telemetry.rel_alt_m, path.poses.centers[:, 2] + telemetry.errors_m[:, 2]
    )
    bias = telemetry.gimbal_deg - angles_from_rotations(path.poses.rotations)
    bias[:, 0] = (bias[:, 0] + 180.0) % 360.0 - 180.0
    assert np.ptp(bias, axis=0).max() < 1e-6
    assert np.abs(bias[0, 1:]).max() < 4 * 0.3
    assert np.abs(bias[0]).min() > 1e-4
    without = simulate_telemetry(path, replace(options, gimbal_angles=False))
    assert np.isnan(without.gimbal_deg).all()


def test_adding_the_time_offset_to_the_records_puts_them_right() -> None:
    """A record stamped t describes the video at time t + offset."""
    options = replace(preset("standard"), time_offset_s=0.7, gnss=GnssOptions.rtk())
    path = simulate_paths(options)["flight2"]
    telemetry = simulate_telemetry(path, options)
    np.testing.assert_allclose(
        np.interp(
            path.time_s[20:-20],
            telemetry.time_s + 0.7,
            telemetry.rel_alt_m - telemetry.errors_m[:, 2],
        ),
        path.poses.centers[20:-20, 2],
        atol=5e-3,
    )


def test_gnss_errors_have_the_stated_statistics() -> None:
    """Sigma of each axis is within 4 %, correlation 1/e after 60 s, white noise and bursts as set."""
    rng = np.random.default_rng(0)
    time_s = np.arange(0.0, 121.0, 20.0)
    calm = GnssOptions(white_sigma_m=0.0, burst_interval_s=float("inf"))
    draws = np.stack([gnss_errors(time_s, calm, rng)[0] for _ in range(4000)])
    np.testing.assert_allclose(draws[:, 0].std(axis=0), [0.7, 0.7, 1.1], rtol=0.04)
    np.testing.assert_allclose(draws[:, -1].std(axis=0), [0.7, 0.7, 1.1], rtol=0.04)
    for axis in range(3):
        correlation = np.corrcoef(draws[:, 0, axis], draws[:, 3, axis])[0, 1]
        assert correlation == pytest.approx(np.exp(-1), abs=0.06)
    assert abs(np.corrcoef(draws[:, 0, 0], draws[:, 0, 1])[0, 1]) < 0.06
    time_s = np.arange(0.0, 30000.0, 0.1)
    white = GnssOptions(bias_sigma_m=(0.0, 0.0, 0.0))
    errors, is_burst = gnss_errors(time_s, white, rng)
    assert errors[~is_burst].std() == pytest.approx(0.08, rel=0.02)
    assert np.linalg.norm(errors[is_burst], axis=1).mean() == pytest.approx(12.0, rel=0.01)
    # 1,000 bursts are expected, a few of which overlap.
    assert np.count_nonzero(np.diff(is_burst.astype(int)) == 1) == pytest.approx(970, rel=0.1)
    assert np.count_nonzero(is_burst) * 0.1 / 970 == pytest.approx(1.0, rel=0.12)


def test_rtk_has_three_centimetres_and_nothing_else() -> None:
    """RTK noise is white with a standard deviation of 3 cm, and its mean over time vanishes."""
    errors, is_burst = gnss_errors(np.arange(20000.0), GnssOptions.rtk(), np.random.default_rng(1))
    assert not is_burst.any()
    np.testing.assert_allclose(errors.std(axis=0), 0.03, rtol=0.03)
    assert np.abs(errors.mean(axis=0)).max() < 0.001
