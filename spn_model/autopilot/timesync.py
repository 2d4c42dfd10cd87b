"""TIMESYNC: answers an autopilot that measures the offset of its clock, and measures it from here too."""

from __future__ import annotations

from collections import deque
from typing import Any

_KEPT = 20  # exchanges; the one with the shortest way there and back has the least error


class Timesync:
    """Exchange of clock readings.

    A request has tc1 = 0 and the sender's clock in ts1; the answer adds the answerer's clock in tc1. Clocks
    are in nanoseconds.
    """

    def __init__(self) -> None:
        self._asked = 0
        self._exchanges: deque[tuple[int, int]] = deque(maxlen=_KEPT)

    def request(self, link: Any, now_us: int) -> Any:
        """Return a request."""
        self._asked = now_us * 1000
        return link.timesync_encode(0, self._asked)

    def handle(self, link: Any, message: Any, now_us: int) -> Any | None:
        """Return the answer to a request, or None after an answer to ours, or to that of somebody else."""
        now = now_us * 1000
        if message.tc1 == 0:
            return link.timesync_encode(now, message.ts1)
        if message.ts1 == self._asked and self._asked:
            self._asked = 0
            round_trip = now - message.ts1
            self._exchanges.append((round_trip, message.tc1 - message.ts1 - round_trip // 2))
        return None

    @property
    def offset_us(self) -> int | None:
        """The autopilot's clock minus ours, of the quickest of the last exchanges; None before the first."""
        return min(self._exchanges)[1] // 1000 if self._exchanges else None

    @property
    def round_trip_us(self) -> int | None:
        """Way there and back of that exchange."""
        return min(self._exchanges)[0] // 1000 if self._exchanges else None
