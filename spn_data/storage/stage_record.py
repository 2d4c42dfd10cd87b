"""stage.json: the options and inputs that a stage was made from, what it holds and what it cost."""

from __future__ import annotations

import hashlib
import json
import math
import platform
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from spn_data.errors import FormatError
from spn_data.storage.json_files import kind_of, read_json, reporting_damage

# Names that version 0.1 used in stage.json and split.json, and the current ones.
_RENAMED_GROUPS = {"4-dense": "4-tracked"}
_RENAMED_OPTIONS = {"dense": "tracked"}


# Kinds of the parts of a record, and of what objects and lists among them hold.
_PARTS: dict[str, type] = {
    **dict.fromkeys(("stage", "finished"), str),
    **dict.fromkeys(("options", "inputs", "upstream", "counts", "versions"), dict),
    **dict.fromkeys(("seconds", "cpu_seconds"), dict),
    "notes": list,
}
_HELD: dict[str, type | tuple[type, ...]] = {
    **dict.fromkeys(("inputs", "upstream", "versions", "notes"), str),
    **dict.fromkeys(("seconds", "cpu_seconds"), (int, float)),
}


@dataclass(frozen=True, kw_only=True)
class StageRecord:
    """The record of one stage, stored as stage.json.

    Attributes
    ----------
    stage : str
        Name of the stage, e.g. `2-model` or `4-eval/<sequence>`.
    options : dict
        Options of the stage.
    inputs : dict
        Content fingerprint of each input file, by file name.
    upstream : dict
        Fingerprint of each stage that this one was made from, by stage name.
    counts : dict
        What the stage holds.
    seconds, cpu_seconds : dict
        Wall and CPU time of each step, child processes included.
    notes : tuple of str
        Notes for the user.
    versions : dict
        Versions of the software that made the stage.
    finished : str
        Time at which the stage was finished (ISO 8601, UTC).
    """

    stage: str
    options: dict[str, Any]
    inputs: dict[str, str]
    upstream: dict[str, str]
    counts: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    cpu_seconds: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    versions: dict[str, str] = field(default_factory=dict)
    finished: str = ""

    def is_made_as(self, other: StageRecord) -> bool:
        """Whether options, inputs and upstream stages are the same under current names.

        An option that is null is the same as one that the program did not know yet.
        """
        mine, theirs = (json.loads(json.dumps(current_options(r.options))) for r in (self, other))
        return (
            not any(_changed_options(mine, theirs))
            and self.inputs == other.inputs
            and _current_upstream(self) == _current_upstream(other)
        )

    def fingerprint(self) -> str:
        """Return a hash that changes whenever the stage is redone from other options, inputs or stages."""
        made_of = {"options": self.options, "inputs": self.inputs, "upstream": self.upstream}
        content = json.dumps({"of": made_of, "counts": self.counts}, sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]


def read_record(path: Path) -> StageRecord:
    """Read a stage.json; raise FormatError if it is missing, damaged, or of a newer version."""
    table = read_json(path)
    with reporting_damage(path, "a record of a stage"):
        known = {each.name: each for each in fields(StageRecord)}
        for name, value in table.items():
            if name != "version" and name not in known:
                raise ValueError(f"{name!r} is not a part of it")
            wanted = _PARTS.get(name)
            if wanted is not None:
                _check(name, value, wanted)
        del table["version"]
        return StageRecord(
            **{
                **table,
                "stage": current_stage(table["stage"]),
                "counts": Counts(table.get("counts", {}), path),
                "notes": tuple(table["notes"]),
            }
        )


class Counts(dict[str, Any]):
    """The counts of a record that was read: a missing one is reported as damage of its file."""

    path: Path | None = None

    def __init__(self, counts: Any = (), path: Path | None = None):
        super().__init__(counts)
        self.path = path

    def __missing__(self, name: str) -> Any:
        """Raise FormatError that names the file."""
        where = "stage.json" if self.path is None else self.path
        raise FormatError(f"{where}: is damaged: its counts have no {name!r}")


def _check(name: str, value: Any, wanted: type) -> None:
    """Raise TypeError if a part of a record is of another kind, or an object or list holds other kinds."""
    held = _HELD.get(name, object)
    items = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    if not isinstance(value, wanted):
        raise TypeError(f"{name!r} is {kind_of(value)} instead of {kind_of(wanted())}")
    for item in items:
        if not isinstance(item, held) or (isinstance(item, bool) and held is not object):
            raise TypeError(f"{name!r} holds {kind_of(item)}")
        if isinstance(item, int | float) and held == (int, float) and not 0 <= item < math.inf:
            raise ValueError(f"{name!r} holds {item!r:.40}")


def current_stage(name: str) -> str:
    """Return the current name of a stage, given its name in a record of any version."""
    group, slash, rest = name.partition("/")
    return _RENAMED_GROUPS.get(group, group) + slash + rest


def current_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return recorded options under their current names, including those in nested groups."""
    return {
        _RENAMED_OPTIONS.get(name, name): current_options(value)
        if isinstance(value, Mapping)
        else value
        for name, value in options.items()
    }


def _current_upstream(record: StageRecord) -> dict[str, str]:
    return {current_stage(name): value for name, value in record.upstream.items()}


def versions() -> dict[str, str]:
    """Return the versions of Python, this package and the libraries that decide results."""
    found = {"python": platform.python_version()}
    for package in ("squeezeposenet-toolkit", "pycolmap", "opencv-python-headless", "numpy", "av"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed as a package"
    return found


def difference(found: StageRecord, wanted: StageRecord) -> str:
    """Describe the first difference between an existing record and the one wanted now.

    The result completes a sentence whose subject is the existing stage, e.g.
    "was made with seed = 0, now 1".
    """
    for name, before, now in _changed_options(
        current_options(found.options), current_options(wanted.options)
    ):
        return f"was made with {name} = {before!r}, now {now!r}"
    new = sorted(set(wanted.inputs) - set(found.inputs))
    gone = sorted(set(found.inputs) - set(wanted.inputs))
    changed = sorted(
        k for k in set(wanted.inputs) & set(found.inputs) if wanted.inputs[k] != found.inputs[k]
    )
    for what, names in (
        ("does not include", new),
        ("includes the missing", gone),
        ("used a different", changed),
    ):
        if names:
            more = f" and {len(names) - 1} more" if len(names) > 1 else ""
            return f"{what} {names[0]}{more}"
    return "was made from an earlier " + " and ".join(
        name for name in wanted.upstream if wanted.upstream[name] != found.upstream.get(name)
    )


def _changed_options(
    found: Mapping[str, Any], wanted: Mapping[str, Any], prefix: str = ""
) -> Iterator[tuple[str, Any, Any]]:
    """Yield (name, value before, value now) of each changed option, nested ones as `group.name`."""
    for name in dict.fromkeys((*wanted, *found)):
        before, now = found.get(name), wanted.get(name)
        if isinstance(before, Mapping) and isinstance(now, Mapping):
            yield from _changed_options(before, now, f"{prefix}{name}.")
        elif before != now:
            yield prefix + name, before, now
