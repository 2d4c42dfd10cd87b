"""Errors that tell the user where something is wrong, what was found, and what to do."""

from __future__ import annotations

from pathlib import Path


class SpnError(Exception):
    """Raised when the user's data or request cannot be used."""


class InputError(SpnError):
    """Raised when a file that the user gave cannot be used; says which file and line."""

    def __init__(self, message: str, *, path: Path | str | None = None, line: int | None = None):
        where = "" if path is None else f"{path}: " if line is None else f"{path}:{line}: "
        super().__init__(where + message)
        self.path = path
        self.line = line


class StageError(SpnError):
    """Raised when a stage of the area is missing, stale, in use, or would be overwritten."""


class InUseError(StageError):
    """Raised when another process works in the folder."""


class GeometryError(SpnError):
    """Raised when the geometry does not determine the answer: too few points, a line, no agreement."""


class FormatError(SpnError):
    """Raised when a file of ours is damaged or was made by a newer version."""
