"""State of an area while commands work in it, from the files that they write anyway; nothing is locked."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Iterable, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import (
    CHECKPOINT,
    COMPARED,
    DATABASE,
    FRAMES,
    GROUPS,
    LOG,
    METRICS,
    MODEL,
    REPORT,
    RUNS,
    SPLIT,
    STAGES,
    STATE,
)
from spn_data.colmap.database_counts import count_progress
from spn_data.colmap.mapping import latest_snapshot
from spn_data.colmap.model_files import read_centers
from spn_data.errors import SpnError
from spn_data.storage.json_files import finite

_MOST_FRAMES = 2000  # drawn; of more, an even selection
_MOST_ROWS = 400  # of a curve
_MOST_FILES = 5000  # looked at to find the latest change
_MOST_RUNS = 50
_MOST_LOG_BYTES = 20_000_000


class LiveState:
    """State of an area at any moment, for a page that is asked for it every few seconds."""

    def __init__(self, area: Area) -> None:
        self._area = area
        self._snapshot: tuple[Path | None, np.ndarray] = (None, np.empty((0, 3)))

    def to_json(self) -> dict[str, Any]:
        """Return the state as plain values (docs/report.md), without NaN."""
        area, now = self._area, time.time()
        at_work = [area, *([area.next_area()] if area.has_unfinished_addition() else [])]
        working = [
            (one, stage) for one in at_work for stage in _stages(one) if one.partial(stage).is_dir()
        ]
        report = area.root / REPORT
        found = {
            "area": str(area.root.resolve()),
            "stages": [_complete(area, stage) for stage in area.stages()],
            "working": [self._working(one, stage, now) for one, stage in working],
            "frames": self._frames(
                [one.partial(stage) for one, stage in working if stage == MODEL]
            ),
            "runs": [_run(area.root / RUNS / name, now) for name in _runs(area)],
            "report_changed_s": report.stat().st_mtime if report.is_file() else None,
        }
        return dict(finite(found))

    def _working(self, area: Area, stage: str, now: float) -> dict[str, Any]:
        folder = area.partial(stage)
        steps: list[tuple[str, int, int]] = []
        if stage == FRAMES:
            steps = [
                ("sources measured", _count(folder.glob(".analysis/*.npz")), 0),
                ("frames written", _count(folder.glob("*/*.jpg")), 0),
            ]
        elif stage == MODEL:
            chosen = area if area.has(FRAMES) else self._area
            total = chosen.record(FRAMES).counts["chosen"] if chosen.has(FRAMES) else 0
            counts = count_progress(folder / DATABASE)
            steps = [
                ("images with features", counts.get("images", 0), total),
                ("pairs matched", counts.get("pairs", 0), 0),
                ("frames registered by the newest attempt", len(self._centers(folder)), total),
            ]
        return {
            "stage": stage,
            "steps": [{"step": name, "done": n, "total": m or None} for name, n, m in steps],
            "changed_s_ago": _seconds_since_change(folder.rglob("*"), now),
        }

    def _centers(self, folder: Path) -> np.ndarray:
        """Return the camera centres of the newest snapshot of a mapping, (N, 3)."""
        tries = sorted(folder.glob("mapping-*/snapshots"), key=lambda f: f.stat().st_mtime)
        newest = latest_snapshot(tries[-1]) if tries else None
        if newest != self._snapshot[0]:
            self._snapshot = (newest, np.empty((0, 3)) if newest is None else read_centers(newest))
        return self._snapshot[1]

    def _frames(self, folders: list[Path]) -> dict[str, Any]:
        """Return where the registered frames are, seen along the direction in which they spread least."""
        centers = np.concatenate([np.empty((0, 3)), *(self._centers(f) for f in folders)])
        chosen = centers[:: max(1, -(-len(centers) // _MOST_FRAMES))]
        chosen = chosen - chosen.mean(axis=0) if len(chosen) else chosen
        axes = (
            np.linalg.svd(chosen, full_matrices=False)[2][:2] if len(chosen) > 1 else np.eye(3)[:2]
        )
        return {"registered": len(centers), "positions": np.round(chosen @ axes.T, 4).tolist()}


def _stages(area: Area) -> list[str]:
    groups = [
        f"{group}/{path.name.removeprefix('.').removesuffix('.partial')}"
        for group in GROUPS
        for path in area.group_folder(group).glob(".*.partial")
    ]
    return [*STAGES, *groups, SPLIT]


def _complete(area: Area, stage: str) -> dict[str, Any]:
    record = area.record(stage)
    return {
        "stage": stage,
        "finished": record.finished,
        "seconds": sum(record.seconds.values()),
        "stale": area.stale_because(stage),
    }


def _runs(area: Area) -> list[str]:
    return [name for name in area.sequences(RUNS) if name != COMPARED][:_MOST_RUNS]


def _run(folder: Path, now: float) -> dict[str, Any]:
    is_trained = (folder / CHECKPOINT).is_file() and not (folder / STATE).is_file()
    try:
        rows = _rows(folder / LOG)
    except (OSError, ValueError, csv.Error) as error:
        return {"run": folder.name, "problem": f"{LOG} cannot be read: {error}"}
    steps = [row for row in rows if row.get("event") == "steps"]
    judged = [row for row in rows if row.get("event") not in ("steps", None)]
    return {
        "run": folder.name,
        "state": "trained" if is_trained else "training, or interrupted",
        "is_evaluated": (folder / METRICS).is_file(),
        "stage": steps[-1]["stage"] if steps else None,
        "stage_done": _number(steps[-1], "progress") if steps else None,
        "images": _number(steps[-1], "images") if steps else None,
        "images_per_s": _number(steps[-1], "images_per_s") if steps else None,
        "loss": [[_minutes(row), _number(row, "loss")] for row in _thinned(steps)],
        "errors": {
            event: [
                [_minutes(row), *(_number(row, name) for name in ("median_m", "median_deg"))]
                for row in _thinned([row for row in judged if row["event"] == event])
            ]
            for event in sorted({row["event"] for row in judged})
        },
        "changed_s_ago": _seconds_since_change([folder / LOG], now),
    }


def _rows(path: Path) -> list[dict[str, str]]:
    """Read the complete rows of log.csv; the last one may be in the making."""
    if not path.is_file():
        return []
    with path.open("rb") as file:
        data = file.read(_MOST_LOG_BYTES)
    text = data[: data.rfind(b"\n") + 1].decode()
    return list(csv.DictReader(io.StringIO(text, newline=""), strict=True))


def _thinned(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """Return an even selection of rows that holds the last one."""
    step = max(1, -(-len(rows) // _MOST_ROWS))
    return rows[::-1][::step][::-1]


def _minutes(row: Mapping[str, str]) -> float | None:
    seconds = _number(row, "train_s")
    return None if seconds is None else seconds / 60


def _number(row: Mapping[str, str], name: str) -> float | None:
    """Return a cell as a number; None if it is empty, missing, infinite or no number."""
    try:
        return finite(float(row.get(name) or "nan"))
    except ValueError:
        return None


def _count(paths: Iterable[Path]) -> int:
    return sum(1 for _ in paths)


def _seconds_since_change(paths: Iterable[Path], now: float) -> float | None:
    """Return how long ago the newest of the files was written; None if there is none."""
    times = []
    try:
        for path in islice(paths, _MOST_FILES):
            times.append(path.stat().st_mtime)
    except OSError:  # removed or renamed meanwhile
        pass
    return max(0.0, round(now - max(times), 1)) if times else None


def read_state(state: LiveState) -> dict[str, Any]:
    """Return the state, or why it cannot be read at this moment, such as while a stage is put in place."""
    try:
        return state.to_json()
    except (SpnError, OSError, ValueError) as error:
        return {"problem": f"the state cannot be read now: {error}"}
