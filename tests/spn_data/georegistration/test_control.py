"""Tests of the GNSS bias and of ground control in the georegistration, on simulated flights."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from spn_data.errors import GeometryError
from spn_data.geometry.camera import Camera
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.pose import Poses, Similarity
from spn_data.geometry.rotations import rotations_from_angles, rotations_from_vectors
from spn_data.georegistration import GeoFit, GeoregisterOptions, georegister
from spn_data.georegistration.control import Control
from spn_data.ground_control.triangulation import Views
from spn_data.telemetry.track import Telemetry

ORIGIN = GeoOrigin(48.5, 9.0, 210.0, HeightReference.ELLIPSOID)
N = 40
SURVEY_M = np.array([0.02, 0.02, 0.03])
WORLD_FROM_MODEL = Similarity(
    7.0, rotations_from_vectors(np.array([0.3, 1.2, -0.5])), np.array([3.0, -2.0, 5.0])
)
MODEL_FROM_WORLD = WORLD_FROM_MODEL.inverse()


def flight(rng: np.random.Generator) -> Poses:
    """Return the true poses of a loop of 60 m."""
    turn = np.linspace(0, 2 * np.pi, N)
    centers = 30 * np.column_stack([np.cos(turn), np.sin(turn), 0.1 * np.sin(3 * turn)])
    angles = np.column_stack([rng.uniform(0, 360, N), rng.uniform(-40, -10, N), np.zeros(N)])
    return Poses.from_rotations(centers + np.array([0, 0, 12]), rotations_from_angles(angles))


def fixes(
    true: Poses,
    rng: np.random.Generator,
    bias_m: np.ndarray,
    *,
    relative: bool = False,
    sigma_m: float | None = None,
) -> Telemetry:
    """Return fixes with a constant bias and white noise of 0.2 m, or sigma."""
    noise = 0.2 if sigma_m is None else sigma_m
    enu = true.centers + bias_m + noise * rng.standard_normal((N, 3))
    place = ORIGIN.wgs84_from_enu(enu)
    gimbal = np.full((N, 3), np.nan)
    return Telemetry.from_columns(
        10.0 * np.arange(N),
        lat_lon_deg=place[:, :2],
        abs_alt_m=None if relative else place[:, 2],
        rel_alt_m=enu[:, 2] if relative else None,
        gimbal_deg=gimbal,
        sigma_m=None if sigma_m is None else np.full((N, 3), sigma_m),
        abs_reference=HeightReference.ELLIPSOID,
        kind="dji-srt",
    )


def surveyed(count: int, rng: np.random.Generator, check: int = 0) -> Control:
    """Return points on the ground with 1 cm of noise in the model and the survey's in the world."""
    true = np.column_stack([rng.uniform(-30, 30, (count, 2)), rng.uniform(0, 4, count)])
    mark_m = 0.01
    model = MODEL_FROM_WORLD.apply(true + mark_m * rng.standard_normal((count, 3)))
    covariance = np.tile((mark_m / WORLD_FROM_MODEL.scale) ** 2 * np.eye(3), (count, 1, 1))
    held = np.arange(count) < check
    # One camera above, which looks down.
    pose = Poses.from_rotations(
        np.array([[0.0, 0, 60]]), rotations_from_angles(np.array([[0.0, -90, 0]]))
    )
    pose = MODEL_FROM_WORLD.apply_to_poses(pose)
    camera = Camera.from_horizontal_fov(1000, 1000, 90.0)
    views = [
        Views(camera.project(pose.to_camera(m[None])), np.ones(1), pose, (camera,)) for m in model
    ]
    return Control(
        tuple(f"P{k}" for k in range(count)),
        model,
        covariance,
        true + SURVEY_M * rng.standard_normal((count, 3)),
        np.tile(SURVEY_M, (count, 1)),
        held,
        ORIGIN,
        ~held,
        tuple(views),
    )


def fit(
    true: Poses,
    rows: Telemetry,
    control: Control | None = None,
    options: GeoregisterOptions | None = None,
) -> GeoFit:
    model = MODEL_FROM_WORLD.apply_to_poses(true)
    options = options or GeoregisterOptions(origin=None if control else ORIGIN)
    return georegister(model, rows, ["a"] * N, 10.0 * np.arange(N), options, control)


def shift_m(found: GeoFit, true: Poses) -> np.ndarray:
    """Return the mean error (3,) of the cameras."""
    model = MODEL_FROM_WORLD.apply(true.centers)
    return np.asarray((found.world_from_model.apply(model) - true.centers).mean(axis=0))


def test_the_stated_uncertainty_contains_a_bias_that_does_not_average() -> None:
    """In 8 draws with a constant bias, truth is within 2 sigma, and hardly ever without the bias in it."""
    inside, without = [], []
    for draw in range(8):
        rng = np.random.default_rng([draw, 7])
        true = flight(rng)
        bias = rng.standard_normal(3) * [0.9, 0.9, 2.3]
        found = fit(true, fixes(true, rng, bias))
        off, stated = (
            np.abs(shift_m(found, true)),
            np.sqrt(np.diag(found.uncertainty.covariance)[:3]),
        )
        inside.append(off <= 2 * stated)
        rest = stated**2 - 1.15 * np.array([1.0, 1.0, 2.5]) ** 2  # the bias, and most of its drift
        without.append(off <= 2 * np.sqrt(np.maximum(rest, 0.01)))
    assert np.mean(inside) >= 0.85
    assert np.mean(without) < 0.8


def test_rtk_and_what_the_user_states_set_the_bias() -> None:
    """RTK fixes are stated to centimetres, and --gnss-bias to what it says."""
    rng = np.random.default_rng(1)
    true = flight(rng)
    rtk = fit(true, fixes(true, rng, np.zeros(3), sigma_m=0.02)).uncertainty
    assert 0.02 < rtk.horizontal_m < 0.04
    assert 0.03 < rtk.vertical_m < 0.05
    rows = fixes(true, rng, np.zeros(3))
    usual = fit(true, rows).uncertainty
    assert 1.2 < usual.horizontal_m < 1.8  # the radius of two axes of 1 m, and of the drift
    assert 2.5 < usual.vertical_m < 3.0
    options = GeoregisterOptions(origin=ORIGIN, gnss_bias_m=(0.0, 0.0))
    none = fit(true, rows, options=options).uncertainty
    assert none.horizontal_m < 0.7 * usual.horizontal_m
    wide = fit(true, rows, options=replace(options, gnss_bias_m=(3.0, 7.0))).uncertainty
    assert wide.vertical_m == pytest.approx(np.hypot(7.0, 0), rel=0.15)
    # A drift of metres over the flight acts on the scale.
    assert wide.scale > 1.5 * none.scale


def test_flights_of_two_days_average_their_biases() -> None:
    """Two flights have independent biases if their dates differ, and one if a date is unknown."""
    rng = np.random.default_rng(2)
    true = flight(rng)
    rows = fixes(true, rng, np.zeros(3))
    names = ["a"] * (N // 2) + ["b"] * (N // 2)
    model = MODEL_FROM_WORLD.apply_to_poses(true)
    time_s = 10.0 * np.arange(N)
    day_s = np.where(np.arange(N) < N // 2, 0.0, 86400.0)
    found = {
        name: georegister(
            model, replace(rows, utc_s=utc_s), names, time_s, GeoregisterOptions(origin=ORIGIN)
        ).uncertainty.vertical_m
        for name, utc_s in (
            ("two", 1.7e9 + day_s),
            ("one", 1.7e9 + time_s),
            ("unknown", rows.utc_s),
        )
    }
    assert found["two"] == pytest.approx(found["one"] / np.sqrt(2), rel=0.1)
    assert found["unknown"] == pytest.approx(found["one"], rel=0.02)


def test_ground_control_takes_the_bias_out() -> None:
    """With eight points the map is true to centimetres, check points say so, and fixes are told to be off."""
    rng = np.random.default_rng(3)
    true = flight(rng)
    found = fit(true, fixes(true, rng, np.array([1.4, -0.8, 3.0])), surveyed(8, rng, check=3))
    assert np.abs(shift_m(found, true)).max() < 0.05
    assert found.uncertainty.horizontal_m < 0.04
    assert [p.role for p in found.control] == ["check"] * 3 + ["control"] * 5
    assert max(p.reprojection_px for p in found.control) < 2
    residual = np.array([p.residual_m for p in found.control[:3]])
    sigma = np.array([p.sigma_m for p in found.control[:3]])
    assert (np.abs(residual) < 3 * sigma).all()
    assert 0.02 < sigma.min() < sigma.max() < 0.1
    assert any(n.startswith("Fixes are +1.") for n in found.notes)
    assert "ground control" in found.observations
    again = GeoFit.from_json(json.loads(json.dumps(found.to_json(), allow_nan=False)))
    assert [p.residual_m for p in again.control] == [p.residual_m for p in found.control]


def test_heights_above_take_off_get_the_height_of_the_points() -> None:
    """The world has the points' heights, and the flight's offset to them is told."""
    rng = np.random.default_rng(4)
    true = flight(rng)
    rows = fixes(true, rng, np.zeros(3), relative=True)
    rows = replace(rows, rel_alt_m=rows.rel_alt_m - 9.0)
    found = fit(true, rows, surveyed(5, rng))
    assert found.height_reference is HeightReference.ELLIPSOID
    assert np.abs(shift_m(found, true)).max() < 0.05
    assert found.vertical_offsets_m["a"] == pytest.approx(9.0, abs=0.3)


def test_one_point_corrects_the_place() -> None:
    """One point takes the bias out and leaves orientation and scale to the telemetry, with a note."""
    rng = np.random.default_rng(5)
    true = flight(rng)
    rows = fixes(true, rng, np.array([1.5, 1.0, -2.0]))
    alone, found = fit(true, rows), fit(true, rows, surveyed(1, rng))
    assert np.abs(shift_m(found, true)).max() < 0.6 < np.abs(shift_m(alone, true)).max()
    assert found.uncertainty.vertical_m < 0.5
    assert found.uncertainty.scale > 0.5 * alone.uncertainty.scale
    assert any(n.startswith("1 ground control point: it corrects the place") for n in found.notes)
    assert any(n.startswith("No check points") for n in found.notes)


def test_a_contradiction_and_a_wrong_point_are_told_with_numbers() -> None:
    """Points 40 m off the fixes are noted; one of seven that is 2 m off is left out by name."""
    rng = np.random.default_rng(6)
    true = flight(rng)
    far = fit(true, fixes(true, rng, np.array([40.0, 0.0, 0.0])), surveyed(5, rng))
    assert any(re.search(r"contradict each other: fixes are \+(39|40)\.", n) for n in far.notes)
    assert np.abs(shift_m(far, true)).max() < 0.1
    control = surveyed(7, rng)
    control.enu_m[2] += [2.0, 0.0, 0.0]
    found = fit(true, fixes(true, rng, np.zeros(3)), control)
    assert [p.name for p in found.control if p.is_outlier] == ["P2"]
    told = r"Ground control point P2 is left out: it is \+(1\.9|2\.0)\d m east"
    assert any(re.match(told, n) for n in found.notes)
    assert np.abs(shift_m(found, true)).max() < 0.05


def test_three_points_do_without_telemetry_and_fewer_do_not() -> None:
    """Without a fix, four points give the map; two, or three in one line, are refused."""
    rng = np.random.default_rng(7)
    true = flight(rng)
    none = Telemetry.from_columns(10.0 * np.arange(N))
    found = fit(true, none, surveyed(4, rng))
    assert np.abs(shift_m(found, true)).max() < 0.1
    assert found.observations == ("ground control",)
    assert found.summary.fixes == 0
    with pytest.raises(GeometryError, match="there are only 2 ground control points to use"):
        fit(true, none, surveyed(2, rng))
    line = surveyed(3, rng)
    ends = np.array([[0.0, 0, 0], [10, 0, 0], [20, 0, 0]])
    with pytest.raises(GeometryError, match="collinear"):
        fit(true, none, replace(line, enu_m=ends, model=MODEL_FROM_WORLD.apply(ends)))


def test_fixes_that_do_not_fit_the_model_are_left_to_ground_control() -> None:
    """Telemetry of another flight is not used if ground control determines the map, and that is said."""
    rng = np.random.default_rng(8)
    true = flight(rng)
    rows = fixes(true, rng, np.zeros(3))
    other = replace(rows, lat_lon_deg=rng.permutation(rows.lat_lon_deg))
    found = fit(true, other, surveyed(5, rng))
    assert any(n.startswith("Fixes are not used, only ground control") for n in found.notes)
    assert np.abs(shift_m(found, true)).max() < 0.1
