"""Operations on rows that belong to groups, and on runs of rows."""

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


def runs_of(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the runs of true elements of a mask begin and end.

    Parameters
    ----------
    mask : ndarray, shape (N,), bool

    Returns
    -------
    starts, ends : ndarray, shape (R,)
        Of each run: its first element, and the one behind its last.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return edges[::2], edges[1::2]
