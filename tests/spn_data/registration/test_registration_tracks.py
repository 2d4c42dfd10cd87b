"""Feature tracks over the frames of a sequence, and their triangulated points."""

from __future__ import annotations

import numpy as np
import pytest

from spn_data.geometry.pose import Poses
from spn_data.registration.tracks import Tracks, find_tracks, triangulate
from tests.worlds.registration_scene import LENS, Flight, flight


def members(tracks: Tracks) -> list[list[tuple[int, int]]]:
    """Return the (frame, feature) pairs of each track."""
    return [
        list(
            zip(
                tracks.frame[tracks.track == t].tolist(),
                tracks.feature[tracks.track == t].tolist(),
                strict=True,
            )
        )
        for t in range(tracks.count)
    ]


def pairs(*triples: tuple[int, int, list[list[int]]]) -> dict[tuple[int, int], np.ndarray]:
    return {(i, j): np.array(matches, np.int64).reshape(-1, 2) for i, j, matches in triples}


def test_matches_of_following_pairs_make_one_track() -> None:
    """Pairs 0-1 and 1-2 that share a feature of frame 1 form one track; another pair forms its own."""
    found = find_tracks(pairs((0, 1, [[5, 7], [0, 1]]), (1, 2, [[7, 3]])), [6, 8, 4])
    assert sorted(members(found)) == [[(0, 0), (1, 1)], [(0, 5), (1, 7), (2, 3)]]
    assert np.all(np.diff(found.track) >= 0)


def test_a_track_that_meets_a_frame_twice_is_left_out() -> None:
    """A track that would contain two features of one frame is dropped."""
    found = find_tracks(
        pairs((0, 1, [[0, 0], [2, 2]]), (1, 2, [[0, 0]]), (0, 2, [[1, 0]])), [3, 3, 3]
    )
    assert members(found) == [[(0, 2), (1, 2)]]


@pytest.mark.parametrize("matched", [{}, pairs((0, 1, []))])
def test_no_matches_make_no_tracks(matched: dict[tuple[int, int], np.ndarray]) -> None:
    """Without matches there are no tracks."""
    found = find_tracks(matched, [4, 4])
    assert found.count == 0
    assert len(found.frame) == len(found.feature) == 0


def test_tracks_of_a_flight_are_its_points() -> None:
    """With correct matches of a flight, each track is one point, in every frame that sees it."""
    made = flight(6)
    tracks = find_tracks(made.pairs, [len(p) for p in made.pixels])
    shown = np.array([made.shows[f][k] for f, k in zip(tracks.frame, tracks.feature, strict=True)])
    for t in range(tracks.count):
        assert len(set(shown[tracks.track == t].tolist())) == 1
    assert tracks.count == len(np.unique(shown))


def seen_at(made: Flight, pixels: np.ndarray, frames: list[int], **options: float) -> np.ndarray:
    """Return the point (3,) of one track."""
    limits = {"max_error_px": 4.0, "min_angle_deg": 1.5, **options}
    return triangulate(
        made.poses,
        LENS,
        pixels,
        np.array(frames),
        np.zeros(len(frames), np.int64),
        1,
        max_error_px=limits["max_error_px"],
        min_angle_deg=limits["min_angle_deg"],
    )[0]


def project(made: Flight, point: np.ndarray, frames: list[int]) -> np.ndarray:
    in_camera = np.einsum(
        "mij,mj->mi", made.poses.rotations[frames], point - made.poses.centers[frames]
    )
    return LENS.project(in_camera)


POINT = np.array([11.0, 0.5, 3.0])


def test_exact_rays_meet_in_their_point() -> None:
    """Exact measurements triangulate to the exact point."""
    made = flight(6)
    found = seen_at(made, project(made, POINT, [1, 2, 4]), [1, 2, 4])
    assert np.abs(found - POINT).max() < 1e-9


def test_noise_moves_a_point_as_far_as_its_angle_says() -> None:
    """0.3 px noise moves a point about a centimetre across and some centimetres in depth at 8 m.

    The focal length is 280 px and the baseline 3 m.
    """
    made = flight(6)
    rng = np.random.default_rng(3)
    frames = [1, 2, 3, 4]
    errors = np.array(
        [
            seen_at(made, project(made, POINT, frames) + rng.normal(0, 0.3, (4, 2)), frames) - POINT
            for _ in range(60)
        ]
    )
    assert 0.001 < errors[:, [0, 2]].std() < 0.012
    assert 0.01 < errors[:, 1].std() < 0.08


@pytest.mark.parametrize(
    ("frames", "off", "limit"),
    [
        ([2], [0.0, 0.0], 1.5),
        ([2, 3], [0.0, 0.0], 20.0),
        ([1, 2, 3], [0.0, 15.0], 1.5),
    ],
    ids=["one frame", "rays almost parallel", "a wrong measurement"],
)
def test_what_does_not_determine_a_point_gives_none(
    frames: list[int], off: list[float], limit: float
) -> None:
    """A single frame, nearly parallel rays and a wrong measurement each give no point."""
    made = flight(6)
    pixels = project(made, POINT, frames)
    pixels[-1] += off
    assert np.isnan(seen_at(made, pixels, frames, min_angle_deg=limit)).all()


def test_rays_that_meet_behind_the_cameras_give_no_point() -> None:
    """If the measurements of two frames are swapped, rays meet behind the cameras and give no point."""
    made = flight(6)
    frames = [1, 4]
    straight = Poses(made.poses.centers, np.tile(made.poses.quats_wxyz[:1], (6, 1)))
    level = Flight(straight, made.points, made.pixels, made.shows)
    pixels = project(level, POINT, frames)[::-1].copy()
    assert np.isnan(seen_at(level, pixels, frames, max_error_px=1e9)).all()
