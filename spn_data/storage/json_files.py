"""JSON files of an area: written atomically, each with a format version, without NaN or infinity."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.errors import FormatError
from spn_data.storage.files import write_atomically

VERSION = 1  # of the area's layout and of stage.json


def write_json(path: Path, value: Any) -> None:
    """Write plain values as indented JSON with sorted keys; the file is replaced atomically.

    Raises
    ------
    StageError
        If the file cannot be written.
    """
    write_atomically(path, json.dumps(value, indent=1, sort_keys=True) + "\n")


def read_json(path: Path) -> Any:
    """Read a JSON object that has a `version`.

    Raises
    ------
    FormatError
        If the file is missing, damaged, or of a newer version.
    """
    try:
        value = json.loads(path.read_text())
        check_version(path, value["version"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{path}: cannot be read ({error!r})") from error
    return value


def check_version(path: Path, found: int) -> None:
    """Raise FormatError if the version found in a file is newer than this program's."""
    if found > VERSION:
        raise FormatError(
            f"{path}: made by a newer version of this program (format {found}, this reads {VERSION}); "
            "update the program"
        )


def finite_or_none(value: float | np.floating[Any]) -> float | None:
    """Return a number as a Python float, or None (JSON null) if it is NaN or infinite."""
    return float(value) if math.isfinite(value) else None


def number_or(value: float | None, unknown: float = math.nan) -> float:
    """Return a number read from JSON as a float, or `unknown` for null."""
    return unknown if value is None else float(value)


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
