"""area.toml: what the user stated about the area."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import tomli_w

from spn_data.errors import FormatError
from spn_data.storage.files import write_atomically
from spn_data.storage.json_files import VERSION, check_version


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Facts that the user stated about the area, as opposed to options.

    Attributes
    ----------
    sources : tuple of str
        Folders and files that were reconstructed, in the order given; relative paths start at the area's
        folder.
    evaluation : mapping of str to str
        Source of each evaluation sequence, by name of the sequence.
    """

    sources: tuple[str, ...] = ()
    evaluation: Mapping[str, str] = field(default_factory=dict)


def read_facts(path: Path) -> Facts:
    """Read area.toml; a missing file has no facts.

    Raises
    ------
    FormatError
        If the file is damaged or of a newer version.
    """
    if not path.exists():
        return Facts()
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        check_version(path, table["version"])
        evaluation = {str(k): str(v) for k, v in dict(table.get("evaluation", {})).items()}
        return Facts(sources=tuple(str(s) for s in table["sources"]), evaluation=evaluation)
    except (tomllib.TOMLDecodeError, KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{path}: not an area file of this program ({error!r})") from error


def write_facts(path: Path, facts: Facts) -> None:
    """Write area.toml atomically.

    Raises
    ------
    StageError
        If the file cannot be written.
    """
    table = {"version": VERSION, "sources": list(facts.sources)}
    if facts.evaluation:
        table["evaluation"] = dict(sorted(facts.evaluation.items()))
    write_atomically(path, tomli_w.dumps(table))
