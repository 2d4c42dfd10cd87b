"""Removal of what a process left that was killed while it replaced a stage."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path

_OLD, _MOVED = ".old-", ".moved-"


def remove_leftovers(root: Path, stages: Iterable[str], groups: Iterable[Path]) -> None:
    """Remove earlier versions of stages whose present version is in place, and unfinished copies of labels.

    Only the process that holds the lock of the area may call it.

    Parameters
    ----------
    root : Path
        The area's folder.
    stages : iterable of str
        Names of the stages in it.
    groups : iterable of Path
        Folders of the groups, whose folders are stages.
    """
    old = [root / f"{_OLD}{name}" for name in stages]
    for group in groups:
        old += group.glob(f"{_OLD}*")
        for unfinished in group.glob(f"{_MOVED}*"):
            shutil.rmtree(unfinished, ignore_errors=True)
    for folder in old:
        if folder.is_dir() and folder.with_name(folder.name.removeprefix(_OLD)).is_dir():
            shutil.rmtree(folder, ignore_errors=True)
