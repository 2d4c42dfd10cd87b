"""Audit of a split, with evidence from the area; audit.json."""

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
from spn_data.dataset.hdf5_schema import Role
from spn_data.dataset.image_copies import ImageChecks
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
    make_finding,
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
from spn_data.storage.json_files import DAMAGE, VERSION, read_json, write_json


def audit(area: Area) -> tuple[AuditFinding, ...]:
    """Check the split of an area as stored on disk.

    Parameters
    ----------
    area : Area

    Returns
    -------
    tuple of AuditFinding

    Raises
    ------
    StageError
        If there is no split, or a stage is stale.
    """
    area.record(SPLIT)
    return (
        check_up_to_date(area.stale_because(SPLIT)),
        *audit_folder(area, read_labelled_area(area), area.folder(SPLIT)),
    )


def audit_folder(area: Area, labelled: LabelledArea, folder: Path) -> tuple[AuditFinding, ...]:
    """Check a split in a folder against the labels of the area."""
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
    if covered.verdict is AuditVerdict.FAIL:  # frames without a group cannot be checked further
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
    """Compare mapping and evaluation frames, if the map is in metres and there are both."""
    if labelled.units != "m" or not labelled.evaluation:
        return []
    mapping = Labels.concatenate([labelled.mapping, labelled.tracked])
    return [check_duplicates(mapping, labelled.evaluation)]


def _sources(area: Area, stage: str) -> dict[str, str]:
    """Return the content fingerprint of each source file of a stage; masks may be shared by several."""
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
            point_ids = _point_ids(dataset)
            copies = _check_images(dataset)
        findings = [
            copies,
            check_dataset(lists, parts, split),
            check_training_points(point_ids, labelled.mapping, labelled.mapping_seen, split),
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


def _check_images(dataset: Dataset) -> AuditFinding:
    """Check that no held-out image has the pixels of a training image; similar ones are a notice."""
    check = "no copy of a training image"
    checks, copies = ImageChecks(), []
    for role in (Role.TRAIN, Role.VALIDATION, Role.TEST):
        for group in dataset.of_role(role) if dataset.info.has_images else ():
            for row, name in enumerate(group.names.tolist()):
                other = checks.add(name, role, group.image(row))
                copies += [f"{name} ({group.name}) has the pixels of {other}"] if other else []
    if not copies and (alike := checks.lookalikes()):
        return AuditFinding(
            check,
            AuditVerdict.NOTICE,
            f"{len(alike)} held-out images look the same as a training image: the camera did not move, or "
            "they are copies that were compressed again",
            tuple(f"{name} looks the same as {other}" for name, other in alike),
        )
    return make_finding(
        check,
        copies,
        "no validation or test image looks the same as a training image",
        "held-out images are copies of training images",
    )


def _point_ids(dataset: Dataset) -> np.ndarray:
    """Return the ids of all map points in the training group."""
    if TRAIN not in dataset.groups:
        return np.zeros(0, np.int64)
    group = dataset.groups[TRAIN]
    ids = [np.unique(group.points(row).ids) for row in range(len(group))]
    return np.unique(np.concatenate([np.zeros(0, np.int64), *ids]))


def _check_cambridge(
    folder: Path, stored: dict[str, PoseList], tracked: dict[str, np.ndarray], split: Split
) -> list[AuditFinding]:
    """Check that the lists contain all chosen frames of the data set, and all tracked frames or none."""
    files = sorted(path.name for path in folder.glob("dataset_*.txt"))
    lists = {file: read_cambridge(folder / file) for file in files}
    listed = {file: PoseList(each.names, each.poses) for file, each in lists.items()}
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
    return [check_cambridge(listed, wanted), check_nvm_measurements(measured, split)]


def _check_map_unchanged(area: Area) -> AuditFinding:
    """Compare the map with its hashes recorded before and after each sequence was registered."""
    hashes: dict[str, MapHashes] = {}
    for group in (EVALUATION, TRACKED):
        for name in area.sequences(group):
            path = area.folder(f"{group}/{name}") / REGISTRATION
            recorded = read_json(path)
            before, after = recorded.get("map_before"), recorded.get("map_after")
            if not (isinstance(before, str) and isinstance(after, str)):
                raise FormatError(f"{path}: does not state the hashes of the map")
            hashes[f"{group}/{name}"] = MapHashes(before, after)
    return check_map_unchanged(map_hash(area.folder(MODEL)), hashes)


def write_audit(path: Path, findings: tuple[AuditFinding, ...]) -> None:
    """Write audit.json, with the findings in the order of the checks."""
    table = [{**asdict(f), "verdict": f.verdict.value} for f in findings]
    write_json(path, {"version": VERSION, "findings": table})


def read_audit(path: Path) -> tuple[AuditFinding, ...]:
    """Read audit.json; raise FormatError if it is not what `write_audit` writes."""
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
    except DAMAGE as error:
        raise FormatError(f"{path}: is not an audit written by this program ({error!r})") from error
