"""Optional packages for messages, imported when they are needed; this room cannot know spn_data.media's."""

from __future__ import annotations

import importlib
from typing import Any

from spn_data.errors import InputError


def optional(module: str, extra: str, what: str) -> Any:
    """Import a module of an optional package; raise InputError with the command that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            f"{what} needs another package: pip install 'squeezeposenet-toolkit[{extra}]'"
        ) from error
