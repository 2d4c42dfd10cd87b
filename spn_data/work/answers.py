"""Checks of what a worker answers, before it is stored: on a cluster, it may be a broken machine."""

from __future__ import annotations

from typing import Any

import numpy as np

from spn_data.errors import SpnError


class WrongAnswerError(SpnError):
    """An answer of a worker that is not what was asked for; the message says what is wrong with it."""


def check_rows(value: Any, what: str, dtype: type, columns: int, most: int) -> None:
    """Check an array (N, columns) of an answer.

    Parameters
    ----------
    value : any
        What the worker sent.
    what : str
        Name of the array in the error message.
    dtype : type
        Exact type of its values; floats must be finite.
    columns : int
        Number of columns.
    most : int
        Largest number of rows.

    Raises
    ------
    WrongAnswerError
        If it is anything else.
    """
    if type(value) is not np.ndarray or value.dtype != dtype or value.ndim != 2:
        raise WrongAnswerError(f"{what} are not an array of {np.dtype(dtype).name}")
    if value.shape[1] != columns or len(value) > most:
        raise WrongAnswerError(
            f"{what} have the shape {value.shape}, expected {columns} columns and at most {most} rows"
        )
    if value.dtype.kind == "f" and not np.isfinite(value).all():
        raise WrongAnswerError(f"{what} are not all finite")


def check_indices(value: Any, what: str, dtype: type, below: tuple[int, int], most: int) -> None:
    """Check pairs of indices (N, 2), each column below its bound; raise WrongAnswerError otherwise."""
    check_rows(value, what, dtype, 2, most)
    if len(value) and (value.min() < 0 or (value.max(axis=0) >= below).any()):
        raise WrongAnswerError(f"{what} refer to rows that do not exist")


def check_asked(name: Any, asked: set[Any]) -> None:
    """Check that an answer belongs to a question, and remove that one; raise WrongAnswerError otherwise."""
    try:
        asked.remove(name)
    except (KeyError, TypeError):
        raise WrongAnswerError(f"an answer to {name!r:.60}, which was not asked") from None


def check_complete(asked: set[Any]) -> None:
    """Raise WrongAnswerError if there are questions without an answer."""
    if asked:
        raise WrongAnswerError(
            f"workers left out {next(iter(asked))!r:.60}, in all {len(asked)} of what they were asked; "
            "use only a cluster that you trust"
        )


def check_kind(value: Any, kind: type[Any], length: int | None = None) -> None:
    """Check the type and the length of an answer; raise WrongAnswerError otherwise."""
    if type(value) is not kind:
        raise WrongAnswerError(f"{type(value).__name__} instead of {kind.__name__}")
    if length is not None and len(value) != length:
        raise WrongAnswerError(f"{len(value)} items instead of {length}")
