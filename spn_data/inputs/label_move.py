"""Labels follow their map into its new place in the world."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from spn_data.area.area import Area
from spn_data.area.names import EVALUATION, POSES, REGISTRATION, TRACKED
from spn_data.geometry.pose import Similarity
from spn_data.inputs.area_labels import (
    read_world_from_model,
)
from spn_data.labels.labels import read_labels, write_labels
from spn_data.storage.json_files import read_json, write_json


def move_labels(area: Area) -> tuple[str, ...]:
    """Bring poses.csv of every sequence to where the map is now; names of the stages that were moved.

    A stage is exchanged whole: its poses always fit its registration.json.
    """
    moved = []
    for group in (EVALUATION, TRACKED):
        for name in area.sequences(group):
            stage = f"{group}/{name}"
            if area.stale_because(stage) is None and _move(area, stage):
                moved.append(stage)
    return tuple(moved)


def _move(area: Area, stage: str) -> bool:
    folder = area.folder(stage)
    registration = read_json(folder / REGISTRATION)
    there = Similarity.from_json(registration["world_from_model"])
    now = read_world_from_model(area)
    if there.to_json() == now.to_json():
        return False
    labels = read_labels(folder / POSES).transformed(now @ there.inverse())
    new = folder.with_name(f".moved-{folder.name}")
    shutil.rmtree(new, ignore_errors=True)
    shutil.copytree(
        folder,
        new,
        copy_function=_link,
        ignore=lambda _, names: {POSES, REGISTRATION} & set(names),
    )
    write_labels(new / POSES, labels)
    write_json(new / REGISTRATION, {**registration, "world_from_model": now.to_json()})
    area.put_in_place(stage, new)
    return True


def _link(source: str, target: str) -> None:
    """One file under two names rather than two files, where the disk allows."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(Path(source), Path(target))
