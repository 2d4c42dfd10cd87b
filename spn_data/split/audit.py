"""Leakage checks of a split: training, validation and test frames, map points, and the map itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.spatial import cKDTree

from spn_data.geometry.rotations import rotation_errors_deg
from spn_data.labels.labels import LabelObservations, Labels
from spn_data.split.groups import (
    OPTIMISTIC,
    SLACK,
    TEST,
    TRAIN,
    VALIDATION,
    Split,
    seconds_to_held_out,
)

REVISIT_M, REVISIT_DEG = 1.0, 10.0
COPY_M, COPY_DEG = 0.05, 0.5
_COPY_FRAMES, _COPY_SHARE = 3, 0.05
_COPIES = "no copy of a mapping flight"
_NOT_IN_MAP = "no evaluation frame in the map"
# Minimum number of training frames that must see a point for it to be used in training.
MIN_TRAINING_VIEWS = 2


class AuditVerdict(StrEnum):
    """Verdict of a check. A notice is not a failure, but the user should know about it."""

    PASS = "pass"
    FAIL = "fail"
    NOTICE = "notice"


@dataclass(frozen=True)
class AuditFinding:
    """Result of one check.

    Attributes
    ----------
    check : str
        Name of the check.
    verdict : AuditVerdict
        Verdict.
    text : str
        What was found, in one sentence.
    evidence : tuple of str
        Evidence, one line each.
    """

    check: str
    verdict: AuditVerdict
    text: str
    evidence: tuple[str, ...] = ()


@dataclass(frozen=True)
class MapHashes:
    """Hashes of the map before and after a sequence was registered in it."""

    before: str
    after: str


def make_finding(check: str, bad: Sequence[str], good_text: str, bad_text: str) -> AuditFinding:
    """Return a failure with `bad` as evidence, or a pass if `bad` is empty."""
    if bad:
        return AuditFinding(check, AuditVerdict.FAIL, bad_text, tuple(bad))
    return AuditFinding(check, AuditVerdict.PASS, good_text)


def check_not_in_map(
    map_names: Sequence[str],
    mapping_sources: Mapping[str, str],
    evaluation: Mapping[str, Labels],
    evaluation_sources: Mapping[str, Mapping[str, str]],
) -> AuditFinding:
    """Check (a) that no evaluation frame is in the map and no evaluation file was used for mapping.

    Parameters
    ----------
    map_names : sequence of str
        Images of the model.
    mapping_sources : mapping of str to str
        Content fingerprint by file of the mapping flights, as recorded by the stages.
    evaluation : mapping of str to Labels
        Labels by evaluation sequence.
    evaluation_sources : mapping of str to mapping
        Content fingerprint by file, by evaluation sequence.

    Returns
    -------
    AuditFinding
        Finding of the check.
    """
    in_map = set(map_names)
    mapped = {fingerprint: name for name, fingerprint in mapping_sources.items()}
    bad = []
    for sequence, labels in evaluation.items():
        bad += [
            f"{name} is an image of the map" for name in labels.names.tolist() if name in in_map
        ]
        for file, fingerprint in evaluation_sources.get(sequence, {}).items():
            if fingerprint in mapped:
                bad.append(f"{sequence}: {file} is the mapping source {mapped[fingerprint]}")
        if sequence not in evaluation_sources:
            bad.append(f"{sequence}: its source files are not recorded")
    frames = sum(len(labels) for labels in evaluation.values())
    if not evaluation:
        return AuditFinding(_NOT_IN_MAP, AuditVerdict.PASS, "there is no evaluation sequence")
    return make_finding(
        _NOT_IN_MAP,
        bad,
        f"none of {frames} evaluation frames is among the map's {len(in_map)} images or from its sources",
        "the map contains data it is to be tested on",
    )


def check_duplicates(mapping: Labels, evaluation: Mapping[str, Labels]) -> AuditFinding:
    """Check (a) that no evaluation sequence is a re-encoded mapping flight, which fingerprints cannot detect.

    Frames of two different flights do not repeatedly coincide within centimetres and fractions of a degree.
    """
    mapped = mapping.poses[mapping.registered]
    tree = cKDTree(mapped.centers)
    suspects = []
    for sequence, labels in evaluation.items():
        poses = labels.poses[labels.registered]
        apart_m, nearest = tree.query(poses.centers)
        turned_deg = rotation_errors_deg(poses.quats_wxyz, mapped.quats_wxyz[nearest])
        same = int(((apart_m <= COPY_M) & (turned_deg <= COPY_DEG)).sum())
        if same >= max(_COPY_FRAMES, _COPY_SHARE * len(poses)):
            suspects.append(f"{sequence}: {same} of {len(poses)} frames")
    near_text = f"within {COPY_M * 100:g} cm and {COPY_DEG:g} deg of a mapping frame"
    if not suspects:
        return AuditFinding(_COPIES, AuditVerdict.PASS, f"no sequence is repeatedly {near_text}")
    return AuditFinding(
        _COPIES,
        AuditVerdict.NOTICE,
        f"frames are {near_text}: this may be a mapping flight under another name, cut or re-encoded",
        tuple(suspects),
    )


def check_map_unchanged(now: str, registrations: Mapping[str, MapHashes]) -> AuditFinding:
    """Check that the map is bit for bit the one every sequence was registered in.

    Parameters
    ----------
    now : str
        Current hash of the map.
    registrations : mapping of str to MapHashes
        Hashes recorded at registration, by sequence.

    Returns
    -------
    AuditFinding
        Finding of the check.
    """
    bad = []
    for sequence, at in registrations.items():
        if at.before != at.after:
            bad.append(f"{sequence}: {at.before} before its registration, {at.after} after")
        elif at.after != now:
            bad.append(f"{sequence}: {at.after} at its registration, {now} now")
    return make_finding(
        "map unchanged",
        bad,
        f"the map's hash is {now[:16]}…, as before and after each of {len(registrations)} registrations"
        if registrations
        else "no sequence was registered in the map",
        "the map is not the one that the sequences were registered in",
    )


def check_blocks(labels: Labels, split: Split) -> AuditFinding:
    """Check (b) that chosen and tracked frames of the mapping flights (`labels`) obey the same blocks."""
    group = split.groups_of(labels.names)
    wrong = np.zeros(len(labels), dtype=bool)
    for block in split.blocks:
        wrong |= block.contains(labels) & (group == TRAIN)
    unblocked = np.isin(group, (VALIDATION, TEST))
    for block in split.blocks:
        unblocked &= ~(block.contains(labels) & (group == block.group))
    return make_finding(
        "chosen and tracked frames obey the blocks",
        [f"{name} is a training frame inside a held-out block" for name in labels.names[wrong]]
        + [f"{name} is held out but in no block" for name in labels.names[unblocked]],
        f"{len(split.blocks)} blocks contain {int(np.isin(group, (VALIDATION, TEST)).sum())} frames, "
        "none of them used for training",
        "frames and held-out blocks disagree",
    )


def check_gap(labels: Labels, split: Split) -> AuditFinding:
    """Check (b) that no training frame is nearer than the gap to a held-out frame of its sequence."""
    group, gap_s = split.groups_of(labels.names), split.options.gap_s
    held = np.isin(group, (VALIDATION, TEST))
    apart = np.where(group == TRAIN, seconds_to_held_out(labels, held), np.inf)
    near = apart < gap_s - SLACK
    nearest = float(apart.min()) if len(apart) else float("inf")
    nearest_text = f"; the nearest is {nearest:.3f} s away" if np.isfinite(nearest) else ""
    return make_finding(
        "guard gap",
        [
            f"{labels.names[k]} is {apart[k]:.3f} s from a held-out frame"
            for k in np.flatnonzero(near)
        ],
        f"no training frame is nearer than {gap_s:g} s to a held-out frame of its sequence"
        f"{nearest_text}",
        f"training frames are nearer than {gap_s:g} s to a held-out frame",
    )


def check_revisits(labels: Labels, split: Split) -> AuditFinding:
    """List (b) for each held-out frame the nearest training frame within 1 m and 10 degrees."""
    check = "revisits"
    group = split.groups_of(labels.names)
    held = np.flatnonzero(np.isin(group, (VALIDATION, TEST)))
    trained = np.flatnonzero(group == TRAIN)
    if not len(held) or not len(trained):
        return AuditFinding(check, AuditVerdict.PASS, "no frame of the mapping flights is held out")
    centers = labels.poses.centers
    tree = cKDTree(centers[trained])
    listed = []
    for row, near in zip(held, tree.query_ball_point(centers[held], REVISIT_M), strict=True):
        if not near:
            continue
        rows = trained[np.array(near)]
        turned_deg = rotation_errors_deg(
            labels.poses.quats_wxyz[rows], labels.poses.quats_wxyz[row]
        )
        apart_m = np.linalg.norm(centers[rows] - centers[row], axis=1)
        alike = turned_deg <= REVISIT_DEG
        if alike.any():
            k = int(np.argmin(np.where(alike, apart_m, np.inf)))
            listed.append(
                f"{labels.names[row]} ({group[row]}) and {labels.names[rows[k]]} (train): "
                f"{apart_m[k]:.2f} m, {turned_deg[k]:.1f} deg"
            )
    near_text = f"within {REVISIT_M:g} m and {REVISIT_DEG:g} deg of a training frame"
    if not listed:
        return AuditFinding(
            check, AuditVerdict.PASS, f"none of {len(held)} held-out frames is {near_text}"
        )
    return AuditFinding(
        check,
        AuditVerdict.NOTICE,
        f"{len(listed)} of {len(held)} held-out frames are {near_text}: the flight returned to that place",
        tuple(listed),
    )


def training_points(labels: Labels, seen: LabelObservations, split: Split) -> np.ndarray:
    """Return the sorted ids of map points seen by at least two chosen training frames.

    Parameters
    ----------
    labels : Labels
        Labels of the chosen frames of the mapping flights.
    seen : LabelObservations
        Observations of map points in those frames, which are the tracks the points were triangulated from.
    split : Split
        The split.

    Returns
    -------
    ndarray of int, shape (K,)
        Point ids in ascending order.

    Notes
    -----
    The position of a point that only one training frame sees was determined by held-out frames.
    """
    trained = split.groups_of(labels.names) == TRAIN
    pairs = np.column_stack([seen.point_ids, seen.frame_idx])[trained[seen.frame_idx]]
    ids, views = np.unique(np.unique(pairs, axis=0)[:, 0], return_counts=True)
    return np.asarray(ids[views >= MIN_TRAINING_VIEWS])


def check_training_points(
    given: np.ndarray, labels: Labels, seen: LabelObservations, split: Split
) -> AuditFinding:
    """Check (c) that points provided for training (ids `given`) are seen by at least two training frames."""
    unseen = np.setdiff1d(given, training_points(labels, seen, split))
    return make_finding(
        "points for training",
        [f"point {k} is seen by fewer than {MIN_TRAINING_VIEWS} training frames" for k in unseen],
        f"all {len(np.unique(given))} points provided for training are seen by at least "
        f"{MIN_TRAINING_VIEWS} training frames",
        "points provided for training depend on held-out frames",
    )


def check_training_marks(for_training: Mapping[str, bool]) -> AuditFinding:
    """Check (d) that only points of group train are marked for training; `for_training`: mark by group."""
    bad = [
        f"points of group {name} are marked for training"
        for name in sorted(for_training)
        if for_training[name] and name != TRAIN
    ]
    if not for_training.get(TRAIN, False):
        bad.append("points of group train are not marked for training")
    others = ", ".join(name for name in for_training if name != TRAIN) or "no other group"
    return make_finding(
        "points marked not for training",
        bad,
        f"points of {others} are marked not for training",
        "points are marked incorrectly",
    )


def check_test_independence(split: Split) -> AuditFinding:
    """Check whether the test frames come from a different flight than the training frames."""
    check = "test apart from training"
    if split.optimistic:
        return AuditFinding(check, AuditVerdict.NOTICE, OPTIMISTIC)
    tests = ", ".join(name for name in split.groups() if name not in (TRAIN, VALIDATION))
    return AuditFinding(
        check, AuditVerdict.PASS, f"test frames come from separate evaluation sequences: {tests}"
    )


def check_up_to_date(reason: str | None) -> AuditFinding:
    """Check that the split was made from the current state of the area; `reason` states why it was not."""
    return make_finding(
        "up to date",
        [] if reason is None else [reason],
        "the split was made from the current state of the area",
        "the split is stale; run spn-data split again",
    )


def has_failed(findings: Sequence[AuditFinding]) -> bool:
    """Return whether any finding is a failure."""
    return any(finding.verdict is AuditVerdict.FAIL for finding in findings)
