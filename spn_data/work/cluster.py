"""Batches of pure function calls on the workers of a Dask cluster, which need no access to the area."""

from __future__ import annotations

import hashlib
import logging
import platform
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Any

from spn_data.errors import InputError
from spn_data.work.answers import WrongAnswerError
from spn_data.work.parallel import Batch, Dispatch, WorkerDiedError, WorkerPool

_logger = logging.getLogger(__name__)

_CONNECT_S = 10.0
_WAIT_FOR_WORKERS_S = 30.0
_AHEAD = 2  # batches per thread of a worker: one running, one queued
_LIBRARIES = ("numpy", "opencv-python-headless", "pycolmap")


@contextmanager
def dispatch_to(address: str, workers: int) -> Iterator[Dispatch]:
    """Yield a `Dispatch` to a Dask cluster or to worker processes on this machine.

    Parameters
    ----------
    address : str
        Address of the Dask scheduler; empty for this machine.
    workers : int
        Number of worker processes on this machine.

    Raises
    ------
    InputError
        When the dispatch is called: see `run_on_cluster`.
    """
    if address:
        yield partial(run_on_cluster, address)
    else:
        with WorkerPool(workers) as team:
            yield team.run


def run_on_cluster(
    address: str,
    function: Callable[..., Any],
    batches: Iterable[Batch],
    on_result: Callable[[Any], None],
) -> None:
    """Run batches like `parallel.WorkerPool.run`, on the workers of a Dask scheduler.

    Arguments are sent with each call and results are returned. Calls of a worker that dies are repeated by
    others.

    Parameters
    ----------
    address : str
        Address of the scheduler (tcp://host:8786).
    function, batches, on_result
        As in `parallel.WorkerPool.run`.

    Raises
    ------
    WorkerDiedError
        If a batch killed four workers.
    InputError
        If there is no such cluster, it has no workers, a worker has other code or libraries, so that its
        results could differ, or `on_result` raises WrongAnswerError.
    """
    with _client(address) as client:
        from distributed import KilledWorker, as_completed

        pending = iter(batches)
        labels: dict[str, str] = {}
        running = as_completed(loop=client.loop)

        def fill() -> None:
            """Submit batches for all threads; workers may have joined or left since the last call."""
            room = max(1, _AHEAD * sum(client.nthreads().values())) - len(labels)
            for label, arguments in islice(pending, max(0, room)):
                future = client.submit(call, fingerprint(), function, arguments, pure=False)
                labels[future.key] = label
                running.add(future)

        fill()
        for future in running:
            label = labels.pop(future.key)
            try:
                result = future.result()
            except KilledWorker:
                raise WorkerDiedError(label) from None
            fill()
            try:
                on_result(result)
            except WrongAnswerError as error:
                workers = next(iter(client.who_has([future]).values()), ())
                raise InputError(
                    f"worker {', '.join(workers) or 'unknown'} answered {label!r} with something else: "
                    f"{error}; remove it, and use only a cluster that you trust"
                ) from error


def call(expected: dict[str, str], function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """Call function(*arguments) on one thread (on a worker).

    Raises
    ------
    InputError
        If the worker's code or libraries differ from those of the program.
    """
    import cv2
    from threadpoolctl import threadpool_limits

    difference = _difference(expected, fingerprint())
    if difference:
        raise InputError(
            f"a worker on {platform.node()} has {difference}: install the same on both"
        )
    cv2.setNumThreads(1)
    with threadpool_limits(
        1, user_api="blas"
    ):  # other thread counts would change the order of summation
        return function(*arguments)


@cache
def fingerprint() -> dict[str, str]:
    """Return what decides the results of a pure call: hash of this package, library and Python versions."""
    digest = hashlib.sha256()
    package = Path(__file__).resolve().parents[1]
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    python = ".".join(platform.python_version_tuple()[:2])
    libraries = {name: version(name) for name in _LIBRARIES}
    return {"python": python, "spn_data": digest.hexdigest()[:16], **libraries}


def _difference(expected: dict[str, str], found: dict[str, str]) -> str:
    for name, wanted in expected.items():
        if found.get(name) != wanted:
            return f"{name} {found.get(name)}, this program {wanted}"
    return ""


@contextmanager
def _client(address: str) -> Iterator[Any]:
    """Yield a client of a scheduler that has at least one worker, all with this program's version."""
    try:
        import dask
        from distributed import Client
    except ImportError as error:
        raise InputError(
            "--cluster needs Dask: pip install 'squeezeposenet-toolkit[cluster]'"
        ) from error
    # Batches contain images or descriptors on purpose; the work of a dead worker is repeated.
    dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 GB"})
    logging.getLogger("distributed").setLevel(logging.ERROR)
    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(f"there is no Dask scheduler at {address} ({error})") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_WAIT_FOR_WORKERS_S)
        except TimeoutError as error:
            raise InputError(f"the scheduler at {address} has no workers") from error
        answers = client.run(fingerprint, on_error="return")
        _logger.debug("%s: %d workers", address, len(answers))
        for worker, answer in answers.items():
            if not isinstance(answer, dict):
                raise InputError(f"worker {worker} cannot load this program ({answer!r})")
            difference = _difference(fingerprint(), answer)
            if difference:
                raise InputError(f"worker {worker} has {difference}: install the same on both")
        yield client
