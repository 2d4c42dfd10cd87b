"""The evidence for an audit, gathered from the area; audit.json."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import (
    CAMBRIDGE,
    DATASET,
    EVALUATION,
    FRAMES,
    MODEL,
    REGISTRATION,
    SPLIT,
    SPLIT_FILE,
    TRACKED,
)
from spn_data.colmap.model import read_scene
from spn_data.dataset.cambridge import NVM, read_cambridge
from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.nvm import read_nvm
from spn_data.errors import FormatError, SpnError
from spn_data.inputs.area_labels import LabelledArea, read_labelled_area
from spn_data.inputs.cambridge_contents import image_name, list_file
from spn_data.labels.labels import Labels
from spn_data.labels.map_hash import map_hash
from spn_data.split.audit import (
    AuditFinding,
    AuditVerdict,
    MapHashes,
    check_blocks,
    check_duplicates,
    check_gap,
    check_map_unchanged,
    check_not_in_map,
    check_revisits,
    check_test_independence,
    check_training_marks,
    check_training_points,
    check_up_to_date,
)
from spn_data.split.audit_files import (
    PoseList,
    check_cambridge,
    check_completeness,
    check_dataset,
    check_labels,
    check_nvm_measurements,
)
from spn_data.split.groups import TRAIN, Split
from spn_data.split.split_file import read_split
from spn_data.storage.json_files import VERSION, read_json, write_json


def audit(area: Area) -> tuple[AuditFinding, ...]:
    """Check the area's split as it lies on the disk. Raises StageError where there is none."""
    area.record(SPLIT)
    return (
        check_up_to_date(area.stale_because(SPLIT)),
        *audit_folder(area, read_labelled_area(area), area.folder(SPLIT)),
    )


def audit_folder(area: Area, labelled: LabelledArea, folder: Path) -> tuple[AuditFinding, ...]:
    """Check a split in a folder against the area's labels."""
    split = read_split(folder / SPLIT_FILE)
    parts = {"mapping": labelled.mapping, "tracked": labelled.tracked, **labelled.evaluation}
    covered = check_completeness(parts, split)
    findings = [
        _check_not_in_map(area, labelled),
        *_check_duplicates(labelled),
        _check_map_unchanged(area),
        check_labels(parts),
        covered,
        check_test_independence(split),
    ]
    if (
        covered.verdict is AuditVerdict.FAIL
    ):  # groups of frames that it does not know cannot be judged
        return tuple(findings)
    flights = Labels.concatenate([labelled.mapping, labelled.tracked])
    flights = flights.select(flights.registered)
    findings += [
        check_blocks(flights, split),
        check_gap(flights, split),
        check_revisits(flights, split),
        *_check_files(folder, labelled, split, parts),
    ]
    return tuple(findings)


def _check_not_in_map(area: Area, labelled: LabelledArea) -> AuditFinding:
    names = read_scene(area.folder(MODEL)).names
    return check_not_in_map(
        names,
        _sources(area, FRAMES),
        labelled.evaluation,
        {name: _sources(area, f"{EVALUATION}/{name}") for name in labelled.evaluation},
    )


def _check_duplicates(labelled: LabelledArea) -> list[AuditFinding]:
    """Only where lengths are metres and there is something to compare."""
    if labelled.units != "m" or not labelled.evaluation:
        return []
    mapping = Labels.concatenate([labelled.mapping, labelled.tracked])
    return [check_duplicates(mapping, labelled.evaluation)]


def _sources(area: Area, stage: str) -> dict[str, str]:
    """Content fingerprint of each file that a stage was made from; a mask may serve several."""
    inputs = area.record(stage).inputs
    return {name: value for name, value in inputs.items() if not name.endswith("/mask")}


def _check_files(
    folder: Path, labelled: LabelledArea, split: Split, parts: dict[str, Labels]
) -> list[AuditFinding]:
    check = "files readable"
    try:
        with Dataset(folder / DATASET) as dataset:
            lists = {
                name: PoseList(tuple(group.names.tolist()), group.poses)
                for name, group in dataset.groups.items()
            }
            tracked = {name: group.tracked for name, group in dataset.groups.items()}
            marks = {name: g.points_for_training for name, g in dataset.groups.items()}
            given = _point_ids(dataset)
        findings = [
            check_dataset(lists, parts, split),
            check_training_points(given, labelled.mapping, labelled.mapping_seen, split),
            check_training_marks(marks),
        ]
        if (folder / CAMBRIDGE).is_dir():
            findings += _check_cambridge(folder / CAMBRIDGE, lists, tracked, split)
    except SpnError as error:
        return [
            AuditFinding(
                check, AuditVerdict.FAIL, "a file of the split cannot be read", (str(error),)
            )
        ]
    return findings


def _point_ids(dataset: Dataset) -> np.ndarray:
    """Ids of all points that the training group gives."""
    if TRAIN not in dataset.groups:
        return np.zeros(0, np.int64)
    group = dataset.groups[TRAIN]
    ids = [np.unique(group.points(row).ids) for row in range(len(group))]
    return np.unique(np.concatenate([np.zeros(0, np.int64), *ids]))


def _check_cambridge(
    folder: Path, stored: dict[str, PoseList], tracked: dict[str, np.ndarray], split: Split
) -> list[AuditFinding]:
    """Lists hold every chosen frame of the data set; tracked ones are in all lists or in none."""
    files = sorted(path.name for path in folder.glob("dataset_*.txt"))
    lists = {file: read_cambridge(folder / file) for file in files}
    found = {file: PoseList(each.names, each.poses) for file, each in lists.items()}
    known = {name for each in lists.values() for name in each.names}
    with_tracked = any(
        image_name(name) in known
        for group, each in stored.items()
        for name in np.array(each.names)[tracked[group]].tolist()
    )
    wanted: dict[str, PoseList] = {}
    for group, each in sorted(stored.items()):
        kept = each.select(np.flatnonzero(~tracked[group] | with_tracked))
        file = list_file(group)
        wanted[file] = kept if file not in wanted else wanted[file].appended(kept)
    model = read_nvm(folder / NVM)
    measured = [model.names[k] for k in np.unique(model.image_idx)]
    return [check_cambridge(found, wanted), check_nvm_measurements(measured, split)]


def _check_map_unchanged(area: Area) -> AuditFinding:
    """Each sequence's stage noted the map's hash before and after it was registered."""
    at: dict[str, MapHashes] = {}
    for group in (EVALUATION, TRACKED):
        for name in area.sequences(group):
            path = area.folder(f"{group}/{name}") / REGISTRATION
            noted = read_json(path)
            try:
                at[f"{group}/{name}"] = MapHashes(str(noted["map_before"]), str(noted["map_after"]))
            except KeyError as error:
                raise FormatError(f"{path}: does not state {error}") from error
    return check_map_unchanged(map_hash(area.folder(MODEL)), at)


def write_audit(path: Path, findings: tuple[AuditFinding, ...]) -> None:
    """audit.json: findings in the order in which they were checked."""
    table = [{**asdict(f), "verdict": f.verdict.value} for f in findings]
    write_json(path, {"version": VERSION, "findings": table})


def read_audit(path: Path) -> tuple[AuditFinding, ...]:
    """Raises FormatError where it is not what `write_audit` writes."""
    table = read_json(path)
    try:
        return tuple(
            AuditFinding(
                str(f["check"]),
                AuditVerdict(f["verdict"]),
                str(f["text"]),
                tuple(str(line) for line in f["evidence"]),
            )
            for f in table["findings"]
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{path}: is no audit of this program ({error!r})") from error
