"""Batches of pure function calls, sent to worker processes that can die without taking work along."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from types import FrameType
from typing import Any, Self

from spn_data.errors import SpnError

THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# Of a worker. The C library's defaults give large blocks back to the system at once, so that each image's
# pages are mapped anew: a third of the time of finding features in 1600 px. An idle worker gives them back.
_ENVIRONMENT = dict.fromkeys(THREAD_LIMITS, "1") | {
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": str(2**40),
}
_IDLE_S = 0.5
_LOOK_S = 0.2  # how often a waiting process looks whether it is to stop

Batch = tuple[str, tuple[Any, ...]]
# Calls a function for each batch and hands each result on: a WorkerPool does here, run_on_cluster elsewhere.
Dispatch = Callable[[Callable[..., Any], Iterable[Batch], Callable[[Any], None]], None]


class WorkerDiedError(SpnError):
    """Raised when one batch killed its worker process twice (a native crash)."""

    def __init__(self, label: str):
        super().__init__(
            f"{label}: a native library crashed on it twice; remove that input or report it"
        )
        self.label = label


def run_batches(
    function: Callable[..., Any],
    batches: Iterable[Batch],
    on_result: Callable[[Any], None],
    *,
    workers: int,
) -> None:
    """As `WorkerPool.run`, by worker processes that end with it."""
    with WorkerPool(workers) as team:
        team.run(function, batches, on_result)


class WorkerPool:
    """Worker processes that stay from one run to the next: starting one takes most of a second of CPU.

    They are started as there is work for them, and end with the team's `with` block.
    """

    def __init__(self, workers: int) -> None:
        self._size = workers
        # Each worker has a pipe of its own, closed on this side: where it dies, even in the middle of an
        # answer, reading ends. In concurrent.futures' shared queues such a death can be waited for for ever.
        self._workers: list[_Worker] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in list(self._workers):
            self._dismiss(worker)

    def run(
        self,
        function: Callable[..., Any],
        batches: Iterable[Batch],
        on_result: Callable[[Any], None],
    ) -> None:
        """Call function(*arguments) for each (label, arguments) and hand each result to on_result, here.

        function must be importable and pure: it runs in another process, each on one thread. Results come
        in the order of completion. A batch whose worker dies is run once more; batches finished before are
        never repeated. Raises WorkerDiedError where it dies again. An exception of the function itself is
        raised here.
        """
        with _held_back_interrupts() as raise_if_interrupted:
            try:
                self._run(function, iter(batches), on_result, raise_if_interrupted)
            except BaseException:
                # What they compute is not wanted any more, and nobody shall wait for it.
                for worker in list(self._workers):
                    worker.process.kill()
                    self._dismiss(worker)
                raise

    def _run(
        self,
        function: Callable[..., Any],
        pending: Iterator[Batch],
        on_result: Callable[[Any], None],
        raise_if_interrupted: Callable[[], None],
    ) -> None:
        ready: list[Batch] = []  # made while the workers are busy
        suspects: set[str] = set()
        exhausted = False
        while True:
            while not exhausted and len(ready) < self._size:
                raise_if_interrupted()
                batch = next(pending, None)
                exhausted = batch is None
                if batch is None:
                    break
                ready.append(batch)
                self._hand_out(function, ready)
            self._hand_out(function, ready)
            busy = {worker.connection: worker for worker in self._workers if worker.batch}
            if not busy:
                return
            for connection in wait(list(busy), _LOOK_S):
                raise_if_interrupted()
                assert isinstance(connection, Connection)
                worker = busy[connection]
                assert worker.batch is not None
                try:
                    good, answer, worker.cpu_s = connection.recv()
                except (EOFError, ConnectionResetError):
                    self._dismiss(worker)
                    label = worker.batch[0]
                    if label in suspects:
                        raise WorkerDiedError(label) from None
                    suspects.add(label)
                    ready.insert(0, worker.batch)
                    continue
                worker.batch = None
                if not good:
                    raise answer
                self._hand_out(function, ready)
                on_result(answer)
            raise_if_interrupted()

    def _hand_out(self, function: Callable[..., Any], ready: list[Batch]) -> None:
        while ready:
            idle = next((worker for worker in self._workers if worker.batch is None), None)
            if idle is None:
                if len(self._workers) == self._size:
                    return
                idle = _start_worker()
                self._workers.append(idle)
                _living.add(idle)
            idle.take(function, ready.pop(0))

    def _dismiss(self, worker: _Worker) -> None:
        worker.connection.close()
        worker.process.join()
        self._workers.remove(worker)
        _living.remove(worker)


@dataclass(eq=False)
class _Worker:
    process: SpawnProcess
    connection: Connection
    batch: Batch | None = None
    cpu_s: float = 0.0  # as of its last answer

    def take(self, function: Callable[..., Any], batch: Batch) -> None:
        self.batch = batch
        # A worker that is dead already is found by the end of its pipe.
        with suppress(BrokenPipeError, ConnectionResetError):
            self.connection.send((function, batch[1]))


_living: set[_Worker] = set()


def living_workers_cpu_seconds() -> float:
    """CPU seconds of the workers that have not ended: the system counts children when they end."""
    return sum(worker.cpu_s for worker in _living)


def _start_worker() -> _Worker:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    # Started with the first worker, it would lift the mask below.
    resource_tracker.ensure_running()
    # A worker never sees Ctrl-C, not even while it loads.
    before_mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    # It inherits the environment, and BLAS reads its limit when it loads.
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    os.environ.update(_ENVIRONMENT)
    try:
        process = context.Process(target=_serve, args=(theirs, os.getpid()))
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before_mask)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        theirs.close()
    return _Worker(process, ours)


def _serve(connection: Connection, parent_pid: int) -> None:
    """In the worker: answer calls until the other end of the pipe is closed."""
    import cv2

    cv2.setNumThreads(1)
    exit_with_parent(parent_pid)
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            if not connection.poll(_IDLE_S):
                _give_memory_back()
            # Nothing of a call is kept while the next is waited for.
            connection.send((*_called(*connection.recv()), time.process_time()))


def _give_memory_back() -> None:
    with suppress(AttributeError):  # other C libraries than glibc have no such call
        ctypes.CDLL(None).malloc_trim(0)


def _called(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[bool, Any]:
    """Whether the function came to its end, and what it gave or raised."""
    try:
        return True, function(*arguments)
    except Exception as error:
        error.add_note("".join(traceback.format_exception(error)))
        return False, error


@contextmanager
def _held_back_interrupts() -> Iterator[Callable[[], None]]:
    """Ctrl-C only where the function given is called, not in the middle of a start or of a transfer."""
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    caught: list[tuple[int, FrameType | None]] = []
    before = signal.signal(signal.SIGINT, lambda *arguments: caught.append(arguments))

    def raise_if_interrupted() -> None:
        if caught:
            signal.signal(signal.SIGINT, before)
            signal.raise_signal(signal.SIGINT)

    try:
        yield raise_if_interrupted
        raise_if_interrupted()
    finally:
        signal.signal(signal.SIGINT, before)


def exit_with_parent(parent_pid: int) -> None:
    """Let this process end within a second of its parent, also when that was killed."""

    def watch() -> None:
        while os.getppid() == parent_pid:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
