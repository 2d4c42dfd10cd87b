"""What is sent in each slot of a sender: each fix once while it is fresh, or else that there is none."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from spn_data.errors import InputError
from spn_model.autopilot import mavlink
from spn_model.autopilot.datum import Datum, Geodetic
from spn_model.autopilot.frames import NED_FROM_ENU, BodyPose, Mounting, body_pose
from spn_model.autopilot.profiles import LOCAL_MESSAGES, MAX_LOCAL_M, STALE_S, Message, Profile
from spn_model.autopilot.received_attitude import MESSAGES as ATTITUDE_MESSAGES
from spn_model.autopilot.received_attitude import ReceivedAttitude
from spn_model.autopilot.timesync import Timesync
from spn_model.integrity.coasting import RecentFixes, check_coast
from spn_model.integrity.fix import Fix, FixState, NoFix

_STALE_US = round(STALE_S * 1e6)
_FUTURE_US = 50_000  # a stamp ahead of the clock by more comes from another clock
_SECOND_US = 1_000_000
_STEP_US = 1000  # a fix that comes after a prediction is moved on to this much later
_ATTITUDE_US = 50_000  # between two messages of an attitude that are asked for
_ASKED_FIRST = 3  # times that an autopilot is asked for its origin before it is given one


@dataclass(frozen=True, kw_only=True)
class SenderOptions:
    """Options of a sender.

    Attributes
    ----------
    mounting : Mounting
        How the camera is fixed to the body.
    datum : Datum
        Where the world is on the Earth.
    messages : tuple of Message
        Messages to send.
    use_height : bool
        Whether the autopilot uses the height, as in `parameter_file`.
    sensor : int
        Identifier of the sensor in GLOBAL_POSITION_SENSOR, 1 to 255.
    system : int
        MAVLink system of the aircraft, 1 to 255.
    reset_on_reacquisition : bool
        Increment the reset counter at the first fix after the state `lost`. PX4 and ArduPilot then *jump* to
        that fix instead of testing it, so this is off by default.
    coast_s : float
        Age of the last fix up to which poses predicted from it go out between images, 0 to 1 s; 0: none.
        They have the state `coast` and the quality 49, below that of every fix.
    attitude_of : str
        Whose attitude is received: `body` or `gimbal`; empty: none.
    flag_unhealthy : bool
        Send GLOBAL_POSITION_SENSOR with the flag for an unhealthy sensor while there is no fix, instead of
        none. Off by default: it could not be verified that PX4 heeds the flag, but it does stop after 5 s
        without data.
    """

    mounting: Mounting
    datum: Datum
    messages: tuple[Message, ...]
    use_height: bool = False
    sensor: int = 1
    system: int = 1
    reset_on_reacquisition: bool = False
    coast_s: float = 0.5
    flag_unhealthy: bool = False
    attitude_of: str = ""

    def __post_init__(self) -> None:
        known = set(Message)
        if not self.messages or not known.issuperset(self.messages):
            raise InputError(
                f"the messages are {', '.join(self.messages) or 'none'}; there are {', '.join(Message)}"
            )
        for name, value in (("sensor", self.sensor), ("system", self.system)):
            if not 1 <= value <= 255:
                raise InputError(f"the {name} is {value}, not a number of 1 to 255")
        check_coast(self.coast_s)
        if self.attitude_of and self.attitude_of not in ATTITUDE_MESSAGES:
            raise InputError(f"there is no attitude of the {self.attitude_of}")
        if LOCAL_MESSAGES & set(self.messages):
            self.datum.require_amsl()


@dataclass(kw_only=True)
class SenderReport:
    """Counts of a sender.

    Attributes
    ----------
    sent : int
        Fixes sent, those moved on after a prediction included.
    coasted : int
        Predictions sent.
    failed : int
        Slots in which it was said that there is no fix.
    stale : int
        Fixes not sent because they were older than 250 ms.
    repeated : int
        Fixes not sent because they were not newer than the last one.
    replaced : int
        Fixes not sent because a newer one came before their slot.
    refused : int
        Fixes not sent for another reason, the last of which is `reason`.
    reason : str
        Why the last image or fix was not sent; empty if it was.
    worst_gap_s : float
        Longest time between two slots.
    errors : int
        Datagrams that could not be sent or received; the last error is in `reason`.
    autopilot : int or None
        MAV_AUTOPILOT of its last heartbeat; that of another profile gets no fixes.
    origin : Geodetic or None
        Origin that the autopilot stated.
    least_age_us : int or None
        Smallest age of a fix when it was sent: what ArduPilot's VISO_DELAY_MS has to be, without the link.
    offset_us, round_trip_us : int or None
        Clock of the autopilot minus ours, and the way there and back.
    """

    sent: int = 0
    coasted: int = 0
    failed: int = 0
    stale: int = 0
    repeated: int = 0
    replaced: int = 0
    refused: int = 0
    reason: str = ""
    worst_gap_s: float = 0.0
    errors: int = 0
    autopilot: int | None = None
    origin: Geodetic | None = None
    least_age_us: int | None = None
    offset_us: int | None = None
    round_trip_us: int | None = None


@dataclass(eq=False)
class Sender:
    """The state between fixes and slots, without threads' timing, clocks or sockets: `slot` has the time.

    Attributes
    ----------
    profile : Profile
        The receiver.
    options : SenderOptions
        Options.
    link : Any
        pymavlink's MAVLink object.
    report : SenderReport
        Counts so far.
    attitude : ReceivedAttitude or None
        What was received of it, if the options ask for it.
    """

    profile: Profile
    options: SenderOptions
    link: Any
    report: SenderReport = field(default_factory=SenderReport)
    attitude: ReceivedAttitude | None = None
    _waiting: Fix | None = None
    _last_us: int = 0  # stamp of the last pose sent
    _measured_us: int = 0  # exposure of the last fix sent
    _recent: RecentFixes = field(default_factory=RecentFixes)
    _fresh_until_us: int = 0
    _failed_us: int = 0  # exposure of the last image without a usable fix
    _lost: bool = False
    _resets: int = 0
    _second_us: int | None = None
    _asked: int = 0
    _timesync: Timesync = field(default_factory=Timesync)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        if self.options.attitude_of:
            self.attitude = ReceivedAttitude(self.options.attitude_of)

    def offer(self, item: Fix | NoFix) -> None:
        """Take the result of an image; a fix waits for the next slot."""
        with self._lock:
            self._recent.follow(item)
            if isinstance(item, Fix) and item.usable:
                self.report.replaced += self._waiting is not None
                self._waiting = item
                return
            if isinstance(item, Fix):
                self.report.refused += 1
            if item.state == FixState.LOST:
                self._lost, self._waiting = True, None
            self._failed_us = item.time_us
            self._drop(
                item.reason
                if isinstance(item, NoFix)
                else f"the state of the fix is {item.state.value}"
            )

    def slot(self, now_us: int) -> list[Any]:
        """Return the messages of a slot; `now_us` is on the clock of the fixes.

        Nothing is said about fixes before the first one.
        """
        with self._lock:
            messages = self._each_second(now_us)
            fix, self._waiting = self._waiting, None
            sent = [] if fix is None else self._messages(fix, now_us)
            if not sent and (predicted := self._prediction(now_us)) is not None:
                sent = self._built(predicted, now_us)
                self.report.coasted += bool(sent)
            if not sent and self._last_us and now_us >= self._fresh_until_us:
                self.report.failed += 1
                sent = self._failed(now_us)
            return messages + sent

    def handle(self, message: Any, now_us: int) -> list[Any]:
        """Take a message from the autopilot; return the answers."""
        kind = message.get_type()
        with self._lock:
            if kind == "TIMESYNC":
                answer = self._timesync.handle(self.link, message, now_us)
                self.report.offset_us = self._timesync.offset_us
                self.report.round_trip_us = self._timesync.round_trip_us
                return [] if answer is None else [answer]
            if message.get_srcSystem() != self.options.system:
                return []
            if kind == "HEARTBEAT" and message.autopilot != 8:  # not of a camera or gimbal
                self.report.autopilot = message.autopilot
            elif kind == "GPS_GLOBAL_ORIGIN":
                self._take_origin(mavlink.stated_origin(message))
            elif self.attitude is not None:
                self.attitude.take(message, now_us, self._timesync.offset_us)
        return []

    def _take_origin(self, origin: Geodetic) -> None:
        """Use the autopilot's own origin: what is local for it is about this one, whoever set it."""
        on_earth = abs(origin.lat_deg) <= 90 and abs(origin.lon_deg) <= 180
        if on_earth and (origin.lat_deg, origin.lon_deg) != (0.0, 0.0):
            self.report.origin = origin

    def _each_second(self, now_us: int) -> list[Any]:
        """Return the heartbeat and what is asked of the autopilot, once a second."""
        if self._second_us is not None and 0 <= now_us - self._second_us < _SECOND_US:
            return []
        self._second_us = now_us
        messages = [mavlink.heartbeat(self.link), self._timesync.request(self.link, now_us)]
        if self.attitude is not None and self.attitude.is_silent(now_us):
            ids = ATTITUDE_MESSAGES[self.attitude.of].values()
            messages += [
                mavlink.request_interval(self.link, self.options.system, one, _ATTITUDE_US)
                for one in ids
            ]
        if LOCAL_MESSAGES & set(self.options.messages) and self.report.origin is None:
            # One that is set already, perhaps in flight, must not be moved.
            if self._asked < _ASKED_FIRST:
                messages.append(mavlink.request_origin(self.link, self.options.system))
            else:
                place = self.options.datum.geodetic(np.zeros(3))
                messages.append(mavlink.set_origin(self.link, self.options.system, place, now_us))
                messages.append(mavlink.request_origin(self.link, self.options.system))
            self._asked += 1
        return messages

    def _messages(self, fix: Fix, now_us: int) -> list[Any]:
        """Return the messages of a fix, or none if it must not be sent."""
        age = now_us - fix.time_us
        if age > _STALE_US:
            self.report.stale += 1
            return self._drop(f"the fix is {age / 1e3:.0f} ms old")
        if age < -_FUTURE_US:
            self.report.refused += 1
            return self._drop(f"the fix is {-age / 1e3:.0f} ms ahead of the clock")
        pose: Fix | None = fix
        if fix.time_us <= self._last_us:
            # After a prediction for a later time, receivers take no older pose: the fix is moved on.
            newer = fix.time_us > self._measured_us
            pose = self._recent.predicted(self._last_us + _STEP_US) if newer else None
        if pose is None:
            self.report.repeated += 1
            return []
        self.report.reason = ""
        built = self._built(pose, now_us)
        if not built:
            self.report.refused += 1
            return []
        self._measured_us = fix.time_us
        if fix.time_us > self._failed_us:  # else a later image has failed
            self._fresh_until_us = fix.time_us + _STALE_US
        self._lost = False
        self.report.sent += 1
        age = max(0, age)
        least = self.report.least_age_us
        self.report.least_age_us = age if least is None else min(least, age)
        return built

    def _prediction(self, now_us: int) -> Fix | None:
        """Return the pose for a slot without a fix, if the motion is known and the last fix is young enough.

        Its stamp is as old as that of a fix at best, for the reason given in `_failed`.
        """
        time_us = now_us - (self.report.least_age_us or 0)
        if self._measured_us == 0 or time_us <= self._last_us:
            return None
        slots = math.ceil(self.options.coast_s * self.profile.rate_hz)
        found = self._recent.predicted(time_us, shared_by=max(1, slots))
        too_old = found is None or time_us - self._recent.last_us > self.options.coast_s * 1e6
        return None if too_old else found

    def _built(self, fix: Fix, now_us: int) -> list[Any]:
        """Return the messages with a pose; none, and the reason in the report, if it must not be sent."""
        if self.report.autopilot not in (None, self.profile.autopilot):
            return self._drop(
                f"the autopilot is of type {self.report.autopilot}, not of profile {self.profile.name}"
            )
        pose = body_pose(fix, self.options.mounting)
        built = [
            message
            for kind in self.options.messages
            for message in (
                self._local(kind, fix, pose)
                if kind in LOCAL_MESSAGES
                else [self._global(fix, pose, now_us)]
            )
        ]
        if built:
            self._last_us = fix.time_us
        return built

    def _local(self, kind: Message, fix: Fix, pose: BodyPose) -> list[Any]:
        """Return a message about the autopilot's origin, or none as long as that is unknown or too far."""
        if self.report.origin is None:
            return self._drop("the autopilot has not stated its origin")
        local = self.options.datum.local_ned(
            pose.position, self.report.origin, self.profile.projection
        )
        if np.abs(local).max() > MAX_LOCAL_M:
            return self._drop(f"the autopilot's origin is {np.abs(local).max() / 1e3:.0f} km away")
        if self.options.reset_on_reacquisition and self._lost:
            self._resets = (self._resets + 1) % 256
            self._lost = False
        ned = replace(pose.in_axes(NED_FROM_ENU), position=local)
        values = mavlink.variances(self.profile, ned, use_height=self.options.use_height)
        if kind == Message.ODOMETRY:
            return [
                mavlink.odometry(
                    self.link, self.profile, fix.time_us, ned, values, fix.quality, self._resets
                )
            ]
        return [mavlink.vision_position_estimate(self.link, fix.time_us, ned, values, self._resets)]

    def _global(self, fix: Fix, pose: BodyPose, now_us: int) -> Any:
        """Return the message with a position on the Earth."""
        position = pose.covariance[:3, :3]
        return mavlink.global_position_sensor(
            self.link,
            now_us,
            max(0, now_us - fix.time_us),
            self.options.datum.geodetic(pose.position),
            float(np.sqrt(np.linalg.eigvalsh(position[:2, :2])[-1])),
            float(np.sqrt(position[2, 2])),
            self.options.sensor,
        )

    def _failed(self, now_us: int) -> list[Any]:
        """Return what says that there is no fix; VISION_POSITION_ESTIMATE cannot say it.

        ArduPilot takes the smallest difference between arrival and stamp as the delay of all messages, so the
        stamp is as old as that of a fix at best.
        """
        messages = []
        if Message.ODOMETRY in self.options.messages:
            stamp = now_us - (self.report.least_age_us or 0)
            messages.append(mavlink.odometry_failed(self.link, self.profile, stamp, self._resets))
        if Message.GLOBAL_POSITION_SENSOR in self.options.messages and self.options.flag_unhealthy:
            messages.append(mavlink.global_position_failed(self.link, now_us, self.options.sensor))
        return messages

    def _drop(self, reason: str) -> list[Any]:
        """Note why nothing is sent, and say from the next slot on that there is no fix."""
        self.report.reason, self._fresh_until_us = reason, 0
        return []
