"""The user's area on disk: its names, stages that appear whole or not at all, and what is stale."""

from __future__ import annotations

import json
import os
import shutil
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import tomli_w

from spn_data.capture.sources import safe_name
from spn_data.errors import FormatError, InputError, InUseError, StageError
from spn_data.storage.files import LOCK, locked, write_atomically
from spn_data.storage.json_files import VERSION, check_version, write_json
from spn_data.storage.stage_record import (
    StageRecord,
    current_stage,
    difference,
    read_record,
    versions,
)

FRAMES, MODEL, GEO, SPLIT = "1-frames", "2-model", "3-geo", "5-split"
STAGES = (FRAMES, MODEL, GEO)  # of the map; --add exchanges them together
EVALUATION, TRACKED = "4-eval", "4-tracked"  # folders with one stage a sequence
_GROUPS = (EVALUATION, TRACKED)
_FORMER_GROUPS = {
    TRACKED: "4-dense"
}  # as version 0.1 called them; read and extended where they are
RUNS = "runs"  # trained networks, a folder each; made by spn-model
CHECKPOINT, LOG, METRICS = "checkpoint.safetensors", "log.csv", "metrics.json"
ERRORS, FIGURES, BUNDLE = "errors.csv", "figures", "bundle"
CONFIG, LAST, STATE = "config.json", "last.safetensors", "state.safetensors"
COMPARED = "compared"  # beside them: several runs evaluated together

# What only unfinished work holds: it is removed once the stage's record stands.
SCRATCH: dict[str, tuple[str, ...]] = {
    FRAMES: (".analysis",),
    MODEL: ("mapping-*", "database-*", "refined"),
    EVALUATION: (".analysis", ".matches"),
}

_FACTS = "area.toml"
_RECORD = "stage.json"
_STARTED = "started.json"
_NEXT = ".next"
_READY = "ready"


@dataclass(frozen=True, kw_only=True)
class Facts:
    """What the user says of the area: facts, not tuning.

    sources : folders and files that were reconstructed, in the order in which they were given; relative ones
    count from the area's folder. evaluation : what each evaluation sequence was registered from, by its name.
    """

    sources: tuple[str, ...] = ()
    evaluation: Mapping[str, str] = field(default_factory=dict)


class StageWork:
    """A stage being made, in a folder of its own that survives an interruption."""

    def __init__(self, area: Area, record: StageRecord, path: Path, *, resumed: bool):
        self._area = area
        self.record = record
        self.path = path
        self.resumed = resumed

    def finish(
        self,
        *,
        counts: dict[str, Any],
        seconds: dict[str, float],
        cpu_seconds: dict[str, float],
        notes: tuple[str, ...] = (),
    ) -> StageRecord:
        """Make the stage appear under its name, in place of the one that it replaces."""
        record = replace(
            self.record,
            counts=counts,
            seconds={k: round(v, 3) for k, v in seconds.items()},
            cpu_seconds={k: round(v, 3) for k, v in cpu_seconds.items()},
            notes=notes,
            versions=versions(),
            finished=datetime.now(UTC).isoformat(timespec="seconds"),
        )
        write_json(self.path / _RECORD, {"version": VERSION, **asdict(record)})
        self._area.put_in_place(record.stage, self.path)
        return record

    def discard(self) -> None:
        """Leave nothing of it, where the work came to no result and going on would gain nothing."""
        shutil.rmtree(self.path)


class Area:
    """A folder that `reconstruct` fills stage by stage."""

    def __init__(self, root: Path):
        self.root = root
        self._finish_exchange()
        self.facts = self._read_facts()

    def folder(self, stage: str) -> Path:
        """Return the folder of a stage, which need not exist."""
        group, _, name = stage.partition("/")
        return self.group_folder(group) / name

    def group_folder(self, group: str) -> Path:
        """Return the folder of a stage or group; that of a former name where the area has one."""
        former = self.root / _FORMER_GROUPS.get(group, group)
        return former if former.is_dir() else self.root / group

    def has(self, stage: str) -> bool:
        """A stage folder that exists is complete."""
        return self.folder(stage).is_dir()

    def _old(self, stage: str) -> Path:
        folder = self.folder(stage)
        return folder.with_name(f".old-{folder.name}")

    def partial(self, stage: str) -> Path:
        folder = self.folder(stage)
        return folder.with_name(f".{folder.name}.partial")

    def sequences(self, group: str) -> tuple[str, ...]:
        """Names of the complete stages of a group (EVALUATION or TRACKED), or of RUNS, sorted."""
        folder = self.group_folder(group)
        found = folder.iterdir() if folder.is_dir() else iter(())
        return tuple(sorted(p.name for p in found if p.is_dir() and not p.name.startswith(".")))

    def stages(self) -> tuple[str, ...]:
        """All stages that stand, in the order of work."""
        after = [f"{group}/{name}" for group in _GROUPS for name in self.sequences(group)]
        return tuple(stage for stage in (*STAGES, *after, SPLIT) if self.has(stage))

    def run_folder(self, name: str) -> Path:
        """Folder of a trained network, which need not exist. Raises InputError for what names no folder."""
        if safe_name(name) != name or name == COMPARED:
            raise InputError(
                f"{name!r} cannot name a run; use letters, digits, dot, dash and underscore, and not "
                f"{COMPARED!r}"
            )
        return self.root / RUNS / name

    def upstream_names(self, stage: str) -> tuple[str, ...]:
        """The stages that `stage` is made from, as the area is now."""
        group, _, name = stage.partition("/")
        if stage == SPLIT:
            found = [s for s in self.stages() if s != SPLIT]
            return tuple(dict.fromkeys((FRAMES, MODEL, *found)))
        if group == TRACKED:
            evaluation = f"{EVALUATION}/{name}"
            return (MODEL, evaluation) if self.has(evaluation) else (FRAMES, MODEL)
        return {FRAMES: (), MODEL: (FRAMES,), GEO: (FRAMES, MODEL), EVALUATION: (MODEL,)}[group]

    def record(self, stage: str) -> StageRecord:
        """Raises StageError where the stage is missing, FormatError where a newer version made it."""
        path = self.folder(stage) / _RECORD
        if not path.exists():
            raise StageError(f"{self.folder(stage)} is missing; run {command_of(stage)} first")
        return read_record(path)

    def stale_because(self, stage: str) -> str | None:
        """Why a stage no longer fits what it was made from, or None."""
        record = self.record(stage)
        for name, fingerprint in record.upstream.items():
            if not self.has(current_stage(name)):
                return f"{name} is missing"
            if self.record(current_stage(name)).fingerprint() != fingerprint:
                return f"{name} was made anew since"
        known = {current_stage(name) for name in record.upstream}
        added = [name for name in self.upstream_names(stage) if name not in known]
        return f"{added[0]} was added since" if added else None

    def upstream_of(self, stage: str) -> dict[str, str]:
        """Fingerprints of the stages that `stage` is made from. Raises StageError for a stale one."""
        names = self.upstream_names(stage)
        for name in names:
            self.check_fresh(name)
        return {name: self.record(name).fingerprint() for name in names}

    def check_fresh(self, stage: str) -> None:
        """Raises StageError where a stage is missing or stale."""
        reason = self.stale_because(stage)
        if reason:
            raise StageError(
                f"{self.folder(stage)} is stale: {reason}; run {command_of(stage)} again"
            )

    def begin(
        self,
        stage: str,
        options: Mapping[str, Any],
        inputs: Mapping[str, str],
        *,
        overwrite: bool,
    ) -> StageWork | StageRecord:
        """The record where the stage stands already, made of the same; else the work to do.

        Unfinished work made of the same goes on. Raises StageError where finished or unfinished work
        made of something else would be lost and `overwrite` is false.
        """
        record = StageRecord(
            stage=stage,
            options=json.loads(json.dumps(options)),
            inputs=dict(inputs),
            upstream=self.upstream_of(stage),
        )
        if self.has(stage):
            found = self.record(stage)
            if found.made_of == record.made_of:
                return found
            if not overwrite:
                change = difference(found, record)
                raise StageError(
                    f"{self.folder(stage)} stands already and {change}; "
                    "--overwrite makes it anew, another --area leaves it"
                )
        path = self.partial(stage)
        started = path / _STARTED
        resumed = started.exists()
        if resumed:
            found = read_record(started)
            if found.made_of != record.made_of:
                if not overwrite and _holds_work(path):
                    raise StageError(
                        f"{path} holds unfinished work and {difference(found, record)}; "
                        "give the same options to go on, or --overwrite to start anew"
                    )
                shutil.rmtree(path)
                resumed = False
            elif (path / _RECORD).exists():  # a kill while scratch files were removed
                self.put_in_place(stage, path)
                return self.record(stage)
        if not resumed:
            shutil.rmtree(path, ignore_errors=True)
            _make_folder(path)
            write_json(started, {"version": VERSION, **asdict(record)})
        return StageWork(self, record, path, resumed=resumed)

    def put_in_place(self, stage: str, path: Path) -> None:
        """Rename a complete folder to the stage's name; a kill at any moment loses neither version."""
        for pattern in SCRATCH.get(stage.partition("/")[0], ()):
            for scratch in path.glob(pattern):
                shutil.rmtree(scratch) if scratch.is_dir() else scratch.unlink()
        shutil.rmtree(self._old(stage), ignore_errors=True)
        if self.has(stage):
            self.folder(stage).rename(self._old(stage))
        path.rename(self.folder(stage))
        (self.folder(stage) / _STARTED).unlink(missing_ok=True)
        shutil.rmtree(self._old(stage), ignore_errors=True)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Only one process at a time changes an area. Makes the folder; removes it if it stays empty."""
        is_new = not self.root.exists()
        _make_folder(self.root)
        with locked(self.root, "spn-data"):
            try:
                yield
            finally:
                if is_new and [path.name for path in self.root.iterdir()] == [LOCK]:
                    shutil.rmtree(self.root)

    def _finish_exchange(self) -> None:
        """Complete the renames that a killed process left half-way; not those of one that still runs."""
        exchanging = (self.root / _NEXT / _READY).exists()
        if not exchanging and not self._moved_away():
            return
        try:
            with self.locked():
                for stage in self._moved_away():
                    self._old(stage).rename(self.folder(stage))
                if (self.root / _NEXT / _READY).exists():
                    self._replace_by_next()
        except InUseError:
            return

    def _moved_away(self) -> list[str]:
        """Stages between the two renames of an exchange."""
        names = [*STAGES, SPLIT]
        for group in _GROUPS:
            names += [
                f"{group}/{old.name.removeprefix('.old-')}"
                for old in self.group_folder(group).glob(".old-*")
            ]
        return [s for s in names if self._old(s).exists() and not self.folder(s).exists()]

    def stored_path(self, path: Path) -> str:
        """A user's path as area.toml holds it: a relative one from the area's folder on, so that it is found
        from any current folder, and where both have moved together."""
        if not path.is_absolute():
            path = Path(os.path.relpath(os.path.abspath(path), os.path.realpath(self.root)))
        return str(path).encode(errors="backslashreplace").decode()

    def write_facts(self, facts: Facts) -> None:
        if facts == self.facts and (self.root / _FACTS).exists():
            return
        table = {"version": VERSION, "sources": list(facts.sources)}
        if facts.evaluation:
            table["evaluation"] = dict(sorted(facts.evaluation.items()))
        text = tomli_w.dumps(table)
        write_atomically(self.root / _FACTS, text)
        self.facts = facts

    def _read_facts(self) -> Facts:
        path = self.root / _FACTS
        if not path.exists():
            return Facts()
        try:
            table = tomllib.loads(path.read_text(encoding="utf-8"))
            check_version(path, table["version"])
            evaluation = {str(k): str(v) for k, v in dict(table.get("evaluation", {})).items()}
            return Facts(sources=tuple(str(s) for s in table["sources"]), evaluation=evaluation)
        except (tomllib.TOMLDecodeError, KeyError, TypeError, ValueError) as error:
            raise FormatError(f"{path}: not an area file of this program ({error!r})") from error

    def next_area(self) -> Area:
        """An area inside this one in which its next version is made, whole, before it replaces this."""
        return Area(self.root / _NEXT)

    def has_unfinished_addition(self) -> bool:
        return (self.root / _NEXT).exists()

    def discard_next(self) -> None:
        """Throw away what an unfinished addition has made."""
        shutil.rmtree(self.root / _NEXT, ignore_errors=True)

    def replace_by_next(self) -> None:
        """Replace the stages by those of the next version, all or none."""
        (self.root / _NEXT / _READY).touch()
        self._replace_by_next()
        self.facts = self._read_facts()

    def _replace_by_next(self) -> None:
        following = self.root / _NEXT
        for stage in STAGES:
            new, now, old = following / stage, self.folder(stage), self._old(stage)
            if new.exists():
                if now.exists():
                    shutil.rmtree(old, ignore_errors=True)
                    now.rename(old)
                new.rename(now)
            shutil.rmtree(old, ignore_errors=True)
        if (following / _FACTS).exists():
            (following / _FACTS).replace(self.root / _FACTS)
        shutil.rmtree(following)


def command_of(stage: str) -> str:
    """The command that makes a stage."""
    group, _, name = stage.partition("/")
    commands = {
        GEO: "spn-data georegister",
        EVALUATION: f"spn-data register VIDEO --name {name}",
        TRACKED: f"spn-data register --all-frames --name {name}",
        SPLIT: "spn-data split",
    }
    return commands.get(group, "spn-data reconstruct")


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StageError(f"{path} cannot be made: {error.strerror}") from error


def _holds_work(path: Path) -> bool:
    """Whether an unfinished stage has made any file yet."""
    return any(p.is_file() and p.name != _STARTED for p in path.rglob("*"))
