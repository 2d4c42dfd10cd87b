"""Links over loopback UDP and a serial line: an autopilot that answers, times, and what fails."""

from __future__ import annotations

import os
import socket
import time
from dataclasses import replace

import numpy as np
import pytest

from spn_data.errors import InputError, SpnError
from spn_model.autopilot.frames import Mounting
from spn_model.autopilot.link import Link, open_link, unix_us
from spn_model.autopilot.profiles import PROFILES, Message
from spn_model.autopilot.sender import SenderOptions
from spn_model.autopilot.timesync import Timesync
from spn_model.autopilot.transport import open_transport
from spn_model.integrity.fix import FixState, NoFix
from tests.worlds.autopilots import DATUM, NOW_US, ArduPilot, Px4, make_fix
from tests.worlds.loopback_autopilot import Autopilot

common = pytest.importorskip("pymavlink.dialects.v20.common")


@pytest.fixture
def autopilot():
    """Yield an autopilot, and close it."""
    found = Autopilot()
    yield found
    found.close()


def fix_now(age_us=30_000, **changes):
    """Return a fix of an exposure a moment ago."""
    return make_fix(time_us=unix_us() - age_us, **changes)


def wait_for(found, seconds=5.0):
    """Wait until a condition holds."""
    end = time.monotonic() + seconds
    while not found() and time.monotonic() < end:
        time.sleep(0.005)
    assert found()


def fixed(link, autopilot, **changes):
    """Send fixes until one has gone out, since this machine may be too busy for the first."""
    end = time.monotonic() + 10
    while not link.report().sent and time.monotonic() < end:
        link.send(fix_now(**changes))
        autopilot.listen(0.1)
    assert link.report().sent


@pytest.mark.parametrize("profile", ["px4", "ardupilot"])
def test_an_autopilot_receives_what_was_fixed(autopilot, profile):
    """Over UDP: origin asked for, clocks compared both ways, fixes taken, and then that there is none."""
    autopilot.type = 12 if profile == "px4" else 3
    link = open_link(profile, autopilot.url, mounting=Mounting(), datum=DATUM)
    autopilot.listen(10, until=lambda: link.report().origin and link.report().offset_us)
    fixed(link, autopilot, heading_pitch_roll_deg=[90.0, 0.0, 0.0])
    autopilot.listen(10, until=lambda: link.report().failed >= 5)
    link.close()
    autopilot.listen(0.2)
    report = link.report()
    taker = Px4(quality_min=1) if profile == "px4" else ArduPilot(quality_min=1)
    for message in autopilot.messages:
        if message.get_type() in set(Message):
            _ = taker.take(message) if profile == "px4" else taker.take(message, unix_us())
    local = [fused for fused in taker.fused if "ned" in fused]
    assert len(local) == report.sent
    np.testing.assert_allclose(local[0]["ned"], [20, 10, -30], atol=0.1)
    assert len(taker.fused) == report.sent * (2 if profile == "px4" else 1)
    failed = [m for m in autopilot.messages if m.get_type() == "ODOMETRY" and m.quality == -1]
    assert len(failed) == report.failed
    assert (report.autopilot, report.errors) == (autopilot.type, 0)
    assert report.worst_gap_s > 0
    # Whatever the way took, an offset is off by half of that at most.
    assert abs(report.offset_us + NOW_US // 2) <= report.round_trip_us / 2 + 1000
    for there_and_back, offset in autopilot.exchanges_us:
        assert abs(offset - NOW_US // 2) <= there_and_back / 2 + 1000


def test_clocks_are_compared_at_once(autopilot):
    """PX4 uses no answer that took 10 ms, so one does not wait for a slot, here of 2 s."""
    link = Link(
        replace(PROFILES["px4"], rate_hz=0.5),
        open_transport(autopilot.url),
        SenderOptions(mounting=Mounting(), datum=DATUM, messages=(Message.ODOMETRY,)),
    )
    autopilot.listen(3, until=lambda: len(autopilot.exchanges_us) >= 3)
    link.close()
    assert min(autopilot.exchanges_us)[0] < 500_000


def test_slots_follow_an_absolute_schedule(autopilot):
    """In 1.2 s, 50 slots a second: delays of single slots do not add up, and the worst gap is measured."""
    autopilot.type = 12
    link = open_link(
        "px4", autopilot.url, mounting=Mounting(), datum=DATUM, messages=[Message.ODOMETRY]
    )
    autopilot.listen(10, until=lambda: link.report().origin)
    fixed(link, autopilot)
    link.send(NoFix(time_us=unix_us(), state=FixState.LOST, reason="covered", processing_s=0.0))
    before, start = link.report().failed, time.monotonic()
    time.sleep(1.0)
    slots, passed = link.report().failed - before, time.monotonic() - start
    gap = link.report().worst_gap_s
    link.close()
    assert slots <= passed * 50 + 2
    assert gap >= 0.02
    if gap < 0.04:  # no slot was missed
        assert slots >= passed * 50 - 2


def test_closing_ends_the_thread_and_twice_is_once(autopilot):
    """After close, nothing is sent."""
    link = open_link("ardupilot", autopilot.url, mounting=Mounting(), datum=DATUM)
    autopilot.listen(0.1)
    link.close()
    link.close()
    autopilot.listen(0.1)
    count = len(autopilot.messages)
    autopilot.listen(0.1)
    assert len(autopilot.messages) == count


def test_a_thread_that_has_ended_is_not_silent(autopilot, monkeypatch):
    """If the thread of a link fails, the next fix says so instead of going nowhere."""
    link = open_link("ardupilot", autopilot.url, mounting=Mounting(), datum=DATUM)
    monkeypatch.setattr(link, "_write", lambda message: 1 / 0)
    wait_for(lambda: not link._thread.is_alive())
    with pytest.raises(SpnError, match="has ended: ZeroDivisionError"):
        link.send(fix_now())
    link.close()


def test_a_refused_connection_is_counted_not_raised():
    """If nobody listens, the link goes on, counts, and says what happened."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
    link = open_link(
        "px4",
        f"udpout:127.0.0.1:{port}",
        mounting=Mounting(),
        datum=DATUM,
        messages=[Message.GLOBAL_POSITION_SENSOR],
    )
    wait_for(lambda: link.report().errors)
    report = link.report()
    link.close()
    assert report.errors > 0
    assert "the connection failed" in report.reason


def test_a_server_answers_whoever_spoke_last(autopilot):
    """With udpin, nothing is sent before the autopilot has spoken, and then to where it did."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    link = open_link("ardupilot", f"udpin:127.0.0.1:{port}", mounting=Mounting(), datum=DATUM)
    autopilot.listen(0.1)
    assert autopilot.messages == []
    autopilot.answer(("127.0.0.1", port), autopilot.link.heartbeat_encode(2, 3, 0, 0, 4))
    autopilot.listen(10, until=lambda: autopilot.messages)
    link.close()
    assert "HEARTBEAT" in {message.get_type() for message in autopilot.messages}


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="this system has no pseudo-terminals")
def test_messages_go_over_a_serial_line():
    """Bytes go both ways over a serial line, unchanged by the terminal."""
    master, slave = os.openpty()
    transport = open_transport(f"serial:{os.ttyname(slave)}:115200")
    every = bytes(range(256))
    transport.send(every)
    assert os.read(master, 1000) == every
    assert transport.receive() == b""
    os.write(master, every)
    found = bytearray()
    wait_for(lambda: found.extend(transport.receive()) or len(found) >= len(every))
    assert found == every
    transport.close()
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize(
    "url",
    [
        "tcp:localhost:5760",
        "udpout:localhost",
        "udpout::14550",
        "udpout:127.0.0.1:0",
        "udpout:127.0.0.1:70000",
        "udpout:no.such.host.invalid:14550",
        "serial:/dev/no-such-line:57600",
        "serial:/dev/null:57600",
        "serial:/dev/null:12345",
    ],
)
def test_connections_that_are_none_are_refused(url):
    """Another protocol, a missing or impossible port, an unknown host and a file that is no serial line."""
    with pytest.raises(
        InputError, match=r"no connection|no port|cannot be opened|is no serial|baud"
    ):
        open_transport(url)


def test_a_world_without_a_place_cannot_be_sent_to_an_autopilot(autopilot):
    """Without an origin, and with an unknown profile, nothing is opened."""
    with pytest.raises(InputError, match="this world has no origin"):
        open_link("px4", autopilot.url, mounting=Mounting(), datum=None)
    with pytest.raises(InputError, match="unknown profile 'inav'; there are px4, ardupilot, ros2"):
        open_link("inav", autopilot.url, mounting=Mounting(), datum=DATUM)


def test_timesync_takes_the_quickest_exchange_and_no_others_answer():
    """The offset is that of the shortest way; an answer to somebody else's question is ignored."""
    link, sync = common.MAVLink(None, 1, 197), Timesync()
    for now_us, way_us in ((1_000_000, 50_000), (2_000_000, 1_000), (3_000_000, 80_000)):
        question = sync.request(link, now_us)
        late = way_us * 9 // 10  # most of the way there
        answer = link.timesync_encode((now_us + late + 7_000_000) * 1000, question.ts1)
        assert sync.handle(link, answer, now_us + way_us) is None
    assert sync.round_trip_us == 1_000
    assert sync.offset_us == 7_000_000 + 900 - 500
    sync.handle(link, link.timesync_encode(5, 12345), 4_000_000)
    assert sync.offset_us == 7_000_400
    asked = link.timesync_encode(0, 77)
    assert (sync.handle(link, asked, 9).tc1, sync.handle(link, asked, 9).ts1) == (9_000, 77)


def test_an_old_pymavlink_is_refused(monkeypatch):
    """Without GLOBAL_POSITION_SENSOR in its dialect, the version that has it is named."""
    monkeypatch.delattr(common, "MAVLink_global_position_sensor_message")
    with pytest.raises(InputError, match="pip install 'pymavlink>="):
        open_link("px4", "udpout:127.0.0.1:9", mounting=Mounting(), datum=DATUM)
