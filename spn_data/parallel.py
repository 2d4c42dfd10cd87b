"""Batches of pure function calls, sent to worker processes that can die without taking work along."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import Any

from spn_data.errors import SpnError

THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class WorkerDiedError(SpnError):
    """Raised when one batch killed its worker process twice (a native crash)."""

    def __init__(self, label: str):
        super().__init__(
            f"{label}: a native library crashed on it twice; remove that input or report it"
        )
        self.label = label


def run_batches(
    function: Callable[..., Any],
    batches: Iterable[tuple[str, tuple[Any, ...]]],
    *,
    workers: int,
    on_result: Callable[[Any], None],
) -> None:
    """Call function(*arguments) for each (label, arguments) and hand each result to on_result, here.

    function must be importable and pure: it runs in another process, each on one thread. Results come
    in the order of completion. A batch whose worker dies is run once more, alone; batches finished
    before are never repeated. Raises WorkerDiedError where it dies again. An exception of the function
    itself is raised here.
    """
    died: list[tuple[str, tuple[Any, ...]]] = []
    pending = iter(batches)
    while not _run_until_broken(function, pending, workers, on_result, died):
        suspects, died = died, []
        for label, arguments in suspects:
            lost: list[tuple[str, tuple[Any, ...]]] = []
            if not _run_until_broken(function, iter([(label, arguments)]), 1, on_result, lost):
                raise WorkerDiedError(label)


def _run_until_broken(
    function: Callable[..., Any],
    pending: Iterator[tuple[str, tuple[Any, ...]]],
    workers: int,
    on_result: Callable[[Any], None],
    died: list[tuple[str, tuple[Any, ...]]],
) -> bool:
    """True when all of pending is done; False when the pool broke, with the batches in flight in died."""
    running: dict[Future[Any], tuple[str, tuple[Any, ...]]] = {}
    others = set(multiprocessing.active_children())
    with _pool(workers) as pool:
        try:
            exhausted = False
            while running or not exhausted:
                while not exhausted and len(running) < 2 * workers:
                    batch = next(pending, None)
                    if batch is None:
                        exhausted = True
                        break
                    try:
                        with _no_interrupt():
                            running[pool.submit(function, *batch[1])] = batch
                    except BrokenProcessPool:
                        died.append(batch)
                        raise
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    result = future.result()
                    del running[future]
                    on_result(result)
        except BrokenProcessPool:
            for future, batch in running.items():
                if future.done() and future.exception() is None:
                    on_result(future.result())
                else:
                    died.append(batch)
            return False
        except BaseException:
            # What they compute is not wanted any more, and nobody shall wait for it.
            for worker in set(multiprocessing.active_children()) - others:
                worker.kill()
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return True


@contextmanager
def _no_interrupt() -> Iterator[None]:
    """Hold SIGINT back. Processes started meanwhile never see it, not even while they load."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    # Spawned processes inherit the environment, and BLAS reads its limit when it loads.
    before = {name: os.environ.get(name) for name in THREAD_LIMITS}
    os.environ.update(dict.fromkeys(THREAD_LIMITS, "1"))
    # Started with the first worker, it would lift the mask of `_no_interrupt`.
    resource_tracker.ensure_running()
    try:
        with ProcessPoolExecutor(
            workers,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_prepare_worker,
            initargs=(os.getpid(),),
        ) as pool:
            yield pool
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _prepare_worker(parent_pid: int) -> None:
    import cv2

    cv2.setNumThreads(1)
    exit_with_parent(parent_pid)


def exit_with_parent(parent_pid: int) -> None:
    """Let this process end within a second of its parent, also when that was killed."""

    def watch() -> None:
        while os.getppid() == parent_pid:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
