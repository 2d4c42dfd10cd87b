"""Parameter files for the receivers, with an explanation of each line."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from spn_data.errors import InputError
from spn_model.autopilot.profiles import ROS2, Message, profile_of

_INT32, _REAL32 = 6, 9  # MAV_PARAM_TYPE in QGroundControl's files
_MAX_DELAY_MS = 250.0
_QUALITY = (
    "Least quality: in ODOMETRY, a fix has 50 to 100, a prediction between images 49, and no pose -1 "
    "(50 takes fixes alone); VISION_POSITION_ESTIMATE has none, 0."
)
_ROBOT_LOCALIZATION = """\
# Parameters of robot_localization for fixes of squeezeposenet-toolkit: check each before a flight.
ekf_filter_node:
  ros__parameters:
    # The fixes are absolute, in the frame map; something else has to provide odom.
    map_frame: map
    odom_frame: odom
    base_link_frame: base_link
    world_frame: map
    pose0: /spn/pose
    # x, y, z, roll, pitch, yaw; then velocities and accelerations, which a fix does not have.
    pose0_config: [true, true, true, false, false, true,
                   false, false, false, false, false, false, false, false, false]
    # A fix is absolute, not a difference to the one before.
    pose0_differential: false
    # A Mahalanobis distance beyond this is rejected.
    pose0_rejection_threshold: 3.0
"""


@dataclass(frozen=True)
class Parameter:
    """One line of a parameter file: name, value and why."""

    name: str
    value: int | float
    why: str


def parameters(
    profile: str,
    *,
    messages: tuple[Message, ...] | None = None,
    use_height: bool = False,
    delay_ms: float = 0.0,
    sensor: int = 1,
) -> list[Parameter]:
    """Return the parameters that an autopilot needs for a profile.

    Parameters
    ----------
    profile : str
        `px4` or `ardupilot`.
    messages : tuple of Message, optional
        Messages sent instead of those of the profile.
    use_height : bool
        Whether the height of the fixes is used.
    delay_ms : float
        Delay from the exposure to the arrival that stamps do not show, 0 to 250 ms.
    sensor : int
        Identifier in GLOBAL_POSITION_SENSOR.

    Returns
    -------
    list of Parameter
        In the order of the file.

    Raises
    ------
    InputError
        If there is no such profile, or the delay is out of range.
    """
    chosen = profile_of(profile)
    if not (math.isfinite(delay_ms) and 0 <= delay_ms <= _MAX_DELAY_MS):
        raise InputError(f"the delay is {delay_ms!r} ms, not 0 to {_MAX_DELAY_MS:g}")
    sent = chosen.messages if messages is None else messages
    # VISION_POSITION_ESTIMATE has no quality, which both autopilots then take as 0, unknown.
    quality = 0 if Message.VISION_POSITION_ESTIMATE in sent else 1
    if profile == "px4":
        return _px4(sent, use_height, delay_ms, sensor, quality)
    return _ardupilot(use_height, delay_ms, quality)


def parameter_file(profile: str, **options: Any) -> str:
    """Return the text of a parameter file, with a comment above each line.

    Parameters
    ----------
    profile : str
        `px4` (format of QGroundControl), `ardupilot` (`NAME,value`) or `ros2` (YAML of robot_localization).
    **options
        As in `parameters`; ROS 2 has none.

    Returns
    -------
    str
        The text.

    Raises
    ------
    InputError
        As `parameters`.
    """
    if profile == ROS2:
        return _ROBOT_LOCALIZATION
    found = parameters(profile, **options)
    lines = [
        f"# Parameters of {profile} for fixes of squeezeposenet-toolkit: check each before a flight."
    ]
    for parameter in found:
        lines.append(f"# {parameter.why}")
        value = parameter.value
        if profile == "px4":
            kind = _INT32 if isinstance(value, int) else _REAL32
            lines.append(f"1\t1\t{parameter.name}\t{value}\t{kind}")
        else:
            lines.append(f"{parameter.name},{value:g}")
    return "\n".join(lines) + "\n"


def _px4(
    messages: tuple[Message, ...], use_height: bool, delay_ms: float, sensor: int, quality: int
) -> list[Parameter]:
    """Return PX4's parameters: one position is fused, by GLOBAL_POSITION_SENSOR if that is sent."""
    is_global = Message.GLOBAL_POSITION_SENSOR in messages
    vision = 8 if is_global else 9
    if use_height:
        vision += 2
    if is_global:
        yaw = "yaw (8)" + (" and height (2)" if use_height else "")
        why = f"External vision gives {yaw} only: the position comes as auxiliary global position, and once."
    else:
        height = ", height (2)" if use_height else ""
        why = f"External vision gives horizontal position (1){height} and yaw (8)."
    found = []
    if is_global:
        found += [
            Parameter(
                "EKF2_AGP0_CTRL",
                1,
                "Fuse the horizontal position of GLOBAL_POSITION_SENSOR (#296).",
            ),
            Parameter("EKF2_AGP0_ID", sensor, "Identifier of this sensor in the message."),
            Parameter(
                "EKF2_AGP0_MODE",
                0,
                "Reset to it only if no other source of horizontal position is fused (0, automatic).",
            ),
            Parameter(
                "EKF2_AGP0_DELAY",
                delay_ms,
                "Delay in ms beyond the message's processing_time; compare innovations in a log.",
            ),
            Parameter(
                "EKF2_AGP0_NOISE", 0.1, "Least standard deviation in m; the message states its own."
            ),
            Parameter(
                "EKF2_AGP0_GATE",
                3.0,
                "Innovations beyond so many standard deviations are rejected.",
            ),
        ]
    else:
        found.append(Parameter("EKF2_AGP0_CTRL", 0, "GLOBAL_POSITION_SENSOR is not sent."))
    return [
        *found,
        Parameter("EKF2_EV_CTRL", vision, why),
        Parameter(
            "EKF2_EV_QMIN",
            quality,
            _QUALITY,
        ),
        Parameter(
            "EKF2_EV_DELAY",
            delay_ms,
            "Delay in ms that stamps do not show: 0 with TIMESYNC, else from exposure to arrival.",
        ),
        Parameter("EKF2_EV_NOISE_MD", 0, "Use the variances of the messages."),
        Parameter("EKF2_EVP_NOISE", 0.1, "Least standard deviation of the position in m."),
        Parameter("EKF2_EVA_NOISE", 0.05, "Least standard deviation of the yaw in rad."),
        *(
            Parameter(
                f"EKF2_EV_POS_{axis}",
                0.0,
                "The lever arm of the camera is in the messages already.",
            )
            for axis in "XYZ"
        ),
    ]


def _ardupilot(use_height: bool, delay_ms: float, quality: int) -> list[Parameter]:
    """Return ArduPilot's parameters."""
    return [
        Parameter("AHRS_EKF_TYPE", 3, "Use EKF3."),
        Parameter("EK3_ENABLE", 1, "Run EKF3."),
        Parameter(
            "VISO_TYPE",
            1,
            "MAVLink. Not 3 (VOXL): there, a reset counter shifts the map, which does not move.",
        ),
        Parameter(
            "VISO_QUAL_MIN",
            quality,
            _QUALITY,
        ),
        Parameter(
            "VISO_DELAY_MS",
            round(delay_ms),
            "Least delay from exposure to arrival in ms (`least_age_us` of the link's report, and the link).",
        ),
        Parameter(
            "VISO_POS_M_NSE",
            0.2,
            "Least standard deviation of the position in m; at least the usual one before ArduPilot#32084.",
        ),
        Parameter("VISO_YAW_M_NSE", 0.2, "Least standard deviation of the yaw in rad."),
        *(
            Parameter(
                f"VISO_POS_{axis}", 0, "The lever arm of the camera is in the messages already."
            )
            for axis in "XYZ"
        ),
        Parameter("VISO_ORIENT", 0, "The mounting of the camera is in the messages already."),
        Parameter("VISO_SCALE", 1, "The map is in metres."),
        Parameter("EK3_SRC1_POSXY", 6, "Horizontal position from external navigation."),
        Parameter("EK3_SRC1_VELXY", 0, "No velocity is sent: 6 would wait for it."),
        Parameter(
            "EK3_SRC1_POSZ",
            6 if use_height else 1,
            "Height from external navigation." if use_height else "Height from the barometer.",
        ),
        Parameter("EK3_SRC1_VELZ", 0, "No vertical velocity is sent."),
        Parameter("EK3_SRC1_YAW", 6, "Yaw from external navigation; 1 takes the compass."),
    ]
