"""Numbers from JSON: finite, of the stated shape, and neither text nor true or false."""

from __future__ import annotations

from typing import Any

import numpy as np


def numbers(value: Any, *shape: int) -> np.ndarray:
    """Return nested lists of finite numbers as an array; a shape of () is a single number.

    Raises
    ------
    TypeError, ValueError
        If there is anything but finite numbers, or the lists have another shape.
    """
    _check(value, 0)
    try:
        found = np.array(value, dtype=np.float64)
    except OverflowError as error:
        raise ValueError("a number is too large") from error
    if found.shape != shape:
        raise ValueError(f"numbers of shape {found.shape} instead of {shape}")
    if not np.isfinite(found).all():
        raise ValueError("a number is not finite")
    return found


def _check(value: Any, depth: int) -> None:
    if depth > 8:
        raise ValueError("numbers are nested too deeply")
    if isinstance(value, list | tuple):
        for item in value:
            _check(item, depth + 1)
    elif isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{type(value).__name__} instead of a number")
