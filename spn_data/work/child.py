"""Run long native computations in a child process that communicates in JSON lines.

A native abort kills only the child, Ctrl-C reaches it in an orderly way, and it never outlives the process
that started it.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from spn_data.errors import StageError

_logger = logging.getLogger(__name__)

Event = dict[str, Any]
_FULL_BYTES = 1_000_000
STOP_WAIT_S = 5  # time for a child to end after SIGINT


def run_child(module: str, job: Event, *, log: Path, on_event: Callable[[Event], None]) -> None:
    """Run `python -m module` with a job on its standard input and pass on the events that it sends.

    Parameters
    ----------
    module : str
        Full name of the module to run.
    job : dict
        JSON-serialisable description of the work.
    log : Path
        File that the child's standard error is appended to.
    on_event : callable
        Called with each event.

    Raises
    ------
    StageError
        If the child fails or is killed; with the last line of its log.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as errors:
        child = subprocess.Popen(
            [sys.executable, "-m", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            start_new_session=True,  # Ctrl-C is forwarded below, once
        )
        _logger.debug("%s: started as process %d, log in %s", module, child.pid, log)
        assert child.stdin is not None
        assert child.stdout is not None
        try:
            # The pipe stays open: when it closes, the child knows that this process has ended.
            child.stdin.write(json.dumps(job) + "\n")
            child.stdin.flush()
            for line in child.stdout:
                on_event(json.loads(line))
            code = child.wait()
        except BaseException:
            _stop(child)
            raise
        finally:
            child.stdin.close()
            child.stdout.close()
    if code != 0:
        outcome = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        if shutil.disk_usage(log.parent).free < _FULL_BYTES:
            outcome += " on a full disk"
        raise StageError(
            f"{module.rpartition('.')[2]} {outcome}. Finished work is kept: run the same command again to "
            f"continue. Last line of {log}: {_last_line(log)}"
        )


def _stop(child: subprocess.Popen[str]) -> None:
    child.send_signal(signal.SIGINT)
    try:
        child.wait(STOP_WAIT_S)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()


def _last_line(log: Path) -> str:
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines()]
    return next((line for line in reversed(lines) if line), "nothing")


def read_job() -> Event:
    """Read the job (in the child) and exit this process as soon as its parent ends."""
    job: Event = json.loads(sys.stdin.readline())

    def watch() -> None:
        sys.stdin.read()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    return job


def send(event: Event) -> None:
    """Send one event to the parent (in the child)."""
    sys.stdout.write(json.dumps(event) + "\n")
    sys.stdout.flush()


@contextmanager
def cancel_on_interrupt(cancel: Callable[[], None]) -> Iterator[None]:
    """Call `cancel` on SIGINT instead of raising KeyboardInterrupt at an arbitrary point (in the child)."""
    before = signal.signal(signal.SIGINT, lambda *_: cancel())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
