"""Frames: known poses, and covariances against differences and random errors."""

from __future__ import annotations

import numpy as np
import pytest

from spn_data.errors import InputError
from spn_data.geometry.rotations import (
    quats_from_rotations,
    rotation_vectors,
    rotations_from_quats,
    rotations_from_vectors,
)
from spn_model.autopilot.frames import FRD_FROM_FLU, NED_FROM_ENU, BodyPose, Mounting, body_pose
from tests.worlds.autopilots import make_fix

TILTED = Mounting.pitched(-35.0, np.array([0.3, -0.1, 0.2]))
ANGLES = [70.0, -20.0, 12.0]


def moved(fix, error):
    """Return the fix that errors of centre and rotation vector in the camera frame make."""
    rotation = rotations_from_vectors(error[3:]) @ rotations_from_quats(fix.quat_wxyz)
    return make_fix(
        center=fix.center + error[:3],
        quat_wxyz=quats_from_rotations(rotation),
        covariance=fix.covariance,
    )


def difference(pose, true, *, fixed_axes=False, angles=False):
    """Return the error of a pose in the way in which a covariance states it."""
    if angles:
        turned = true.rpy - pose.rpy
        return np.concatenate(
            [true.position - pose.position, (turned + np.pi) % (2 * np.pi) - np.pi]
        )
    between = (
        true.world_from_body @ pose.world_from_body.T
        if fixed_axes
        else pose.world_from_body.T @ true.world_from_body
    )
    return np.concatenate([true.position - pose.position, rotation_vectors(between)])


def by_differences(fix, convert, **kind):
    """Return the covariance that central differences of a conversion give."""
    step = 1e-5
    pose = convert(fix)
    columns = [
        (
            difference(pose, convert(moved(fix, step * unit)), **kind)
            - difference(pose, convert(moved(fix, -step * unit)), **kind)
        )
        / (2 * step)
        for unit in np.eye(6)
    ]
    jacobian = np.stack(columns, axis=1)
    return jacobian @ fix.covariance @ jacobian.T


def full_covariance():
    """Return a covariance with correlations between everything."""
    rows = np.random.default_rng(3).normal(size=(6, 6))
    scale = np.array([0.3, 0.2, 0.5, 0.01, 0.02, 0.015])
    return (rows @ rows.T / 6 + np.eye(6)) * np.outer(scale, scale)


def test_a_camera_that_looks_north_is_a_body_that_heads_north():
    """A level camera that looks north and is mounted forward gives roll, pitch and yaw of zero in NED."""
    ned = body_pose(make_fix(), Mounting()).in_axes(NED_FROM_ENU)
    np.testing.assert_allclose(ned.position, [20, 10, -30])
    np.testing.assert_allclose(ned.rpy, 0, atol=1e-12)


@pytest.mark.parametrize("pitch", [-90.0, -30.0, 0.0])
def test_the_mounting_takes_the_pitch_of_the_camera_away(pitch):
    """A camera pitched by its mounting and heading east belongs to a level body that heads east."""
    fix = make_fix(heading_pitch_roll_deg=[90.0, pitch, 0.0])
    ned = body_pose(fix, Mounting.pitched(pitch)).in_axes(NED_FROM_ENU)
    np.testing.assert_allclose(np.rad2deg(ned.rpy), [0, 0, 90], atol=1e-9)


def test_the_lever_arm_is_taken_off():
    """The body of a camera 2 m in front and 1 m below, heading east, is 2 m west and 1 m above it."""
    fix = make_fix(heading_pitch_roll_deg=[90.0, 0.0, 0.0])
    pose = body_pose(fix, Mounting(lever_arm_m=np.array([2.0, 0.0, 1.0])))
    np.testing.assert_allclose(pose.position, fix.center + np.array([-2, 0, 1]), atol=1e-12)


def test_ros_axes_point_forward_left_and_up():
    """In ROS, a body that heads east in an East-North-Up world has no rotation."""
    fix = make_fix(heading_pitch_roll_deg=[90.0, 0.0, 0.0])
    pose = body_pose(fix, Mounting()).with_body_axes(FRD_FROM_FLU)
    np.testing.assert_allclose(pose.quat_wxyz, [1, 0, 0, 0], atol=1e-12)


@pytest.mark.parametrize("mounting", [Mounting(), TILTED])
def test_the_covariance_of_the_body_is_that_of_differences(mounting):
    """Mounting, lever arm and all correlations are in the covariance, in East-North-Up and in NED."""
    fix = make_fix(heading_pitch_roll_deg=ANGLES, covariance=full_covariance())
    pose = body_pose(fix, mounting)
    expected = by_differences(fix, lambda f: body_pose(f, mounting))
    np.testing.assert_allclose(pose.covariance, expected, rtol=1e-6, atol=1e-10)
    expected = by_differences(fix, lambda f: body_pose(f, mounting).in_axes(NED_FROM_ENU))
    ned = pose.in_axes(NED_FROM_ENU).covariance
    np.testing.assert_allclose(ned, expected, rtol=1e-6, atol=1e-10)


def test_the_covariances_of_mavlink_and_ros_are_those_of_differences():
    """Variances of roll, pitch and yaw in NED, and those about fixed axes with ROS's body axes."""
    fix = make_fix(heading_pitch_roll_deg=ANGLES, covariance=full_covariance())

    def ned(f):
        return body_pose(f, TILTED).in_axes(NED_FROM_ENU)

    def ros(f):
        return body_pose(f, TILTED).with_body_axes(FRD_FROM_FLU)

    def turned(f):
        return body_pose(f, TILTED).with_body_axes(NED_FROM_ENU @ FRD_FROM_FLU)

    expected = by_differences(fix, turned)
    np.testing.assert_allclose(turned(fix).covariance, expected, rtol=1e-6, atol=1e-10)
    assert np.abs(ned(fix).rpy[:2]).min() > 0.05
    expected = by_differences(fix, ned, angles=True)
    np.testing.assert_allclose(ned(fix).rpy_covariance(), expected, rtol=1e-6, atol=1e-10)
    expected = by_differences(fix, ros, fixed_axes=True)
    np.testing.assert_allclose(ros(fix).fixed_axis_covariance(), expected, rtol=1e-6, atol=1e-10)


def test_yaw_is_uncertain_when_the_nose_points_up():
    """At a vertical nose, the variance of the yaw is finite and too large to be of use."""
    up = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    pose = BodyPose(position=np.zeros(3), world_from_body=up, covariance=np.eye(6) * 1e-4)
    yaw = pose.rpy_covariance()[5, 5]
    assert np.isfinite(yaw)
    assert yaw > 10


@pytest.mark.parametrize(
    "wrong",
    [
        {"body_from_camera": np.eye(2)},
        {"body_from_camera": np.diag([1.0, 1.0, -1.0])},
        {"body_from_camera": np.full((3, 3), np.nan)},
        {"lever_arm_m": np.array([0.0, np.nan, 0.0])},
        {"lever_arm_m": np.array([0.0, 200.0, 0.0])},
    ],
)
def test_a_mounting_that_is_none_is_refused(wrong):
    """A reflection, NaN, and a lever arm of 200 m are refused."""
    with pytest.raises(InputError, match="the mounting has"):
        Mounting(**wrong)
