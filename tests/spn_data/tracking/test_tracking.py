"""Poses of frames between labelled ones, against the exact truth of a small rendered world."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from spn_data.capture.frames import FrameStatus
from spn_data.geometry.pose import Poses, pose_errors
from spn_data.geometry.pose_fit import fit_pose
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.matching.patches import track_points
from spn_data.tracking.label_video import drop_jumps, track_frames
from spn_data.tracking.point_tracking import spread_points, track_segment
from spn_data.tracking.segments import read_segments
from spn_data.tracking.tracked_frames import TrackedFrame, TrackingOptions
from tests.worlds.tracking_world import CAMERA, LABELLED, TEXTURE, N, World, visible

OPTIONS = TrackingOptions()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    return World(tmp_path_factory.mktemp("tracked"))


def poses_of(tracked: list[TrackedFrame]) -> Poses:
    return Poses(
        np.concatenate([f.poses.centers for f in tracked]),
        np.concatenate([f.poses.quats_wxyz for f in tracked]),
    )


def test_every_other_frame_of_two_files_gets_its_pose(world: World) -> None:
    """Frames between, before and after labels get poses, despite H.264, distortion and uneven motion."""
    heard: list[tuple[int, int]] = []
    labels, seen = track_frames(
        world.videos,
        world.frames,
        world.labelled,
        world.seen,
        {"f": CAMERA},
        world.points,
        OPTIONS,
        workers=1,
        progress=lambda step, done, total: heard.append((done, total)),
    )
    others = [k for k in range(N) if k not in LABELLED]
    assert labels.names.tolist() == [f"f/{k:06d}.jpg" for k in others]
    assert labels.video_frame.tolist() == [k % 12 for k in others]
    assert labels.sources.tolist() == ["a.mp4" if k < 12 else "b.mp4" for k in others]
    assert labels.tracked.all()
    assert labels.registered.all()
    error_m, error_deg = pose_errors(labels.poses, world.poses[np.array(others)])
    assert 1e-5 < np.median(error_m) < 0.004
    assert error_m.max() < 0.02
    assert error_deg.max() < 0.1
    assert heard[-1] == (20, 20)

    assert np.bincount(seen.frame_idx).tolist() == labels.inliers.tolist()
    ids, pixels = seen.of_frame(7)
    xyz = world.points.xyz[world.points.rows_of(ids)]
    true = world.poses[others[7] : others[7] + 1]
    there = CAMERA.project((xyz - true.centers[0]) @ true.rotations[0].T)
    assert np.median(np.linalg.norm(there - pixels, axis=1)) < 0.25
    assert 0.02 < labels.error_px[7] < 0.6
    assert labels.coverage.min() > 0.7


def test_frames_off_a_steady_motion_are_dropped_from_the_labels(world: World) -> None:
    """Frames whose rotation rate is not constant are dropped; two workers give the same poses."""
    options = replace(OPTIONS, max_jump_deg=0.02, max_turn_deg_s2=1e-6)
    labels, seen = track_frames(
        world.videos,
        world.frames,
        world.labelled,
        world.seen,
        {"f": CAMERA},
        world.points,
        options,
        workers=2,
    )
    dropped = ~labels.registered
    assert 3 <= dropped.sum() < 20
    assert set(labels.reason[dropped]) == {
        "its pose deviates from the motion of the frames before and after"
    }
    assert labels.inliers[dropped].max() == 0
    assert not np.isin(seen.frame_idx, np.flatnonzero(dropped)).any()


def test_points_are_followed_to_a_tenth_of_a_pixel() -> None:
    """Points are followed to 0.1 px from a start 12 px off; points out of view or occluded are lost."""
    before = TEXTURE[:400, :400]
    moved = cv2.warpAffine(
        before, np.array([[1, 0, 3.3], [0, 1, -2.6]]), (400, 400), flags=cv2.INTER_CUBIC
    )
    hidden = np.random.default_rng(3).integers(0, 255, (120, 120)).astype(np.uint8)
    moved[140:260, 140:260] = cv2.GaussianBlur(hidden, (0, 0), 2)
    x, y = np.meshgrid(np.arange(40.5, 360, 40), np.arange(40.5, 360, 40))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    pixels[0] = (398.0, 200.0)
    there, found = track_points(
        before,
        moved,
        pixels,
        pixels + np.array([9.0, 8.0]),
        levels=3,
        window_px=OPTIONS.window_px,
        round_trip_px=OPTIONS.round_trip_px,
    )
    behind = np.all((pixels > 150) & (pixels < 250), axis=1)
    clear = np.any((pixels < 110) | (pixels > 290), axis=1)
    assert behind.sum() == 9
    assert not found[behind].any()
    assert not found[0]
    assert found[clear].mean() > 0.95
    right = found & clear
    error = there[right] - pixels[right] - [3.3, -2.6]
    assert np.abs(error).max() < 0.1


def test_a_larger_image_is_followed_at_reduced_size_in_full_size_pixels(world: World) -> None:
    """At half size, poses agree within what the resolution allows, and pixels are in full-size units."""
    segment = world.segment(9, 15)
    small = [cv2.resize(g, (240, 135), interpolation=cv2.INTER_AREA) for g in segment.grays]
    anchors = [
        replace(a, gray=cv2.resize(a.gray, (240, 135), interpolation=cv2.INTER_AREA))
        for a in segment.anchors
    ]
    options = replace(OPTIONS, start_halvings=1)
    tracked = track_segment(replace(segment, grays=small, anchors=anchors), options)
    error_m, error_deg = pose_errors(poses_of(tracked), world.poses[segment.rows])
    assert error_m.max() < 0.03
    assert error_deg.max() < 0.15
    for frame, row in zip(tracked, segment.rows.tolist(), strict=True):
        ids, there = visible(world.points, world.poses[row : row + 1])
        _, mine, true = np.intersect1d(frame.point_ids, ids, return_indices=True)
        assert np.median(np.linalg.norm(frame.pixels[mine] - there[true], axis=1)) < 0.5


def test_a_labelled_frame_in_the_wrong_place_takes_its_neighbours_along_to_no_place(
    world: World,
) -> None:
    """If a label and its points are both 1.5 m off, as on a repeated facade, no frame is labelled wrong."""
    segment = world.segment(9, 15)
    right, wrong = segment.anchors
    off = np.array([1.5, 0.0, 0.0])
    wrong = replace(
        wrong,
        poses=Poses(wrong.poses.centers + off, wrong.poses.quats_wxyz),
        xyz=wrong.xyz + off,
        point_ids=wrong.point_ids + 100_000,
    )
    tracked = track_segment(replace(segment, anchors=[right, wrong]), OPTIONS)
    for frame, row in zip(tracked, segment.rows.tolist(), strict=True):
        if not frame.reason:
            error_m, error_deg = pose_errors(frame.poses, world.poses[row : row + 1])
            assert error_m[0] < 0.5
            assert error_deg[0] < 2
    assert sum(bool(f.reason) for f in tracked) >= 4


def test_a_frame_of_something_else_fails_and_those_around_it_do_not(world: World) -> None:
    """A frame of pure noise fails, and the frames around it do not."""
    segment = world.segment(9, 15)
    grays = list(segment.grays)
    grays[2] = np.random.default_rng(0).integers(0, 255, grays[2].shape).astype(np.uint8)
    tracked = track_segment(replace(segment, grays=grays), OPTIONS)
    assert [bool(f.reason) for f in tracked] == [False, False, True, False, False]
    assert np.isnan(tracked[2].poses.centers).all()
    assert len(tracked[2].point_ids) == 0


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (replace(OPTIONS, min_inliers=10_000), "points of the adjacent labelled frames"),
        (replace(OPTIONS, min_coverage=1.01), "cover only"),
        (replace(OPTIONS, max_sigma=1e-9), "don't determine its pose"),
        (replace(OPTIONS, max_split=1e-9), "ambiguous"),
    ],
)
def test_each_check_names_its_reason(world: World, options: TrackingOptions, reason: str) -> None:
    """Each check refuses the frames with its own reason."""
    segment = world.segment(15, 20)
    for frame in track_segment(segment, options):
        assert reason in frame.reason


def test_a_pose_off_the_motion_of_its_neighbours_fails_and_they_stay(world: World) -> None:
    """A pose displaced by 5 % of its distance fails, and its neighbours keep their poses."""
    tracked = [*track_segment(world.segment(9, 15), OPTIONS)]
    found = {frame.row: frame for frame in tracked}
    drop_jumps(world.sequence, found, OPTIONS)
    assert not any(frame.reason for frame in found.values())
    moved = found[12].poses.centers + np.array([0, 0.05 * found[12].distance, 0])
    found[12] = replace(found[12], poses=Poses(moved, found[12].poses.quats_wxyz))
    drop_jumps(world.sequence, found, OPTIONS)
    assert [row for row, frame in found.items() if frame.reason] == [12]
    assert "deviates from the motion" in found[12].reason


def test_segments_lie_between_labelled_frames_and_hold_both(world: World) -> None:
    """Segments are bounded by two labelled frames; the frames at both ends use the two nearest labels."""
    reasons: dict[int, str] = {}
    lengths = np.random.default_rng(4).integers(2, 40, len(world.points))
    sequence = replace(world.sequence, points=replace(world.points, track_lengths=lengths))
    segments = list(read_segments(sequence, world.videos, OPTIONS, reasons))
    of_first = lengths[world.points.rows_of(segments[0].anchors[0].point_ids)]
    assert (np.diff(of_first) <= 0).all()  # points seen in most frames are followed first
    assert [s.rows.tolist() for s in segments] == [
        [0, 1, 2],
        [4, 5, 6, 7, 8],
        [10, 11, 12, 13, 14],
        [16, 17, 18, 19],
        [21, 22, 23],
    ]
    ends = [[round(a.time_s * 10) for a in s.anchors] for s in segments]
    assert ends == [[3, 9], [3, 9], [9, 15], [15, 20], [15, 20]]
    assert reasons == {}


def test_a_long_gap_keeps_its_ends_only_and_memory_bounded(world: World) -> None:
    """With only frames 3 and 20 labelled, frames mid-gap fail and at most four images are kept in memory."""
    few = np.array([0, 3])
    sequence = replace(
        world.sequence, labelled=world.labelled.select(few), seen=world.seen.select(few)
    )
    options = replace(OPTIONS, max_batch_mb=4.5 * 480 * 270 / 1e6)
    reasons: dict[int, str] = {}
    segments = list(read_segments(sequence, world.videos, options, reasons))
    assert [s.rows.tolist() for s in segments][1:] == [
        [4, 5, 6, 7, 8],
        [16, 17, 18, 19],
        [21, 22, 23],
    ]
    assert sorted(reasons) == [*range(9, 16)]
    assert set(reasons.values()) == {"too far from any labelled frame"}


def test_frames_of_a_lens_without_labels_and_unreadable_frames_say_so(world: World) -> None:
    """After a zoom change without labels frames fail with a reason, as does a damaged frame."""
    frames = world.frames
    cameras = frames.cameras.astype("<U4")
    cameras[21:] = "f-2"
    status, reason = frames.status.copy(), frames.reason.copy()
    status[5], reason[5] = FrameStatus.UNREADABLE.value, "damaged in the file"
    changed = replace(frames, cameras=cameras, status=status, reason=reason)
    sequence = replace(world.sequence, frames=changed)
    reasons: dict[int, str] = {}
    segments = list(read_segments(sequence, world.videos, OPTIONS, reasons))
    assert segments[-1].rows.tolist() == [16, 17, 18, 19]
    assert reasons == {
        5: "damaged in the file",
        **dict.fromkeys((21, 22, 23), "no labelled frame of its camera"),
    }


def test_a_pose_is_fitted_among_outliers_and_not_where_points_lie_behind(world: World) -> None:
    """With a third of the points 5 to 60 px off and a start 30 cm and 1.5 degrees off, the pose is found."""
    rng = np.random.default_rng(1)
    true = world.poses[10:11]
    ids, pixels = visible(world.points, true)
    xyz = world.points.xyz[world.points.rows_of(ids)]
    noisy = pixels + 0.3 * rng.standard_normal(pixels.shape)
    bad = rng.random(len(pixels)) < 0.33
    noisy[bad] += rng.uniform(5, 60, (bad.sum(), 2))
    turn = rotations_from_angles(np.array([[1.5, 0, 0]])) @ rotations_from_angles(
        np.zeros((1, 3))
    ).transpose(0, 2, 1)
    start = Poses.from_rotations(true.centers + np.array([0.2, 0.2, -0.1]), turn @ true.rotations)
    fit = fit_pose(CAMERA, start, xyz, noisy, first_px=16.0, last_px=1.0)
    assert fit is not None
    error_m, error_deg = pose_errors(fit.poses, true)
    assert error_m[0] < 0.02
    assert error_deg[0] < 0.05
    assert np.array_equal(fit.inliers(2.0), ~bad)
    # The noise is 0.3 px per axis; `inverse` is for one pixel.
    sigma_m = 0.3 * np.sqrt(np.trace(fit.inverse[:3, :3]))
    assert error_m[0] / 4 < sigma_m < 0.02
    behind = Poses(true.centers + np.array([0.0, 100.0, 0.0]), true.quats_wxyz)
    assert fit_pose(CAMERA, behind, xyz, pixels, first_px=16.0, last_px=1.0) is None


def test_points_are_spread_over_the_image_and_the_first_of_a_cell_kept() -> None:
    """90 of 100 points crowd one corner, and all 10 others are kept."""
    rng = np.random.default_rng(2)
    crowd = rng.uniform(0, 30, (90, 2))
    others = np.column_stack([np.linspace(150, 470, 10), np.linspace(60, 260, 10)])
    rows = spread_points(np.concatenate([crowd, others]), 480, 270, 30)
    assert len(rows) == 30
    assert set(range(90, 100)) <= set(rows.tolist())
    assert 0 in rows
