"""Profiles: what each receiver expects and does with a position from outside, as a table of traits."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from spn_data.errors import InputError
from spn_model.autopilot.projection import Projection

STALE_S = 0.25  # older positions are dropped: ArduPilot corrects no larger delay
MAX_LOCAL_M = 50_000.0  # MAVLink has float32, whose step there is 4 mm

MAV_FRAME_LOCAL_NED = 1
MAV_FRAME_BODY_FRD = 12
MAV_FRAME_LOCAL_FRD = 20


class Message(StrEnum):
    """A MAVLink message that carries a position."""

    ODOMETRY = "ODOMETRY"
    VISION_POSITION_ESTIMATE = "VISION_POSITION_ESTIMATE"
    GLOBAL_POSITION_SENSOR = "GLOBAL_POSITION_SENSOR"


# Positions in these are relative to the autopilot's own origin.
LOCAL_MESSAGES = frozenset({Message.ODOMETRY, Message.VISION_POSITION_ESTIMATE})


class Covariance(StrEnum):
    """How a covariance is encoded."""

    FULL = "full"  # as it is; the receiver reads what it needs
    SCALAR = (
        "scalar"  # a third of a variance on each diagonal element, because the receiver adds them
    )


@dataclass(frozen=True, kw_only=True)
class Profile:
    """Traits of a receiver.

    Attributes
    ----------
    name : str
        Name of the profile.
    messages : tuple of Message
        Messages sent by default.
    odometry_frame : int
        MAV_FRAME of ODOMETRY's position; both receivers take it as North, East, Down about their origin.
    projection : Projection
        How it projects latitude and longitude onto its local plane.
    covariance : Covariance
        Encoding of the covariance.
    rate_hz : float
        Slots of the sender in a second.
    autopilot : int
        MAV_AUTOPILOT that its heartbeat states.
    """

    name: str
    messages: tuple[Message, ...]
    odometry_frame: int
    projection: Projection
    covariance: Covariance
    rate_hz: float
    autopilot: int


ROS2 = "ros2"  # has no traits: the messages of ROS state frames and covariances themselves
PROFILES = {
    profile.name: profile
    for profile in (
        Profile(
            name="px4",
            messages=(Message.GLOBAL_POSITION_SENSOR, Message.ODOMETRY),
            odometry_frame=MAV_FRAME_LOCAL_NED,
            projection=Projection.PX4,
            covariance=Covariance.FULL,
            rate_hz=50.0,
            autopilot=12,
        ),
        Profile(
            name="ardupilot",
            messages=(Message.ODOMETRY,),
            odometry_frame=MAV_FRAME_LOCAL_FRD,
            projection=Projection.ARDUPILOT,
            covariance=Covariance.SCALAR,
            rate_hz=30.0,
            autopilot=3,
        ),
    )
}


def profile_of(name: str) -> Profile:
    """Return the profile of an autopilot by its name; raise InputError if there is none."""
    if name not in PROFILES:
        raise InputError(f"unknown profile '{name}'; there are {', '.join([*PROFILES, ROS2])}")
    return PROFILES[name]
