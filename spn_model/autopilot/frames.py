"""From the camera of a fix to the body of the aircraft: mounting, axes, and covariances by Jacobians."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.rotations import quats_from_rotations, rotations_from_quats
from spn_model.integrity.fix import Fix

# Body axes are forward, right, down (FRD); those of ROS are forward, left, up (FLU).
FRD_FROM_FLU = np.diag([1.0, -1.0, -1.0])
NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# Camera axes are right, down, forward.
_FORWARD = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_MIN_COS_PITCH = (
    1e-3  # yaw is not defined when the nose points straight up or down; its variance is then huge
)
_MAX_ARM_M = 100.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Mounting:
    """How the camera is fixed to the body.

    Attributes
    ----------
    body_from_camera : ndarray, shape (3, 3)
        Rotation from camera axes (right, down, forward) to body axes (forward, right, down).
    lever_arm_m : ndarray, shape (3,)
        Position of the camera in body axes, in metres from the point whose position the autopilot estimates.

    Raises
    ------
    InputError
        If the rotation is none, or the lever arm is not finite or longer than 100 m.
    """

    body_from_camera: np.ndarray = field(default_factory=lambda: _FORWARD)
    lever_arm_m: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        rotation = np.array(self.body_from_camera, dtype=np.float64)
        arm = np.array(self.lever_arm_m, dtype=np.float64)
        if (
            rotation.shape != (3, 3)
            or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
            or np.linalg.det(rotation) < 0
        ):
            raise InputError(f"the mounting has no rotation: {rotation.tolist()}")
        if arm.shape != (3,) or not np.isfinite(arm).all() or np.linalg.norm(arm) > _MAX_ARM_M:
            raise InputError(
                f"the mounting has the lever arm {arm.tolist()}, not 3 numbers in metres"
            )
        object.__setattr__(self, "body_from_camera", rotation)
        object.__setattr__(self, "lever_arm_m", arm)

    @classmethod
    def pitched(cls, pitch_deg: float, lever_arm_m: np.ndarray | None = None) -> Mounting:
        """Return the mounting of a camera that looks forward, pitched by an angle.

        Parameters
        ----------
        pitch_deg : float
            Positive: up; -90 looks down.
        lever_arm_m : ndarray, shape (3,), optional
            Camera from the body's centre: forward, right, down.

        Returns
        -------
        Mounting
        """
        c, s = np.cos(np.deg2rad(pitch_deg)), np.sin(np.deg2rad(pitch_deg))
        turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        return cls(
            body_from_camera=turn @ _FORWARD,
            lever_arm_m=np.zeros(3) if lever_arm_m is None else lever_arm_m,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyPose:
    """Pose of the body in a world frame.

    Attributes
    ----------
    position : ndarray, shape (3,)
        In the world, in metres.
    world_from_body : ndarray, shape (3, 3)
        Rotation from body axes to world axes.
    covariance : ndarray, shape (6, 6)
        Over the position (world axes, m) and a rotation vector w in body axes (rad):
        world_from_body_true = world_from_body exp(w).
    """

    position: np.ndarray
    world_from_body: np.ndarray
    covariance: np.ndarray

    @property
    def quat_wxyz(self) -> np.ndarray:
        """Unit quaternion (4,), scalar first, from body axes to world axes."""
        return np.asarray(quats_from_rotations(self.world_from_body))

    @property
    def rpy(self) -> np.ndarray:
        """Roll, pitch and yaw (3,) in radians: world_from_body = Rz(yaw) Ry(pitch) Rx(roll)."""
        m = self.world_from_body
        return np.array(
            [
                np.arctan2(m[2, 1], m[2, 2]),
                -np.arcsin(np.clip(m[2, 0], -1.0, 1.0)),
                np.arctan2(m[1, 0], m[0, 0]),
            ]
        )

    def in_axes(self, new_from_world: np.ndarray) -> BodyPose:
        """Return the pose in other axes of the world, given by a rotation (3, 3)."""
        turn = np.eye(6)
        turn[:3, :3] = new_from_world
        return BodyPose(
            position=new_from_world @ self.position,
            world_from_body=new_from_world @ self.world_from_body,
            covariance=turn @ self.covariance @ turn.T,
        )

    def with_body_axes(self, old_from_new: np.ndarray) -> BodyPose:
        """Return the pose with other body axes: old_from_new (3, 3) turns them into the present ones."""
        turn = np.eye(6)
        turn[3:, 3:] = old_from_new.T
        return BodyPose(
            position=self.position,
            world_from_body=self.world_from_body @ old_from_new,
            covariance=turn @ self.covariance @ turn.T,
        )

    def rpy_covariance(self) -> np.ndarray:
        """Return the covariance (6, 6) over position, roll, pitch and yaw, as MAVLink states it.

        Near a vertical nose, roll and yaw are not separable: their variances grow with 1 / cos² of the
        pitch, up to a million times.
        """
        roll, pitch, _ = self.rpy
        cos_pitch = max(np.cos(pitch), _MIN_COS_PITCH)
        tan_pitch = np.sin(pitch) / cos_pitch
        c, s = np.cos(roll), np.sin(roll)
        turn = np.eye(6)
        turn[3:, 3:] = [
            [1.0, s * tan_pitch, c * tan_pitch],
            [0.0, c, -s],
            [0.0, s / cos_pitch, c / cos_pitch],
        ]
        return np.asarray(turn @ self.covariance @ turn.T)

    def fixed_axis_covariance(self) -> np.ndarray:
        """Return the covariance (6, 6) over position and rotation about world axes, as ROS states it."""
        turn = np.eye(6)
        turn[3:, 3:] = self.world_from_body
        return np.asarray(turn @ self.covariance @ turn.T)


def body_pose(fix: Fix, mounting: Mounting) -> BodyPose:
    """Return the pose of the body, in the world of the fix.

    Parameters
    ----------
    fix : Fix
        Pose of the camera.
    mounting : Mounting
        How the camera is fixed to the body.

    Returns
    -------
    BodyPose
        In axes of the world of the fix.

    Notes
    -----
    With R = cam_from_world, R_true = exp(v) R, M = body_from_camera and W = R^T M^T = world_from_body:
    W_true = R^T exp(-v) M^T = W exp(-M v), so w = -M v. The body is at p = c - W l with the lever arm l, and
    W_true l = W l + W (w x l) to first order, so dp = dc + W [l]x w.
    """
    cam_from_world = rotations_from_quats(fix.quat_wxyz)
    m, arm = mounting.body_from_camera, mounting.lever_arm_m
    world_from_body = cam_from_world.T @ m.T
    jacobian = np.eye(6)
    jacobian[3:, 3:] = -m
    jacobian[:3, 3:] = world_from_body @ _cross_matrix(arm) @ -m
    return BodyPose(
        position=fix.center - world_from_body @ arm,
        world_from_body=world_from_body,
        covariance=jacobian @ fix.covariance @ jacobian.T,
    )


def _cross_matrix(a: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])
