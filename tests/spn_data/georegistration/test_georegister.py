"""Tests of georegistration on simulated flights with exact ground truth."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, replace

import numpy as np
import pytest

from spn_data.errors import FormatError, GeometryError
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.pose import Poses, Similarity, pose_errors
from spn_data.geometry.rotations import rotations_from_vectors
from spn_data.georegistration import (
    GeoErrors,
    GeoFit,
    GeoregisterOptions,
    Heights,
    align_telemetry,
    georegister,
    georegistration_errors,
)
from spn_data.simulate.flight import simulate_paths, simulate_telemetry
from spn_data.simulate.gnss import GnssOptions
from spn_data.simulate.presets import MappingPaths, SimulateOptions, preset
from spn_data.telemetry.track import Telemetry

STANDARD = preset("standard", seed=3)
STRAIGHT = replace(STANDARD, mapping_paths=MappingPaths.STRAIGHT)


@dataclass(frozen=True, eq=False)
class Draw:
    """One draw of errors: the inputs of georegistration and the truth."""

    model: Poses
    telemetry: Telemetry
    sequence: list[str]
    time_s: np.ndarray
    true: Poses
    world_from_model: Similarity
    is_burst: np.ndarray
    origin: GeoOrigin

    def fit(self, options: GeoregisterOptions | None = None) -> GeoFit:
        return georegister(self.model, self.telemetry, self.sequence, self.time_s, options)

    def errors(self, fit: GeoFit) -> GeoErrors:
        zero = np.array([[self.origin.lat_deg, self.origin.lon_deg, 0.0]])
        shift = fit.origin.enu_from_wgs84(zero)[0] * [1, 1, 0]
        true = replace(self.world_from_model, translation=self.world_from_model.translation + shift)
        return georegistration_errors(fit.world_from_model, true, self.model.centers)


def draw(options: SimulateOptions = STANDARD, *, sigma_m: dict[str, float] | None = None) -> Draw:
    """Simulate every eighth mapping frame, with model poses off by 1 cm and 0.03 degrees of noise."""
    rng = np.random.default_rng([options.seed, 5])
    tracks, sequence, times, centers, rotations, bursts = {}, [], [], [], [], []
    for name, path in simulate_paths(replace(options, seed=STANDARD.seed)).items():
        if path.role != "mapping":
            continue
        drawn = simulate_telemetry(path, options)
        sigma = (sigma_m or {}).get(name)
        tracks[name] = Telemetry.from_columns(
            drawn.time_s,
            lat_lon_deg=np.round(drawn.lat_lon_deg, 6) if sigma is None else drawn.lat_lon_deg,
            rel_alt_m=drawn.rel_alt_m,
            abs_alt_m=drawn.abs_alt_m,
            gimbal_deg=np.round(drawn.gimbal_deg, 1),
            sigma_m=None if sigma is None else np.full((len(drawn.time_s), 3), sigma),
            kind="dji-srt",
        )
        rows = np.arange(0, len(path.time_s), 8)
        sequence += [name] * len(rows)
        times.append(path.time_s[rows])
        centers.append(path.poses.centers[rows])
        rotations.append(path.poses.rotations[rows])
        bursts.append(drawn.is_burst[rows])
    true = Poses.from_rotations(np.concatenate(centers), np.concatenate(rotations))
    shake = rotations_from_vectors(np.deg2rad(0.03) * rng.standard_normal((len(true), 3)))
    near = Poses.from_rotations(
        true.centers + 0.01 * rng.standard_normal((len(true), 3)), shake @ true.rotations
    )
    model_from_world = Similarity(
        0.37, rotations_from_vectors(np.array([0.4, -1.9, 0.8])), np.ones(3)
    )
    time_s = np.concatenate(times)
    return Draw(
        model_from_world.apply_to_poses(near),
        align_telemetry(tracks, sequence, time_s),
        sequence,
        time_s,
        true,
        model_from_world.inverse(),
        np.concatenate(bursts),
        options.origin,
    )


@pytest.fixture(scope="module")
def standard() -> Draw:
    return draw()


@pytest.fixture(scope="module")
def standard_fit(standard: Draw) -> GeoFit:
    return standard.fit()


def test_gnss_bias_limits_the_position_and_the_gimbal_the_tilt(standard, standard_fit):
    """Position is off by the mean GNSS bias (decimetres), tilt by less than 0.1 degrees."""
    errors = standard.errors(standard_fit)
    assert 0.05 < errors.position_m < 2.0
    assert errors.tilt_deg < 0.1
    assert abs(errors.heading_deg) < 2.0
    assert 1e-6 < abs(errors.scale) < 0.03
    assert standard_fit.observations == ("fixes", "heights", "gimbal")
    assert 1 < standard_fit.summary.effective_fixes < 10  # of 169: two flights of about one minute


def test_noise_levels_are_found_from_the_residuals(standard_fit):
    """The drifting bias (0.7/1.1 m) and white noise (0.08 m) are estimated from the residuals."""
    bias, white = standard_fit.noise_m["horizontal"]
    assert 0.45 < bias < 1.1
    assert 0.05 < white < 0.13
    bias, white = standard_fit.noise_m["vertical"]
    assert 0.7 < bias < 1.7
    assert 0.05 < white < 0.13


def test_frames_in_bursts_are_outliers_and_no_others(standard, standard_fit):
    """All frames with 12 m of multipath are outliers, with less than 2 % false alarms."""
    assert standard.is_burst.sum() >= 3
    assert standard_fit.outlier[standard.is_burst].all()
    assert standard_fit.outlier[~standard.is_burst].mean() < 0.02
    assert standard_fit.summary.outliers == standard_fit.outlier.sum()


def test_the_gauge_of_the_model_does_not_matter(standard, standard_fit):
    """Any gauge of the model gives the same world poses within 1e-9."""
    turn = rotations_from_vectors(np.array([2.0, 0.3, -1.0]))
    other_from_model = Similarity(23.0, turn, np.array([500.0, -80.0, 9.0]))
    moved = replace(standard, model=other_from_model.apply_to_poses(standard.model))
    first = standard_fit.world_from_model.apply_to_poses(standard.model)
    second = moved.fit().world_from_model.apply_to_poses(moved.model)
    error_m, error_deg = pose_errors(second, first)
    assert error_m.max() < 1e-9
    assert error_deg.max() < 1e-9


@pytest.mark.parametrize(
    ("lat", "lon"), [(-33.4, -70.6), (64.1, -21.9), (-17.5, 179.9999), (0.0, 0.0)]
)
def test_any_place_on_earth_gives_the_same_fit(standard, standard_fit, lat, lon):
    """The errors are the same in the south, in the west, at the antimeridian and on the equator."""
    there = draw(replace(STANDARD, origin=GeoOrigin(lat, lon, 163.2)))
    errors, expected = there.errors(there.fit()), standard.errors(standard_fit)
    # Rounding latitude and longitude to 6 decimals has a different effect in each place.
    assert errors.position_m == pytest.approx(expected.position_m, abs=0.1)
    assert errors.heading_deg == pytest.approx(expected.heading_deg, abs=0.15)


def test_a_take_off_twelve_metres_lower_becomes_the_flight_s_offset(standard):
    """A second take-off 12 m lower is estimated as that flight's vertical offset."""
    second = np.array(standard.sequence) == "flight2"
    heights = standard.telemetry.rel_alt_m + np.where(second, 12.0, 0.0)
    fit = replace(standard, telemetry=replace(standard.telemetry, rel_alt_m=heights)).fit()
    assert fit.vertical_offsets_m["flight1"] == 0.0
    assert fit.vertical_offsets_m["flight2"] == pytest.approx(-12.0, abs=3.0)  # two biases of 1.1 m
    assert standard.errors(fit).tilt_deg < 0.1
    assert any("flight2: its heights are offset by" in note for note in fit.notes)


def test_take_offs_that_differ_within_the_errors_pass_as_one(standard, standard_fit):
    """Flights from one take-off get vertical offsets below 0.6 m and no note."""
    assert abs(standard_fit.vertical_offsets_m["flight2"]) < 0.6
    assert not any("its heights are offset by" in note for note in standard_fit.notes)


def test_a_straight_flight_needs_gimbal_angles():
    """A straight flight is refused without gimbal angles; with them, tilt is within 0.7 degrees."""
    with pytest.raises(GeometryError, match=r"cross leg of at least 20 m, or give gimbal angles"):
        draw(replace(STRAIGHT, gimbal_angles=False)).fit()
    straight = draw(STRAIGHT)
    errors = straight.errors(straight.fit())
    assert errors.tilt_deg < 0.7
    assert abs(errors.scale) < 0.1


def test_without_gimbal_angles_heights_and_level_cameras_give_the_vertical():
    """Without gimbal angles, tilt is within 2 degrees and its uncertainty reflects that."""
    without = draw(replace(STANDARD, gimbal_angles=False))
    fit = without.fit()
    assert 0.02 < without.errors(fit).tilt_deg < 2.0
    assert 0.2 < fit.uncertainty.tilt_deg < 2.0
    assert fit.observations == ("fixes", "heights", "level cameras")
    assert np.isnan(fit.gravity_deg).all()


def test_a_hovering_drone_is_refused(standard):
    """Fixes that spread no more than their noise are refused."""
    hover = replace(standard.telemetry, lat_lon_deg=standard.telemetry.lat_lon_deg.copy())
    rng = np.random.default_rng(1)
    hover.lat_lon_deg[:] = hover.lat_lon_deg[0] + 3e-6 * rng.standard_normal((len(hover), 2))
    hover = replace(hover, rel_alt_m=5 + 0.3 * rng.standard_normal(len(hover)))
    with pytest.raises(GeometryError, match="hovering drone"):
        replace(standard, telemetry=hover).fit()


def test_too_few_fixes_are_refused(standard):
    """Two fixes, or none, are refused with their count."""
    for count, message in ((2, "2 frames have a fix, 6 are needed"), (0, "none of 169 frames")):
        lat_lon = standard.telemetry.lat_lon_deg.copy()
        lat_lon[count:] = np.nan
        with pytest.raises(GeometryError, match=message):
            replace(standard, telemetry=replace(standard.telemetry, lat_lon_deg=lat_lon)).fit()


def test_telemetry_of_another_flight_is_refused(standard):
    """Fixes shuffled in time fit no similarity and are refused."""
    back = np.random.default_rng(0).permutation(len(standard.time_s))
    shuffled = replace(standard.telemetry.select(back), time_s=standard.telemetry.time_s)
    with pytest.raises(GeometryError, match="telemetry of another"):
        replace(standard, telemetry=shuffled).fit()


def test_a_model_joined_wrongly_is_refused(standard, monkeypatch):
    """If 47 % of the model are 200 m beside their place, and 40 % are allowed, the fixes contradict it."""
    module = sys.modules["spn_data.georegistration.georegister"]
    monkeypatch.setattr(module, "_MAX_OUTLIERS", 0.4)
    centers, at = (
        standard.model.centers.copy(),
        np.arange(len(standard.time_s)) / len(standard.time_s),
    )
    shift = np.array([200.0, 0.0, 0.0]) / standard.world_from_model.scale
    centers[at >= 0.53] += standard.world_from_model.rotation.T @ shift
    joined = Poses(centers, standard.model.quats_wxyz)
    with pytest.raises(GeometryError, match="fixes contradict the georegistered model"):
        replace(standard, model=joined).fit()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_two_flights_with_each_other_s_telemetry_are_refused_for_it(seed):
    """Swapped telemetry of two flights is refused, even if the flights have equal length."""
    drawn = draw(replace(STANDARD, seed=seed))
    first = np.array(drawn.sequence) == "flight1"
    n = min(first.sum(), (~first).sum())
    rows = np.arange(len(first))
    rows[:n], rows[np.flatnonzero(~first)[:n]] = np.flatnonzero(~first)[:n], np.arange(n)
    swapped = replace(drawn, telemetry=replace(drawn.telemetry.select(rows), time_s=drawn.time_s))
    with pytest.raises(GeometryError, match="may be the telemetry of another flight"):
        swapped.fit()


def test_a_gimbal_that_was_never_written_does_not_stop_the_fit(standard):
    """Gimbal angles that are all zero are ignored with a note."""
    frozen = replace(standard.telemetry, gimbal_deg=np.zeros_like(standard.telemetry.gimbal_deg))
    fit = replace(standard, telemetry=frozen).fit()
    assert "gimbal" not in fit.observations
    assert any("gimbal angles disagree" in note for note in fit.notes)


def test_frames_without_telemetry_change_nothing(standard):
    """Frames without telemetry do not affect the fit and have no residual."""
    gone = np.zeros(len(standard.time_s), dtype=bool)
    gone[::3] = True
    columns = ("lat_lon_deg", "rel_alt_m", "abs_alt_m", "gimbal_deg", "sigma_m")
    empty = {name: getattr(standard.telemetry, name).copy() for name in columns}
    for column in empty.values():
        column[gone] = np.nan
    with_gaps = replace(standard, telemetry=replace(standard.telemetry, **empty)).fit()
    without = georegister(
        standard.model[~gone],
        standard.telemetry.select(~gone),
        [s for s, g in zip(standard.sequence, gone, strict=True) if not g],
        standard.time_s[~gone],
    )
    assert np.isnan(with_gaps.residuals_m[gone]).all()
    assert with_gaps.world_from_model.apply(standard.model.centers) == pytest.approx(
        without.world_from_model.apply(standard.model.centers), abs=1e-6
    )


def test_a_flight_with_rtk_leads_one_without():
    """With one RTK flight of 3 cm, position error and uncertainty are below 5 cm."""
    mixed = draw(STANDARD, sigma_m={"flight1": 0.03, "flight2": 1.0})
    exact = draw(
        replace(STANDARD, gnss=GnssOptions.rtk()), sigma_m={"flight1": 0.03, "flight2": 0.03}
    )
    first = np.array(mixed.sequence) == "flight1"
    lat_lon = np.where(first[:, None], exact.telemetry.lat_lon_deg, mixed.telemetry.lat_lon_deg)
    heights = np.where(first, exact.telemetry.rel_alt_m, mixed.telemetry.rel_alt_m)
    both = replace(mixed.telemetry, lat_lon_deg=lat_lon, rel_alt_m=heights)
    fit = replace(mixed, telemetry=both).fit()
    assert 0 < mixed.errors(fit).position_m < 0.05
    assert fit.uncertainty.horizontal_m < 0.05
    assert {"horizontal", "horizontal_rtk"} <= set(fit.noise_m)


def test_rtk_that_the_source_does_not_state_shows_in_the_residuals():
    """RTK accuracy that the source does not state is estimated: the fit is accurate to 5 cm."""
    exact = draw(replace(STANDARD, gnss=GnssOptions.rtk()))
    fit = exact.fit()
    assert exact.errors(fit).position_m < 0.05
    assert fit.noise_m["horizontal"][1] < 0.06


def test_fixes_left_out_in_blocks_fit_worse_than_those_used(standard_fit):
    """Held-out blocks of a minute reveal that correlated errors make residuals too small."""
    held_out, summary = standard_fit.held_out_blocks, standard_fit.summary
    assert held_out.folds == 3
    assert held_out.horizontal_rmse_m > 1.1 * summary.horizontal_rmse_m
    assert standard_fit.held_out_flights.folds == 2


def test_gimbal_angles_that_move_otherwise_than_the_camera_are_refused_by_name(standard):
    """Wrong gimbal angles are refused with the flight's name; without gimbal the fit succeeds."""
    gimbal = standard.telemetry.gimbal_deg.copy()
    second = np.array(standard.sequence) == "flight2"
    gimbal[second, 1:] = np.random.default_rng(2).uniform(-60, 60, (second.sum(), 2))
    wrong = replace(standard, telemetry=replace(standard.telemetry, gimbal_deg=gimbal))
    with pytest.raises(GeometryError, match="flight2: the gimbal angles vary by"):
        wrong.fit()
    assert standard.errors(wrong.fit(GeoregisterOptions(use_gimbal=False))).tilt_deg < 2


def test_the_zero_of_heights_is_what_was_said_of_it(standard, standard_fit):
    """The vertical zero is the take-off, its given height, or that of absolute heights (unknown)."""
    assert standard_fit.height_reference is HeightReference.TAKEOFF
    assert standard_fit.origin.alt_m == 0.0
    given = standard.fit(
        GeoregisterOptions(takeoff_alt_m=115.0, height_reference=HeightReference.AMSL)
    )
    assert (given.origin.alt_m, given.height_reference) == (115.0, HeightReference.AMSL)
    assert given.world_from_model.translation[2] == pytest.approx(
        standard_fit.world_from_model.translation[2], abs=0.01
    )
    unknown = standard.fit(GeoregisterOptions(heights=Heights.ABSOLUTE))
    assert unknown.height_reference is HeightReference.UNKNOWN
    assert any("vertical zero is unknown" in note for note in unknown.notes)
    up_m = unknown.world_from_model.apply(standard.model.centers)[:, 2] + unknown.origin.alt_m
    # abs_alt is offset from the courtyard's ground by 163.2 m minus the geoid height of 48.3 m.
    assert np.mean(up_m - standard.true.centers[:, 2]) == pytest.approx(163.2 - 48.3, abs=3.0)


def test_without_heights_everything_but_the_height_is_known(standard):
    """Without heights, the mean camera height is 0 with infinite vertical uncertainty."""
    unknown = np.full(len(standard.time_s), np.nan)
    flat = replace(standard.telemetry, rel_alt_m=unknown, abs_alt_m=unknown)
    fit = replace(standard, telemetry=flat).fit()
    errors = standard.errors(fit)
    assert errors.tilt_deg < 0.1
    assert errors.horizontal_m < 1.5
    assert fit.uncertainty.vertical_m == np.inf
    assert fit.world_from_model.apply(standard.model.centers)[:, 2].mean() == pytest.approx(
        0, abs=1e-6
    )
    assert "heights" not in fit.observations


def test_an_area_that_is_extended_keeps_its_origin(standard, standard_fit):
    """A given origin is kept, and world poses shift by the difference of the origins."""
    origin = GeoOrigin(STANDARD.origin.lat_deg + 0.001, STANDARD.origin.lon_deg, 0.0)
    origin = replace(origin, height_reference=HeightReference.TAKEOFF)
    fit = standard.fit(GeoregisterOptions(origin=origin))
    assert fit.origin == origin
    north_m = fit.world_from_model.translation[1] - standard_fit.world_from_model.translation[1]
    assert north_m == pytest.approx(
        origin.enu_from_wgs84(
            np.array([standard_fit.origin.lat_deg, standard_fit.origin.lon_deg, 0.0])
        )[1],
        abs=0.01,
    )


def test_json_holds_the_whole_fit(standard_fit):
    """A fit survives the JSON round trip; damaged and newer versions are refused."""
    text = json.dumps(standard_fit.to_json(), allow_nan=False)
    again = GeoFit.from_json(json.loads(text))
    assert again.to_json() == standard_fit.to_json()
    assert again.origin == standard_fit.origin
    assert np.array_equal(again.residuals_m, standard_fit.residuals_m, equal_nan=True)
    value = json.loads(text)
    with pytest.raises(FormatError, match="version 99"):
        GeoFit.from_json({**value, "version": 99})
    del value["uncertainty"]["tilt_deg"]
    with pytest.raises(FormatError, match="tilt_deg"):
        GeoFit.from_json(value)


@pytest.mark.slow
def test_the_stated_uncertainty_contains_the_truth():
    """In 15 draws, at least 70 % of the errors are within two sigma (nominally 95 %)."""
    inside = []
    for seed in range(200, 215):
        one = draw(replace(STANDARD, seed=seed))
        fit = one.fit(GeoregisterOptions(gnss_bias_m=(0.0, 0.0)))  # the draws have none
        errors, stated = one.errors(fit), fit.uncertainty
        inside.append(
            [
                errors.horizontal_m < 2 * stated.horizontal_m,
                abs(errors.vertical_m) < 2 * stated.vertical_m,
                abs(errors.heading_deg) < 2 * stated.heading_deg,
                abs(errors.scale) < 2 * stated.scale,
            ]
        )
    assert np.all(np.mean(inside, axis=0) >= 0.7)
    assert np.mean(inside) < 1.0
