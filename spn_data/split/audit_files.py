"""Consistency checks of the files of a data set with the labels and with each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spn_data.geometry.pose import Poses
from spn_data.labels.labels import Labels
from spn_data.split.audit import AuditFinding, make_finding
from spn_data.split.groups import LEFT_OUT, TEST, TRAIN, VALIDATION, Split

# Half a unit of the sixth decimal plus a margin for rounding.
_PRINTED = 0.5e-6 + 1e-9


def check_labels(parts: Mapping[str, Labels]) -> AuditFinding:
    """Check that poses are finite, quaternions unit, and covariances unknown or finite and not negative."""
    bad: list[str] = []
    count = without = 0
    for labels in parts.values():
        rows = np.flatnonzero(labels.registered)
        count += len(rows)
        finite = np.isfinite(labels.poses.centers[rows]).all(axis=1)
        norms = np.linalg.norm(labels.poses.quats_wxyz[rows], axis=1)
        covariance = labels.covariance[rows]
        unknown = np.isnan(covariance).all(axis=(1, 2))
        without += int(unknown.sum())
        whole = np.isfinite(covariance).all(axis=(1, 2))
        variances = np.diagonal(covariance, axis1=1, axis2=2)
        for fine, what in (
            (finite, "its position is not finite"),
            (np.abs(norms - 1) < 1e-6, "its quaternion is not of length 1"),
            (unknown | whole, "its covariance is not finite"),
            (~whole | (variances >= 0).all(axis=1), "a variance is negative"),
        ):
            bad += [f"{name}: {what}" for name in labels.names[rows[~fine]].tolist()]
    return make_finding(
        "labels finite",
        bad,
        f"{count} labels are finite; {without} have no covariance",
        "some labels are invalid",
    )


def check_completeness(parts: Mapping[str, Labels], split: Split) -> AuditFinding:
    """Check that the split contains every frame exactly once, in a permitted group or with a reason.

    Parameters
    ----------
    parts : mapping of str to Labels
        All labels: "mapping", "tracked", and each evaluation sequence by its name.
    split : Split
        The split.

    Returns
    -------
    AuditFinding
        Finding of the check; frames without a pose must be left out.
    """
    names, times = np.unique(split.names, return_counts=True)
    bad = [
        f"{name} is listed {n} times in the split"
        for name, n in zip(names, times, strict=True)
        if n > 1
    ]
    group = dict(zip(split.names.tolist(), split.group.tolist(), strict=True))
    reason = dict(zip(split.names.tolist(), split.reason.tolist(), strict=True))
    known: set[str] = set()
    for part, labels in parts.items():
        allowed = {part} if part not in ("mapping", "tracked") else {TRAIN, VALIDATION, TEST}
        for name, registered in zip(labels.names.tolist(), labels.registered.tolist(), strict=True):
            known.add(name)
            if name not in group:
                bad.append(f"{name} is missing from the split")
            elif group[name] == LEFT_OUT:
                if not reason[name]:
                    bad.append(f"{name} is left out without a reason")
            elif not registered:
                bad.append(f"{name} has no pose but is in group {group[name]}")
            elif group[name] not in allowed:
                bad.append(f"{name} of {part} is in group {group[name]}")
    bad += [f"{name} is not a frame of the area" for name in group if name not in known]
    return make_finding(
        "every frame once",
        bad,
        f"{len(known)} frames, each once: "
        + ", ".join(f"{n} {name}" for name, n in split.counts().items())
        + f", {int((split.group == LEFT_OUT).sum())} left out",
        "the split does not match the frames",
    )


@dataclass(frozen=True, eq=False)
class PoseList:
    """Images and their poses, in the order of a file.

    Attributes
    ----------
    names : tuple of str
        N image names.
    poses : Poses
        N poses.
    """

    names: tuple[str, ...]
    poses: Poses

    def select(self, rows: np.ndarray) -> PoseList:
        """Return the given rows."""
        return PoseList(tuple(self.names[k] for k in rows), self.poses[rows])

    def appended(self, other: PoseList) -> PoseList:
        """Return this list followed by the other."""
        return PoseList(self.names + other.names, Poses.concatenate([self.poses, other.poses]))


def check_dataset(
    stored: Mapping[str, PoseList], parts: Mapping[str, Labels], split: Split
) -> AuditFinding:
    """Check that each group of dataset.h5 contains exactly its frames, with the poses of their labels.

    Parameters
    ----------
    stored : mapping of str to PoseList
        Images and poses of dataset.h5 by group.
    parts : mapping of str to Labels
        All labels.
    split : Split
        The split.

    Returns
    -------
    AuditFinding
        Finding of the check.
    """
    bad = []
    for name in sorted({*stored, *split.groups()}):
        wanted = set(split.names[split.group == name].tolist())
        found = set(stored[name].names) if name in stored else set()
        bad += [f"{frame} is missing from group {name}" for frame in sorted(wanted - found)]
        bad += [f"{frame} should not be in group {name}" for frame in sorted(found - wanted)]
    labels = Labels.concatenate(list(parts.values()))
    row_of = {name: k for k, name in enumerate(labels.names.tolist())}
    for held in stored.values():
        known = [k for k, name in enumerate(held.names) if name in row_of]
        rows = [row_of[held.names[k]] for k in known]
        same = (held.poses.centers[known] == labels.poses.centers[rows]).all(axis=1)
        same &= (held.poses.quats_wxyz[known] == labels.poses.quats_wxyz[rows]).all(axis=1)
        bad += [
            f"{held.names[known[k]]} has another pose than its label" for k in np.flatnonzero(~same)
        ]
    return make_finding(
        "dataset.h5 holds the split",
        bad,
        f"{sum(len(held.names) for held in stored.values())} images in {len(stored)} groups, "
        "each with its label's pose",
        "dataset.h5 does not match split.json",
    )


def check_cambridge(listed: Mapping[str, PoseList], stored: Mapping[str, PoseList]) -> AuditFinding:
    """Check that lists in Cambridge Landmarks format agree with dataset.h5 to the printed digits.

    Parameters
    ----------
    listed : mapping of str to PoseList
        Content of each list file.
    stored : mapping of str to PoseList
        Expected content by the same file, from dataset.h5. Names are compared without suffix; order is
        ignored.

    Returns
    -------
    AuditFinding
        Finding of the check.
    """
    bad, images = [], 0
    for file in sorted({*listed, *stored}):
        found = _by_stem(listed[file]) if file in listed else {}
        wanted = _by_stem(stored[file]) if file in stored else {}
        images += len(found)
        if file not in listed:
            bad.append(f"{file} is missing")
            continue
        bad += [f"{file}: {name} is missing" for name in sorted(wanted.keys() - found.keys())]
        for name in sorted(found):
            if name not in wanted:
                bad.append(f"{file}: {name} does not belong there")
            elif not _is_same_to_the_digits(found[name], wanted[name]):
                bad.append(f"{file}: {name} has another pose")
    return make_finding(
        "Cambridge lists agree with dataset.h5",
        bad,
        f"{images} poses in {len(listed)} lists agree to the printed digits",
        "the lists do not match dataset.h5",
    )


def check_nvm_measurements(measured: Sequence[str], split: Split) -> AuditFinding:
    """Check that the NVM model next to the lists contains measurements of training frames only.

    measured : images with at least one measurement; names are compared without suffix.
    """
    group = {_stem(n): g for n, g in zip(split.names.tolist(), split.group.tolist(), strict=True)}
    return make_finding(
        "model measured in training frames",
        [f"{n} has measurements" for n in measured if group.get(_stem(n)) != TRAIN],
        f"points of the model are measured in {len(measured)} training frames and in no other",
        "the model next to the lists leaks the poses of held-out frames",
    )


def _by_stem(listed: PoseList) -> dict[str, np.ndarray]:
    """Return centre and quaternion (7,) by name without suffix."""
    rows = np.concatenate([listed.poses.centers, listed.poses.quats_wxyz], axis=1)
    return {_stem(name): row for name, row in zip(listed.names, rows, strict=True)}


def _is_same_to_the_digits(found: np.ndarray, wanted: np.ndarray) -> bool:
    # q and -q are the same rotation.
    sign = -1.0 if found[3:] @ wanted[3:] < 0 else 1.0
    apart = np.concatenate([found[:3] - wanted[:3], sign * found[3:] - wanted[3:]])
    return bool(np.abs(apart).max() <= _PRINTED)


def _stem(name: str) -> str:
    return name.rpartition(".")[0]
