"""Exceptions whose messages say which file or option is wrong, what was found, and what to do."""

from __future__ import annotations

from pathlib import Path


class SpnError(Exception):
    """Base class of all errors caused by the user's data or request.

    The message is one line: what libraries say, and names of files, may have several.
    """

    def __init__(self, message: str = ""):
        super().__init__(" ".join(line.strip() for line in message.splitlines()))


class InputError(SpnError):
    """An input file or option value that cannot be used; the message names the file and line.

    Attributes
    ----------
    path : Path or str or None
        The file, if there is one.
    line : int or None
        The line, counted from 1, if known.
    """

    def __init__(self, message: str, *, path: Path | str | None = None, line: int | None = None):
        where = "" if path is None else f"{path}: " if line is None else f"{path}:{line}: "
        super().__init__(where + message)
        self.path = path
        self.line = line


class StageError(SpnError):
    """A stage of the area that is missing, stale or in use, would be overwritten, or cannot be written."""


class InUseError(StageError):
    """A folder that another process is working in."""


class GeometryError(SpnError):
    """A geometric problem without a unique solution: too few points, collinear points, no consensus."""


class FormatError(SpnError):
    """A file written by this program that is damaged or was made by a newer version."""
