"""Rows that belong to groups."""

from __future__ import annotations

import numpy as np


def rank_within_group(group: np.ndarray, count: int) -> np.ndarray:
    """(M,) how many rows of the same group, (M,) 0..count-1, come before each."""
    # Small integers are sorted by radix, several times faster.
    order = np.argsort(group.astype(np.min_scalar_type(count)), kind="stable")
    sizes = np.bincount(group, minlength=count)
    number = np.empty(len(group), dtype=np.int64)
    number[order] = np.arange(len(group)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return number
