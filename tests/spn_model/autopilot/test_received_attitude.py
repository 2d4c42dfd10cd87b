"""Attitude from an autopilot or a gimbal: real MAVLink messages, their times, and what is refused."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest

from spn_data.geometry.rotations import quats_from_rotations, rotations_from_vectors
from spn_model.autopilot.frames import Mounting
from spn_model.autopilot.link import open_link, unix_us
from spn_model.autopilot.received_attitude import BODY, GIMBAL, ReceivedAttitude
from spn_model.onboard.attitude import GimbalMounting, LiveAttitude, read_attitude
from tests.worlds.autopilots import DATUM
from tests.worlds.loopback_autopilot import Autopilot

common = pytest.importorskip("pymavlink.dialects.v20.common")
MAV = common.MAVLink(None, 1, 1)
NOW, OFFSET = 5_000_000_000, -4_000_000_000  # our clock; the autopilot's is 4000 s behind
PITCH, ROLL = np.deg2rad(-20.0), np.deg2rad(5.0)
UP = np.array([np.sin(PITCH), -np.cos(PITCH) * np.sin(ROLL), -np.cos(PITCH) * np.cos(ROLL)])
NO_RATE = (math.nan, math.nan, math.nan)


def packed(message):
    """Return a message as it comes out of a link."""
    return common.MAVLink(None).parse_buffer(message.pack(MAV))[0]


def boot_ms(time_us: int) -> int:
    return (time_us + OFFSET) // 1000


def attitude(time_us, roll=ROLL, pitch=PITCH, rates=(0.0, 0.0, 0.0)):
    return packed(MAV.attitude_encode(boot_ms(time_us), roll, pitch, 1.2, *rates))


def quat() -> list[float]:
    """Return the rotation from the body to North, East, Down with the pitch and roll above, and a yaw."""
    about = rotations_from_vectors(np.diag([ROLL, PITCH, 1.2]))
    return quats_from_rotations((about[2] @ about[1] @ about[0])[None])[0].tolist()


def gimbal(time_us, flags=12, failure=0, q=None, rates=NO_RATE):
    q = quat() if q is None else q
    return packed(
        MAV.gimbal_device_attitude_status_encode(0, 0, boot_ms(time_us), flags, q, *rates, failure)
    )


@pytest.mark.parametrize(
    ("of", "message"),
    [
        (BODY, attitude(NOW)),
        (BODY, packed(MAV.attitude_quaternion_encode(boot_ms(NOW), *quat(), 0, 0, 0))),
        (GIMBAL, gimbal(NOW)),
    ],
)
def test_up_is_that_of_pitch_and_roll(of, message):
    """Angles and quaternions give the same up, whatever the yaw, at the time on our clock."""
    found = ReceivedAttitude(of)
    found.take(message, NOW + 20_000, OFFSET)
    up, _ = found.at(NOW)
    assert up == pytest.approx(UP, abs=1e-5)
    assert found.at(NOW + 101_000) is found.at(NOW - 101_000) is None
    assert found.taken == 1


def test_a_turn_since_the_message_is_followed_and_makes_it_less_sure():
    """50 ms after a message at 40 deg/s up has turned by 2 degrees; without a rate only sigma grows."""
    found = ReceivedAttitude(BODY)
    found.take(attitude(NOW, rates=(0.0, np.deg2rad(40.0), 0.0), roll=0.0), NOW, OFFSET)
    up, sigma_deg = found.at(NOW + 50_000)
    assert np.rad2deg(np.arcsin(up[0])) == pytest.approx(-18.0, abs=0.05)
    assert sigma_deg == pytest.approx(1.0)
    still = ReceivedAttitude(GIMBAL)
    still.take(gimbal(NOW), NOW, OFFSET)
    assert still.at(NOW + 50_000)[1] == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("of", "message", "offset", "told"),
    [
        (BODY, attitude(NOW), None, "the autopilot's clock is not known yet"),
        (BODY, attitude(NOW - 600_000), OFFSET, "it is 600 ms old"),
        (BODY, attitude(NOW + 60_000), OFFSET, "it is 60 ms ahead of the clock"),
        (BODY, attitude(NOW, pitch=math.nan), OFFSET, "ATTITUDE has no attitude"),
        (GIMBAL, gimbal(NOW, q=[0.0] * 4), OFFSET, "has no attitude"),
        (GIMBAL, gimbal(NOW, flags=8), OFFSET, "not relative to the horizon"),
        (GIMBAL, gimbal(NOW, failure=2), OFFSET, "the gimbal reports the failure 2"),
    ],
)
def test_what_states_no_attitude_now_is_refused(of, message, offset, told):
    """Each kind is counted and named, and nothing is known then."""
    found = ReceivedAttitude(of)
    found.take(message, NOW, offset)
    assert (found.taken, found.refused) == (0, 1)
    assert told in found.reason
    assert found.at(NOW) is None
    assert found.is_silent(NOW)


def asked(autopilot) -> set[int]:
    """Return the kinds of messages that an autopilot was asked to send regularly."""
    commands = [m for m in autopilot.messages if m.get_type() == "COMMAND_LONG"]
    return {int(m.param1) for m in commands if m.command == 511}


def test_it_comes_over_a_link_at_the_times_of_images():
    """Over loopback: asked for, stamped by TIMESYNC although the clocks differ, ignored from others."""
    autopilot = Autopilot()
    boot_us = unix_us() - 1_000_000_000
    autopilot.clock_us = lambda: unix_us() - boot_us
    link = open_link("ardupilot", autopilot.url, mounting=Mounting(), datum=DATUM, attitude_of=BODY)
    autopilot.listen(10, until=lambda: link.report().offset_us is not None)
    peer = autopilot.peer
    stranger = common.MAVLink(None, 9, 1)
    image_us, end = 0, time.monotonic() + 10
    while link.attitude.taken < 2 and time.monotonic() < end:
        now_ms = autopilot.clock_us() // 1000
        wrong = stranger.attitude_encode(now_ms, 3.0, 0.0, 0.0, 0, 0, 0)
        autopilot.socket.sendto(wrong.pack(stranger), peer)
        autopilot.answer(
            peer, autopilot.link.attitude_encode(now_ms, ROLL, PITCH, 0.0, 0.0, 0.0, 0.0)
        )
        image_us = boot_us + now_ms * 1000
        autopilot.listen(0.05)
    autopilot.listen(10, until=lambda: asked(autopilot) == {30, 31})
    live = LiveAttitude(
        link.attitude, of=BODY, mounting=None, body_from_camera=np.eye(3), sigma_deg=1.0
    )
    found = live.at(image_us)
    link.close()
    autopilot.close()
    assert found.up == pytest.approx(UP, abs=1e-5)
    assert found.sigma_deg == pytest.approx(1.0, abs=0.1)
    assert "received for 1 of 2 images" in live.coverage(1, 2)
    assert asked(autopilot) == {30, 31}


@pytest.mark.parametrize("of", ["gimbal", "camera", "body"])
def test_live_and_recorded_angles_give_the_same_up(tmp_path, of):
    """Pitch and roll of a file and of a message are turned into the camera alike, mounting included."""
    mounting = GimbalMounting(turn_deg=(1.5, 0.0, -0.5), sigma_deg=0.7, frames=50, flights=2)
    path = tmp_path / "a.csv"
    path.write_text(f"time_s,pitch_deg,roll_deg\n0,{math.degrees(PITCH)},{math.degrees(ROLL)}\n")
    given = {
        "of": of,
        "mounting": mounting,
        "body_from_camera": Mounting.pitched(-30.0).body_from_camera,
        "sigma_deg": None if of == "gimbal" else 1.0,
    }
    received = ReceivedAttitude(BODY if of == "body" else GIMBAL)
    received.take(attitude(NOW) if of == "body" else gimbal(NOW), NOW, OFFSET)
    found = LiveAttitude(received, **given).at(NOW)
    expected = read_attitude(path, **given).at(0.0)
    assert found.up == pytest.approx(expected.up, abs=1e-5)
    assert found.sigma_deg == pytest.approx(expected.sigma_deg)
    later = LiveAttitude(received, **given, offset_s=0.3)
    assert later.at(NOW) is None
    assert later.at(NOW + 300_000) == found
