"""Attitude that an autopilot or a gimbal sends: direction of up at the times of images, on our clock."""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from spn_data.geometry.rotations import rotations_from_quats

BODY, GIMBAL = "body", "gimbal"  # whose attitude is taken
MESSAGES = {
    BODY: {"ATTITUDE": 30, "ATTITUDE_QUATERNION": 31},
    GIMBAL: {"GIMBAL_DEVICE_ATTITUDE_STATUS": 285},
}
_KEPT = 400  # messages
_STALE_US, _FUTURE_US = 500_000, 50_000  # on arrival
_NEAR_US = 100_000  # between a message and an image
_SILENT_US = 1_000_000  # after which the messages are asked for again
_LOCKED = (
    4 | 8
)  # ROLL_LOCK and PITCH_LOCK of GIMBAL_DEVICE_FLAGS: angles are relative to the horizon
_UNIT_TOLERANCE = 0.01
_TURN_DEG_S = 30.0  # of a gimbal that states no rate
_RATE_SHARE = 0.5  # of a turn since a message that counts as its standard deviation


@dataclass(frozen=True, eq=False)
class _Received:
    time_us: int
    up: np.ndarray
    rate: np.ndarray  # rad/s; NaN if it is not stated


class ReceivedAttitude:
    """Messages of the last seconds, from the thread of a link, asked for by the one that localizes.

    Parameters
    ----------
    of : str
        `BODY` for ATTITUDE and ATTITUDE_QUATERNION, `GIMBAL` for GIMBAL_DEVICE_ATTITUDE_STATUS.

    Attributes
    ----------
    taken : int
        Messages taken.
    refused : int
        Messages that were not, the last one for `reason`.
    reason : str
    """

    def __init__(self, of: str):
        self.of = of
        self.taken = self.refused = 0
        self.reason = ""
        self._records: deque[_Received] = deque(maxlen=_KEPT)
        self._lock = threading.Lock()

    def is_silent(self, now_us: int) -> bool:
        """Return whether nothing came for a second."""
        with self._lock:
            return not self._records or now_us - self._records[-1].time_us > _SILENT_US

    def take(self, message: Any, now_us: int, offset_us: int | None) -> None:
        """Take a message; `offset_us` is the sender's clock minus ours, None if it is not known yet."""
        if message.get_type() not in MESSAGES[self.of]:
            return
        with self._lock:
            reason = self._fault(message)
            time_us = 0 if offset_us is None else message.time_boot_ms * 1000 - offset_us
            if not reason and offset_us is None:
                reason = "the autopilot's clock is not known yet"
            elif not reason and now_us - time_us > _STALE_US:
                reason = f"it is {(now_us - time_us) / 1e3:.0f} ms old"
            elif not reason and time_us - now_us > _FUTURE_US:
                reason = f"it is {(time_us - now_us) / 1e3:.0f} ms ahead of the clock"
            elif not reason and self._records and time_us <= self._records[-1].time_us:
                reason = "it is not later than the one before"
            if reason:
                self.refused, self.reason = self.refused + 1, reason
                return
            self.taken += 1
            self._records.append(_Received(time_us, _up(message), _rate(message)))

    def at(self, time_us: int) -> tuple[np.ndarray, float] | None:
        """Return up in the axes of the sender (forward, right, down), and its standard deviation, at a time.

        The standard deviation, in degrees, is that of the time between image and message alone. The nearest
        message within 0.1 s is moved on by its rate; None if there is none.
        """
        with self._lock:
            nearest = min(self._records, key=lambda one: abs(one.time_us - time_us), default=None)
        if nearest is None or abs(nearest.time_us - time_us) > _NEAR_US:
            return None
        since_s = (time_us - nearest.time_us) * 1e-6
        if not np.isfinite(nearest.rate).all():
            return nearest.up, _TURN_DEG_S * abs(since_s)
        up = nearest.up - since_s * np.cross(nearest.rate, nearest.up)
        turn_deg = math.degrees(float(np.linalg.norm(nearest.rate))) * abs(since_s)
        return up / np.linalg.norm(up), _RATE_SHARE * turn_deg

    def _fault(self, message: Any) -> str:
        """Return why a message states no attitude relative to the horizon, or nothing."""
        if self.of == GIMBAL and message.failure_flags:
            return f"the gimbal reports the failure {message.failure_flags}"
        if self.of == GIMBAL and message.flags & _LOCKED != _LOCKED:
            return "the gimbal's angles are not relative to the horizon"
        if message.get_type() == "ATTITUDE":
            angles = (message.roll, message.pitch)
            is_sound = all(math.isfinite(a) and abs(a) <= 2 * math.pi for a in angles)
        else:
            quat = _quat(message)
            is_sound = bool(np.isfinite(quat).all()) and bool(
                abs(np.linalg.norm(quat) - 1) <= _UNIT_TOLERANCE
            )
        return "" if is_sound else f"{message.get_type()} has no attitude"


def _quat(message: Any) -> np.ndarray:
    if message.get_type() == "ATTITUDE_QUATERNION":
        return np.array([message.q1, message.q2, message.q3, message.q4], dtype=np.float64)
    return np.array(message.q, dtype=np.float64)


def _up(message: Any) -> np.ndarray:
    """Return up (3,) in the axes of the sender: its quaternion turns them into North, East, Down."""
    if message.get_type() == "ATTITUDE":
        roll, pitch = message.roll, message.pitch
        return np.array(
            [
                math.sin(pitch),
                -math.cos(pitch) * math.sin(roll),
                -math.cos(pitch) * math.cos(roll),
            ]
        )
    quat = _quat(message)
    return -rotations_from_quats(quat / np.linalg.norm(quat))[2]


def _rate(message: Any) -> np.ndarray:
    if message.get_type() in MESSAGES[BODY]:
        return np.array([message.rollspeed, message.pitchspeed, message.yawspeed])
    names = ("angular_velocity_x", "angular_velocity_y", "angular_velocity_z")
    return np.array([getattr(message, name) for name in names])
