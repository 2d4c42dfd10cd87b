"""The user's area on disk: stages that appear atomically, their records, and which of them are stale."""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from spn_data.area.facts import Facts, read_facts, write_facts
from spn_data.area.leftovers import remove_leftovers
from spn_data.area.names import (
    COMPARED,
    EVALUATION,
    FORMER_GROUPS,
    FRAMES,
    GEO,
    GROUPS,
    MODEL,
    RUNS,
    SCRATCH,
    SPLIT,
    STAGES,
    TRACKED,
)
from spn_data.area.stage_counts import check_counts
from spn_data.capture.sources import safe_name
from spn_data.errors import FormatError, InputError, InUseError, StageError
from spn_data.storage.files import LOCK, locked, make_folder
from spn_data.storage.json_files import VERSION, reporting_damage, write_json
from spn_data.storage.stage_record import (
    StageRecord,
    current_stage,
    difference,
    read_record,
    versions,
)

_logger = logging.getLogger(__name__)

_FACTS = "area.toml"
_RECORD = "stage.json"
_STARTED = "started.json"
_NEXT = ".next"
_READY = "ready"


class StageWork:
    """A stage in progress, in a partial folder that survives an interruption.

    Attributes
    ----------
    record : StageRecord
        Record of the stage, without results.
    path : Path
        The partial folder.
    resumed : bool
        Whether the folder contains work of an interrupted run.
    """

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
        """Write the record and move the stage to its final place, replacing an earlier version."""
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
        """Remove the partial folder, for work without a result that is not worth resuming."""
        shutil.rmtree(self.path)


class Area:
    """A folder that is filled stage by stage.

    Creating an instance completes the renames of a process that was killed in the middle of them.

    Attributes
    ----------
    root : Path
        The area's folder, which need not exist.
    facts : Facts
        What the user stated about it, in the file `facts_path`.
    """

    def __init__(self, root: Path):
        self.root = root
        self._complete_renames()
        self.facts_path = self.root / _FACTS
        self.facts = read_facts(self.facts_path)

    def folder(self, stage: str) -> Path:
        """Return the folder of a stage, which need not exist."""
        group, _, name = stage.partition("/")
        return self.group_folder(group) / name

    def group_folder(self, group: str) -> Path:
        """Return the folder of a stage or group, under its former name if the area has that one."""
        former = self.root / FORMER_GROUPS.get(group, group)
        return former if former.is_dir() else self.root / group

    def has(self, stage: str) -> bool:
        """Return whether a stage is complete: its folder exists only then."""
        return self.folder(stage).is_dir()

    def _old(self, stage: str) -> Path:
        folder = self.folder(stage)
        return folder.with_name(f".old-{folder.name}")

    def partial(self, stage: str) -> Path:
        """Return the folder of a stage in progress."""
        folder = self.folder(stage)
        return folder.with_name(f".{folder.name}.partial")

    def sequences(self, group: str) -> tuple[str, ...]:
        """Return the sorted names of the complete stages of a group (EVALUATION or TRACKED), or of RUNS."""
        folder = self.group_folder(group)
        found = folder.iterdir() if folder.is_dir() else iter(())
        return tuple(sorted(p.name for p in found if p.is_dir() and not p.name.startswith(".")))

    def stages(self) -> tuple[str, ...]:
        """Return all complete stages in processing order."""
        after = [f"{group}/{name}" for group in GROUPS for name in self.sequences(group)]
        return tuple(stage for stage in (*STAGES, *after, SPLIT) if self.has(stage))

    def run_folder(self, name: str) -> Path:
        """Return the folder of a trained network; raise InputError if the name is not valid."""
        if safe_name(name) != name or name == COMPARED:
            raise InputError(
                f"{name!r} is not a valid run name; use letters, digits, dot, dash and underscore, but not "
                f"{COMPARED!r}"
            )
        return self.root / RUNS / name

    def upstream_names(self, stage: str) -> tuple[str, ...]:
        """Return the stages that `stage` depends on in the present area."""
        group, _, name = stage.partition("/")
        if stage == SPLIT:
            found = [s for s in self.stages() if s != SPLIT]
            return tuple(dict.fromkeys((FRAMES, MODEL, *found)))
        if group == TRACKED:
            evaluation = f"{EVALUATION}/{name}"
            return (MODEL, evaluation) if self.has(evaluation) else (FRAMES, MODEL)
        return {FRAMES: (), MODEL: (FRAMES,), GEO: (FRAMES, MODEL), EVALUATION: (MODEL,)}[group]

    def record(self, stage: str) -> StageRecord:
        """Return the record of a stage.

        Raises StageError if the stage is missing, FormatError if its record is damaged or of a newer version.
        """
        if not (path := self.folder(stage) / _RECORD).exists():
            raise StageError(f"{self.folder(stage)} is missing; run {command_of(stage)} first")
        record = read_record(path)
        if current_stage(record.stage).partition("/")[0] != stage.partition("/")[0]:
            raise FormatError(f"{path}: is the record of another stage, {record.stage!r:.60}")
        with reporting_damage(path, "a record of a stage"):
            check_counts(stage, record.counts)
        return record

    def stale_because(self, stage: str) -> str | None:
        """Return why a stage is out of date with respect to its upstream stages, or None."""
        record = self.record(stage)
        for name, fingerprint in record.upstream.items():
            if not self.has(current_stage(name)):
                return f"{name} is missing"
            if self.record(current_stage(name)).fingerprint() != fingerprint:
                return f"{name} was redone since"
        known = {current_stage(name) for name in record.upstream}
        added = [name for name in self.upstream_names(stage) if name not in known]
        return f"{added[0]} was added since" if added else None

    def upstream_of(self, stage: str) -> dict[str, str]:
        """Return the fingerprints of the stages that `stage` depends on; raise StageError if one is stale."""
        names = self.upstream_names(stage)
        for name in names:
            self.check_fresh(name)
        return {name: self.record(name).fingerprint() for name in names}

    def check_fresh(self, stage: str) -> None:
        """Raise StageError if a stage is missing or stale."""
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
        """Start or resume a stage, or return its record if it is already up to date.

        Parameters
        ----------
        stage : str
            Name of the stage.
        options : mapping
            JSON-serialisable options of the stage.
        inputs : mapping of str to str
            Fingerprint of each input file, by name.
        overwrite : bool
            Whether work made from other options or inputs may be discarded.

        Returns
        -------
        StageWork or StageRecord
            The work to do; or the record of the complete stage if it was made from the same.

        Raises
        ------
        StageError
            If an upstream stage is missing or stale, or work made from something else would be lost and
            `overwrite` is false.
        """
        record = StageRecord(
            stage=stage,
            options=json.loads(json.dumps(options)),
            inputs=dict(inputs),
            upstream=self.upstream_of(stage),
        )
        if self.has(stage):
            found = self.record(stage)
            if found.is_made_as(record):
                _logger.debug("%s: up to date", stage)
                return found
            if not overwrite:
                change = difference(found, record)
                raise StageError(
                    f"{self.folder(stage)} already exists but {change}; "
                    "use --overwrite to redo it, or another --area to keep it"
                )
        path = self.partial(stage)
        started, complete = path / _STARTED, (path / _RECORD).exists()
        resumed = complete or started.exists()
        if resumed:
            found = read_record(path / _RECORD if complete else started)
            if not found.is_made_as(record):
                if not overwrite and _has_files(path):
                    raise StageError(
                        f"{path} contains unfinished work that {difference(found, record)}; "
                        "use the same options to continue, or --overwrite to start over"
                    )
                shutil.rmtree(path)
                resumed = False
            elif complete:  # killed before it was in place
                self.put_in_place(stage, path)
                return self.record(stage)
        if not resumed:
            shutil.rmtree(path, ignore_errors=True)
            make_folder(path)
            write_json(started, {"version": VERSION, **asdict(record)})
        _logger.debug("%s: %s", stage, "resumed" if resumed else "started")
        return StageWork(self, record, path, resumed=resumed)

    def put_in_place(self, stage: str, path: Path) -> None:
        """Rename a complete folder to the stage's folder; a kill at any moment loses neither version."""
        for pattern in SCRATCH.get(stage.partition("/")[0], ()):
            for scratch in path.glob(pattern):
                shutil.rmtree(scratch) if scratch.is_dir() else scratch.unlink()
        (path / _STARTED).unlink(missing_ok=True)
        shutil.rmtree(self._old(stage), ignore_errors=True)
        if self.has(stage):
            self.folder(stage).rename(self._old(stage))
        path.rename(self.folder(stage))
        shutil.rmtree(self._old(stage), ignore_errors=True)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the lock of the area, so that only one process at a time changes it.

        Creates the folder, and removes it again if it stays empty. Raises InUseError if it is in use.
        """
        is_new = not self.root.exists()
        make_folder(self.root)
        with locked(self.root, "spn-data"):
            remove_leftovers(self.root, (*STAGES, SPLIT), [self.group_folder(g) for g in GROUPS])
            try:
                yield
            finally:
                if is_new and [path.name for path in self.root.iterdir()] == [LOCK]:
                    shutil.rmtree(self.root)

    def _complete_renames(self) -> None:
        """Complete renames that a killed process left unfinished, unless another process is at work."""
        exchanging = (self.root / _NEXT / _READY).exists()
        if not exchanging and not self._half_replaced():
            return
        try:
            with self.locked():
                _logger.info("%s: completing the renames of a process that was killed", self.root)
                for stage in self._half_replaced():
                    self._old(stage).rename(self.folder(stage))
                if (self.root / _NEXT / _READY).exists():
                    self._replace_by_next()
        except InUseError:
            return

    def _half_replaced(self) -> list[str]:
        """Return the stages whose old folder is moved away and whose new one is not yet in place."""
        names = [*STAGES, SPLIT]
        for group in GROUPS:
            names += [
                f"{group}/{old.name.removeprefix('.old-')}"
                for old in self.group_folder(group).glob(".old-*")
            ]
        return [s for s in names if self._old(s).exists() and not self.folder(s).exists()]

    def stored_path(self, path: Path) -> str:
        """Return a user's path as stored in area.toml, with relative paths starting at the area's folder.

        It can then be resolved from any current folder, also after both have been moved together.
        """
        if not path.is_absolute():
            path = Path(os.path.relpath(os.path.abspath(path), os.path.realpath(self.root)))
        return str(path).encode(errors="backslashreplace").decode()

    def write_facts(self, facts: Facts) -> None:
        """Write area.toml if its content changes."""
        if facts != self.facts or not self.facts_path.exists():
            write_facts(self.facts_path, facts)
        self.facts = facts

    def next_area(self) -> Area:
        """Return an area inside this one in which its next version is built before it replaces this one."""
        return Area(self.root / _NEXT)

    def has_unfinished_addition(self) -> bool:
        """Return whether a next version was begun."""
        return (self.root / _NEXT).exists()

    def discard_next(self) -> None:
        """Remove the next version."""
        shutil.rmtree(self.root / _NEXT, ignore_errors=True)

    def replace_by_next(self) -> None:
        """Replace the stages of the map by those of the next version, all or none."""
        (self.root / _NEXT / _READY).touch()
        self._replace_by_next()
        self.facts = read_facts(self.facts_path)

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
    """Return the command that makes a stage."""
    group, _, name = stage.partition("/")
    commands = {
        GEO: "spn-data georegister",
        EVALUATION: f"spn-data register VIDEO --name {name}",
        TRACKED: f"spn-data register --all-frames --name {name}",
        SPLIT: "spn-data split",
    }
    return commands.get(group, "spn-data reconstruct")


def _has_files(path: Path) -> bool:
    return any(p.is_file() and p.name != _STARTED for p in path.rglob("*"))
