"""Packages that only some users need, imported when a file asks for them."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from spn_data.errors import InputError


def import_extra(package: str, extra: str, what: str, path: Path | str) -> Any:
    """Import an optional package.

    Parameters
    ----------
    package : str
        Full name of the module.
    extra : str
        Extra of this distribution that installs it.
    what : str
        What is read with it, such as "DNG photos", for the message.
    path : Path or str
        The file that asks for it.

    Returns
    -------
    module
        The imported module.

    Raises
    ------
    InputError
        If it is not installed; the message has the command that installs it.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise InputError(
            f"reading {what} needs another package: pip install 'squeezeposenet-toolkit[{extra}]'",
            path=path,
        ) from error
