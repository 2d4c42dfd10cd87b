"""Wall and CPU time of the steps of a stage, child processes included, and the progress callback."""

from __future__ import annotations

import logging
import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from spn_data.work.parallel import living_workers_cpu_seconds

_logger = logging.getLogger(__name__)

# Called with the step's name, the amount done, and the total (0 if unknown).
Progress = Callable[[str, int, int], None]


@dataclass
class Stopwatch:
    """Accumulates wall and CPU time by step.

    Attributes
    ----------
    seconds, cpu_seconds : dict of str to float
        Wall and CPU seconds of each step; a step that is entered twice adds up.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    cpu_seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Measure the block as part of a step."""
        wall, cpu = time.perf_counter(), cpu_seconds()
        _logger.debug("%s: started", name)
        try:
            yield
        finally:
            seconds = time.perf_counter() - wall
            _logger.debug("%s: ended after %.1f s", name, seconds)
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds
            self.cpu_seconds[name] = self.cpu_seconds.get(name, 0.0) + cpu_seconds() - cpu


def cpu_seconds() -> float:
    """Return CPU seconds of this process, of ended children, and of workers up to their last answer."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used) + living_workers_cpu_seconds()
