"""Checks that decide which poses become labels: every reason for refusal, and votes of neighbours."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from spn_data.geometry.initial_lens import GUESS_SIGMA, InitialLens
from spn_data.geometry.pose import pose_errors
from spn_data.labels.map_points import MapPoints
from spn_data.registration.checks import (
    Evidence,
    PoseVerdict,
    check_poses,
    gather_evidence,
    same_pose,
)
from spn_data.registration.register import accept_poses
from spn_data.registration.register_options import CheckOptions, RegisterOptions
from spn_data.registration.solution import (
    SequenceSolution,
    UnsolvedSequence,
    adjust_inliers,
    remove_frames,
)
from spn_data.registration.solve import solve
from tests.worlds.registration_scene import (
    A_COLUMN,
    KNOWN,
    LENS,
    PITCH_M,
    Flight,
    PerfectMap,
    flight,
)

OPTIONS = RegisterOptions()


def evidence(count: int = 3, pairs: dict[tuple[int, int], float] | None = None) -> Evidence:
    """Return evidence for sound frames; `pairs` is the agreement of neighbours, all agree if None."""
    if pairs is None:
        pairs = {(k, k + 1): 1.0 for k in range(count - 1)}
    keys = sorted(pairs)
    return Evidence(
        direct=np.full(count, 200),
        putative=np.full(count, 400),
        inliers=np.full(count, 220),
        coverage=np.full(count, 0.6),
        rival=np.zeros(count, np.int64),
        depth=np.full(count, 10.0),
        sigma=np.full(count, 0.01),
        sigma_deg=np.full(count, 0.02),
        pairs=np.array(keys, np.int64).reshape(-1, 2),
        matches=np.full(len(keys), 100),
        agreement=np.array([pairs[key] for key in keys]),
    )


def with_frame(found: Evidence, row: int, **values: Any) -> Evidence:
    """Return the evidence with other values for one frame."""
    columns = {}
    for name, value in values.items():
        column = getattr(found, name).copy()
        column[row] = value
        columns[name] = column
    return replace(found, **columns)


def judged(found: Evidence, posed: np.ndarray | None = None) -> PoseVerdict:
    return check_poses(
        np.ones(len(found.direct), bool) if posed is None else posed, found, CheckOptions()
    )


def test_frames_of_which_all_is_well_are_accepted() -> None:
    """Frames with sound evidence are accepted without a reason."""
    verdict = judged(evidence())
    assert verdict.accepted.all()
    assert verdict.reason == ("", "", "")


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"inliers": 29}, "only 29 map points agree (30 are needed)"),
        ({"coverage": 0.07}, "the map points that agree cover 7% of the image (8% are needed)"),
        ({"sigma": 0.13}, "its position is uncertain by 1.3% of the distance"),
        ({"sigma": np.nan}, "its position is uncertain by nan% of the distance"),
        ({"sigma_deg": 0.6}, "its rotation is uncertain by 0.60 deg"),
    ],
)
def test_what_no_neighbour_can_make_good(values: dict[str, float], reason: str) -> None:
    """Too few or crowded points, or an undetermined pose, fail a frame even if all its neighbours agree."""
    verdict = judged(with_frame(evidence(), 1, **values))
    assert verdict.accepted.tolist() == [True, False, True]
    assert verdict.reason[1] == reason


NEED_SUPPORT = [
    ({"rival": 101}, "ambiguous: 200 map points agree with the pose and 101 with another"),
    ({"direct": 29}, "only 29 map points found in it agree (30 are needed)"),
    ({"putative": 1334}, "only 200 of its 1334 matches with the map agree"),
]


@pytest.mark.parametrize(("values", "reason"), NEED_SUPPORT)
def test_what_a_neighbour_can_make_good_fails_without_one(
    values: dict[str, int], reason: str
) -> None:
    """A frame with two possible poses or few matches of its own fails unless a neighbour confirms it."""
    alone = evidence(3, {(0, 2): 1.0})
    verdict = judged(with_frame(alone, 1, **values))
    assert verdict.accepted.tolist() == [True, False, True]
    assert verdict.reason[1] == f"{reason}, and no neighbour confirms its pose"


@pytest.mark.parametrize(("values", "reason"), NEED_SUPPORT)
def test_a_neighbour_that_stands_makes_it_good(values: dict[str, int], reason: str) -> None:
    """A weak frame is accepted if an accepted neighbour confirms its pose."""
    assert judged(with_frame(evidence(), 1, **values)).accepted.all()


def test_support_reaches_along_a_chain_but_must_begin_somewhere() -> None:
    """Support passes along a chain of weak frames only if it starts at a frame that passes independently."""
    weak = evidence(5)
    for row in range(1, 5):
        weak = with_frame(weak, row, direct=5)
    assert judged(weak).accepted.all()
    assert not judged(with_frame(weak, 0, direct=5)).accepted.any()


def test_a_frame_whose_neighbours_contradict_it_is_ambiguous_and_they_are_not() -> None:
    """A frame that four neighbours contradict is ambiguous, and those neighbours keep their poses."""
    pairs = {(i, j): 0.0 if 2 in (i, j) else 1.0 for i in range(5) for j in range(i + 1, 5)}
    verdict = judged(evidence(5, pairs))
    assert verdict.accepted.tolist() == [True, True, False, True, True]
    assert verdict.reason[2] == "ambiguous: 4 of 4 neighbours contradict its pose"


def test_where_no_majority_holds_all_fail() -> None:
    """Without a majority all fail: two frames that contradict each other, or two groups of two."""
    verdict = judged(evidence(2, {(0, 1): 0.1}))
    assert not verdict.accepted.any()
    assert verdict.reason == ("ambiguous: 1 of 1 neighbours contradict its pose",) * 2
    camps = {(0, 1): 1.0, (2, 3): 1.0, (0, 2): 0.0, (1, 3): 0.0}
    assert not judged(evidence(4, camps)).accepted.any()


def test_a_neighbour_with_few_matches_or_no_pose_of_its_own_does_not_testify() -> None:
    """Neighbours with few matches, a refused pose or no pose do not vote."""
    few = replace(evidence(2, {(0, 1): 0.0}), matches=np.array([29]))
    assert judged(few).accepted.all()
    refused = with_frame(evidence(2, {(0, 1): 0.0}), 0, inliers=3)
    assert judged(refused).accepted.tolist() == [False, True]
    unknown = replace(evidence(2), agreement=np.array([np.nan]))
    assert judged(unknown, np.array([True, False])).accepted.tolist() == [True, False]


def test_a_frame_without_a_pose_says_why() -> None:
    """A frame without a pose has the reason for it."""
    found = with_frame(evidence(), 1, putative=0)
    verdict = judged(found, np.array([False, False, True]))
    assert verdict.reason[0] == "no pose agrees with its 400 matches with the map"
    assert verdict.reason[1] == "no feature matches a point of the map"
    assert verdict.accepted.tolist() == [False, False, True]


def solved(
    made: Flight, putative: list[np.ndarray]
) -> tuple[UnsolvedSequence, SequenceSolution, Evidence]:
    sequence = made.sequence(putative)
    solution = solve(sequence, KNOWN, OPTIONS)
    covariances = np.tile(1e-6 * np.eye(6), (len(made.poses), 1, 1))
    found = gather_evidence(sequence, solution, covariances, made.pairs, OPTIONS)
    return sequence, solution, found


def test_a_flight_along_the_facade_stands() -> None:
    """With correct matches every frame is centimetres off, all neighbours agree and no rival pose exists."""
    made = flight()
    _, solution, found = solved(made, made.matched())
    assert check_poses(solution.posed, found, CheckOptions()).accepted.all()
    assert pose_errors(solution.poses, made.poses)[0].max() < 0.05
    assert found.agreement.min() > 0.95
    assert found.rival.max() == 0
    assert np.array_equal(found.putative, [len(shows) for shows in made.shows])
    assert np.all((found.depth > 8) & (found.depth < 11))


@pytest.mark.parametrize(("share_of_limit", "agreement"), [(0.95, 1.0), (1.05, 0.0)])
def test_matches_agree_up_to_the_limit_of_the_sampson_error(
    share_of_limit: float, agreement: float
) -> None:
    """A match d pixels off the epipolar line in one of the images has a Sampson error of d / sqrt(2)."""
    made = flight(2, noise_px=0.0)
    off_px = share_of_limit * np.sqrt(2) * OPTIONS.max_error_px
    shifted = replace(made, pixels=[made.pixels[0], made.pixels[1] + [0.0, off_px]])
    sequence = shifted.sequence([np.empty((0, 2), np.int64)] * 2)
    none = np.empty(0, np.int64)
    posed = np.ones(2, bool)
    solution = SequenceSolution(posed, made.poses, LENS, *(none,) * 4, np.empty((0, 3)), KNOWN)
    found = gather_evidence(sequence, solution, np.tile(np.eye(6), (2, 1, 1)), made.pairs, OPTIONS)
    assert found.agreement.tolist() == [agreement]


@pytest.mark.parametrize("columns", [1, -1])
def test_a_frame_at_the_wrong_window_is_ambiguous(columns: int) -> None:
    """A frame placed one window off along the flight, where epipolar lines do not change, is ambiguous."""
    made = flight()
    sequence, solution, found = solved(made, made.matched({3: columns}))
    away = solution.poses.centers[3] - made.poses.centers[3]
    assert away == pytest.approx([columns * PITCH_M, 0, 0], abs=0.15)
    assert found.direct[3] > 0.9 * len(sequence.putative[3])
    assert found.rival[3] == 0
    verdict = check_poses(solution.posed, found, CheckOptions())
    assert verdict.accepted.tolist() == [k != 3 for k in range(8)]
    assert verdict.reason[3] == "ambiguous: 6 of 6 neighbours contradict its pose"


def test_a_frame_that_fits_two_windows_is_settled_by_its_neighbours_or_not_at_all() -> None:
    """A frame whose matches split between two windows fails alone and is accepted with its neighbours."""
    made = flight()
    right, wrong = made.matched()[3], made.matched({3: 1})[3]
    both = np.concatenate([right[::2], wrong[1::2]])
    alone = Flight(made.poses[3:4], made.points, made.pixels[3:4], made.shows[3:4])
    _, solution, found = solved(alone, [both[np.argsort(both[:, 0])]])
    assert found.rival[0] > 0.8 * found.direct[0]
    verdict = check_poses(solution.posed, found, CheckOptions())
    assert verdict.reason[0].startswith("ambiguous: ")
    assert verdict.reason[0].endswith("with another, and no neighbour confirms its pose")
    putative = made.matched()
    putative[3] = np.concatenate([right[: len(right) * 3 // 5], wrong[len(right) * 3 // 5 :]])
    _, solution, found = solved(made, putative)
    assert found.rival[3] > 0.5 * found.direct[3]
    assert check_poses(solution.posed, found, CheckOptions()).accepted.all()
    assert pose_errors(solution.poses, made.poses)[0].max() < 0.05


def test_a_frame_without_matches_is_carried_by_its_neighbours() -> None:
    """A frame without matches to the map is placed by the features that it shares with its neighbours."""
    made = flight()
    putative = made.matched()
    putative[3] = np.zeros((0, 2), np.int64)
    _, solution, found = solved(made, putative)
    assert found.direct[3] == 0
    assert found.inliers[3] > A_COLUMN
    assert check_poses(solution.posed, found, CheckOptions()).accepted.all()
    assert pose_errors(solution.poses, made.poses)[0].max() < 0.05


def test_random_matches_give_no_label() -> None:
    """If features are matched with random map points, as in another place, every frame fails."""
    made = flight()
    rng = np.random.default_rng(1)
    putative = [
        np.column_stack([np.arange(len(p)), rng.integers(0, len(made.points), len(p))])
        for p in made.pixels
    ]
    _, solution, found = solved(made, putative)
    verdict = check_poses(solution.posed, found, CheckOptions())
    assert not verdict.accepted.any()
    assert all(verdict.reason)


def test_a_second_pose_that_is_the_same_is_no_rival() -> None:
    """Half of the features are 9 px off; their pose differs by less than 2 degrees and is no rival."""
    made = flight(1)
    pixels = made.pixels[0].copy()
    pixels[::2, 0] += 9
    moved = replace(made, pixels=[pixels])
    _, _, found = solved(moved, made.matched())
    assert found.direct[0] < 0.7 * len(pixels)
    assert found.rival[0] == 0
    near, far = (
        replace(made.poses, centers=made.poses.centers + np.array([x, 0, 0])) for x in (0.2, 0.3)
    )
    assert same_pose(made.poses, near, 10.0, CheckOptions())
    assert not same_pose(made.poses, far, 10.0, CheckOptions())


def test_a_lens_that_is_not_known_is_found() -> None:
    """An unknown lens is estimated from a narrow-angle start without distortion; a fixed one is kept."""
    made = flight()
    start = replace(LENS, params=np.array([900.0, 160, 120, 0, 0]))
    sequence = made.sequence(made.matched())
    found = solve(sequence, InitialLens(start, GUESS_SIGMA, "guess"), OPTIONS)
    assert found.camera.focal_px[0] == pytest.approx(LENS.focal_px[0], rel=0.005)
    assert pose_errors(found.poses, made.poses)[0].max() < 0.06
    held = solve(sequence, KNOWN, replace(OPTIONS, hold_lens=True))
    assert np.array_equal(held.camera.params, LENS.params)
    assert pose_errors(held.poses, made.poses)[0].max() < 0.03


def test_what_no_map_point_explains_becomes_a_point_of_the_sequence_where_it_is() -> None:
    """Tracks on the unmapped two thirds of the facade become own points at their true positions."""
    made = flight()
    putative = [matches[matches[:, 1] % 3 == 0] for matches in made.matched()]
    _, solution, _ = solved(made, putative)
    assert len(solution.own_points) > 60
    for row, point in enumerate(solution.own_points):
        mine = np.flatnonzero(solution.own == row)
        shown = {int(made.shows[solution.frame[k]][solution.feature[k]]) for k in mine}
        assert len(shown) == 1
        assert len(mine) >= 2
        assert np.linalg.norm(point - made.points[shown.pop()]) < 0.5
    assert pose_errors(solution.poses, made.poses)[0].max() < 0.15


def test_points_that_only_one_frame_sees_leave_with_the_others() -> None:
    """After removing frames 3 to 7, every remaining own point is seen in two remaining frames."""
    made = flight()
    putative = [matches[matches[:, 1] % 3 == 0] for matches in made.matched()]
    _, solution, _ = solved(made, putative)
    left = remove_frames(solution, np.arange(8) > 2)
    assert left.posed.tolist() == [k <= 2 for k in range(8)]
    assert left.frame.max() == 2
    counts = np.bincount(left.own[left.own >= 0], minlength=len(left.own_points))
    assert len(left.own_points) < len(solution.own_points)
    assert counts.min() >= 2


def test_a_frame_that_fails_later_says_why_it_did(monkeypatch: pytest.MonkeyPatch) -> None:
    """One frame fails at first, another after its removal, and each keeps its own reason."""
    rounds = iter([({3}, "first"), ({3, 5}, "second"), ({3, 5}, "third")])

    def scripted(posed: np.ndarray, *_: object) -> PoseVerdict:
        failing, reason = next(rounds)
        return PoseVerdict(
            np.array([k not in failing for k in range(8)]),
            tuple(reason if k in failing else "" for k in range(8)),
        )

    monkeypatch.setattr("spn_data.registration.register.check_poses", scripted)
    made = flight()
    found = accepted(made, made.matched())
    assert [found.reason[k] for k in (3, 5, 6)] == ["first", "second", ""]
    assert found.solution.posed.tolist() == [k not in (3, 5) for k in range(8)]


def accepted(made: Flight, putative: list[np.ndarray]):  # type: ignore[no-untyped-def]
    sequence = made.sequence(putative)
    solution = solve(sequence, KNOWN, OPTIONS)
    points = MapPoints(
        np.arange(100, 100 + len(made.points)),
        made.points,
        np.zeros((len(made.points), 3), np.uint8),
        np.full(len(made.points), 5),
    )
    return accept_poses(sequence, solution, made.pairs, PerfectMap(), points, OPTIONS)  # type: ignore[arg-type]


def test_what_failed_pulls_at_nothing_that_stands() -> None:
    """Two frames at the wrong window are removed from the adjustment and do not affect the others."""
    made = flight(10)
    found = accepted(made, made.matched({3: 1, 7: -1}))
    stands = [k not in (3, 7) for k in range(10)]
    assert found.solution.posed.tolist() == stands
    assert found.reason[3].startswith("ambiguous: ")
    assert found.inliers[3] > 50, "what is told of a frame is what held when it failed"
    error_m = pose_errors(found.solution.poses[np.array(stands)], made.poses[np.array(stands)])[0]
    assert error_m.max() < 0.05
    assert np.isnan(found.solution.poses.centers[[3, 7]]).all()
    assert np.isnan(found.covariances[[3, 7]]).all()
    assert np.linalg.eigvalsh(found.covariances[stands]).min() > 0
    assert not np.isin(found.seen.frame_idx, [3, 7]).any()
    assert found.seen.point_ids.min() >= 100


def test_where_nothing_stands_there_is_no_covariance() -> None:
    """If no frame is accepted, there is no covariance and each frame has a reason."""
    made = flight(3)
    found = accepted(made, [np.zeros((0, 2), np.int64)] * 3)
    assert not found.solution.posed.any()
    assert found.covariance is None
    assert found.reason == ("no feature matches a point of the map",) * 3


def test_a_frame_of_which_hardly_any_measurement_agrees_loses_its_pose() -> None:
    """A frame moved far off before the adjustment has no agreeing measurements and loses its pose alone."""
    made = flight()
    sequence, solution, _ = solved(made, made.matched())
    centers = solution.poses.centers.copy()
    centers[3] += [0, 40, 0]
    moved = replace(solution, poses=replace(solution.poses, centers=centers))
    again = adjust_inliers(sequence, moved, OPTIONS)
    assert again.posed.tolist() == [k != 3 for k in range(8)]
    assert np.isnan(again.poses.centers[3]).all()
    assert not (again.frame == 3).any()
