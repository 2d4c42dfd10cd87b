"""A long native computation in a child process that talks in JSON lines.

A native abort there takes no other work along, Ctrl-C reaches it in an orderly way, and it never
outlives the process that started it.
"""

from __future__ import annotations

import json
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

Event = dict[str, Any]
_FULL_BYTES = 1_000_000
STOP_WAIT_S = 5  # what a child gets to end by itself


def run_child(module: str, job: Event, *, log: Path, on_event: Callable[[Event], None]) -> None:
    """Run `python -m module` with job on its standard input, and hand each event to on_event.

    The child's standard error goes to `log`. Raises StageError, with the log's last line, where the
    child ends otherwise than well.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as errors:
        child = subprocess.Popen(
            [sys.executable, "-m", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            start_new_session=True,  # Ctrl-C is passed on below, once
        )
        assert child.stdin is not None
        assert child.stdout is not None
        try:
            # The pipe stays open: its end tells the child that this process is gone.
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
        how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        if shutil.disk_usage(log.parent).free < _FULL_BYTES:
            how += " on a full disk"
        raise StageError(
            f"{module.rpartition('.')[2]} {how}. What was done before is kept: the same command goes on. "
            f"{log} ends in: {_last_line(log)}"
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
    """In the child: the job; and from here on the process ends when its parent does."""
    job: Event = json.loads(sys.stdin.readline())

    def watch() -> None:
        sys.stdin.read()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    return job


def send(event: Event) -> None:
    """In the child: one event to the parent."""
    sys.stdout.write(json.dumps(event) + "\n")
    sys.stdout.flush()


@contextmanager
def cancel_on_interrupt(cancel: Callable[[], None]) -> Iterator[None]:
    """In the child: SIGINT calls cancel instead of raising wherever Python happens to be."""
    before = signal.signal(signal.SIGINT, lambda *_: cancel())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
