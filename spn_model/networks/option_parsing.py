"""Parsing of options from a recipe or a checkpoint into a dataclass."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, TypeVar

from spn_data.errors import InputError

_T = TypeVar("_T")


def from_mapping(kind: type[_T], given: Mapping[str, Any], where: str) -> _T:
    """Build a dataclass of numbers, bools and strings from values by the names of its fields.

    All fields need defaults, which define their types. An int is accepted for a float; nothing else is
    converted. `where` starts the messages. Raises InputError for an unknown name, a value of another type
    or one that is not finite.
    """
    defaults = {field.name: field.default for field in fields(kind)}  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for name, value in given.items():
        if name not in defaults:
            raise InputError(f"{where}: unknown option {name!r}; options are {', '.join(defaults)}")
        wanted = type(defaults[name])
        if wanted is float and type(value) is int:
            value = float(value)
        if type(value) is not wanted:
            raise InputError(f"{where}: {name} is {value!r}, needs a {wanted.__name__}")
        if isinstance(value, float) and not math.isfinite(value):
            raise InputError(f"{where}: {name} is {value}, needs a finite number")
        values[name] = value
    return kind(**values)
