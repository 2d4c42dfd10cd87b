"""Poses of the frames between labelled ones, against the exact truth of a small rendered world."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from spn_data.camera import Camera
from spn_data.dense import dense_labels, drop_jumps
from spn_data.dense_segments import SequenceToLabel, read_segments
from spn_data.dense_tracking import (
    Anchor,
    DenseOptions,
    Segment,
    TrackedFrame,
    follow,
    spread,
    track_segment,
)
from spn_data.frames import Frames, FrameStatus
from spn_data.labels import Labels, LabelStatus, SeenPoints
from spn_data.map_points import MapPoints
from spn_data.pose import Poses, pose_errors, rotations_from_angles
from spn_data.pose_fit import fit_pose
from spn_data.simulate.video_out import write_video

CAMERA = Camera.from_horizontal_fov(480, 270, 80, (-0.08, 0.02))
OPTIONS = DenseOptions()
N = 24
LABELLED = (3, 9, 15, 20)
WALL_NORTH_M = 15.0
TEXELS_PER_M = 24


def path() -> Poses:
    """10 fps past a wall 11 m away, 4 m above the ground, turning and nodding; not at constant velocity."""
    t = np.arange(N) / 10
    centers = np.stack([-2 + 1.6 * t + 0.3 * t**2, 4 - 0.5 * t, 4 + 0.4 * np.sin(2 * t)], axis=1)
    angles = np.stack([-8 + 6 * t + 3 * t**2, -14 + 3 * np.sin(2 * t), np.sin(3 * t)], axis=1)
    return Poses.from_rotations(centers, rotations_from_angles(angles))


def texture() -> np.ndarray:
    """Blobs of several sizes, which do not repeat."""
    rng = np.random.default_rng(5)
    image = np.zeros((1536, 1536), np.float32)
    for size in (1, 3, 9):
        noise = cv2.GaussianBlur(rng.standard_normal(image.shape).astype(np.float32), (0, 0), size)
        image += noise / noise.std()
    return np.clip(128 + 30 * image, 0, 255).astype(np.uint8)


TEXTURE = texture()


def surfaces(rays: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Where rays (K, 3) from a centre meet the ground (up 0) or the wall (north 15 m)."""
    with np.errstate(divide="ignore"):
        to_ground = np.where(rays[:, 2] < 0, -center[2] / rays[:, 2], np.inf)
        to_wall = np.where(rays[:, 1] > 0, (WALL_NORTH_M - center[1]) / rays[:, 1], np.inf)
    return center + rays * np.minimum(to_ground, to_wall)[:, None]


def rays_of(pixels: np.ndarray, pose: Poses) -> np.ndarray:
    xy = CAMERA.unproject(pixels)
    return np.column_stack([xy, np.ones(len(xy))]) @ pose.rotations[0]


def render(pose: Poses) -> np.ndarray:
    """Grey image (270, 480)."""
    x, y = np.meshgrid(np.arange(480) + 0.5, np.arange(270) + 0.5)
    hit = surfaces(rays_of(np.column_stack([x.ravel(), y.ravel()]), pose), pose.centers[0])
    # The ground goes on behind the wall's foot, so that the texture has no seam there.
    along = np.where(hit[:, 2] > 1e-9, WALL_NORTH_M + hit[:, 2], hit[:, 1])
    u, v = (hit[:, 0] + 30) * TEXELS_PER_M, along * TEXELS_PER_M
    maps = [m.reshape(270, 480).astype(np.float32) for m in (u, v)]
    return cv2.remap(TEXTURE, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def map_points(poses: Poses) -> MapPoints:
    """What a grid of pixels of the labelled frames sees."""
    x, y = np.meshgrid(np.arange(12, 480, 24.0), np.arange(12, 270, 24.0))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    xyz = np.concatenate(
        [surfaces(rays_of(pixels, poses[k : k + 1]), poses.centers[k]) for k in LABELLED]
    )
    xyz = xyz[np.abs(xyz[:, 0]) < 28]
    n = len(xyz)
    return MapPoints(np.arange(10, 10 + n), xyz, np.zeros((n, 3), np.uint8), np.full(n, 3))


def visible(points: MapPoints, pose: Poses) -> tuple[np.ndarray, np.ndarray]:
    """(ids, pixels) of the points inside the image."""
    pixels = CAMERA.project((points.xyz - pose.centers[0]) @ pose.rotations[0].T)
    inside = np.all((pixels > 12) & (pixels < [468, 258]), axis=1)
    return points.ids[inside], pixels[inside]


def table(names: list[str], sources: list[str], video_frame: list[int]) -> Frames:
    n = len(names)
    nan = np.full(n, np.nan)
    return Frames(
        names=np.array(names),
        sequences=np.array(["f"] * n),
        cameras=np.array(["f"] * n),
        sources=np.array(sources),
        video_frame=np.array(video_frame),
        time_s=np.arange(n) / 10,
        status=np.array([FrameStatus.SKIPPED.value] * n, dtype="<U10"),
        reason=np.array([""] * n, dtype="<U40"),
        sharpness=nan,
        motion_px=nan,
        width=np.full(n, 480),
        height=np.full(n, 270),
        lat_lon_deg=np.full((n, 2), np.nan),
        rel_alt_m=nan,
        abs_alt_m=nan,
        sigma_m=np.full((n, 3), np.nan),
        gimbal_deg=np.full((n, 3), np.nan),
    )


def labels_of(frames: Frames, rows: tuple[int, ...], poses: Poses) -> Labels:
    n = len(rows)
    chosen = frames.select(np.array(rows))
    return Labels(
        names=chosen.names,
        sequences=chosen.sequences,
        cameras=chosen.cameras,
        sources=chosen.sources,
        video_frame=chosen.video_frame,
        dense=np.zeros(n, bool),
        time_s=chosen.time_s,
        status=np.array([LabelStatus.REGISTERED.value] * n),
        reason=np.array([""] * n),
        poses=poses[np.array(rows)],
        covariance=np.full((n, 6, 6), np.nan),
        inliers=np.full(n, 100),
        coverage=np.ones(n),
        error_px=np.ones(n),
    )


class World:
    """A flight in two files, four of its frames labelled."""

    def __init__(self, folder: Path) -> None:
        self.poses = path()
        self.grays = [render(self.poses[k : k + 1]) for k in range(N)]
        half = N // 2
        self.videos = [folder / "a.mp4", folder / "b.mp4"]
        for video, images in zip(self.videos, (self.grays[:half], self.grays[half:]), strict=True):
            rgb = (np.repeat(g[:, :, None], 3, axis=2) for g in images)
            write_video(video, rgb, width=480, height=270, fps=10, crf=16)
        self.frames = table(
            [f"f/{k:06d}.jpg" for k in range(N)],
            [self.videos[k // half].name for k in range(N)],
            [k % half for k in range(N)],
        )
        self.points = map_points(self.poses)
        self.labelled = labels_of(self.frames, LABELLED, self.poses)
        views = [visible(self.points, self.poses[k : k + 1]) for k in LABELLED]
        self.seen = SeenPoints(
            np.repeat(np.arange(len(LABELLED)), [len(ids) for ids, _ in views]),
            np.concatenate([ids for ids, _ in views]),
            np.concatenate([pixels for _, pixels in views]),
        )

    @property
    def sequence(self) -> SequenceToLabel:
        return SequenceToLabel(self.frames, self.labelled, self.seen, {"f": CAMERA}, self.points)

    def anchor(self, k: int) -> Anchor:
        ids, pixels = self.seen.of_frame(LABELLED.index(k))
        xyz = self.points.xyz[self.points.rows_of(ids)]
        return Anchor(k / 10, self.grays[k], self.poses[k : k + 1], ids, xyz, pixels)

    def segment(self, first: int, last: int) -> Segment:
        """The frames between two labelled ones."""
        rows = np.arange(first + 1, last)
        anchors = [self.anchor(first), self.anchor(last)]
        return Segment(rows, rows / 10, [self.grays[k] for k in rows], CAMERA, anchors)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    return World(tmp_path_factory.mktemp("dense"))


def poses_of(tracked: list[TrackedFrame]) -> Poses:
    return Poses(
        np.concatenate([f.poses.centers for f in tracked]),
        np.concatenate([f.poses.quats_wxyz for f in tracked]),
    )


def test_every_other_frame_of_two_files_gets_its_pose(world: World) -> None:
    """Through H.264, a distorted lens, uneven motion; before the first and after the last label as well."""
    heard: list[tuple[int, int]] = []
    labels, seen = dense_labels(
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
    assert labels.dense.all()
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


def test_points_are_followed_to_a_tenth_of_a_pixel() -> None:
    """An image moved by a known fraction, begun 12 pixels off; points that leave it are not found."""
    moved = cv2.warpAffine(
        TEXTURE[:400, :400],
        np.array([[1, 0, 3.3], [0, 1, -2.6]]),
        (400, 400),
        flags=cv2.INTER_CUBIC,
    )
    x, y = np.meshgrid(np.arange(40.5, 360, 40), np.arange(40.5, 360, 40))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    pixels[0] = (398.0, 200.0)
    there, found = follow(
        TEXTURE[:400, :400], moved, pixels, pixels + np.array([9.0, 8.0]), 3, OPTIONS
    )
    assert not found[0]
    assert found[1:].mean() > 0.9
    error = there[found] - pixels[found] - [3.3, -2.6]
    assert np.abs(error).max() < 0.1


def test_a_larger_image_is_followed_at_reduced_size_in_full_size_pixels(world: World) -> None:
    """Half the size: the same poses within what half the pixels can tell, pixels as before."""
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
    """Its pose and points 1.5 m off together, as a repeated facade would have it: none is labelled wrong."""
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
    """Here its pixels are noise."""
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
        (replace(OPTIONS, min_inliers=10_000), "points of the labelled frames beside it"),
        (replace(OPTIONS, min_coverage=1.01), "cover only"),
        (replace(OPTIONS, max_sigma=1e-9), "don't determine its pose"),
        (replace(OPTIONS, max_split=1e-9), "ambiguous"),
    ],
)
def test_each_check_names_its_reason(world: World, options: DenseOptions, reason: str) -> None:
    segment = world.segment(15, 20)
    for frame in track_segment(segment, options):
        assert reason in frame.reason


def test_a_pose_off_the_motion_of_its_neighbours_fails_and_they_stay(world: World) -> None:
    """Moved by 5 % of its distance; without it the frames beside it fit."""
    tracked = [*track_segment(world.segment(9, 15), OPTIONS)]
    found = {frame.row: frame for frame in tracked}
    drop_jumps(world.sequence, found, OPTIONS)
    assert not any(frame.reason for frame in found.values())
    moved = found[12].poses.centers + np.array([0, 0.05 * found[12].distance, 0])
    found[12] = replace(found[12], poses=Poses(moved, found[12].poses.quats_wxyz))
    drop_jumps(world.sequence, found, OPTIONS)
    assert [row for row, frame in found.items() if frame.reason] == [12]
    assert "off the motion" in found[12].reason


def test_segments_lie_between_labelled_frames_and_hold_both(world: World) -> None:
    """The frames before the first one wait for the second; those after the last have the last two."""
    reasons: dict[int, str] = {}
    segments = list(read_segments(world.sequence, world.videos, OPTIONS, reasons))
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
    """Only frames 3 and 20 are labelled, and four images are all that may wait."""
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
    """The zoom changed after the last labelled frame; one frame before was damaged."""
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
    """A third of the points are 5 to 60 pixels off; the start is 30 cm and 1.5 degrees off."""
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
    # 0.3 px on each axis, and the inverse is that of one pixel.
    sigma_m = 0.3 * np.sqrt(np.trace(fit.inverse[:3, :3]))
    assert error_m[0] / 4 < sigma_m < 0.02
    behind = Poses(true.centers + np.array([0.0, 100.0, 0.0]), true.quats_wxyz)
    assert fit_pose(CAMERA, behind, xyz, pixels, first_px=16.0, last_px=1.0) is None


def test_points_are_spread_over_the_image_and_the_first_of_a_cell_kept() -> None:
    """90 of 100 points crowd one corner, and all 10 others are kept."""
    rng = np.random.default_rng(2)
    crowd = rng.uniform(0, 30, (90, 2))
    others = np.column_stack([np.linspace(150, 470, 10), np.linspace(60, 260, 10)])
    rows = spread(np.concatenate([crowd, others]), 480, 270, 30)
    assert len(rows) == 30
    assert set(range(90, 100)) <= set(rows.tolist())
    assert 0 in rows
