"""The console entry points: what ends a command before it begins gives one line."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from types import SimpleNamespace

import pytest
from spn_cli import entry

STOPPED_WHILE_LOADING = """\
import os, signal, sys
from spn_cli import entry
entry.import_module = lambda name: os.kill(os.getpid(), int(sys.argv[1]))
entry.data()
"""


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        ImportError("libtorch_cpu.so: failed to map segment from shared object"),
        RuntimeError("[enforce fail] DefaultCPUAllocator: can't\n allocate memory: you tried"),
        RuntimeError("can't start new thread"),
    ],
)
def test_too_little_memory_gives_one_line(monkeypatch, error):
    """Whatever a library raises when memory is short becomes one line; other errors stay what they are."""
    raised = [error, RuntimeError("something else")]

    def main(prog_name: str) -> None:
        raise raised.pop(0)

    monkeypatch.setattr(entry, "import_module", lambda _: SimpleNamespace(main=main))
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    with pytest.raises(SystemExit) as stopped:
        entry.model()
    assert str(stopped.value).startswith("Error: there is not enough memory for this")
    assert "\n" not in str(stopped.value)
    with pytest.raises(RuntimeError, match="something else"):
        entry.model()


def test_blas_has_one_thread_where_memory_is_limited():
    """OpenBLAS interrupts a process in which it cannot start threads, as if Ctrl-C had been pressed."""
    script = (
        "import os, resource; from spn_cli import entry\n"
        "resource.setrlimit(resource.RLIMIT_AS, (10**9, 10**9))\n"
        "entry.import_module = lambda name: os._exit(6 + int(os.environ['OPENBLAS_NUM_THREADS']))\n"
        "entry.data()"
    )
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    done = subprocess.run([sys.executable, "-c", script], env=environment, timeout=60, check=False)
    assert done.returncode == 7


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_modules_are_loaded_gives_one_line(number):
    """Ctrl-C or SIGTERM before the command begins exits with 130 or 143 and no stack trace."""
    command = [sys.executable, "-c", STOPPED_WHILE_LOADING, str(int(number))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 128 + number
    assert done.stderr.split("\n") == ["", entry.STOPPED, ""]
