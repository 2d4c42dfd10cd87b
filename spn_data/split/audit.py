"""Whether a data set keeps what it promises: each promise is checked, with the evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.spatial import cKDTree

from spn_data.geometry.pose import rotation_errors_deg
from spn_data.labels.labels import LabelObservations, Labels
from spn_data.split.groups import (
    OPTIMISTIC,
    SLACK,
    TEST,
    TRAIN,
    VALIDATION,
    Split,
    seconds_apart,
)

REVISIT_M, REVISIT_DEG = 1.0, 10.0
COPY_M, COPY_DEG = 0.05, 0.5
_COPY_FRAMES, _COPY_SHARE = 3, 0.05
_COPIES = "no copy of a mapping flight"
_NOT_IN_MAP = "no evaluation frame in the map"
# Views of a point by training frames from which on it may be given for training.
MIN_TRAINING_VIEWS = 2


class AuditVerdict(StrEnum):
    """What a check found. A notice is no fault; the user should know it."""

    PASS = "pass"
    FAIL = "fail"
    NOTICE = "notice"


@dataclass(frozen=True)
class AuditFinding:
    """One check: its name, what it found in a sentence, and the evidence (one line each)."""

    check: str
    verdict: AuditVerdict
    text: str
    evidence: tuple[str, ...] = ()


@dataclass(frozen=True)
class MapHashes:
    """Hash of the map before and after a sequence was registered in it."""

    before: str
    after: str


def finding_of(check: str, bad: Sequence[str], good_text: str, bad_text: str) -> AuditFinding:
    """Failed where there is anything bad, with that as evidence."""
    if bad:
        return AuditFinding(check, AuditVerdict.FAIL, bad_text, tuple(bad))
    return AuditFinding(check, AuditVerdict.PASS, good_text)


def check_not_in_map(
    map_names: Sequence[str],
    mapping_sources: Mapping[str, str],
    evaluation: Mapping[str, Labels],
    evaluation_sources: Mapping[str, Mapping[str, str]],
) -> AuditFinding:
    """(a) No evaluation frame is in the map, and no file of an evaluation sequence was mapped.

    map_names : images of the model; mapping_sources, evaluation_sources[sequence] : content fingerprint by
    file, as the stages recorded them.
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
            bad.append(f"{sequence}: its source is not recorded")
    frames = sum(len(labels) for labels in evaluation.values())
    if not evaluation:
        return AuditFinding(_NOT_IN_MAP, AuditVerdict.PASS, "there is no evaluation sequence")
    return finding_of(
        _NOT_IN_MAP,
        bad,
        f"none of {frames} evaluation frames is among the map's {len(in_map)} images or from its sources",
        "the map has seen what it is to be tested on",
    )


def check_copies(mapping: Labels, evaluation: Mapping[str, Labels]) -> AuditFinding:
    """(a) No evaluation sequence looks like a mapping flight itself, encoded anew: that no fingerprint tells.

    Two flights do not meet within centimetres and fractions of a degree, again and again.
    """
    here = mapping.poses[mapping.registered]
    tree = cKDTree(here.centers)
    suspects = []
    for sequence, labels in evaluation.items():
        poses = labels.poses[labels.registered]
        apart_m, nearest = tree.query(poses.centers)
        turned_deg = rotation_errors_deg(poses.quats_wxyz, here.quats_wxyz[nearest])
        same = int(((apart_m <= COPY_M) & (turned_deg <= COPY_DEG)).sum())
        if same >= max(_COPY_FRAMES, _COPY_SHARE * len(poses)):
            suspects.append(f"{sequence}: {same} of {len(poses)} frames")
    meet = f"within {COPY_M * 100:g} cm and {COPY_DEG:g} deg of a mapping frame"
    if not suspects:
        return AuditFinding(_COPIES, AuditVerdict.PASS, f"no sequence lies again and again {meet}")
    return AuditFinding(
        _COPIES,
        AuditVerdict.NOTICE,
        f"frames lie {meet}: is it a mapping flight under another name, cut or encoded anew?",
        tuple(suspects),
    )


def check_map_unchanged(now: str, registrations: Mapping[str, MapHashes]) -> AuditFinding:
    """The map is, bit for bit, the one that every sequence was registered in."""
    bad = []
    for sequence, at in registrations.items():
        if at.before != at.after:
            bad.append(f"{sequence}: {at.before} before its registration, {at.after} after")
        elif at.after != now:
            bad.append(f"{sequence}: {at.after} at its registration, {now} now")
    return finding_of(
        "map unchanged",
        bad,
        f"its hash is {now[:16]}…, as before and after each of {len(registrations)} registrations"
        if registrations
        else "nothing was registered in it",
        "the map is not the one that sequences were registered in",
    )


def check_blocks(labels: Labels, split: Split) -> AuditFinding:
    """(b) Chosen and tracked frames obey the same blocks. labels : of the mapping flights."""
    group = split.of(labels.names)
    wrong = np.zeros(len(labels), dtype=bool)
    for block in split.blocks:
        wrong |= block.holds(labels) & (group == TRAIN)
    unblocked = np.isin(group, (VALIDATION, TEST))
    for block in split.blocks:
        unblocked &= ~(block.holds(labels) & (group == block.group))
    return finding_of(
        "chosen and tracked frames obey the blocks",
        [f"{name} trains and lies in a held-out block" for name in labels.names[wrong]]
        + [f"{name} is held out and lies in no block" for name in labels.names[unblocked]],
        f"{len(split.blocks)} blocks hold {int(np.isin(group, (VALIDATION, TEST)).sum())} frames, "
        "none of which trains",
        "frames are on the wrong side of a block",
    )


def check_gap(labels: Labels, split: Split) -> AuditFinding:
    """(b) No training frame is nearer to a held-out frame of its sequence than the gap."""
    group, gap_s = split.of(labels.names), split.options.gap_s
    held = np.isin(group, (VALIDATION, TEST))
    apart = np.where(group == TRAIN, seconds_apart(labels, held), np.inf)
    near = apart < gap_s - SLACK
    nearest = float(apart.min()) if len(apart) else float("inf")
    told = f"; the nearest is {nearest:.3f} s away" if np.isfinite(nearest) else ""
    return finding_of(
        "guard gap",
        [
            f"{labels.names[k]} is {apart[k]:.3f} s from a held-out frame"
            for k in np.flatnonzero(near)
        ],
        f"no training frame is nearer than {gap_s:g} s to a held-out frame of its sequence{told}",
        f"training frames lie within {gap_s:g} s of a held-out frame",
    )


def check_revisits(labels: Labels, split: Split) -> AuditFinding:
    """(b) Lists training frames within 1 m and 10 degrees of a held-out frame, the nearest of each."""
    check = "revisits"
    group = split.of(labels.names)
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
            check, AuditVerdict.PASS, f"none of {len(held)} held-out frames lies {near_text}"
        )
    return AuditFinding(
        check,
        AuditVerdict.NOTICE,
        f"{len(listed)} of {len(held)} held-out frames lie {near_text}: the flight came back there",
        tuple(listed),
    )


def training_points(labels: Labels, seen: LabelObservations, split: Split) -> np.ndarray:
    """Ids, ascending, of map points that at least two chosen training frames see.

    labels, seen : the chosen frames of the mapping flights, whose tracks made the points. A point that only
    one of them sees owes its place to frames that are held out.
    """
    trained = split.of(labels.names) == TRAIN
    pairs = np.column_stack([seen.point_ids, seen.frame_idx])[trained[seen.frame_idx]]
    ids, views = np.unique(np.unique(pairs, axis=0)[:, 0], return_counts=True)
    return np.asarray(ids[views >= MIN_TRAINING_VIEWS])


def check_training_points(
    given: np.ndarray, labels: Labels, seen: LabelObservations, split: Split
) -> AuditFinding:
    """(c) Points given for training are seen by at least two training frames. given : their ids."""
    unseen = np.setdiff1d(given, training_points(labels, seen, split))
    return finding_of(
        "points for training",
        [f"point {k} is seen by fewer than {MIN_TRAINING_VIEWS} training frames" for k in unseen],
        f"all {len(np.unique(given))} points given for training are seen by at least "
        f"{MIN_TRAINING_VIEWS} training frames",
        "points were given for training that held-out frames made",
    )


def check_marks(for_training: Mapping[str, bool]) -> AuditFinding:
    """(d) Points of no group but train are marked for training. for_training : mark by group."""
    bad = [
        f"points of group {name} are marked for training"
        for name in sorted(for_training)
        if for_training[name] and name != TRAIN
    ]
    if not for_training.get(TRAIN, False):
        bad.append("points of group train are not marked for training")
    others = ", ".join(name for name in for_training if name != TRAIN) or "no other group"
    return finding_of(
        "points marked not for training",
        bad,
        f"points of {others} are marked not for training",
        "points carry the wrong mark",
    )


def check_test_is_apart(split: Split) -> AuditFinding:
    """Whether the test frames are of another flight than the training frames."""
    check = "test apart from training"
    if split.optimistic:
        return AuditFinding(check, AuditVerdict.NOTICE, OPTIMISTIC)
    tests = ", ".join(name for name in split.groups() if name not in (TRAIN, VALIDATION))
    return AuditFinding(check, AuditVerdict.PASS, f"evaluation sequences of their own: {tests}")


def check_fresh(reason: str | None) -> AuditFinding:
    """The split is made from the area as it is now. reason : why not."""
    return finding_of(
        "up to date",
        [] if reason is None else [reason],
        "the split was made from the area as it is",
        "the split is stale; run spn-data split again",
    )


def has_failed(findings: Sequence[AuditFinding]) -> bool:
    return any(finding.verdict is AuditVerdict.FAIL for finding in findings)
