"""What the running command is to print, and the object with its results that `--json` prints."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import click
import numpy as np

from spn_data.storage.json_files import finite

_KEY = "spn_cli.output"


@dataclass
class Output:
    """What a command was asked to print, and its results so far."""

    verbose: bool = False
    quiet: bool = False
    as_json: bool = False
    has_shown: bool = False  # anything, so that the user knows that the command is at work
    figures: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def is_silent(self) -> bool:
        """Whether tables and sentences are left out."""
        return self.quiet or self.as_json

    def to_json(self, command: str) -> str:
        """Return the results of a command as a JSON object; unknown and infinite numbers are null."""
        found = {"command": command, **self.figures, "notes": self.notes}
        return json.dumps(finite(found), indent=1, allow_nan=False, default=_plain)


def current() -> Output:
    """Return what the running command was asked to print."""
    context = click.get_current_context(silent=True)
    if context is None:
        return Output()
    found: Output = context.meta.setdefault(_KEY, Output())
    return found


def figures(**values: Any) -> None:
    """Add results to the object of `--json`; names of quantities end with their unit."""
    current().figures.update(values)


@contextmanager
def after(seconds: float, act: Callable[[], None]) -> Iterator[None]:
    """Do something once, unless the block ends sooner."""
    timer = threading.Timer(seconds, act)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _plain(value: Any) -> Any:
    """Return what `json` does not know as plain values."""
    if isinstance(value, np.ndarray | np.generic):
        return finite(value.tolist())
    if is_dataclass(value) and not isinstance(value, type):
        return finite(asdict(value))
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no form in JSON")
