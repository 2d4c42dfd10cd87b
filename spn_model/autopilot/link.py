"""Links to an autopilot: a thread that sends on an absolute schedule, and the function that opens one."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from spn_data.errors import InputError, SpnError
from spn_model.autopilot import mavlink
from spn_model.autopilot.datum import Datum
from spn_model.autopilot.frames import Mounting
from spn_model.autopilot.profiles import ROS2, Message, Profile, profile_of
from spn_model.autopilot.received_attitude import ReceivedAttitude
from spn_model.autopilot.ros2 import Ros2Writer
from spn_model.autopilot.sender import Sender, SenderOptions, SenderReport
from spn_model.autopilot.transport import Transport, open_transport
from spn_model.integrity.fix import Fix, NoFix


class FixSink(Protocol):
    """Where fixes go: a link to an autopilot, or a file."""

    def send(self, item: Fix | NoFix) -> None:
        """Take the result of one image."""

    def close(self) -> None:
        """Finish."""


def unix_us() -> int:
    """Return the time since 1970 in microseconds."""
    return time.time_ns() // 1000


class Link:
    """A link to an autopilot, with a thread of its own.

    Parameters
    ----------
    profile : Profile
        The autopilot.
    transport : Transport
        Where the messages go.
    options : SenderOptions
        What is sent.
    clock_us : callable
        Clock of the fixes' `time_us`.

    Notes
    -----
    Slot k is due at start + k / rate, so delays do not add up. A slot that is missed is not made up for: the
    next one has the newest fix.
    """

    def __init__(
        self,
        profile: Profile,
        transport: Transport,
        options: SenderOptions,
        clock_us: Callable[[], int] = unix_us,
    ):
        self._transport, self._clock_us = transport, clock_us
        self._dialect = mavlink.dialect()
        self._mav = self._dialect.MAVLink(None, options.system, mavlink.COMPONENT)
        self._parser = self._new_parser()
        self._sender = Sender(profile, options, self._mav)
        self._period_s = 1 / profile.rate_hz
        self._stop = threading.Event()
        self._crash: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="autopilot-link", daemon=True)
        self._thread.start()

    def send(self, item: Fix | NoFix) -> None:
        """Take the result of one image; it goes out with the next slot, or is dropped if it is too old.

        Raises
        ------
        SpnError
            If the thread has ended, so that nothing is sent any more.
        """
        if self._crash is not None:
            raise SpnError(f"the link to the autopilot has ended: {self._crash!r}")
        self._sender.offer(item)

    @property
    def attitude(self) -> ReceivedAttitude | None:
        """What the autopilot sent of an attitude, if the options ask for it."""
        return self._sender.attitude

    def report(self) -> SenderReport:
        """Return a copy of the counts so far."""
        return replace(self._sender.report)

    def close(self) -> None:
        """Stop sending; what waits for a slot is not sent."""
        if not self._stop.is_set():
            self._stop.set()
            self._thread.join()
            self._transport.close()

    def _run(self) -> None:
        try:
            self._slots()
        except Exception as error:  # silence must not go unnoticed
            self._crash = error

    def _slots(self) -> None:
        start = before = time.monotonic()
        slot = 0
        while self._wait(start + slot * self._period_s):
            now = time.monotonic()
            if slot:
                self._sender.report.worst_gap_s = max(self._sender.report.worst_gap_s, now - before)
            before = now
            for message in self._sender.slot(self._clock_us()):
                self._write(message)
            slot = max(slot + 1, int((time.monotonic() - start) / self._period_s))

    def _wait(self, due: float) -> bool:
        """Wait for a slot and answer at once what comes meanwhile; return whether the link goes on.

        PX4 uses no answer to TIMESYNC that took more than 10 ms.
        """
        while (left := due - time.monotonic()) > 0 and not self._stop.is_set():
            if self._transport.wait(left) and not self._receive():
                self._stop.wait(left)
        return not self._stop.is_set()

    def _new_parser(self) -> Any:
        parser = self._dialect.MAVLink(None)
        parser.robust_parsing = True  # damaged bytes are a message of their own, not an error
        return parser

    def _receive(self) -> bool:
        """Take what the autopilot sent, and answer it; return whether there was anything."""
        try:
            data = self._transport.receive()
        except OSError as error:
            self._failed(error)
            return False
        if not self._transport.is_stream:  # a damaged datagram must not swallow those after it
            self._parser = self._new_parser()
        now_us = self._clock_us()
        for message in self._parser.parse_buffer(data) or []:
            for answer in self._sender.handle(message, now_us):
                self._write(answer)
        return bool(data)

    def _write(self, message: Any) -> None:
        try:
            self._transport.send(message.pack(self._mav))
        except OSError as error:
            self._failed(error)
        self._mav.seq = (self._mav.seq + 1) % 256

    def _failed(self, error: OSError) -> None:
        self._sender.report.errors += 1
        self._sender.report.reason = f"the connection failed: {error}"


def open_link(
    profile: str,
    url: str,
    *,
    mounting: Mounting,
    datum: Datum | None,
    messages: Sequence[Message] | None = None,
    clock_us: Callable[[], int] = unix_us,
    **options: Any,
) -> FixSink:
    """Open a link for fixes.

    Parameters
    ----------
    profile : str
        `px4`, `ardupilot` or `ros2`.
    url : str
        `udpout:HOST:PORT`, `udpin:HOST:PORT` or `serial:DEVICE:BAUD`; for `ros2` the new folder of a bag.
    mounting : Mounting
        How the camera is fixed to the body.
    datum : Datum or None
        Where the world is on the Earth; only `ros2` can do without.
    messages : sequence of Message, optional
        Messages to send instead of those of the profile.
    clock_us : callable, optional
        Clock of the fixes' `time_us`; Unix time by default.
    **options
        Further options of `SenderOptions`.

    Returns
    -------
    FixSink
        A `Link` or a `Ros2Writer`.

    Raises
    ------
    InputError
        If the profile is unknown, the world has no origin, an option is out of range, a package is missing or
        the connection cannot be opened.
    """
    if profile == ROS2:
        coast_s = options.get("coast_s", SenderOptions.coast_s)
        return Ros2Writer(Path(url), mounting=mounting, datum=datum, coast_s=coast_s)
    chosen = profile_of(profile)
    if datum is None:
        raise InputError(
            f"the profile {profile} needs the place of the world on the Earth, and this world has no origin"
        )
    given = SenderOptions(
        mounting=mounting,
        datum=datum,
        messages=chosen.messages if messages is None else tuple(messages),
        **options,
    )
    mavlink.dialect()  # before anything is opened
    return Link(chosen, open_transport(url), given, clock_us)
