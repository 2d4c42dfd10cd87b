"""What a stage was made of, and our JSON files: each written whole, each with a version."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from spn_data.errors import FormatError
from spn_data.storage.files import write_whole

VERSION = 1  # of the area's layout and of stage.json
# Names that version 0.1 used in stage.json and split.json, and what they are called now.
_RENAMED_GROUPS = {"4-dense": "4-tracked"}
_RENAMED_OPTIONS = {"dense": "tracked"}


@dataclass(frozen=True, kw_only=True)
class StageRecord:
    """What a stage was made of, with what, and what it cost; stage.json.

    options : of the stage; inputs : content fingerprint by file name; upstream : fingerprint of each
    stage it was made from; counts : what it holds; seconds, cpu_seconds : by step, child processes
    included; notes : what the user should know.
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

    @property
    def made_of(self) -> dict[str, Any]:
        """What decides whether a stage would come out the same."""
        upstream = {current_stage(name): value for name, value in self.upstream.items()}
        made_of = {
            "options": current_options(self.options),
            "inputs": self.inputs,
            "upstream": upstream,
        }
        return dict(json.loads(json.dumps(made_of)))

    def fingerprint(self) -> str:
        """Changes whenever the stage is made anew from something else."""
        made_of = {"options": self.options, "inputs": self.inputs, "upstream": self.upstream}
        content = json.dumps({"of": made_of, "counts": self.counts}, sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]


def current_stage(name: str) -> str:
    """Return the name that a stage has in this version, given the one that its record has."""
    group, slash, rest = name.partition("/")
    return _RENAMED_GROUPS.get(group, group) + slash + rest


def current_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return recorded options under the names that they have in this version, nested groups too."""
    return {
        _RENAMED_OPTIONS.get(name, name): current_options(value)
        if isinstance(value, Mapping)
        else value
        for name, value in options.items()
    }


def content_fingerprint(path: Path) -> str:
    """Of a file's size and of its first, middle and last megabyte: quick also for hours of video."""
    size = path.stat().st_size
    digest = hashlib.sha256(str(size).encode())
    with path.open("rb") as handle:
        for start in (0, max(0, size // 2 - 2**19), max(0, size - 2**20)):
            handle.seek(start)
            digest.update(handle.read(2**20))
    return digest.hexdigest()[:16]


def write_json(path: Path, value: Any) -> None:
    write_whole(path, json.dumps(value, indent=1, sort_keys=True) + "\n")


def read_json(path: Path) -> Any:
    """Raises FormatError where the file is missing, damaged, or of a newer version."""
    try:
        value = json.loads(path.read_text())
        check_version(path, value["version"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{path}: cannot be read ({error!r})") from error
    return value


def versions() -> dict[str, str]:
    """Of what computed something."""
    found = {"python": platform.python_version()}
    for package in ("squeezeposenet-toolkit", "pycolmap", "opencv-python-headless", "numpy", "av"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed as a package"
    return found


def read_record(path: Path) -> StageRecord:
    table = read_json(path)
    del table["version"]
    try:
        return StageRecord(**{**table, "notes": tuple(table["notes"])})
    except (TypeError, KeyError) as error:
        raise FormatError(f"{path}: not a record of a stage ({error!r})") from error


def check_version(path: Path, found: int) -> None:
    if found > VERSION:
        raise FormatError(
            f"{path}: made by a newer version of this program (format {found}, this reads {VERSION}); "
            "update the program"
        )


def difference(found: StageRecord, wanted: StageRecord) -> str:
    """In words, what two records are made of that differs."""
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
        ("does not hold", new),
        ("holds the missing", gone),
        ("saw another", changed),
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
    """(name, value before, value now) of each option that differs, those in groups as `group.name`."""
    for name in dict.fromkeys((*wanted, *found)):
        before, now = found.get(name), wanted.get(name)
        if isinstance(before, Mapping) and isinstance(now, Mapping):
            yield from _changed_options(before, now, f"{prefix}{name}.")
        elif before != now:
            yield prefix + name, before, now
