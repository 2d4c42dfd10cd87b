"""Fixes to send, and what PX4 and ArduPilot do with them: transcriptions of their sources, no simulators.

ArduPilot: GCS_Common.cpp (handle_odometry), AP_VisualOdom_MAV.cpp, JitterCorrection.cpp and
NavEKF3_core (writeExtNavData) of 2026. PX4: mavlink_receiver.cpp (handle_message_odometry), EKF2.cpp
(UpdateExtVisionSample), ev_control.cpp, ev_pos_control.cpp and aux_global_position_control.cpp of 2026.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.rotations import quats_from_rotations, rotations_from_angles
from spn_model.autopilot.datum import Datum
from spn_model.integrity.fix import Fix, FixSource, FixState

NOW_US = 1_800_000_000_000_000
ORIGIN = GeoOrigin(48.1, 11.6, 560.0, HeightReference.AMSL)
DATUM = Datum(origin=ORIGIN, geoid_height_m=45.5)
AMSL_ONLY = Datum(origin=ORIGIN)


def make_fix(**changes: Any) -> Fix:
    """Return a fix of a camera that looks north, 30 m above the origin, with some values changed."""
    heading = changes.pop("heading_pitch_roll_deg", [0.0, 0.0, 0.0])
    values = {
        "time_us": NOW_US - 60_000,
        "center": [10.0, 20.0, 30.0],
        "quat_wxyz": quats_from_rotations(rotations_from_angles(np.array([heading])))[0],
        "covariance": np.diag([0.09, 0.04, 0.25, 4e-4, 1e-4, 9e-4]),
        "horizontal_protection_m": 1.5,
        "vertical_protection_m": 2.5,
        "state": FixState.TRACK,
        "source": FixSource.TRACK,
        "quality": 80,
        "processing_s": 0.05,
    }
    return Fix(**{**values, **changes})


@dataclass
class ArduPilot:
    """ArduPilot's way from a message to EKF3, with VISO_TYPE = 1."""

    pos_noise: float = 0.2
    yaw_noise: float = 0.2
    quality_min: int = 0
    internal_errors: int = 0
    resets: int = 0
    fused: list[dict[str, Any]] = field(default_factory=list)
    _counter: int | None = None
    _offset: int | None = None
    _samples: list[int] = field(default_factory=list)
    _last_ms: int = -(10**9)

    def take(self, message: Any, arrival_us: int) -> str:
        """Return why a message is not fused; empty if it is."""
        if message.get_type() == "ODOMETRY":
            if message.frame_id != 20 or message.child_frame_id != 12:
                return "frame"
            covariance, stamp, quality = message.pose_covariance, message.time_usec, message.quality
            yaw = _yaw(message.q)
        elif message.get_type() == "VISION_POSITION_ESTIMATE":
            covariance, stamp, quality = message.covariance, message.usec, 0
            yaw = message.yaw
        else:
            return "message"
        time_ms = self._correct(stamp, arrival_us) // 1000
        position_error = angle_error = 0.0
        if not math.isnan(covariance[0]):
            position_error = _root(covariance[0] + covariance[6] + covariance[11])
            angle_error = _root(covariance[15] + covariance[18] + covariance[20])
        position_error = self._constrain(position_error, self.pos_noise, 100.0)
        angle_error = self._constrain(angle_error, self.yaw_noise, 1.5)
        if self._counter is not None and message.reset_counter != self._counter:
            self.resets += 1
        self._counter = message.reset_counter
        if quality < self.quality_min:
            return "quality"
        position = (message.x, message.y, message.z)
        if any(math.isnan(v) for v in (*position, position_error)):
            return "NaN"
        if time_ms - self._last_ms < 20:
            return "rate"
        self._last_ms = time_ms
        self.fused.append(
            {
                "ned": position,
                "sigma": position_error,
                "yaw": yaw,
                "yaw_sigma": max(angle_error, math.radians(5)),
                "time_ms": time_ms,
            }
        )
        return ""

    def _constrain(self, value: float, low: float, high: float) -> float:
        if math.isnan(value):  # constrain_float: an internal error, and the middle
            self.internal_errors += 1
            return (low + high) / 2
        return min(max(value, low), high)

    def _correct(self, stamp: int, local: int) -> int:
        difference = local - stamp
        if self._offset is None or difference < self._offset:
            self._offset = difference
        estimate = stamp + self._offset
        if estimate + 500_000 < local:
            estimate = local - 500_000
            self._offset = estimate - stamp
        self._samples.append(difference)
        if len(self._samples) == 100:
            self._offset = min(self._samples)
            self._samples.clear()
        return estimate


@dataclass
class Px4:
    """PX4's way from a message to EKF2, as long as it is not in the state that starts or resets fusion."""

    position_noise: float = 0.1
    yaw_noise: float = 0.05
    quality_min: int = 0
    aux_noise: float = 0.1
    resets: int = 0
    fused: list[dict[str, Any]] = field(default_factory=list)
    _counter: int | None = None

    def take(self, message: Any) -> str:
        """Return why a message is not fused; empty if it is."""
        kind = message.get_type()
        if kind == "GLOBAL_POSITION_SENSOR":
            return self._take_global(message)
        if kind == "ODOMETRY":
            frames = {1: "NED", 20: "FRD"}
            frame = frames.get(message.frame_id)
            covariance, quality, q = message.pose_covariance, message.quality, message.q
            if message.estimator_type not in (0, 1, 2, 3):
                return "estimator"
        elif kind == "VISION_POSITION_ESTIMATE":
            frame, covariance, quality = "NED", message.covariance, 0
            q = [1.0, 0.0, 0.0, 0.0]
        else:
            return "message"
        position = [message.x, message.y, message.z]
        variance = [covariance[i] for i in (0, 6, 11)]
        position_valid = frame is not None and all(math.isfinite(v) for v in position)
        attitude_valid = all(math.isfinite(v) for v in q) and abs(np.linalg.norm(q) - 1) <= 1e-5
        if not position_valid and not attitude_valid:
            return "nothing valid"  # never reaches the buffer of EKF2
        if self._counter is not None and message.reset_counter != self._counter:
            self.resets += 1
        self._counter = message.reset_counter
        if self.quality_min > 0 and quality < self.quality_min:
            return "quality"
        if not position_valid:
            return "position"
        floor = self.position_noise**2
        known = all(math.isfinite(v) for v in variance)
        self.fused.append(
            {
                "frame": frame,
                "ned": position,
                "variance": [max(floor, v) if known else floor for v in variance],
                "yaw": _yaw(q) if kind == "ODOMETRY" else message.yaw,
                "yaw_variance": max(self.yaw_noise**2, covariance[20]),
            }
        )
        return ""

    def _take_global(self, message: Any) -> str:
        """EKF2's rules; how the receiver takes flags and INT32_MAX could not be read, so both are assumed."""
        if message.flags & 1 or message.lat == 2**31 - 1:
            return "unhealthy"
        self.fused.append(
            {
                "lat": message.lat * 1e-7,
                "lon": message.lon * 1e-7,
                "sigma": max(message.eph, self.aux_noise, 0.01),
                "sample_us": message.time_usec - message.processing_time,
            }
        )
        return ""


def _root(value: float) -> float:
    return math.nan if math.isnan(value) else math.sqrt(value)


def _yaw(q: list[float]) -> float:
    w, x, y, z = q
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
