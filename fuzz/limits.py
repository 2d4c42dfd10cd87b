"""Child processes that read one input after another within limits of CPU time and memory."""

from __future__ import annotations

import os
import resource
import select
import signal
import traceback
from collections.abc import Callable
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from time import monotonic

CPU_S = 5.0
MEMORY_BYTES = 10**9
WALL_S = 120.0  # an input that waits without using the processor
_ADDRESSES = (
    4 * 10**9
)  # address space beyond that at the start; threads reserve some that they never use

Task = Callable[[], None]


class Reader:
    """A child process, forked from this one with everything imported, that is replaced when it dies."""

    def __init__(self, serve: Callable[[str, int], tuple[str, str]]):
        self._serve = serve
        self._start()

    def _start(self) -> None:
        self._ours, theirs = Pipe()
        self.pid = os.fork()
        if self.pid == 0:
            self._ours.close()
            try:
                _loop(theirs, self._serve)
            finally:
                os._exit(0)
        theirs.close()
        self.job: tuple[str, int] | None = None

    def fileno(self) -> int:
        """Return what `select` waits for."""
        return self._ours.fileno()

    def give(self, target: str, number: int) -> None:
        """Start reading an input."""
        self.job, self._since = (target, number), monotonic()
        self._ours.send(self.job)

    def take(self) -> tuple[str, str]:
        """Return verdict and explanation of the input given last; call it when `select` says so."""
        try:
            found: tuple[str, str] = self._ours.recv()
            self.job = None
            return found
        except (EOFError, ConnectionResetError):
            return self._bury()

    def is_overdue(self) -> bool:
        """Return whether the input takes too long by the clock."""
        return self.job is not None and monotonic() - self._since > WALL_S

    def kill(self) -> tuple[str, str]:
        """Kill a child that waits for something."""
        os.kill(self.pid, signal.SIGKILL)
        self._bury()
        return "timeout", f"waits for more than {WALL_S:.0f} s"

    def close(self) -> None:
        """End the child."""
        self._ours.close()
        os.kill(self.pid, signal.SIGKILL)  # its siblings hold the pipe open
        os.waitpid(self.pid, 0)

    def _bury(self) -> tuple[str, str]:
        self._ours.close()
        _, status = os.waitpid(self.pid, 0)
        self._start()
        if not os.WIFSIGNALED(status):
            return "crash", f"the process ended with code {os.WEXITSTATUS(status)}"
        number = os.WTERMSIG(status)
        if number == signal.SIGPROF:
            return "timeout", f"more than {CPU_S:g} s of CPU time"
        return "crash", signal.Signals(number).name


def wait_for(readers: list[Reader]) -> list[Reader]:
    """Return the readers that have finished or died, after a second at the latest."""
    ready, _, _ = select.select(readers, [], [], 1.0)
    return ready


def _loop(connection: Connection, serve: Callable[[str, int], tuple[str, str]]) -> None:
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    most = _memory("VmSize") + _ADDRESSES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    while True:
        try:
            target, number = connection.recv()
        except (EOFError, OSError):
            return
        connection.send(serve(target, number))


def limited(task: Task, accepted: type[Exception]) -> tuple[str, str]:
    """Run a task in this process; too much CPU time kills it.

    Returns
    -------
    verdict : str
        ``ok``, ``refused`` (with an exception of the accepted kind), ``traceback``, ``lines`` (the message
        has several) or ``memory``.
    explanation : str
    """
    before = _reset_peak()
    signal.setitimer(signal.ITIMER_PROF, CPU_S)
    try:
        task()
        verdict, text = "ok", ""
    except accepted as error:
        text = str(error)
        verdict = "lines" if "\n" in text.strip() else "refused"
    except MemoryError:
        verdict, text = "memory", traceback.format_exc()
    except Exception:
        verdict, text = "traceback", traceback.format_exc()
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    more = _memory("VmHWM") - before
    if more > MEMORY_BYTES:
        verdict, text = "memory", f"{more / 1e9:.1f} GB more than before\n{text}"
    return verdict, text


def _reset_peak() -> int:
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")
    return _memory("VmRSS")


def _memory(name: str) -> int:
    with open("/proc/self/status") as file:
        for line in file:
            if line.startswith(name + ":"):
                return int(line.split()[1]) * 1024
    return 0
