"""The audit finds each kind of leak and inconsistency planted in an otherwise valid data set."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.labels.labels import LabelObservations, Labels, LabelStatus
from spn_data.split import audit, audit_files
from spn_data.split.audit import AuditFinding, AuditVerdict, MapHashes
from spn_data.split.audit_files import PoseList
from spn_data.split.groups import LEFT_OUT, TRAIN, VALIDATION, Split, SplitOptions
from spn_data.split.holdout import make_split


def frames(
    sequence: str, count: int, *, north_m: float = 0.0, every_s: float = 0.5, kind: str = "f"
) -> Labels:
    """Return registered frames on a line to the east at 2 m/s, looking north."""
    east = 2.0 * every_s * np.arange(count)
    centers = np.column_stack([east, np.full(count, north_m), np.full(count, 8.0)])
    angles = np.tile([0.0, -20.0, 0.0], (count, 1))
    return Labels(
        names=np.array([f"{sequence}/{kind}{k:05d}.jpg" for k in range(count)]),
        sequences=np.full(count, sequence),
        cameras=np.full(count, sequence),
        sources=np.full(count, f"{sequence}.mp4"),
        video_frame=np.arange(count),
        tracked=np.full(count, kind == "d"),
        time_s=every_s * np.arange(count),
        status=np.full(count, "registered", dtype="<U10"),
        reason=np.full(count, "", dtype="<U40"),
        poses=Poses.from_rotations(centers, rotations_from_angles(angles)),
        covariance=np.tile(np.eye(6) * 1e-4, (count, 1, 1)),
        inliers=np.full(count, 100),
        coverage=np.full(count, 0.8),
        error_px=np.full(count, 0.5),
    )


@pytest.fixture
def mapping() -> Labels:
    """100 chosen frames of a 50 s flight and 200 tracked frames between them."""
    tracked = replace(
        frames("one", 200, every_s=0.25, kind="d"), time_s=0.125 + 0.25 * np.arange(200)
    )
    return Labels.concatenate([frames("one", 100), tracked])


@pytest.fixture
def evaluation() -> dict[str, Labels]:
    return {"medium": frames("medium", 30, north_m=5.0)}


@pytest.fixture
def split(mapping: Labels, evaluation: dict[str, Labels]) -> Split:
    chosen, tracked = mapping.select(~mapping.tracked), mapping.select(mapping.tracked)
    return make_split(chosen, tracked, evaluation, SplitOptions())


@pytest.fixture
def parts(mapping: Labels, evaluation: dict[str, Labels]) -> dict[str, Labels]:
    chosen, tracked = mapping.select(~mapping.tracked), mapping.select(mapping.tracked)
    return {"mapping": chosen, "tracked": tracked, **evaluation}


def regrouped(split: Split, name: str, group: str) -> Split:
    """Return the split with one frame moved to another group."""
    return replace(split, group=np.where(split.names == name, group, split.group))


def assert_fails(finding: AuditFinding, *words: str) -> None:
    """Assert that a check failed and that one line of evidence contains all the words."""
    assert finding.verdict is AuditVerdict.FAIL
    assert any(all(word in line for word in words) for line in finding.evidence), finding.evidence


SOURCES = {"one/one.mp4": "aaaa"}
EVALUATION_SOURCES = {"medium": {"medium/medium.mp4": "bbbb"}}


def test_evaluation_frames_apart_from_the_map_pass(mapping, evaluation):
    """Evaluation frames that are not in the map pass."""
    names = mapping.names[~mapping.tracked].tolist()
    found = audit.check_not_in_map(names, SOURCES, evaluation, EVALUATION_SOURCES)
    assert found.verdict is AuditVerdict.PASS
    assert "30 evaluation frames" in found.text


def test_an_evaluation_frame_among_the_maps_images_is_found(mapping, evaluation):
    """An evaluation frame among the images of the map is named."""
    names = [*mapping.names.tolist(), "medium/f00007.jpg"]
    found = audit.check_not_in_map(names, SOURCES, evaluation, EVALUATION_SOURCES)
    assert_fails(found, "medium/f00007.jpg")


def test_an_evaluation_video_that_was_mapped_is_found_under_any_name(mapping, evaluation):
    """A mapped evaluation video is found under any file name because content is compared."""
    sources = {"medium": {"medium/renamed.mp4": "aaaa"}}
    found = audit.check_not_in_map(mapping.names.tolist(), SOURCES, evaluation, sources)
    assert_fails(found, "renamed.mp4", "one.mp4")


def test_an_evaluation_sequence_of_unknown_source_is_found(mapping, evaluation):
    """An evaluation sequence whose source was not recorded fails."""
    found = audit.check_not_in_map(mapping.names.tolist(), SOURCES, evaluation, {})
    assert_fails(found, "medium", "not recorded")


def test_a_mapping_flight_under_another_name_is_noticed(mapping, evaluation):
    """A relabelled copy of a mapping flight is noticed, and another flight passes.

    In the copy, every fourth frame of the flight has a label 2 cm off.
    """
    assert audit.check_duplicates(mapping, evaluation).verdict is AuditVerdict.PASS
    rows = np.arange(0, 100, 4)
    copy = frames("copy", 100).select(rows)
    copy = replace(copy, poses=Poses(copy.poses.centers + 0.01, copy.poses.quats_wxyz))
    found = audit.check_duplicates(mapping, {**evaluation, "copy": copy})
    assert found.verdict is AuditVerdict.NOTICE
    assert found.evidence == ("copy: 25 of 25 frames",)
    crossing = frames("crossing", 20, north_m=3.0)
    centers = crossing.poses.centers.copy()
    centers[:2] = mapping.poses.centers[:2]
    crossing = replace(crossing, poses=Poses(centers, crossing.poses.quats_wxyz))
    assert audit.check_duplicates(mapping, {"crossing": crossing}).verdict is AuditVerdict.PASS


def test_a_map_hash_that_changed_is_found():
    """A map hash that changed during a registration or afterwards is reported."""
    same = audit.check_map_unchanged("m1", {"medium": MapHashes("m1", "m1")})
    assert same.verdict is AuditVerdict.PASS
    assert_fails(audit.check_map_unchanged("m2", {"medium": MapHashes("m1", "m2")}), "m1", "m2")
    assert_fails(audit.check_map_unchanged("m2", {"medium": MapHashes("m1", "m1")}), "m2 now")


def test_a_sound_split_passes_every_check_of_blocks(mapping, split):
    """A valid split passes the checks of blocks and gaps."""
    for check in (audit.check_blocks, audit.check_gap):
        assert check(mapping, split).verdict is AuditVerdict.PASS


@pytest.mark.parametrize("tracked", [False, True])
def test_a_training_frame_within_a_block_is_found(mapping, split, tracked):
    """A chosen or tracked training frame in a held-out block is reported by both checks."""
    held = mapping.names[
        (split.groups_of(mapping.names) == VALIDATION) & (mapping.tracked == tracked)
    ]
    planted = regrouped(split, held[len(held) // 2], TRAIN)
    assert_fails(audit.check_blocks(mapping, planted), held[len(held) // 2])
    assert_fails(audit.check_gap(mapping, planted), held[len(held) // 2])


def test_a_held_out_frame_outside_all_blocks_is_found(mapping, split):
    """A validation frame outside all blocks is named."""
    outside = mapping.names[split.groups_of(mapping.names) == TRAIN][0]
    assert_fails(audit.check_blocks(mapping, regrouped(split, outside, VALIDATION)), outside)


def test_a_dense_training_frame_in_the_guard_gap_is_found(mapping, split):
    """A tracked training frame in the guard is named, with its distance in seconds."""
    guard = mapping.names[(split.groups_of(mapping.names) == LEFT_OUT) & mapping.tracked][0]
    assert_fails(audit.check_gap(mapping, regrouped(split, guard, TRAIN)), guard, "s from")


def test_a_gap_smaller_than_the_stated_one_is_found(mapping, split):
    """Blocks cut for a gap of 2 s do not pass as cut for 3 s."""
    stated = replace(split, options=SplitOptions(gap_s=3.0))
    assert audit.check_gap(mapping, stated).verdict is AuditVerdict.FAIL


def test_a_training_frame_that_comes_back_to_a_held_out_place_is_listed(mapping, split):
    """A training frame 0.5 m and 5 degrees from a held-out one, a minute later, is listed.

    A frame at that place that looks in another direction is not.
    """
    row = np.flatnonzero((split.groups_of(mapping.names) == VALIDATION) & ~mapping.tracked)[0]
    center = mapping.poses.centers[row] + [0.0, 0.5, 0.0]
    for heading_deg, listed in ((5.0, True), (40.0, False)):
        there = rotations_from_angles(np.array([[heading_deg, -20.0, 0.0]]))
        again = replace(frames("back", 1), poses=Poses.from_rotations(center[None], there))
        both = Labels.concatenate([mapping, again])
        with_back = replace(
            split,
            names=np.append(split.names, "back/f00000.jpg"),
            group=np.append(split.group, TRAIN),
            reason=np.append(split.reason, ""),
        )
        found = audit.check_revisits(both, with_back)
        assert (found.verdict is AuditVerdict.NOTICE) == listed
        if listed:
            (line,) = (e for e in found.evidence if mapping.names[row] in e)
            assert "back/f00000.jpg (train): 0.50 m, 5.0 deg" in line


def seen_points(mapping: Labels, views: dict[int, list[str]]) -> LabelObservations:
    """Return observations of points by id, each in the named frames."""
    row_of = {name: k for k, name in enumerate(mapping.names.tolist())}
    pairs = sorted((row_of[name], point) for point, names in views.items() for name in names)
    rows, points = np.array(pairs, dtype=np.int64).T
    return LabelObservations(rows, points, np.zeros((len(rows), 2)))


def test_a_point_that_one_training_frame_sees_is_found(mapping, split):
    """A point marked for training must be seen by at least two training frames.

    Point 1 has two training frames, point 2 has one and two validation frames, and point 3 has none.
    """
    chosen = mapping.select(~mapping.tracked)
    group = split.groups_of(chosen.names)
    train, held = chosen.names[group == TRAIN], chosen.names[group == VALIDATION]
    views = {
        1: [train[0], train[1], held[0]],
        2: [train[0], held[0], held[1]],
        3: [held[0], held[1]],
    }
    seen = seen_points(chosen, views)
    assert audit.training_points(chosen, seen, split).tolist() == [1]
    fine = audit.check_training_points(np.array([1, 1]), chosen, seen, split)
    assert fine.verdict is AuditVerdict.PASS
    assert_fails(audit.check_training_points(np.array([1, 2]), chosen, seen, split), "point 2")
    assert_fails(audit.check_training_points(np.array([3]), chosen, seen, split), "point 3")


def test_a_point_seen_twice_in_one_frame_has_one_view(mapping, split):
    """Two pixels of a point in one training frame count as one view."""
    chosen = mapping.select(~mapping.tracked)
    row = np.flatnonzero(split.groups_of(chosen.names) == TRAIN)[0]
    seen = LabelObservations(np.array([row, row]), np.array([7, 7]), np.zeros((2, 2)))
    assert len(audit.training_points(chosen, seen, split)) == 0


@pytest.mark.parametrize(
    ("marks", "word"),
    [
        ({"train": True, "validation": False, "medium": True}, "group medium"),
        ({"train": True, "validation": True, "medium": False}, "group validation"),
        ({"train": False, "validation": False, "medium": False}, "group train"),
        ({"validation": False}, "group train"),
    ],
)
def test_a_wrong_mark_is_found(marks, word):
    """Only points of the training group may be marked for training."""
    sound = audit.check_training_marks({"train": True, "validation": False, "medium": False})
    assert sound.verdict is AuditVerdict.PASS
    assert_fails(audit.check_training_marks(marks), word)


def test_labels_that_are_not_finite_are_found(parts):
    """Non-finite positions, partial covariances, non-unit quaternions and negative variances are found."""
    assert audit_files.check_labels(parts).verdict is AuditVerdict.PASS
    unknown = replace(parts["mapping"], covariance=np.full((100, 6, 6), np.nan))
    found = audit_files.check_labels({"mapping": unknown})
    assert found.verdict is AuditVerdict.PASS
    assert "100 have no covariance" in found.text
    for field, index, value, word in (
        ("centers", (3, 1), np.inf, "position"),
        ("quats_wxyz", (4, 0), 0.5, "quaternion"),
    ):
        values = {
            "centers": parts["medium"].poses.centers.copy(),
            "quats_wxyz": parts["medium"].poses.quats_wxyz.copy(),
        }
        values[field][index] = value
        bad = replace(parts["medium"], poses=Poses(**values))
        assert_fails(audit_files.check_labels({"medium": bad}), bad.names[index[0]], word)
    for value, word in ((np.nan, "not finite"), (-1.0, "negative")):
        covariance = parts["medium"].covariance.copy()
        covariance[5, 0, 0] = value
        bad = replace(parts["medium"], covariance=covariance)
        assert_fails(audit_files.check_labels({"medium": bad}), bad.names[5], word)


def test_a_frame_that_the_split_lacks_or_holds_twice_is_found(parts, split):
    """A frame that is missing from the split or listed twice is named."""
    assert audit_files.check_completeness(parts, split).verdict is AuditVerdict.PASS
    name = split.names[0]
    missing = replace(split, names=split.names[1:], group=split.group[1:], reason=split.reason[1:])
    assert_fails(audit_files.check_completeness(parts, missing), name, "missing")
    twice = replace(
        split,
        names=np.append(split.names, name),
        group=np.append(split.group, TRAIN),
        reason=np.append(split.reason, ""),
    )
    assert_fails(audit_files.check_completeness(parts, twice), name, "2 times")


def test_a_frame_in_a_group_that_is_not_its_own_is_found(parts, split):
    """Frames in the wrong group are found.

    Cases: an evaluation frame that trains, a mapping frame in a test set, a frame without a pose, an unknown
    frame.
    """
    for name, group in (("medium/f00003.jpg", TRAIN), ("one/f00003.jpg", "medium")):
        assert_fails(audit_files.check_completeness(parts, regrouped(split, name, group)), name)
    medium = parts["medium"]
    status = medium.status.copy()
    status[2] = LabelStatus.FAILED
    lost = {**parts, "medium": replace(medium, status=status)}
    assert_fails(audit_files.check_completeness(lost, split), "medium/f00002.jpg", "no pose")
    fewer = {**parts, "medium": medium.select(np.arange(29))}
    assert_fails(audit_files.check_completeness(fewer, split), "medium/f00029.jpg", "not a frame")


def test_a_frame_left_out_without_a_reason_is_found(parts, split):
    """A frame left out without a reason is named."""
    bare = regrouped(split, "one/f00000.jpg", LEFT_OUT)
    assert_fails(audit_files.check_completeness(parts, bare), "one/f00000.jpg", "without a reason")


def lists(parts: dict[str, Labels], split: Split) -> dict[str, PoseList]:
    """Return the contents of a valid dataset.h5, by group."""
    labels = Labels.concatenate(list(parts.values()))
    group = split.groups_of(labels.names)
    return {
        name: PoseList(tuple(labels.names[group == name].tolist()), labels.poses[group == name])
        for name in split.groups()
    }


def test_a_data_set_that_differs_from_the_split_is_found(parts, split):
    """A frame too many, a missing frame, and a pose that moved by a nanometre are found."""
    stored = lists(parts, split)
    assert audit_files.check_dataset(stored, parts, split).verdict is AuditVerdict.PASS
    medium = stored["medium"]
    short = {**stored, "medium": medium.select(np.arange(29))}
    assert_fails(audit_files.check_dataset(short, parts, split), "medium/f00029.jpg", "missing")
    leaked = PoseList(
        (*stored["train"].names, medium.names[0]),
        Poses(
            np.concatenate([stored["train"].poses.centers, medium.poses.centers[:1]]),
            np.concatenate([stored["train"].poses.quats_wxyz, medium.poses.quats_wxyz[:1]]),
        ),
    )
    with_leak = {**stored, "train": leaked}
    assert_fails(audit_files.check_dataset(with_leak, parts, split), medium.names[0], "group train")
    moved = Poses(medium.poses.centers + 1e-9, medium.poses.quats_wxyz)
    off = {**stored, "medium": PoseList(medium.names, moved)}
    assert_fails(audit_files.check_dataset(off, parts, split), "another pose")


def test_lists_that_differ_from_the_data_set_are_found(parts, split):
    """Rounding to six decimals passes; a larger difference, another order or another list fails."""
    stored = {"dataset_train.txt": lists(parts, split)["train"]}
    wanted = stored["dataset_train.txt"]
    png = tuple(name.replace(".jpg", ".png") for name in wanted.names)
    rounded = Poses(wanted.poses.centers.round(6), -wanted.poses.quats_wxyz.round(6))
    listed = {"dataset_train.txt": PoseList(png, rounded)}
    assert audit_files.check_cambridge(listed, stored).verdict is AuditVerdict.PASS
    off = Poses(rounded.centers + 1.1e-6, rounded.quats_wxyz)
    found = audit_files.check_cambridge({"dataset_train.txt": PoseList(png, off)}, stored)
    assert_fails(found, png[0].removesuffix(".png"), "another pose")
    fewer = {"dataset_train.txt": listed["dataset_train.txt"].select(np.arange(1, len(png)))}
    assert_fails(audit_files.check_cambridge(fewer, stored), "f00000 is missing")
    found = audit_files.check_cambridge(listed, {**fewer})
    assert_fails(found, "f00000 does not belong there")
    assert_fails(audit_files.check_cambridge({}, stored), "dataset_train.txt is missing")


def test_a_measurement_of_a_held_out_frame_in_the_model_is_found(mapping, split):
    """Measurements in the model of a validation or an evaluation frame are found among training ones."""
    group = split.groups_of(mapping.names)
    train, held = mapping.names[group == TRAIN][:5].tolist(), mapping.names[group == VALIDATION][0]
    png = [name.replace(".jpg", ".png") for name in train]
    assert audit_files.check_nvm_measurements(png, split).verdict is AuditVerdict.PASS
    assert_fails(audit_files.check_nvm_measurements([*png, held], split), held)
    assert_fails(
        audit_files.check_nvm_measurements([*png, "medium/f00001.png"], split), "medium/f00001"
    )


def test_a_test_of_a_mapping_flight_is_noticed(mapping, split):
    """A test block in a mapping flight gives a notice that results are optimistic."""
    assert audit.check_test_independence(split).verdict is AuditVerdict.PASS
    chosen, tracked = mapping.select(~mapping.tracked), mapping.select(mapping.tracked)
    alone = make_split(chosen, tracked, {}, SplitOptions())
    found = audit.check_test_independence(alone)
    assert found.verdict is AuditVerdict.NOTICE
    assert found.text == "same flight as training: optimistic"


def test_a_stale_split_fails():
    """A split older than a redone stage fails."""
    assert audit.check_up_to_date(None).verdict is AuditVerdict.PASS
    assert audit.has_failed([audit.check_up_to_date("3-geo was redone since")])
