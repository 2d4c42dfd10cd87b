"""Second attempt at frames that failed: carried by accepted frames, kept if the map confirms them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from spn_data.geometry.pose import pose_errors
from spn_data.registration.checks import gather_evidence
from spn_data.registration.map_search import MapSearch, search_map
from spn_data.registration.recovery import carry_failed_frames, check_carried
from spn_data.registration.register import RegisteredSequence, accept_poses, recover_frames
from spn_data.registration.register_options import RegisterOptions
from spn_data.registration.solution import UnsolvedSequence
from spn_data.registration.solve import solve
from tests.worlds.registration_scene import (
    KNOWN,
    LENS,
    PITCH_M,
    FacadeMap,
    Flight,
    PerfectMap,
    flight,
)

OPTIONS = RegisterOptions()
WEAK = [3, 7]  # frames that agree with a wrong window


def first_attempt(made: Flight) -> tuple[UnsolvedSequence, RegisteredSequence]:
    """Register a flight of which two frames fail, since they were matched with another window."""
    sequence = made.sequence(made.matched({3: 1, 7: -1}))
    solution = solve(sequence, KNOWN, OPTIONS)
    points = FacadeMap(made).points
    covariance = cast(Any, PerfectMap())
    first = accept_poses(sequence, solution, made.pairs, covariance, points, OPTIONS)
    assert np.flatnonzero(~first.solution.posed).tolist() == WEAK
    return sequence, first


def recovered(
    made: Flight, sequence: UnsolvedSequence, first: RegisteredSequence, seed: int = 7
) -> RegisteredSequence:
    """Try again; the descriptors of the frames are those of a map of seed 7."""
    here, frozen = FacadeMap(made), FacadeMap(made, seed)
    return recover_frames(
        sequence,
        first,
        made.pairs,
        cast(Any, PerfectMap()),
        cast(Any, frozen),
        lambda row: here.descriptors(made.shows[row]),
        OPTIONS,
    )


@pytest.fixture(scope="module")
def made() -> Flight:
    return flight(10)


@pytest.fixture(scope="module")
def failed(made: Flight) -> tuple[UnsolvedSequence, RegisteredSequence]:
    return first_attempt(made)


def test_frames_at_a_wrong_window_are_carried_to_the_right_one(
    made: Flight, failed: tuple[UnsolvedSequence, RegisteredSequence]
) -> None:
    """Two frames matched with the wrong window get their true poses, and observe the map there."""
    found = recovered(made, *failed)
    assert found.solution.posed.all()
    assert found.reason == ("",) * 10
    assert pose_errors(found.solution.poses, made.poses)[0].max() < 0.05
    assert np.linalg.eigvalsh(found.covariances).min() > 0
    for row in WEAK:
        assert found.inliers[row] > 30
        mine = found.seen.frame_idx == row
        shown = dict(zip(map(tuple, made.pixels[row]), made.shows[row], strict=True))
        pairs = zip(map(tuple, found.seen.pixels[mine]), found.seen.point_ids[mine], strict=True)
        assert all(shown[pixel] + 100 == point for pixel, point in pairs)


def test_a_frame_that_the_map_does_not_confirm_keeps_its_reason(
    made: Flight, failed: tuple[UnsolvedSequence, RegisteredSequence]
) -> None:
    """Where the map looks different, neighbours alone give no label, and nothing else changes."""
    assert recovered(made, *failed, seed=8) is failed[1]


def test_without_a_failed_or_without_an_accepted_frame_nothing_is_tried(
    made: Flight, failed: tuple[UnsolvedSequence, RegisteredSequence]
) -> None:
    """A sequence that registers fully, or not at all, is returned as it is."""
    sequence, first = failed
    for posed in (np.ones(10, bool), np.zeros(10, bool)):
        same = replace(first, solution=replace(first.solution, posed=posed))
        assert recovered(made, sequence, same) is same


def test_a_carried_frame_needs_two_neighbours_a_majority_and_certainty(
    made: Flight, failed: tuple[UnsolvedSequence, RegisteredSequence]
) -> None:
    """Two of three voting neighbours carry a frame; one of three does not, nor do two with a large sigma."""
    sequence, first = failed
    frozen = FacadeMap(made)
    carried = carry_failed_frames(
        sequence,
        first.solution,
        cast(Any, frozen),
        lambda row: frozen.descriptors(made.shows[row]),
        OPTIONS,
    )
    assert carried is not None
    sequence, solution = carried
    covariances = np.tile(1e-6 * np.eye(6), (10, 1, 1))
    found = gather_evidence(sequence, solution, covariances, made.pairs, OPTIONS, find_rivals=False)
    assert not found.rival.any()

    def stands(votes: list[float], sigma: float = 0.001) -> bool:
        voting = dict(zip([(1, 3), (2, 3), (3, 5)], votes, strict=True))
        of_3 = [3 in pair for pair in found.pairs.tolist()]
        shares = [voting.get((i, j), np.nan) for i, j in found.pairs.tolist()]
        voted = replace(
            found,
            agreement=np.where(of_3, shares, 1.0),
            matches=np.where(of_3 & np.isnan(shares), 0, found.matches),
            sigma=np.where(np.arange(10) == 3, sigma, found.sigma),
        )
        accepted = first.solution.posed
        judged = check_carried(sequence, solution, accepted, voted, OPTIONS.checks)
        assert judged[np.arange(10) != 3].all()
        return bool(judged[3])

    assert stands([1.0, 1.0, 1.0])
    assert stands([1.0, 1.0, 0.0])
    assert not stands([1.0, 0.0, 0.0])
    assert not stands([1.0, 1.0, 1.0], sigma=1.0)


def test_the_search_finds_the_points_and_nothing_beside_them(made: Flight) -> None:
    """At the true pose all points are found; at one that is a window off, none is near its place."""
    frozen = FacadeMap(made)
    row = 5
    described = frozen.descriptors(made.shows[row])
    for off_m, found in ((0.0, True), (PITCH_M, False)):
        pose = replace(made.poses, centers=made.poses.centers + np.array([off_m, 0, 0]))[
            row : row + 1
        ]
        search = search_map(
            made.pixels[row], described, pose, LENS, cast(Any, frozen), OPTIONS.matching
        )
        right = made.shows[row][search.matches[:, 0]] == search.matches[:, 1]
        assert right.all()
        assert (len(right) > 0.9 * len(made.shows[row])) == found
        assert (search.chance() < 1e-9) == found
        assert found or not len(right)
    empty = search_map(
        np.zeros((0, 2)),
        np.zeros((0, 128), np.uint8),
        made.poses[row : row + 1],
        LENS,
        cast(Any, frozen),
        OPTIONS.matching,
    )
    assert empty.chance() == 1.0


def test_features_spread_over_the_search_radius_are_no_witness() -> None:
    """Matches all over the search radius may be chance; as many in its middle are not; a heap counts once."""
    rng = np.random.default_rng(2)
    pixels = 40.0 * np.arange(30)[:, None] + np.zeros(2)
    matches = np.zeros((30, 2), np.int64)
    spread = MapSearch(matches, 12 * np.sqrt(rng.random(30)), pixels)
    middle = MapSearch(matches, 3 * np.sqrt(rng.random(30)), pixels)
    heap = replace(middle, pixels=np.zeros((30, 2)))
    assert spread.chance() > 0.01
    assert middle.chance() < 1e-20
    assert heap.witnesses() == (1, 1)
