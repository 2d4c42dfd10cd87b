"""Replay of a recording in real time, for receivers that compare the times of fixes with their clock."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator

import numpy as np

from spn_model.autopilot.link import unix_us
from spn_model.landmarks.aids import KnownVertical

_LATE_US = 100_000  # after which an image is left out, as by a camera whose images are not fetched

# Time in microseconds, image, and if known: up in the camera, and the reading of a barometer.
FlownImage = tuple[int, np.ndarray, KnownVertical | None, float | None]


class RealTime:
    """Images of a recording when they are due, stamped with Unix time.

    Attributes
    ----------
    late : int
        Images left out because the computer had not finished the ones before.
    """

    def __init__(self) -> None:
        self.late = 0

    def paced(self, images: Iterable[FlownImage]) -> Iterator[FlownImage]:
        """Yield the images that are not late, each at its time after the first one."""
        begin_us: int | None = None
        for time_us, image, vertical, height_m in images:
            now_us = unix_us()
            if begin_us is None:
                begin_us = now_us - time_us
            due_us = begin_us + time_us
            if now_us - due_us > _LATE_US:
                self.late += 1
                continue
            time.sleep(max(0, due_us - now_us) * 1e-6)
            yield due_us, image, vertical, height_m
