"""Batches of pure function calls in worker processes; a worker that crashes loses only its own batch."""

from __future__ import annotations

import ctypes
import logging
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

_logger = logging.getLogger(__name__)

THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# Environment of a worker. By default the C library returns large blocks to the system at once, so that
# pages are mapped again for each image: a third of the time of feature detection at 1600 px. An idle worker
# returns its free memory instead.
_ENVIRONMENT = dict.fromkeys(THREAD_LIMITS, "1") | {
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": str(2**40),
}
_IDLE_S = 0.5
_POLL_S = 0.2  # how often a waiting process checks for an interrupt

Batch = tuple[str, tuple[Any, ...]]
# Calls a function for each batch and passes on each result: WorkerPool.run locally, run_on_cluster remotely.
Dispatch = Callable[[Callable[..., Any], Iterable[Batch], Callable[[Any], None]], None]


class WorkerDiedError(SpnError):
    """A batch that killed its worker process twice (a native crash).

    Attributes
    ----------
    label : str
        Label of the batch.
    """

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
    """Run batches in worker processes that are started for this call; see `WorkerPool.run`.

    Parameters
    ----------
    function : callable
        Importable, pure function.
    batches : iterable of (str, tuple)
        Label and arguments of each call.
    on_result : callable
        Called with each result, in order of completion.
    workers : int
        Number of worker processes.

    Raises
    ------
    WorkerDiedError
        If a batch kills its worker twice.
    """
    with WorkerPool(workers) as team:
        team.run(function, batches, on_result)


class WorkerPool:
    """Worker processes that are reused from one run to the next.

    Starting a worker takes most of a second of CPU time. Workers are started as work arrives and end with the
    pool's `with` block.
    """

    def __init__(self, workers: int) -> None:
        self._size = workers
        # Each worker has its own pipe, whose remote end is closed in this process: if the worker dies, even
        # in the middle of an answer, reading fails at once. With the shared queues of concurrent.futures such
        # a death can block forever.
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
        """Call function(*arguments) for each (label, arguments) and pass on each result in this process.

        Parameters
        ----------
        function : callable
            Importable and pure: it runs in another process, on one thread per worker.
        batches : iterable of (str, tuple)
            Label and arguments of each call.
        on_result : callable
            Called with each result, in order of completion.

        Raises
        ------
        WorkerDiedError
            If the worker of a batch dies twice. After the first time the batch is repeated; finished batches
            are never repeated.

        Notes
        -----
        An exception raised by the function itself is raised here.
        """
        with _deferred_interrupts() as raise_if_interrupted:
            try:
                self._run(function, iter(batches), on_result, raise_if_interrupted)
            except BaseException:
                # Their results are no longer needed; do not wait for them.
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
        ready: list[Batch] = []  # generated while the workers are busy
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
            for connection in wait(list(busy), _POLL_S):
                raise_if_interrupted()
                assert isinstance(connection, Connection)
                worker = busy[connection]
                assert worker.batch is not None
                try:
                    succeeded, answer, worker.cpu_s = connection.recv()
                except (EOFError, ConnectionResetError):
                    self._dismiss(worker)
                    label = worker.batch[0]
                    if label in suspects:
                        raise WorkerDiedError(label) from None
                    suspects.add(label)
                    _logger.info("the worker of %s ended; the batch is repeated alone", label)
                    ready.insert(0, worker.batch)
                    continue
                worker.batch = None
                if not succeeded:
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
    """A worker process, the pipe to it, and the batch that it is working on."""

    process: SpawnProcess
    connection: Connection
    batch: Batch | None = None
    cpu_s: float = 0.0  # at its last answer

    def take(self, function: Callable[..., Any], batch: Batch) -> None:
        """Send a call to the worker."""
        self.batch = batch
        # If the worker is already dead, reading from its pipe will report it.
        with suppress(BrokenPipeError, ConnectionResetError):
            self.connection.send((function, batch[1]))


_living: set[_Worker] = set()


def living_workers_cpu_seconds() -> float:
    """Return CPU seconds of running workers; the operating system counts children only when they end."""
    return sum(worker.cpu_s for worker in _living)


def _start_worker() -> _Worker:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    # Workers inherit the environment; BLAS reads its thread limit when it is loaded.
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    os.environ.update(_ENVIRONMENT)
    try:
        process = context.Process(target=_serve, args=(theirs, os.getpid()))
        with interrupts_blocked():
            process.start()
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        theirs.close()
    return _Worker(process, ours)


def _serve(connection: Connection, parent_pid: int) -> None:
    """Answer calls until the other end of the pipe is closed (in the worker)."""
    import cv2

    cv2.setNumThreads(1)
    exit_with_parent(parent_pid)
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            if not connection.poll(_IDLE_S):
                _release_memory()
            # In one expression, so that no arguments or results are kept while waiting for the next call.
            connection.send((*_outcome_of(*connection.recv()), time.process_time()))


def _release_memory() -> None:
    with suppress(AttributeError):  # only glibc has this function
        ctypes.CDLL(None).malloc_trim(0)


def _outcome_of(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[bool, Any]:
    """Return (True, result) or (False, exception) of a call."""
    try:
        return True, function(*arguments)
    except Exception as error:
        error.add_note("".join(traceback.format_exception(error)))
        return False, error


@contextmanager
def _deferred_interrupts() -> Iterator[Callable[[], None]]:
    """Defer Ctrl-C: KeyboardInterrupt is raised only when the yielded function is called.

    This keeps it out of the middle of a process start or of a transfer.
    """
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


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Block Ctrl-C: processes started within the block never receive it, not even while they load.

    It reaches every process of the terminal; only the parent handles it, and it ends its children.
    """
    # If it were started with the first of these processes, it would clear the signal mask.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def exit_with_parent(parent_pid: int) -> None:
    """Exit this process within a second after its parent ends, also if the parent was killed."""

    def watch() -> None:
        while os.getppid() == parent_pid:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
