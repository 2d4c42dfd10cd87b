"""Records of the intermediate models of a reconstruction, from which an interrupted run continues."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from spn_data.geometry.json_values import parse_file
from spn_data.storage.files import write_atomically
from spn_data.storage.json_files import load_json, reporting_damage

_MAX_BYTES = 1_000_000
_MODELS, _SETTLED = "models.json", "settled.json"


def write_submodels(folder: Path, models: Sequence[Path]) -> None:
    """Record the sub-models of a mapping, which are in its folder `models`."""
    write_atomically(folder / _MODELS, json.dumps([model.name for model in models]))


def read_submodels(folder: Path) -> list[Path] | None:
    """Return the sub-models of a finished mapping; None if it is not finished.

    Raises
    ------
    FormatError
        If the record is damaged or names anything but folders of this mapping.
    """
    path = folder / _MODELS
    if not path.exists():
        return None
    with reporting_damage(path, "a list of models"):
        names = parse_file(path, max_bytes=_MAX_BYTES)
        if not isinstance(names, list):
            raise TypeError("no list")
        return [_inside(folder / "models", name) for name in names]


def write_settled(folder: Path, work: Path, model: Path, notes: Sequence[str]) -> None:
    """Record the model, below `work`, with which the second chances begin, and what the user should know."""
    value = {"model": model.relative_to(work).as_posix(), "notes": list(notes)}
    write_atomically(folder / _SETTLED, json.dumps(value))


def read_settled(folder: Path, work: Path) -> tuple[Path, list[str]] | None:
    """Return the model with which the second chances begin, and the notes; None if there is none yet.

    Raises
    ------
    FormatError
        If the record is damaged or names anything but a folder below `work`.
    """
    path = folder / _SETTLED
    if not path.exists():
        return None
    found = load_json(path, max_bytes=_MAX_BYTES)
    with reporting_damage(path, "a record of a model"):
        notes = found.get("notes", found.get("told"))  # the latter by earlier versions
        if not isinstance(notes, list) or not all(isinstance(note, str) for note in notes):
            raise TypeError("its notes are no list of sentences")
        return _inside(work, found["model"]), notes


def _inside(folder: Path, name: object) -> Path:
    """Return an existing folder below another; raise ValueError for anything else."""
    if not isinstance(name, str):
        raise TypeError("a name that is no text")
    parts = PurePosixPath(name)
    if not name or parts.is_absolute() or ".." in parts.parts or not (folder / parts).is_dir():
        raise ValueError(f"no such folder: {name[:80]!r}")
    return folder / parts
