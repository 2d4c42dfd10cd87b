"""Splits with held-out blocks and guards, on flights with prescribed poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spn_data.errors import FormatError, GeometryError, StageError
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.labels.labels import Labels
from spn_data.split.groups import LEFT_OUT, TEST, TRAIN, VALIDATION, Policy, Split, SplitOptions
from spn_data.split.holdout import make_split
from spn_data.split.split_file import read_split, write_split
from spn_data.storage.json_files import read_json


def flight(
    sequence: str,
    centers: np.ndarray,
    *,
    every_s: float = 0.5,
    tracked: bool = False,
    start_s: float = 0.0,
    heading_deg: float = 0.0,
) -> Labels:
    """Return registered frames at centres (N, 3), all with the same orientation."""
    n = len(centers)
    kind = "d" if tracked else "f"
    angles = np.tile([heading_deg, -20.0, 0.0], (n, 1))
    return Labels(
        names=np.array([f"{sequence}/{kind}{k:05d}.jpg" for k in range(n)]),
        sequences=np.full(n, sequence),
        cameras=np.full(n, sequence),
        sources=np.full(n, f"{sequence}.mp4"),
        video_frame=np.arange(n),
        tracked=np.full(n, tracked),
        time_s=start_s + every_s * np.arange(n),
        status=np.full(n, "registered"),
        reason=np.full(n, "", dtype="<U40"),
        poses=Poses.from_rotations(centers, rotations_from_angles(angles)),
        covariance=np.tile(np.eye(6) * 1e-4, (n, 1, 1)),
        inliers=np.full(n, 100),
        coverage=np.full(n, 0.8),
        error_px=np.full(n, 0.5),
    )


def failed(labels: Labels, rows: slice, reason: str) -> Labels:
    """Return the same labels with some frames failed, without a pose."""
    status, why = labels.status.astype("<U10"), labels.reason.copy()
    centers, quats = labels.poses.centers.copy(), labels.poses.quats_wxyz.copy()
    status[rows], why[rows], centers[rows], quats[rows] = "failed", reason, np.nan, np.nan
    return replace(labels, status=status, reason=why, poses=Poses(centers, quats))


def line(count: int, *, up_m: float = 8.0, step_m: float = 1.0, north_m: float = 0.0) -> np.ndarray:
    """Return centres (N, 3) along a straight line to the east."""
    return np.column_stack(
        [step_m * np.arange(count), np.full(count, north_m), np.full(count, up_m)]
    )


def nothing() -> Labels:
    return flight("a", line(1)).select(np.zeros(0, np.int64))


@pytest.fixture
def area() -> tuple[Labels, Labels]:
    """Two flights of 100 s and 60 s with 2 chosen frames a second and 10 tracked frames between."""
    mapping = Labels.concatenate(
        [flight("one", line(200)), flight("two", line(120, north_m=20.0, up_m=12.0))]
    )
    tracked = Labels.concatenate(
        [
            flight("one", line(1000, step_m=0.2), every_s=0.1, start_s=0.05, tracked=True),
            flight(
                "two", line(600, step_m=0.2, up_m=12.0), every_s=0.1, start_s=0.05, tracked=True
            ),
        ]
    )
    return mapping, tracked


@pytest.fixture
def evaluation() -> dict[str, Labels]:
    return {"medium": flight("medium", line(50, north_m=5.0))}


def nearest_s(labels: Labels, split: Split) -> float:
    """Return seconds from each training frame to its sequence's nearest held-out frame, by brute force."""
    group = split.groups_of(labels.names)
    return min(
        float(np.abs(labels.time_s[k] - labels.time_s[held]).min())
        for k in np.flatnonzero(group == TRAIN)
        if (
            held := np.isin(group, [VALIDATION, TEST]) & (labels.sequences == labels.sequences[k])
        ).any()
    )


def test_mapping_frames_train_and_each_evaluation_sequence_is_a_group(area, evaluation):
    """By default, 11 % of each mapping flight validates, none tests, and evaluation flights are groups."""
    mapping, _ = area
    split = make_split(mapping, nothing(), evaluation, SplitOptions())
    assert split.groups() == (TRAIN, VALIDATION, "medium")
    assert not split.optimistic
    assert (split.groups_of(evaluation["medium"].names) == "medium").all()
    for sequence, count in (("one", 200), ("two", 120)):
        names = mapping.names[mapping.sequences == sequence]
        held = (split.groups_of(names) == VALIDATION).sum()
        assert held == pytest.approx(0.11 * count, abs=1.5)
        assert (split.groups_of(names) == TRAIN).sum() >= 0.7 * count


def test_blocks_in_time_have_about_the_length_wanted(area, evaluation):
    """11 % of 100 s in blocks of about 5 s gives two contiguous blocks."""
    mapping, _ = area
    split = make_split(mapping, nothing(), evaluation, SplitOptions())
    mine = [block for block in split.blocks if block.sequence == "one"]
    assert len(mine) == 2
    for block in mine:
        first, last = block.seconds
        assert 4 <= last - first <= 6
        inside = block.contains(mapping)
        assert (split.groups_of(mapping.names[inside]) == VALIDATION).all()


def test_dense_frames_fall_into_the_block_of_their_time(area, evaluation):
    """Tracked frames in a block validate, and no training frame is within 2 s of a block."""
    mapping, tracked = area
    split = make_split(mapping, tracked, evaluation, SplitOptions())
    everything = Labels.concatenate([mapping, tracked])
    held = np.zeros(len(everything), bool)
    for block in split.blocks:
        held |= block.contains(everything)
    group = split.groups_of(everything.names)
    assert (group[held] == VALIDATION).all()
    assert (group[~held] != VALIDATION).all()
    assert (everything.tracked & (group == VALIDATION)).sum() > 50
    assert nearest_s(everything, split) == pytest.approx(2.0, abs=0.11)
    assert nearest_s(everything, split) >= 2.0 - 1e-6
    left_out = group == LEFT_OUT
    assert set(split.reason[np.isin(split.names, everything.names[left_out])]) == {"guard gap"}


@pytest.mark.parametrize("seed", range(20))
def test_the_gap_holds_for_every_seed(area, seed):
    """For every seed, no training frame is closer than the gap to test or validation frames."""
    mapping, tracked = area
    options = SplitOptions(seed=seed, gap_s=3.0)
    split = make_split(mapping, tracked, {}, options)
    assert nearest_s(Labels.concatenate([mapping, tracked]), split) >= 3.0 - 1e-6
    assert set(split.groups()) == {TRAIN, VALIDATION, TEST}


def test_without_an_evaluation_sequence_one_block_is_held_out_and_said_to_be_optimistic(area):
    """Without an evaluation sequence, one block of about 15 % of all frames tests, and a note warns.

    Validation keeps its distance from the test block too.
    """
    mapping, _ = area
    split = make_split(mapping, nothing(), {}, SplitOptions())
    assert split.optimistic
    (block,) = (b for b in split.blocks if b.group == TEST)
    assert (split.group == TEST).sum() == round(0.15 * 320)
    tested = split.groups_of(mapping.names) == TEST
    assert set(mapping.sequences[tested]) == {block.sequence} == {"one"}
    first, last = block.seconds
    near = (mapping.sequences == "one") & (mapping.time_s > first - 2) & (mapping.time_s < last + 2)
    assert set(split.groups_of(mapping.names[near])) == {TEST, LEFT_OUT}


def test_an_evaluation_sequence_of_which_every_frame_failed_is_no_test(area, evaluation):
    """If every frame of the evaluation sequence failed, a block is held out and a note says why."""
    lost = failed(evaluation["medium"], slice(None), "no map point is seen")
    split = make_split(area[0], nothing(), {"medium": lost}, SplitOptions())
    assert split.optimistic
    assert "medium: no frame has a pose" in split.notes
    assert set(split.reason[split.names == lost.names[0]]) == {"failed: no map point is seen"}


def test_a_frame_without_a_pose_is_in_no_group(area, evaluation):
    """Failed frames are left out of all groups with their reason, wherever they are."""
    mapping = failed(area[0], slice(0, 320, 7), "too few matches")
    split = make_split(mapping, nothing(), evaluation, SplitOptions())
    lost = mapping.names[~mapping.registered]
    assert (split.groups_of(lost) == LEFT_OUT).all()
    assert set(split.reason[np.isin(split.names, lost)]) == {"failed: too few matches"}


def test_the_same_input_gives_the_same_split_in_any_order(area, evaluation):
    """Frame order and other flights do not move any block, but another seed does."""
    mapping, tracked = area
    options = SplitOptions(seed=5)
    split = make_split(mapping, tracked, evaluation, options)
    shuffled = mapping.select(np.random.default_rng(0).permutation(len(mapping)))
    again = make_split(shuffled, tracked, evaluation, options)
    assert (again.groups_of(split.names) == split.group).all()
    alone = mapping.select(mapping.sequences == "one")
    of_one = make_split(alone, nothing(), evaluation, options)
    assert (of_one.groups_of(alone.names) == split.groups_of(alone.names)).all()
    others = [make_split(mapping, tracked, evaluation, replace(options, seed=s)) for s in range(4)]
    assert len({other.blocks for other in others}) > 2


def test_photos_far_apart_in_time_keep_a_frame_between(evaluation):
    """With photos 10 s apart, the photo on each side of a block is still left out."""
    photos = flight("photos", line(100, step_m=10.0), every_s=10.0)
    split = make_split(photos, nothing(), evaluation, SplitOptions())
    group = split.groups_of(photos.names)
    assert len(split.blocks) == 2
    for block in split.blocks:
        inside = np.flatnonzero(block.contains(photos))
        assert len(inside) >= 4
        beside = [k for k in (inside[0] - 1, inside[-1] + 1) if 0 <= k < 100]
        assert (group[beside] == LEFT_OUT).all()
    assert (group == LEFT_OUT).sum() <= 4
    without = make_split(photos, nothing(), evaluation, SplitOptions(gap_s=0.0))
    assert (without.groups_of(photos.names) != LEFT_OUT).all()


def test_a_hover_next_to_a_block_is_left_out_up_to_the_next_chosen_frame(evaluation):
    """A hover at the edge of a block is left out up to the next chosen frame.

    The hover lasts 20 s, and its tracked frames show the same view as the end of the block.
    """
    moving = flight("one", line(30))
    after = flight("one", line(30) + np.array([30.0, 0.0, 0.0]), start_s=35.0)
    names = np.char.replace(after.names, "/f", "/g")
    chosen = Labels.concatenate([moving, replace(after, names=names)])
    hover = flight(
        "one", np.tile([29.0, 0.0, 8.0], (180, 1)), every_s=0.1, start_s=15.0, tracked=True
    )
    for seed in range(60):
        split = make_split(chosen, hover, evaluation, SplitOptions(seed=seed))
        if any(block.seconds[1] == 14.5 for block in split.blocks):
            assert TRAIN not in split.groups_of(hover.names)
            return
    pytest.fail("no seed placed a block before the hover")


def test_a_short_flight_beside_a_long_one_trains_as_a_whole(area, evaluation):
    """A flight of 3 s, which a block and its guards would use up, trains entirely, with a note."""
    mapping = Labels.concatenate([area[0], flight("short", line(6, north_m=40.0))])
    split = make_split(mapping, nothing(), evaluation, SplitOptions())
    assert (split.groups_of(mapping.names[mapping.sequences == "short"]) == TRAIN).all()
    assert any(note.startswith("short is too short") for note in split.notes)


def test_a_single_flight_of_nine_seconds_is_split_without_any_option():
    """In a 9 s flight the test block is at one end and shares its guard; half of the rest trains."""
    split = make_split(flight("a", line(18)), nothing(), {}, SplitOptions())
    assert split.counts()[TRAIN] >= 5
    assert split.counts()[VALIDATION] == 1
    assert split.counts()[TEST] == 3


def test_too_few_frames_are_an_error_that_names_the_way_out():
    """Four frames within 2 s cannot be kept 2 s apart, and the error names an option that helps."""
    with pytest.raises(GeometryError, match=r"leaves no frame for .*--gap"):
        make_split(flight("a", line(4)), nothing(), {}, SplitOptions())


def test_nothing_registered_is_an_error(evaluation):
    """If no mapping frame has a pose, there is an error."""
    lost = failed(flight("a", line(30)), slice(None), "too few matches")
    with pytest.raises(GeometryError, match="no mapping frame has a pose"):
        make_split(lost, nothing(), evaluation, SplitOptions())


def test_left_out_dense_frames_are_in_no_group(area, evaluation):
    """If tracked frames are excluded, those of evaluation sequences are excluded too."""
    mapping, tracked = area
    more = flight("medium", line(100), every_s=0.1, tracked=True)
    both = {"medium": Labels.concatenate([evaluation["medium"], more])}
    split = make_split(mapping, tracked, both, SplitOptions(tracked=False))
    for names in (tracked.names, more.names):
        assert (split.groups_of(names) == LEFT_OUT).all()
    assert split.counts()["medium"] == 50


@pytest.mark.parametrize("name", ["train", "validation", "test"])
def test_a_sequence_may_not_be_called_like_a_group(area, evaluation, name):
    """A sequence with the name of a group is refused."""
    with pytest.raises(StageError, match="may not be called"):
        make_split(area[0], nothing(), {name: evaluation["medium"]}, SplitOptions())


def raster() -> Labels:
    """Flight of eight lines of 40 m, 2 m apart, with neighbours in time and space everywhere."""
    rows = [
        line(41, north_m=2.0 * k) if k % 2 == 0 else line(41, north_m=2.0 * k)[::-1]
        for k in range(8)
    ]
    return flight("raster", np.concatenate(rows))


def test_blocks_in_space_touch_and_keep_their_distance(evaluation):
    """Validation is one region of cells; training stays 3 m away in plan and 2 s away in time."""
    mapping = raster()
    options = SplitOptions(validation=Policy.SPACE)
    split = make_split(mapping, nothing(), evaluation, options)
    group = split.groups_of(mapping.names)
    held, trained = group == VALIDATION, group == TRAIN
    assert 0.08 <= held.mean() <= 0.2
    plan_view = mapping.poses.centers[:, :2]
    apart = np.linalg.norm(plan_view[held][:, None] - plan_view[trained][None], axis=2)
    assert apart.min() >= 3.0 - 1e-6
    assert nearest_s(mapping, split) >= 2.0 - 1e-6
    (block,) = split.blocks
    reached, cells = {block.cells[0]}, set(block.cells)
    for _ in cells:
        reached |= {
            c for c in cells for r in reached if max(abs(c[0] - r[0]), abs(c[1] - r[1])) <= 1
        }
    assert reached == cells
    assert {"guard gap", "guard distance"} >= set(split.reason[split.group == LEFT_OUT])


@pytest.mark.parametrize("seed", range(15))
def test_a_place_apart_from_the_others_is_no_region(evaluation, seed):
    """An isolated frame 100 m away, without neighbours, is never the whole validation set."""
    away = flight("away", line(1) + np.array([100.0, 100.0, 0.0]))
    mapping = Labels.concatenate([raster(), away])
    options = SplitOptions(validation=Policy.SPACE, seed=seed)
    counts = make_split(mapping, nothing(), evaluation, options).counts()
    assert counts[VALIDATION] >= 0.05 * len(mapping)


@pytest.mark.parametrize("seed", range(15))
def test_half_of_a_flight_is_left_to_training_where_that_can_be_had(evaluation, seed):
    """In a 7 s flight, a block at one end is preferred: it leaves 9 of 14 frames instead of 6."""
    short = flight("short", line(14))
    split = make_split(short, nothing(), evaluation, SplitOptions(seed=seed))
    assert split.counts()[TRAIN] >= 7


def test_a_band_of_heights_is_held_out(evaluation):
    """On a climb, frames of a height band validate and those within 1 m above and below are left out."""
    climb = line(400, step_m=0.2)
    climb[:, 2] = np.linspace(2, 42, 400)
    mapping = flight("climb", climb)
    split = make_split(mapping, nothing(), evaluation, SplitOptions(validation=Policy.HEIGHT))
    group, height = split.groups_of(mapping.names), mapping.poses.centers[:, 2]
    held = height[group == VALIDATION]
    assert len(held) == 44
    trained = height[group == TRAIN]
    assert not ((trained > held.min() - 1 + 1e-6) & (trained < held.max() + 1 - 1e-6)).any()


@pytest.mark.parametrize("policy", [Policy.SPACE, Policy.HEIGHT])
def test_space_and_height_need_metres(area, evaluation, policy):
    """Splits by space or height are refused if the area is not in metres."""
    with pytest.raises(GeometryError, match="needs metres"):
        make_split(*area, evaluation, SplitOptions(validation=policy), metric=False)


def test_all_frames_at_one_place_cannot_be_split_in_space(evaluation):
    """A hover fills a single cell and is refused because no frame would train."""
    hover = flight("a", np.tile([1.0, 1.0, 5.0], (60, 1)))
    with pytest.raises(GeometryError, match="leaves no frame for train"):
        make_split(hover, nothing(), evaluation, SplitOptions(validation=Policy.SPACE))


@pytest.mark.parametrize("policy", list(Policy))
def test_a_split_comes_back_from_its_file(area, evaluation, policy, tmp_path: Path):
    """Groups, reasons, blocks and options read from the file equal those written."""
    mapping = raster() if policy is not Policy.TIME else area[0]
    mapping = failed(mapping, slice(0, 3), "too few matches")
    mapping.poses.centers[3:, 2] += np.linspace(0, 30, len(mapping) - 3)
    split = make_split(mapping, nothing(), evaluation, SplitOptions(validation=policy, seed=3))
    write_split(tmp_path / "split.json", split)
    again = read_split(tmp_path / "split.json")
    assert (again.groups_of(split.names) == split.group).all()
    assert len(again.names) == len(split.names)
    assert dict(zip(again.names, again.reason, strict=True)) == dict(
        zip(split.names, split.reason, strict=True)
    )
    assert again.blocks == split.blocks
    assert again.options == split.options
    assert again.optimistic == split.optimistic


def test_the_file_says_what_validation_cannot_be_free_of(area, tmp_path: Path):
    """split.json warns of the joint bundle adjustment and of an optimistic test on a mapping flight."""
    write_split(tmp_path / "split.json", make_split(area[0], nothing(), {}, SplitOptions()))
    table = read_json(tmp_path / "split.json")
    said = " ".join(table["not_free_of"])
    assert "bundle-adjusted jointly with the training frames" in said
    assert "same flight as training: optimistic" in said
    assert table["optimistic"] is True
    assert sum(len(names) for names in table["groups"].values()) + len(table["left_out"]) == 320


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ('"version": 1', '"version": 2'),
        ('"groups"', '"grps"'),
        ('"one/f00000.jpg"', '"../f00000.jpg"'),
        ('"validation": "time"', '"validation": "weather"'),
        ("{", "["),
    ],
)
def test_a_file_that_is_no_split_is_refused(area, evaluation, tmp_path: Path, before, after):
    """A malformed split.json is refused, and the error names the file."""
    path = tmp_path / "split.json"
    write_split(path, make_split(area[0], nothing(), evaluation, SplitOptions()))
    assert before in path.read_text()
    path.write_text(path.read_text().replace(before, after))
    with pytest.raises(FormatError, match=r"split\.json"):
        read_split(path)


@pytest.mark.parametrize(
    "wrong", [{"validation_share": 0.0}, {"test_share": 1.0}, {"gap_s": -1.0}, {"cell_m": 0.0}]
)
def test_options_that_mean_nothing_are_refused(wrong):
    """Options outside their valid range are refused."""
    with pytest.raises(ValueError, match=r"must be between|at least"):
        SplitOptions(**wrong)
