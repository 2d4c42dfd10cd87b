"""Messages as the autopilots read them: packed, parsed by pymavlink, and taken by their rules."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_model.autopilot.datum import Datum
from spn_model.autopilot.frames import Mounting
from spn_model.autopilot.profiles import PROFILES, Message
from spn_model.autopilot.sender import Sender, SenderOptions
from spn_model.integrity.fix import FixState, NoFix
from tests.worlds.autopilots import DATUM, NOW_US, ORIGIN, ArduPilot, Px4, make_fix

common = pytest.importorskip("pymavlink.dialects.v20.common")
SLOT_US = 20_000


def make_sender(profile="ardupilot", *, origin=True, **options):
    """Return a sender whose autopilot has stated the origin of the world, if it has one."""
    chosen = PROFILES[profile]
    values = {"mounting": Mounting(), "datum": DATUM, "messages": chosen.messages}
    link = common.MAVLink(None, 1, 197)
    sender = Sender(chosen, SenderOptions(**{**values, **options}), link)
    if origin:
        autopilot = common.MAVLink(None, 1, 1)
        stated = autopilot.gps_global_origin_encode(481000000, 116000000, 560_000, 0)
        sender.handle(parsed(stated, autopilot), NOW_US)
    return sender


def parsed(message, link):
    """Return a message as pymavlink reads its bytes."""
    (found,) = common.MAVLink(None).parse_buffer(message.pack(link))
    return found


def said(sender, now_us=NOW_US):
    """Return the messages of a slot that are about positions, read from their bytes."""
    kinds = set(Message)
    messages = [parsed(message, sender.link) for message in sender.slot(now_us)]
    return [message for message in messages if message.get_type() in kinds]


def no_fix(time_us=NOW_US, state=FixState.TRACK, reason="too few inliers"):
    """Return a result without a fix."""
    return NoFix(time_us=time_us, state=state, reason=reason, processing_s=0.05)


# ArduPilot


def test_ardupilot_reads_position_yaw_and_the_sigma_that_was_meant():
    """Its one standard deviation is that of the worst horizontal axis, 0.3 m, not a sum over three axes."""
    sender, autopilot = make_sender(), ArduPilot()
    sender.offer(make_fix(heading_pitch_roll_deg=[90.0, 0.0, 0.0]))
    (message,) = said(sender)
    assert autopilot.take(message, NOW_US) == ""
    (fused,) = autopilot.fused
    np.testing.assert_allclose(fused["ned"], [20, 10, -30], atol=0.1)
    assert fused["sigma"] == pytest.approx(0.3, abs=1e-6)
    assert fused["yaw"] == pytest.approx(math.pi / 2, abs=1e-6)
    assert message.quality == 80
    assert message.time_usec == NOW_US - 60_000
    assert autopilot.internal_errors == 0


def test_ardupilot_gets_the_worse_of_height_and_position_if_it_uses_both():
    """With the height, its one standard deviation must hold for the height too: 0.5 m."""
    sender, autopilot = make_sender(use_height=True), ArduPilot()
    sender.offer(make_fix())
    autopilot.take(said(sender)[0], NOW_US)
    assert autopilot.fused[0]["sigma"] == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize(("sigma", "read"), [(0.01, 0.2), (0.5, 0.5), (400.0, 100.0)])
def test_ardupilot_clamps_the_sigma(sigma, read):
    """Below VISO_POS_M_NSE and above 100 m, the standard deviation is clamped; between, it is ours."""
    sender, autopilot = make_sender(), ArduPilot(yaw_noise=0.0)
    covariance = np.diag([sigma**2, sigma**2 / 4, sigma**2, 1e-4, 0.04, 1e-4])
    sender.offer(make_fix(covariance=covariance))
    autopilot.take(said(sender)[0], NOW_US)
    assert autopilot.fused[0]["sigma"] == pytest.approx(read, rel=1e-6)
    # Camera axis y points down: its 0.2 rad are the yaw's.
    assert autopilot.fused[0]["yaw_sigma"] == pytest.approx(0.2, rel=1e-6)


@pytest.mark.parametrize("quality_min", [-1, 0, 1])
def test_no_fix_moves_ardupilot_under_no_parameters(quality_min):
    """After a loss nothing is fused, even if VISO_QUAL_MIN is -1, and nothing is an internal error."""
    sender, autopilot = make_sender(), ArduPilot(quality_min=quality_min)
    sender.offer(make_fix())
    assert autopilot.take(said(sender)[0], NOW_US) == ""
    sender.offer(no_fix())
    (message,) = said(sender, NOW_US + SLOT_US)
    assert message.quality == -1
    assert autopilot.take(message, NOW_US + SLOT_US) == ("NaN" if quality_min < 0 else "quality")
    assert len(autopilot.fused) == 1
    assert autopilot.internal_errors == 0


def test_an_ignored_height_would_poison_ardupilots_sigma():
    """The transcription shows the trap: NaN in the height's variance is an internal error and 50 m."""
    sender, autopilot = make_sender(), ArduPilot()
    sender.offer(make_fix())
    (message,) = said(sender)
    message.pose_covariance = [
        math.nan if i == 11 else v for i, v in enumerate(message.pose_covariance)
    ]
    autopilot.take(message, NOW_US)
    assert autopilot.internal_errors == 1
    assert autopilot.fused[0]["sigma"] == pytest.approx(50.1)


def test_ardupilot_drops_the_frame_of_px4_in_silence():
    """What is sent to PX4 is nothing to ArduPilot, so the profile counts."""
    sender = make_sender("px4", messages=(Message.ODOMETRY,))
    sender.offer(make_fix())
    assert ArduPilot().take(said(sender)[0], NOW_US) == "frame"


def test_ardupilots_times_keep_one_delay_over_a_loss():
    """Its corrected times lag by one constant, also after minutes without a fix: the least delay, 60 ms."""
    sender, autopilot = make_sender(), ArduPilot()
    lags, now = [], NOW_US
    for step in range(400):
        now += 33_000
        if not 100 <= step < 300:
            sender.offer(make_fix(time_us=now - 60_000 - 1000 * (step % 30)))
        for message in said(sender, now):
            if not autopilot.take(message, now + 2000):
                lags.append(autopilot.fused[-1]["time_ms"] - message.time_usec // 1000)
    assert len(lags) > 180
    assert sender.report.least_age_us == 60_000
    assert set(lags) <= {61, 62, 63}


# Between images


def moving(step, latency_us=60_000, **changes):
    """Return the fix of an image each 0.2 s of a camera that flies east at 5 m/s."""
    covariance = np.diag([1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6])
    values = {"center": [10.0 + step, 20.0, 30.0], "covariance": covariance}
    time_us = NOW_US + 200_000 * step - latency_us
    return make_fix(time_us=time_us, **{**values, **changes})


def flown(sender, fixes, slots=100):
    """Return the messages of slots at 50 a second, with the fixes offered at the slots of their keys."""
    found = []
    for slot in range(slots):
        if slot in fixes:
            sender.offer(fixes[slot])
        found += said(sender, NOW_US + SLOT_US * slot)
    return found


def test_predictions_fill_the_time_between_images():
    """At 5 images a second PX4 gets a pose each 20 ms: right, marked as predictions, and heavier never."""
    sender, taker = make_sender("px4", messages=(Message.ODOMETRY,)), Px4()
    messages = flown(sender, {10 * k: moving(k) for k in range(10)})
    assert all(taker.take(message) == "" for message in messages)
    stamps = np.array([m.time_usec for m in messages])
    assert np.diff(stamps).max() <= 200_000  # until the motion is known
    assert np.diff(stamps[2:]).max() <= SLOT_US
    np.testing.assert_allclose(
        [m.y for m in messages], 10 + (stamps + 60_000 - NOW_US) * 5e-6, atol=0.1
    )
    measured = np.array([m.quality == 80 for m in messages])
    assert np.count_nonzero(measured) == sender.report.sent == 10
    assert all(m.quality <= 49 for m in np.array(messages)[~measured])
    weights = np.array([1 / m.pose_covariance[6] for m in messages])
    assert weights[~measured].sum() < weights[measured].sum()
    last = np.flatnonzero(measured)[5]
    assert (np.diff([m.pose_covariance[6] for m in messages[last : last + 10]]) > 0).all()
    assert sender.report.coasted == np.count_nonzero(~measured)


def test_predictions_end():
    """They end 0.5 s after the last fix, at once after a loss, and none comes if they are switched off."""
    for options, item, longest in (
        ({}, None, 500_000),
        ({}, no_fix(NOW_US + 220_000, FixState.COAST), 500_000),
        ({}, no_fix(NOW_US + 220_000, FixState.LOST), 100_000),
        ({"coast_s": 0.0}, None, 0),
    ):
        sender = make_sender("px4", messages=(Message.ODOMETRY,), **options)
        fixes = {0: moving(0), 10: moving(1)} | ({} if item is None else {15: item})
        poses = [m for m in flown(sender, fixes) if m.quality >= 0]
        assert poses[-1].time_usec - moving(1).time_us <= longest
        assert longest == 0 or poses[-1].time_usec - moving(1).time_us > longest - 2 * SLOT_US
    with pytest.raises(InputError, match="predictions go out for"):
        make_sender(coast_s=3.0)


def test_a_fix_that_comes_after_a_prediction_is_moved_on():
    """One whose image took longer is no older than the last pose, is counted, and keeps its weight."""
    sender = make_sender("px4", messages=(Message.ODOMETRY,))
    late = moving(2)
    messages = flown(sender, {0: moving(0), 10: moving(1), 22: late}, slots=23)
    assert messages[-1].time_usec == messages[-2].time_usec + 1000 > late.time_us
    assert sender.report.sent == 3
    assert sender.report.repeated == 0
    assert messages[-1].pose_covariance[6] < messages[-2].pose_covariance[6] / 10
    assert messages[-1].quality == 49


# PX4


def test_px4_reads_each_axis_and_the_yaw():
    """Its variances are those of north, east, down and yaw, with its floors."""
    sender, autopilot = make_sender("px4", messages=(Message.ODOMETRY,)), Px4(quality_min=1)
    sender.offer(make_fix(heading_pitch_roll_deg=[90.0, 0.0, 0.0]))
    (message,) = said(sender)
    assert autopilot.take(message) == ""
    (fused,) = autopilot.fused
    assert fused["frame"] == "NED"
    np.testing.assert_allclose(fused["ned"], [20, 10, -30], atol=0.1)
    np.testing.assert_allclose(fused["variance"], [0.04, 0.09, 0.25], rtol=1e-6)
    assert fused["yaw"] == pytest.approx(math.pi / 2, abs=1e-6)
    assert fused["yaw_variance"] == pytest.approx(0.0025)  # 1e-4 is below the floor
    tight = make_fix(time_us=NOW_US, covariance=np.eye(6) * 1e-6)
    sender.offer(tight)
    autopilot.take(said(sender, NOW_US + SLOT_US)[0])
    np.testing.assert_allclose(autopilot.fused[1]["variance"], 0.01)


@pytest.mark.parametrize("quality_min", [0, 1])
def test_no_fix_never_reaches_px4s_filter(quality_min):
    """What says that there is no fix is valid in nothing, so it is not fused even if EKF2_EV_QMIN is 0."""
    sender = make_sender("px4", messages=(Message.ODOMETRY,))
    autopilot = Px4(quality_min=quality_min)
    sender.offer(make_fix())
    assert autopilot.take(said(sender)[0]) == ""
    for step in (1, 2, 30):
        sender.offer(no_fix(NOW_US + step * SLOT_US, FixState.LOST))
        (message,) = said(sender, NOW_US + step * SLOT_US)
        assert autopilot.take(message) == "nothing valid"
    assert len(autopilot.fused) == 1


def test_px4_reads_the_place_on_the_earth_with_standard_deviations():
    """GLOBAL_POSITION_SENSOR has the place, both heights, sigmas, the time of sending and the processing."""
    sender, autopilot = make_sender("px4", sensor=3), Px4()
    sender.offer(make_fix())
    message, _ = said(sender)
    assert autopilot.take(message) == ""
    (fused,) = autopilot.fused
    enu = ORIGIN.enu_from_wgs84(np.array([fused["lat"], fused["lon"], message.alt]))
    np.testing.assert_allclose(enu, [10, 20, 30], atol=0.02)
    assert fused["sigma"] == pytest.approx(0.3)
    assert message.epv == pytest.approx(0.5)
    assert message.alt_ellipsoid - message.alt == pytest.approx(45.5, abs=1e-3)
    assert fused["sample_us"] == NOW_US - 60_000
    assert (message.source, message.flags, message.id) == (2, 0, 3)


def test_heights_that_are_not_known_are_not_sent():
    """Above take-off, a place on the Earth has no height, and messages about an origin are refused."""
    datum = Datum(origin=replace(ORIGIN, height_reference=HeightReference.TAKEOFF))
    sender = make_sender("px4", datum=datum, messages=(Message.GLOBAL_POSITION_SENSOR,))
    sender.offer(make_fix())
    (message,) = said(sender)
    assert math.isnan(message.alt)
    assert math.isnan(message.alt_ellipsoid)
    assert message.lat != 2**31 - 1
    with pytest.raises(InputError, match="above sea level"):
        make_sender("px4", datum=datum)


def test_an_unhealthy_global_position_is_silent_unless_asked_for():
    """Without a fix, GLOBAL_POSITION_SENSOR is not sent, or flagged and without position if asked for."""
    messages = (Message.GLOBAL_POSITION_SENSOR,)
    sender = make_sender("px4", messages=messages)
    flagging = make_sender("px4", messages=messages, flag_unhealthy=True)
    for one in (sender, flagging):
        one.offer(make_fix())
        said(one)
        one.offer(no_fix())
    assert said(sender, NOW_US + SLOT_US) == []
    (message,) = said(flagging, NOW_US + SLOT_US)
    assert (message.flags, message.lat, message.lon) == (1, 2**31 - 1, 2**31 - 1)
    assert all(
        math.isnan(v) for v in (message.alt, message.alt_ellipsoid, message.eph, message.epv)
    )


@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
def test_vision_position_estimate_has_the_same_pose(profile):
    """VISION_POSITION_ESTIMATE is read as ODOMETRY is, but for the quality that it cannot carry."""
    sender = make_sender(profile, messages=(Message.VISION_POSITION_ESTIMATE,))
    sender.offer(make_fix(heading_pitch_roll_deg=[90.0, 0.0, 0.0]))
    (message,) = said(sender)
    autopilot = Px4() if profile == "px4" else ArduPilot()
    taken = autopilot.take(message) if profile == "px4" else autopilot.take(message, NOW_US)
    assert taken == ""
    np.testing.assert_allclose(autopilot.fused[0]["ned"], [20, 10, -30], atol=0.1)
    assert autopilot.fused[0]["yaw"] == pytest.approx(math.pi / 2, abs=1e-6)
    sender.offer(no_fix())
    assert said(sender, NOW_US + SLOT_US) == []  # it could only be a lie
    strict = Px4(quality_min=1)
    assert profile != "px4" or strict.take(message) == "quality"


# What is sent when


def test_a_fix_is_sent_once_and_then_not_repeated():
    """Between fixes there is silence, and after 250 ms it is said that there is none."""
    sender = make_sender()
    assert said(sender, NOW_US - 10**6) == []  # nothing to say before the first fix
    sender.offer(make_fix())
    assert [m.quality for m in said(sender)] == [80]
    qualities = [
        [m.quality for m in said(sender, NOW_US + step * SLOT_US)] for step in range(1, 14)
    ]
    assert qualities == [[]] * 9 + [[-1]] * 4  # 190 ms after the slot, the exposure is 250 ms ago
    sender.offer(make_fix())
    (message,) = said(sender, NOW_US + 14 * SLOT_US)
    assert message.quality == -1
    assert sender.report.stale == 1


def test_old_repeated_and_future_fixes_are_dropped_with_a_reason():
    """A fix that is stale, not newer than the last, or ahead of the clock is not sent."""
    sender = make_sender()
    sender.offer(make_fix(time_us=NOW_US - 250_001))
    assert said(sender) == []
    assert sender.report.reason == "the fix is 250 ms old"
    sender.offer(make_fix(time_us=NOW_US - 250_000))
    assert len(said(sender)) == 1
    sender.offer(make_fix(time_us=NOW_US - 250_000))
    assert said(sender, NOW_US - 1) == []
    sender.offer(make_fix(time_us=NOW_US + 10**6))
    assert [m.quality for m in said(sender)] == [-1]
    assert sender.report.reason == "the fix is 1000 ms ahead of the clock"
    report = sender.report
    assert (report.sent, report.stale, report.repeated, report.refused) == (1, 1, 1, 1)


@pytest.mark.parametrize("state", [FixState.BOOT, FixState.SEARCH, FixState.CONFIRM, FixState.LOST])
def test_a_fix_that_waits_for_confirmation_is_not_sent(state):
    """Only the states track and coast reach an autopilot; the others say why not."""
    sender = make_sender()
    sender.offer(make_fix())
    said(sender)
    sender.offer(make_fix(time_us=NOW_US, state=state))
    assert [m.quality for m in said(sender, NOW_US + SLOT_US)] == [-1]
    assert sender.report.reason == f"the state of the fix is {state.value}"
    sender.offer(make_fix(time_us=NOW_US + 1, state=FixState.COAST))
    assert [m.quality for m in said(sender, NOW_US + 2 * SLOT_US)] == [80]


def test_a_failed_image_does_not_take_back_the_fix_before_it():
    """A fix that waits for its slot goes out though the next image failed; a loss takes it back."""
    sender = make_sender()
    sender.offer(make_fix())
    sender.offer(no_fix())
    assert [m.quality for m in said(sender)] == [80]
    assert [m.quality for m in said(sender, NOW_US + SLOT_US)] == [-1]
    sender.offer(make_fix(time_us=NOW_US + 1))
    sender.offer(no_fix(NOW_US + 2, FixState.LOST))
    assert [m.quality for m in said(sender, NOW_US + 2 * SLOT_US)] == [-1]


def test_the_newest_of_two_fixes_is_sent():
    """Of two fixes in one slot, the newer one goes out."""
    sender = make_sender()
    sender.offer(make_fix())
    sender.offer(make_fix(time_us=NOW_US - 10_000))
    (message,) = said(sender)
    assert message.time_usec == NOW_US - 10_000
    assert sender.report.replaced == 1


@pytest.mark.parametrize(("asked", "resets"), [(False, 0), (True, 1)])
def test_the_reset_counter_counts_only_if_asked_for(asked, resets):
    """After a loss, the counter stays by default, since it makes the autopilots jump."""
    sender = make_sender(reset_on_reacquisition=asked)
    ardupilot, px4 = ArduPilot(), Px4()
    items = [make_fix(), no_fix(state=FixState.LOST), make_fix(time_us=NOW_US + 1)]
    items.append(make_fix(time_us=NOW_US + 30_000))
    for step, item in enumerate(items):
        sender.offer(item)
        for message in said(sender, NOW_US + step * SLOT_US):
            ardupilot.take(message, NOW_US + step * SLOT_US)
            px4.take(message)
    assert (ardupilot.resets, px4.resets) == (resets, resets)
    assert len(ardupilot.fused) == 3


# Origins


def sent_kinds(sender, now_us):
    """Return the kinds of all messages of a slot."""
    return [message.get_type() for message in sender.slot(now_us)]


def test_nothing_about_an_unknown_origin_is_sent():
    """Without the autopilot's origin, ODOMETRY waits; the autopilot is asked first, and then given one."""
    sender = make_sender(origin=False)
    sender.offer(make_fix())
    assert said(sender) == []
    assert sender.report.reason == "the autopilot has not stated its origin"
    for second in (1, 2):
        assert sent_kinds(sender, NOW_US + second * 10**6)[2:] == ["COMMAND_LONG"]
    messages = sender.slot(NOW_US + 3 * 10**6)
    given = parsed(messages[2], sender.link)
    assert given.get_type() == "SET_GPS_GLOBAL_ORIGIN"
    assert (given.latitude, given.longitude) == (481000000, 116000000)
    assert given.altitude == pytest.approx(560_000, abs=1)
    autopilot = common.MAVLink(None, 1, 1)
    stated = autopilot.gps_global_origin_encode(481000000, 116000000, 560_000, 0)
    sender.handle(parsed(stated, autopilot), NOW_US)
    assert sent_kinds(sender, NOW_US + 4 * 10**6) == ["HEARTBEAT", "TIMESYNC"]
    sender.offer(make_fix(time_us=NOW_US + 4 * 10**6))
    assert len(said(sender, NOW_US + 4 * 10**6 + 1)) == 1


def test_positions_follow_the_autopilots_own_origin():
    """An origin that GNSS has set 100 m north shifts what is sent, though not the place."""
    sender, autopilot = make_sender(), ArduPilot()
    lat = round(ORIGIN.wgs84_from_enu(np.array([0.0, 100.0, 0.0]))[0] * 1e7)
    other = common.MAVLink(None, 1, 1)
    sender.handle(parsed(other.gps_global_origin_encode(lat, 116000000, 550_000, 0), other), NOW_US)
    sender.offer(make_fix())
    autopilot.take(said(sender)[0], NOW_US)
    np.testing.assert_allclose(autopilot.fused[0]["ned"], [-80, 10, -40], atol=0.15)


@pytest.mark.parametrize(
    ("system", "lat", "reason"),
    [
        (9, 481000000, "has not stated its origin"),  # of another aircraft
        (1, 0, "has not stated its origin"),  # a place that nobody set
        (1, 1000000000, "has not stated its origin"),
        (1, 471000000, "origin is 111 km away"),
    ],
)
def test_origins_of_others_and_impossible_ones_are_not_used(system, lat, reason):
    """The origin of another aircraft, of nowhere and of far away holds ODOMETRY back, with the reason."""
    sender = make_sender(origin=False)
    other = common.MAVLink(None, system, 1)
    lon = 116000000 if lat else 0
    sender.handle(parsed(other.gps_global_origin_encode(lat, lon, 0, 0), other), NOW_US)
    sender.offer(make_fix())
    assert said(sender) == []
    assert reason in sender.report.reason


def test_a_fix_is_not_sent_to_another_autopilot():
    """To what ArduPilot would drop in silence, the heartbeat of the wrong autopilot is an objection."""
    sender = make_sender("px4")
    other = common.MAVLink(None, 1, 1)
    sender.handle(parsed(other.heartbeat_encode(2, 3, 0, 0, 4), other), NOW_US)
    sender.offer(make_fix())
    assert said(sender) == []
    assert sender.report.reason == "the autopilot is of type 3, not of profile px4"
    sender.handle(parsed(other.heartbeat_encode(2, 12, 0, 0, 4), other), NOW_US)
    sender.offer(make_fix())
    assert len(said(sender)) == 2


@pytest.mark.parametrize("messages", [(), ("ODOMETRY", "GPS_INPUT")])
def test_other_messages_are_refused(messages):
    """No message and one that is not offered are refused."""
    with pytest.raises(InputError, match=r"the messages are .*; there are ODOMETRY"):
        make_sender(messages=messages)


@pytest.mark.parametrize("wrong", [{"sensor": 0}, {"sensor": 256}, {"system": 0}])
def test_options_out_of_range_are_refused(wrong):
    """Identifiers are one byte and not zero."""
    with pytest.raises(InputError, match="not a number of 1 to 255"):
        make_sender(**wrong)
