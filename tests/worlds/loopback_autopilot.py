"""An autopilot on a UDP socket of this machine."""

from __future__ import annotations

import socket
import time

import pytest

from spn_model.autopilot.link import unix_us
from tests.worlds.autopilots import NOW_US

common = pytest.importorskip("pymavlink.dialects.v20.common")


class Autopilot:
    """An autopilot on a UDP socket of this machine: it has a clock of its own and answers questions."""

    def __init__(self):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.05)
        self.link = common.MAVLink(None, 1, 1)
        self.url = f"udpout:127.0.0.1:{self.socket.getsockname()[1]}"
        self.messages: list = []
        self.exchanges_us: list = []
        self.type = 3
        self.peer: tuple[str, int] | None = None

    def clock_us(self):
        """Return its time since boot."""
        return unix_us() - NOW_US // 2

    def listen(self, seconds, until=lambda: False):
        """Take messages for a time or until a condition holds, ask for the clock, and answer."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and not until():
            try:
                data, peer = self.socket.recvfrom(4096)
            except TimeoutError:
                continue
            self.peer = peer
            self.answer(peer, self.link.timesync_encode(0, self.clock_us() * 1000))
            self.answer(peer, self.link.heartbeat_encode(2, self.type, 0, 0, 4))
            self.socket.sendto(b"\xfd\xff noise that is no message", peer)
            for message in self.link.parse_buffer(data) or []:
                self.messages.append(message)
                self.take(message, peer)

    def take(self, message, peer):
        """Answer one message."""
        if message.get_type() == "TIMESYNC" and message.tc1 == 0:
            self.answer(peer, self.link.timesync_encode(self.clock_us() * 1000, message.ts1))
        elif message.get_type() == "TIMESYNC":
            # As PX4 computes the other clock minus its own, half of the way there and back assumed.
            there_and_back = self.clock_us() - message.ts1 // 1000
            offset = message.tc1 // 1000 - message.ts1 // 1000 - there_and_back // 2
            self.exchanges_us.append((there_and_back, offset))
        elif message.get_type() == "COMMAND_LONG" and message.param1 == 49:
            self.answer(peer, self.link.gps_global_origin_encode(481000000, 116000000, 560_000, 0))

    def answer(self, peer, message):
        """Send a message back."""
        self.socket.sendto(message.pack(self.link), peer)
        self.link.seq = (self.link.seq + 1) % 256

    def close(self):
        """Close the socket."""
        self.socket.close()
