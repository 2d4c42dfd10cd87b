"""Cost of a program including all its child processes: wall time, CPU time and memory."""

from __future__ import annotations

import os
import subprocess
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from spn_data.work.parallel import THREAD_LIMITS

_SAMPLE_EVERY_S = 0.25


@dataclass(frozen=True)
class Usage:
    """Resource usage of a process and all its descendants.

    peak_memory_mb : maximum of the memory summed over the processes, with shared memory split among them
    (Linux' proportional set size, sampled); None if the system does not report it.
    """

    exit_code: int  # negative: minus the signal that ended it
    wall_s: float
    cpu_s: float
    peak_memory_mb: float | None


def run_measured(command: list[str], *, threads: int, log: Path) -> Usage:
    """Run a command to its end with its output in `log`; numerical libraries get `threads` threads."""
    environment = {**os.environ, **dict.fromkeys(THREAD_LIMITS, str(threads))}
    ended = threading.Event()
    peaks_kb: list[int] = []
    with log.open("w") as output:
        begin = time.perf_counter()
        process = subprocess.Popen(
            command, stdout=output, stderr=subprocess.STDOUT, env=environment
        )
        sampler = threading.Thread(target=_sample, args=(process.pid, ended, peaks_kb))
        sampler.start()
        try:
            _, status, used = os.wait4(process.pid, 0)
            wall_s = time.perf_counter() - begin
            process.returncode = os.waitstatus_to_exitcode(
                status
            )  # otherwise Popen would wait for it again
        finally:
            ended.set()
            sampler.join()
            if process.returncode is None:
                process.kill()
                process.wait()
    return Usage(
        process.returncode,
        wall_s,
        used.ru_utime + used.ru_stime,
        max(peaks_kb) / 1024 if peaks_kb else None,
    )


def _sample(pid: int, ended: threading.Event, found_kb: list[int]) -> None:
    while not ended.wait(_SAMPLE_EVERY_S):
        held_kb = [_held_kb(one) for one in _tree(pid)]
        if any(held_kb):
            found_kb.append(sum(held_kb))


def _tree(pid: int) -> Iterator[int]:
    """Yield a process and its descendants."""
    yield pid
    for children in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            found = children.read_text().split()
        except OSError:  # it has ended in the meantime
            continue
        for child in found:
            yield from _tree(int(child))


def _held_kb(pid: int) -> int:
    """Return the proportional set size of a process in kB; zero if it has ended."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("Pss:")), 0)
