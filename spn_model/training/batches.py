"""Which training images a step takes, and batches made ahead of their use."""

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
    """(batch,) rows of `count` training images: every image once an epoch, in an order of each epoch's own.

    A function of its arguments alone: a training that was stopped goes on with the same images. Of several
    processes each takes its part of a larger batch.
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
    """Draws all that is random in a batch."""
    # 1: epochs draw from [seed, stage, epoch], and a step's number may be an epoch's.
    return np.random.default_rng([seed, stage, step, 1, rank])


def torch_seed_of_step(seed: int, stage: int, step: int, rank: int = 0) -> int:
    """For torch, which draws what dropout drops."""
    return int(np.random.SeedSequence([seed, stage, step, 2, rank]).generate_state(1)[0])


class BatchPrefetcher:
    """Batches by their numbers; while one is used the next are made, in threads.

    Threads, since OpenCV, NumPy and torch let others run while they compute, and images need not be sent.
    waited_s : seconds that `next` has waited for a batch that was not ready.
    """

    def __init__(
        self, make: Callable[[int], Batch], first: int, pool: ThreadPoolExecutor, depth: int
    ):
        self._make, self._number, self._pool = make, first, pool
        self._made: deque[Future[Batch]] = deque()
        self.waited_s = 0.0
        for _ in range(depth):
            self._order()

    def next(self) -> Batch:
        """The next batch. Raises what making it has raised."""
        began = time.perf_counter()
        batch = self._made.popleft().result()
        self.waited_s += time.perf_counter() - began
        self._order()
        return batch

    def _order(self) -> None:
        self._made.append(self._pool.submit(self._make, self._number))
        self._number += 1


@contextmanager
def prefetch_batches(
    make: Callable[[int], Batch], first: int, workers: int, depth: int = 0
) -> Iterator[BatchPrefetcher]:
    """`make` is called with number `first` and those after it, by threads that end with the block.

    depth : that are ready or under way, at most; at least two for each worker.
    """
    pool = ThreadPoolExecutor(workers, "batches", initializer=torch.set_num_threads, initargs=(1,))
    try:
        yield BatchPrefetcher(make, first, pool, max(depth, 2 * workers))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
