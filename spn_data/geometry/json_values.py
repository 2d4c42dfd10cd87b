"""JSON from outside, parsed within bounds, and numbers in it: finite and of the stated shape."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

_MAX_DIGITS = 100  # the state of a random generator needs 39, a float holds 308


def parse_file(path: Path, *, max_bytes: int) -> Any:
    """Parse a JSON file of any kind of value; raise OSError or ValueError if that is impossible."""
    if path.stat().st_size > max_bytes:
        raise ValueError(f"larger than {max_bytes / 1e6:g} MB")
    return parse_json(path.read_text(encoding="utf-8"))


def parse_json(text: str) -> Any:
    """Parse JSON; raise ValueError if it is damaged, nested too deeply, or has too large a number."""
    try:
        return json.loads(text, parse_int=_integer, parse_float=_float)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


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


def bounded(value: Any, low: float, high: float) -> float:
    """Return a number between two bounds.

    Raises
    ------
    TypeError, ValueError
        If it is no number, or outside the bounds.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r} is not a number")
    if not (math.isfinite(value) and low <= value <= high):
        raise ValueError(f"{value!r} is outside {low} to {high}")
    return float(value)


def _check(value: Any, depth: int) -> None:
    if depth > 8:
        raise ValueError("numbers are nested too deeply")
    if isinstance(value, list | tuple):
        for item in value:
            _check(item, depth + 1)
    elif isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{type(value).__name__} instead of a number")


def _integer(digits: str) -> int:
    if len(digits) > _MAX_DIGITS:
        raise ValueError(f"a number of {len(digits)} digits")
    return int(digits)


def _float(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise ValueError(f"{digits[:40]} is too large a number")
    return value
