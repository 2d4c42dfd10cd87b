"""Batches in worker processes: each runs exactly once, and a crash is reported."""

from __future__ import annotations

import os
import platform
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from spn_data.work.parallel import WorkerDiedError, WorkerPool, run_batches
from spn_data.work.timing import cpu_seconds


def square(x: int) -> int:
    return x * x


def die_once(marker: str, x: int) -> int:
    """Kill the worker the first time a batch with x = 3 arrives."""
    if x == 3 and not Path(marker).exists():
        Path(marker).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return x


def die(x: int) -> int:
    if x == 2:
        os.abort()
    return x


def fail(x: int) -> int:
    raise ValueError(f"no {x}")


def blas_threads() -> str:
    return os.environ["OPENBLAS_NUM_THREADS"]


def work_for(cpu_s: float) -> int:
    end = time.process_time() + cpu_s
    while time.process_time() < end:
        pass
    return os.getpid()


def held_mb_before(allocating_mb: int) -> float:
    """Return the memory that the process holds when called, then allocate and free a given amount."""
    lines = Path("/proc/self/status").read_text().splitlines()
    held_kb = next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:"))
    bytearray(allocating_mb * 2**20)
    return held_kb / 1024


def test_every_result_arrives_once() -> None:
    """Each batch gives exactly one result."""
    results: list[int] = []
    run_batches(square, ((str(x), (x,)) for x in range(20)), workers=2, on_result=results.append)
    assert sorted(results) == [x * x for x in range(20)]


def test_a_killed_worker_costs_only_the_batches_in_flight(tmp_path: Path) -> None:
    """After a worker is killed, its batches are repeated and every result arrives once."""
    results: list[int] = []
    batches = ((str(x), (str(tmp_path / "died"), x)) for x in range(8))
    run_batches(die_once, batches, workers=2, on_result=results.append)
    assert (tmp_path / "died").exists()
    assert sorted(results) == list(range(8))


def test_a_batch_that_crashes_twice_is_named_and_the_others_are_kept() -> None:
    """A batch that crashes twice is named in the error, and results of other batches are kept."""
    results: list[int] = []
    with pytest.raises(WorkerDiedError, match="photo 2: a native library crashed on it twice"):
        run_batches(
            die, ((f"photo {x}", (x,)) for x in range(3)), workers=1, on_result=results.append
        )
    assert set(results) <= {0, 1}


def test_an_exception_of_the_function_comes_back() -> None:
    """An exception raised in a worker is raised in the parent process."""
    with pytest.raises(ValueError, match="no 1"):
        run_batches(fail, [("1", (1,))], workers=1, on_result=print)


def test_workers_compute_on_one_thread() -> None:
    """Numerical libraries use one thread in each worker."""
    results: list[str] = []
    run_batches(blas_threads, [("a", ())], workers=1, on_result=results.append)
    assert results == ["1"]


def test_workers_stay_from_one_run_to_the_next_and_end_with_their_team() -> None:
    """Worker processes are reused by the next run and end with their pool."""
    first: list[int] = []
    second: list[int] = []
    with WorkerPool(2) as team:
        team.run(work_for, [(str(k), (0.1,)) for k in range(4)], first.append)
        team.run(work_for, [(str(k), (0.1,)) for k in range(4)], second.append)
    assert len(set(first)) == 2
    assert set(second) == set(first)
    assert not any(Path(f"/proc/{pid}").exists() for pid in set(first))


def test_a_team_works_on_after_an_exception() -> None:
    """A pool still works after an exception in a batch."""
    results: list[int] = []
    with WorkerPool(2) as team:
        with pytest.raises(ValueError, match="no 1"):
            team.run(fail, [("1", (1,))], print)
        team.run(square, [("3", (3,))], results.append)
    assert results == [9]


def test_cpu_time_of_workers_counts_once_before_and_after_they_end() -> None:
    """The CPU time of workers is counted once, whether they are running or have ended."""
    before = cpu_seconds()
    with WorkerPool(1) as team:
        team.run(work_for, [("a", (1.0,))], print)
        living = cpu_seconds() - before
    ended = cpu_seconds() - before
    assert living > 1.0
    assert living - 0.1 < ended < living + 0.7  # time to end, and time to start


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries do as they like")
def test_a_worker_keeps_its_memory_from_call_to_call_and_gives_it_back_when_it_idles() -> None:
    """A worker keeps freed memory between calls and returns it to the system when idle."""
    held: list[float] = []
    with WorkerPool(1) as team:
        team.run(held_mb_before, [("a", (200,)), ("b", (200,))], held.append)
        time.sleep(1.5)
        team.run(held_mb_before, [("c", (0,))], held.append)
    assert held[1] > held[0] + 190
    assert held[2] < held[0] + 50


def test_workers_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    """Workers end if their parent process is killed."""
    script = tmp_path / "parent.py"
    script.write_text(
        "import os, sys, time\n"
        "from spn_data.work.parallel import run_batches\n"
        "def wait(path):\n"
        "    open(path, 'w').write(str(os.getpid())); time.sleep(60)\n"
        "if __name__ == '__main__':\n"
        "    run_batches(wait, [('a', (sys.argv[1],))], workers=1, on_result=print)\n"
    )
    pid_file = tmp_path / "pid"
    parent = subprocess.Popen([sys.executable, str(script), str(pid_file)])
    deadline = time.monotonic() + 30
    while not (pid_file.exists() and pid_file.read_text()) and time.monotonic() < deadline:
        time.sleep(0.05)
    parent.kill()
    parent.wait()
    worker = int(pid_file.read_text())
    while time.monotonic() < deadline:
        try:
            # A zombie has ended as well: its parent is gone, and it may not have been reaped yet.
            state = Path(f"/proc/{worker}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except FileNotFoundError:
            return
        if state == "Z":
            return
        time.sleep(0.05)
    pytest.fail("the worker outlived its parent")


def test_ctrl_c_at_any_moment_ends_it_though_answers_are_under_way(tmp_path: Path) -> None:
    """Ctrl-C ends the run even if a killed worker leaves half of a large answer in the pipe."""
    script = tmp_path / "parent.py"
    script.write_text(
        "import signal, sys\n"
        "from spn_data.work.parallel import run_batches\n"
        "def answer(size):\n"
        "    return bytes(size)\n"
        "if __name__ == '__main__':\n"
        "    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where tests run behind '&'\n"
        "    batches = ((str(k), (6_000_000,)) for k in range(100_000))\n"
        "    try:\n"
        "        run_batches(answer, batches, workers=2, on_result=lambda r: print('go', flush=True))\n"
        "    except KeyboardInterrupt:\n"
        "        sys.exit(130)\n"
    )
    for delay_s in (0.0, 0.013, 0.037, 0.061, 0.083):
        command = [sys.executable, str(script)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as parent:
            assert parent.stdout is not None
            parent.stdout.readline()
            time.sleep(delay_s)
            os.killpg(parent.pid, signal.SIGINT)
            try:
                assert parent.wait(30) == 130
            finally:
                parent.kill()
