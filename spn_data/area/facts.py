"""area.toml: what the user stated about the area."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tomli_w

from spn_data.storage.files import write_atomically
from spn_data.storage.json_files import VERSION, check_version, reporting_damage

_MAX_BYTES = 10_000_000


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
    expect_low : tuple of str
        Evaluation sequences that are meant to be far from the map.
    options : mapping of str to tuple of str
        Options of the mapping that were given, as words of the command line, by name without dashes.
    """

    sources: tuple[str, ...] = ()
    evaluation: Mapping[str, str] = field(default_factory=dict)
    expect_low: tuple[str, ...] = ()
    options: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


def read_facts(path: Path) -> Facts:
    """Read area.toml; a missing file has no facts.

    Raises
    ------
    FormatError
        If the file is damaged or of a newer version.
    """
    if not path.exists():
        return Facts()
    with reporting_damage(path, "an area file"):
        if path.stat().st_size > _MAX_BYTES:
            raise ValueError(f"larger than {_MAX_BYTES // 1_000_000} MB")
        try:
            table = tomllib.loads(path.read_text(encoding="utf-8"))
        except RecursionError as error:
            raise ValueError("nested too deeply") from error
        check_version(path, table["version"])
        sources, evaluation = table["sources"], table.get("evaluation", {})
        expect_low, options = table.get("expect_low", []), table.get("options", {})
        if not isinstance(options, dict):
            raise TypeError("options is not a table")
        lists = [("sources", sources), ("expect_low", expect_low), *options.items()]
        for name, value in lists:
            if not isinstance(value, list) or not all(isinstance(s, str) for s in value):
                raise TypeError(f"{name:.60} is not a list of texts")
        if not isinstance(evaluation, dict) or not all(
            isinstance(s, str) for s in evaluation.values()
        ):
            raise TypeError("evaluation is not a table of texts")
        return Facts(
            sources=tuple(sources),
            evaluation=evaluation,
            expect_low=tuple(expect_low),
            options={name: tuple(words) for name, words in options.items()},
        )


def write_facts(path: Path, facts: Facts) -> None:
    """Write area.toml atomically.

    Raises
    ------
    StageError
        If the file cannot be written.
    """
    table: dict[str, Any] = {"version": VERSION, "sources": list(facts.sources)}
    if facts.expect_low:
        table["expect_low"] = sorted(set(facts.expect_low))
    if facts.evaluation:
        table["evaluation"] = dict(sorted(facts.evaluation.items()))
    if facts.options:
        table["options"] = {name: list(words) for name, words in sorted(facts.options.items())}
    write_atomically(path, tomli_w.dumps(table))
