"""Batches of pure calls on the workers of a Dask cluster, which need neither the area nor a shared disk."""

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
from spn_data.work.parallel import Batch, Dispatch, WorkerDiedError, WorkerPool

_CONNECT_S = 10.0
_WAIT_FOR_WORKERS_S = 30.0
_AHEAD = 2  # batches that each thread of a worker has, one of them waiting
_LIBRARIES = ("numpy", "opencv-python-headless", "pycolmap")


@contextmanager
def dispatch_to(address: str, workers: int) -> Iterator[Dispatch]:
    """The cluster at an address, or, where that is empty, so many processes of this machine."""
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
    """As `parallel.WorkerPool.run`, by the workers of the scheduler at an address (tcp://host:8786).

    Arguments travel with each call and results come back. Calls of a worker that dies are done again by
    others; WorkerDiedError names a batch that four of them died of. Raises InputError where there is no such
    cluster, none joins it, or a worker has other code or libraries: its results could differ.
    """
    with _client(address) as client:
        from distributed import KilledWorker, as_completed

        pending = iter(batches)
        labels: dict[str, str] = {}
        running = as_completed(loop=client.loop)

        def fill() -> None:
            """Workers may have come or gone."""
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
            on_result(result)


def call(expected: dict[str, str], function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """On a worker: function(*arguments), on one thread. Raises InputError where it is another version."""
    import cv2
    from threadpoolctl import threadpool_limits

    told = _difference(expected, fingerprint())
    if told:
        raise InputError(f"a worker on {platform.node()} has {told}: install the same on both")
    cv2.setNumThreads(1)
    with threadpool_limits(1, user_api="blas"):  # sums in another order would differ
        return function(*arguments)


@cache
def fingerprint() -> dict[str, str]:
    """Of all that decides what a pure call gives: this package's code, libraries, Python."""
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
    """Connected, with at least one worker, all of this program's version."""
    try:
        import dask
        from distributed import Client
    except ImportError as error:
        raise InputError(
            "--cluster needs Dask: pip install 'squeezeposenet-toolkit[cluster]'"
        ) from error
    # A batch carries images or descriptors, on purpose; what a dead worker had is computed again.
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
        for worker, answer in answers.items():
            if not isinstance(answer, dict):
                raise InputError(f"worker {worker} cannot load this program ({answer!r})")
            told = _difference(fingerprint(), answer)
            if told:
                raise InputError(f"worker {worker} has {told}: install the same on both")
        yield client
