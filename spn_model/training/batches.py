"""Selection of the training images of each step, and prefetching of batches."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
import torch

from spn_model.models.pose_model import Batch


def rows_of_step(
    count: int, batch: int, step: int, seed: int, stage: int, *, rank: int = 0, world: int = 1
) -> np.ndarray:
    """Return the training rows (batch,) of a step; each epoch takes every image once in an order of its own.

    The rows depend on the arguments only, so that a resumed training continues with the same images. If
    there are several processes, each takes its part of a larger batch.
    """
    first = (step * world + rank) * batch
    places = np.arange(first, first + batch)
    epochs, within = places // count, places % count
    rows = np.empty(batch, np.int64)
    for epoch in np.unique(epochs):
        order = np.random.default_rng([seed, stage, int(epoch)]).permutation(count)
        rows[epochs == epoch] = order[within[epochs == epoch]]
    return rows


def generator_of_step(seed: int, stage: int, step: int, rank: int = 0) -> np.random.Generator:
    """Return the generator of everything random in a batch."""
    # The 1 separates it from the seeds of epochs, [seed, stage, epoch], since a step can equal an epoch.
    return np.random.default_rng([seed, stage, step, 1, rank])


def torch_seed_of_step(seed: int, stage: int, step: int, rank: int = 0) -> int:
    """Return the seed of torch for a step, which determines dropout."""
    return int(np.random.SeedSequence([seed, stage, step, 2, rank]).generate_state(1)[0])


class BatchPrefetcher:
    """Batches in order, made ahead in threads while one is being used.

    It uses threads because OpenCV, NumPy and torch release the interpreter lock while they compute, and
    images need not be copied between processes.

    Attributes
    ----------
    waited_s : float
        Seconds that `next` has waited for batches that were not ready.
    """

    def __init__(
        self, make: Callable[[int], Batch], first: int, pool: ThreadPoolExecutor, depth: int
    ):
        self._make, self._number, self._pool = make, first, pool
        self._made: deque[Future[Batch]] = deque()
        self.waited_s = 0.0
        for _ in range(depth):
            self._submit()

    def next(self) -> Batch:
        """Return the next batch. Raises what making it has raised."""
        began = time.perf_counter()
        batch = self._made.popleft().result()
        self.waited_s += time.perf_counter() - began
        self._submit()
        return batch

    def _submit(self) -> None:
        self._made.append(self._pool.submit(self._make, self._number))
        self._number += 1


@contextmanager
def prefetch_batches(
    make: Callable[[int], Batch], first: int, workers: int, depth: int = 0
) -> Iterator[BatchPrefetcher]:
    """Call `make` with number `first` and the following ones in threads, which end with the block.

    At most `depth` batches, and at least two for each worker, are ready or in progress.
    """
    pool = ThreadPoolExecutor(workers, "batches", initializer=torch.set_num_threads, initargs=(1,))
    try:
        yield BatchPrefetcher(make, first, pool, max(depth, 2 * workers))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
