"""Transformation of labels after their map was georegistered again."""

from __future__ import annotations

import shutil
from pathlib import Path

from spn_data.area.area import Area
from spn_data.area.names import EVALUATION, POSES, REGISTRATION, TRACKED
from spn_data.inputs.area_labels import read_world_from_model, read_written_world
from spn_data.inputs.file_links import link_or_copy
from spn_data.labels.labels import read_labels, write_labels
from spn_data.storage.json_files import read_json, write_json


def move_labels(area: Area) -> tuple[str, ...]:
    """Transform poses.csv of each sequence into the present world frame of the map.

    A stage is replaced as a whole, so that its poses always match its registration.json.

    Parameters
    ----------
    area : Area

    Returns
    -------
    tuple of str
        Names of the stages that changed.
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
    before = read_written_world(folder / REGISTRATION)
    now = read_world_from_model(area)
    if before.to_json() == now.to_json():
        return False
    labels = read_labels(folder / POSES).transformed(now @ before.inverse())
    new = folder.with_name(f".moved-{folder.name}")
    shutil.rmtree(new, ignore_errors=True)
    shutil.copytree(
        folder,
        new,
        copy_function=lambda source, target: link_or_copy(Path(source), Path(target)),
        ignore=lambda _, names: {POSES, REGISTRATION} & set(names),
    )
    write_labels(new / POSES, labels)
    write_json(new / REGISTRATION, {**registration, "world_from_model": now.to_json()})
    area.put_in_place(stage, new)
    return True
