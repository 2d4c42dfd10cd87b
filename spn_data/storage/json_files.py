"""JSON files of an area: written atomically, each with a format version, without NaN or infinity."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.errors import FormatError
from spn_data.geometry.json_values import parse_file
from spn_data.geometry.json_values import parse_json as parse_json
from spn_data.storage.files import write_atomically

VERSION = 1  # of the area's layout and of stage.json
MAX_BYTES = 500_000_000  # far beyond the files of an area of 100 000 frames
# Raised when values of a damaged file are used.
DAMAGE = (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError)
_MAX_TOLD = 200
_KINDS = {
    dict: "an object",
    list: "a list",
    str: "text",
    bool: "true or false",
    type(None): "null",
}


def write_json(path: Path, value: Any) -> None:
    """Write plain values as indented JSON with sorted keys; the file is replaced atomically.

    Raises
    ------
    StageError
        If the file cannot be written.
    """
    write_atomically(path, json.dumps(value, indent=1, sort_keys=True) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object that has a `version`.

    Raises
    ------
    FormatError
        If the file is missing, damaged, too large, or of a newer version.
    """
    value = load_json(path)
    with reporting_damage(path):
        check_version(path, value["version"])
    return value


def load_json(path: Path, *, max_bytes: int = MAX_BYTES) -> dict[str, Any]:
    """Read a file that holds a JSON object.

    Raises
    ------
    FormatError
        If the file is missing, damaged or too large, or holds something else.
    """
    with reporting_damage(path):
        value = parse_file(path, max_bytes=max_bytes)
        if not isinstance(value, dict):
            raise TypeError(f"{kind_of(value)} instead of an object")
    return value


@contextmanager
def reporting_damage(path: Path, what: str = "") -> Iterator[None]:
    """Turn what a damaged file's values raise within the block into a FormatError that names the file.

    Parameters
    ----------
    path : Path
        The file.
    what : str
        What the file should be, such as "a split"; if empty, it is said that the file cannot be read.
    """
    try:
        yield
    except (*DAMAGE, OSError) as error:
        why = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        if isinstance(error, KeyError):
            why = f"{error} is missing"
        why = why[:_MAX_TOLD]
        if what:
            raise FormatError(f"{path}: is not {what} written by this program ({why})") from error
        raise FormatError(f"{path}: cannot be read ({why})") from error


def kind_of(value: Any) -> str:
    """Return the kind of a JSON value in words."""
    return _KINDS.get(type(value), "a number")


def check_version(path: Path, found: Any) -> None:
    """Raise FormatError if a file's version is newer than this program's, TypeError if it is none."""
    if not isinstance(found, int) or isinstance(found, bool):
        raise TypeError(f"its version is {kind_of(found)}")
    if found > VERSION:
        raise FormatError(
            f"{path}: made by a newer version of this program (format {found}, this reads {VERSION}); "
            "update the program"
        )


def finite_or_none(value: float | np.floating[Any]) -> float | None:
    """Return a number as a Python float, or None (JSON null) if it is NaN or infinite."""
    return float(value) if math.isfinite(value) else None


def text_of(value: Any, most: int) -> str:
    """Return the first characters of a text read from JSON; raise TypeError for anything else."""
    if not isinstance(value, str):
        raise TypeError(f"{type(value).__name__} instead of text")
    return value[:most]


def number_or(value: float | None, unknown: float = math.nan) -> float:
    """Return a number read from JSON as a float, or `unknown` for null; raise TypeError for anything else."""
    if value is None:
        return unknown
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{kind_of(value)} instead of a number")
    return float(value)


def finite(value: Any) -> Any:
    """Return nested plain values with None (JSON null) for every float that is NaN or infinite.

    Mappings become dicts with text keys, lists and tuples become lists, NumPy floats become Python floats;
    other values are returned as they are.
    """
    if isinstance(value, float | np.floating):
        return finite_or_none(value)
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return value
