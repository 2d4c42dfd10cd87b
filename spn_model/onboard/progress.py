"""Progress of a flight on standard error: a line at the first image, and every ten seconds."""

from __future__ import annotations

import sys
import time

_EVERY_S = 10.0


class FlightProgress:
    """Lines about the progress of a flight; none if it is `quiet`."""

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self._started = self._told = time.monotonic()
        self._count = 0
        self.tell("Loading the bundle.")

    def tell(self, text: str) -> None:
        """Write a line."""
        if not self._quiet:
            sys.stderr.write(text + "\n")
            sys.stderr.flush()

    def image(self) -> None:
        """Count an image."""
        self._count += 1
        now = time.monotonic()
        if self._count == 1:
            self._started = self._told = now
            self.tell("First image.")
        elif now - self._told >= _EVERY_S:
            self._told = now
            rate = (self._count - 1) / (now - self._started)
            self.tell(f"{self._count} images, {rate:.1f} per second.")
