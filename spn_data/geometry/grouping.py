"""Operations on rows that belong to groups."""

from __future__ import annotations

import numpy as np


def rank_within_group(group: np.ndarray, count: int) -> np.ndarray:
    """Return the rank of each row among the rows of its group, in row order.

    Parameters
    ----------
    group : ndarray, shape (M,)
        Group of each row, 0..count-1.
    count : int
        Number of groups.

    Returns
    -------
    ndarray, shape (M,)
        Number of earlier rows of the same group.
    """
    # NumPy sorts small integers by radix, which is several times faster.
    order = np.argsort(group.astype(np.min_scalar_type(count)), kind="stable")
    sizes = np.bincount(group, minlength=count)
    rank = np.empty(len(group), dtype=np.int64)
    rank[order] = np.arange(len(group)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return rank
