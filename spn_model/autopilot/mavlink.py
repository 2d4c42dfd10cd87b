"""MAVLink 2 messages of fixes, built with pymavlink's common dialect."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np

from spn_data.errors import InputError
from spn_model.autopilot.datum import Geodetic
from spn_model.autopilot.extras import optional
from spn_model.autopilot.frames import BodyPose
from spn_model.autopilot.profiles import MAV_FRAME_BODY_FRD, Covariance, Profile

INVALID_DEGREES = 2**31 - 1  # INT32_MAX: "invalid" in GLOBAL_POSITION_SENSOR
UNHEALTHY = 1  # GLOBAL_POSITION_FLAGS
SOURCE_VISION = 2  # GLOBAL_POSITION_SRC
ESTIMATOR_VISION = 2  # MAV_ESTIMATOR_TYPE
QUALITY_FAILED = -1
COMPONENT = 197  # MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
_TYPE_ONBOARD, _NO_AUTOPILOT, _ACTIVE = 18, 8, 4  # MAV_TYPE_ONBOARD_CONTROLLER and so on
_REQUEST_MESSAGE, _SET_MESSAGE_INTERVAL, _GPS_GLOBAL_ORIGIN = 512, 511, 49
_UPPER = np.triu_indices(6)
_NAN = math.nan
_IGNORE_CRC = "MAV_IGNORE_CRC"  # pymavlink would accept damaged messages


def dialect() -> Any:
    """Import pymavlink's dialect; raise InputError if it is missing or too old for GLOBAL_POSITION_SENSOR."""
    before = os.environ.pop(_IGNORE_CRC, None)
    try:
        found = optional("pymavlink.dialects.v20.common", "mavlink", "MAVLink")
    finally:
        if before is not None:
            os.environ[_IGNORE_CRC] = before
    if not hasattr(found, "MAVLink_global_position_sensor_message"):
        raise InputError(
            "this pymavlink does not know GLOBAL_POSITION_SENSOR: pip install 'pymavlink>=2.4.50'"
        )
    return found


def variances(profile: Profile, pose: BodyPose, *, use_height: bool) -> np.ndarray:
    """Return the covariance of a pose in North, East, Down as a profile's receiver reads it rightly.

    Parameters
    ----------
    profile : Profile
        The receiver.
    pose : BodyPose
        In North, East, Down.
    use_height : bool
        Whether the receiver uses the height; counts for `Covariance.SCALAR` only.

    Returns
    -------
    ndarray, shape (21,)
        Upper triangle, row by row, over x, y, z, roll, pitch, yaw.

    Notes
    -----
    ArduPilot makes one standard deviation from the position, sqrt(c0 + c6 + c11), and uses it for each axis;
    likewise for the attitude, of which it uses the yaw. A third of the variance of the worst axis that is
    used on each of the three elements gives exactly that.
    """
    covariance = pose.rpy_covariance()
    if profile.covariance == Covariance.FULL:
        return np.asarray(covariance[_UPPER])
    worst = float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    if use_height:
        worst = max(worst, float(covariance[2, 2]))
    yaw = float(covariance[5, 5])
    return np.asarray(np.diag([worst / 3] * 3 + [yaw / 3] * 3)[_UPPER])


def odometry(
    link: Any,
    profile: Profile,
    time_us: int,
    pose: BodyPose,
    triangle: np.ndarray,
    quality: int,
    resets: int,
) -> Any:
    """Return ODOMETRY of a pose in North, East, Down; velocities are unknown.

    The stamp is the middle of the exposure; `triangle` are the 21 values of `variances`.
    """
    return link.odometry_encode(
        time_us,
        profile.odometry_frame,
        MAV_FRAME_BODY_FRD,
        *(float(v) for v in pose.position),
        [float(v) for v in pose.quat_wxyz],
        *[_NAN] * 6,
        [float(v) for v in triangle],
        [_NAN] * 21,
        resets,
        ESTIMATOR_VISION,
        quality,
    )


def odometry_failed(link: Any, profile: Profile, time_us: int, resets: int) -> Any:
    """Return ODOMETRY that says that there is no pose: quality -1, and NaN in place of every value.

    NaN is what neither autopilot fuses, whatever its parameters: with a zero or the last pose,
    EKF2_EV_QMIN = 0 or VISO_QUAL_MIN = -1 would make it a measurement.
    """
    return link.odometry_encode(
        time_us,
        profile.odometry_frame,
        MAV_FRAME_BODY_FRD,
        *[_NAN] * 3,
        [_NAN] * 4,
        *[_NAN] * 6,
        [_NAN] * 21,
        [_NAN] * 21,
        resets,
        ESTIMATOR_VISION,
        QUALITY_FAILED,
    )


def vision_position_estimate(
    link: Any, time_us: int, pose: BodyPose, triangle: np.ndarray, resets: int
) -> Any:
    """Return VISION_POSITION_ESTIMATE of a pose in North, East, Down; it has no field for the quality."""
    return link.vision_position_estimate_encode(
        time_us,
        *(float(v) for v in pose.position),
        *(float(v) for v in pose.rpy),
        [float(v) for v in triangle],
        resets,
    )


def global_position_sensor(
    link: Any,
    now_us: int,
    processing_us: int,
    place: Geodetic,
    horizontal_sigma_m: float,
    vertical_sigma_m: float,
    sensor: int,
) -> Any:
    """Return GLOBAL_POSITION_SENSOR: stamped when it is sent, with standard deviations, not variances."""
    return link.global_position_sensor_encode(
        0,
        0,
        sensor,
        now_us,
        processing_us,
        SOURCE_VISION,
        0,
        _degrees(place.lat_deg),
        _degrees(place.lon_deg),
        place.ellipsoid_m,
        place.amsl_m,
        horizontal_sigma_m,
        vertical_sigma_m,
    )


def global_position_failed(link: Any, now_us: int, sensor: int) -> Any:
    """Return GLOBAL_POSITION_SENSOR with the flag for an unhealthy sensor, and no position."""
    return link.global_position_sensor_encode(
        0,
        0,
        sensor,
        now_us,
        0,
        SOURCE_VISION,
        UNHEALTHY,
        INVALID_DEGREES,
        INVALID_DEGREES,
        *[_NAN] * 4,
    )


def set_origin(link: Any, target: int, place: Geodetic, now_us: int) -> Any:
    """Return SET_GPS_GLOBAL_ORIGIN, whose height is above sea level."""
    return link.set_gps_global_origin_encode(
        target, _degrees(place.lat_deg), _degrees(place.lon_deg), round(place.amsl_m * 1e3), now_us
    )


def request_origin(link: Any, target: int) -> Any:
    """Return the command that asks an autopilot for GPS_GLOBAL_ORIGIN."""
    return link.command_long_encode(
        target, 0, _REQUEST_MESSAGE, 0, _GPS_GLOBAL_ORIGIN, 0, 0, 0, 0, 0, 0
    )


def request_interval(link: Any, target: int, message_id: int, interval_us: int) -> Any:
    """Return the command that asks an autopilot for a message again and again."""
    return link.command_long_encode(
        target, 0, _SET_MESSAGE_INTERVAL, 0, message_id, interval_us, 0, 0, 0, 0, 0
    )


def stated_origin(message: Any) -> Geodetic:
    """Return the origin that a GPS_GLOBAL_ORIGIN states."""
    return Geodetic(
        lat_deg=message.latitude * 1e-7,
        lon_deg=message.longitude * 1e-7,
        ellipsoid_m=_NAN,
        amsl_m=message.altitude * 1e-3,
    )


def heartbeat(link: Any) -> Any:
    """Return HEARTBEAT of an onboard computer."""
    return link.heartbeat_encode(_TYPE_ONBOARD, _NO_AUTOPILOT, 0, 0, _ACTIVE)


def _degrees(value: float) -> int:
    return round(value * 1e7)
