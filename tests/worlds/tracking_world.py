"""Small world of a ground and a wall, rendered along a flight with some labelled frames."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from spn_data.capture.frames import Frames, FrameStatus
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.labels.labels import LabelObservations, Labels, LabelStatus
from spn_data.labels.map_points import MapPoints
from spn_data.simulate.video_out import write_video
from spn_data.tracking.segments import SequenceToLabel
from spn_data.tracking.tracked_frames import Anchor, Segment

CAMERA = Camera.from_horizontal_fov(480, 270, 80, (-0.08, 0.02))
N = 24
LABELLED = (3, 9, 15, 20)
WALL_NORTH_M = 15.0
TEXELS_PER_M = 24


def path() -> Poses:
    """Fly past a wall 11 m away at 10 fps, 4 m above the ground, with varying velocity, heading and pitch."""
    t = np.arange(N) / 10
    centers = np.stack([-2 + 1.6 * t + 0.3 * t**2, 4 - 0.5 * t, 4 + 0.4 * np.sin(2 * t)], axis=1)
    angles = np.stack([-8 + 6 * t + 3 * t**2, -14 + 3 * np.sin(2 * t), np.sin(3 * t)], axis=1)
    return Poses.from_rotations(centers, rotations_from_angles(angles))


def texture() -> np.ndarray:
    """Paint blobs of several sizes that do not repeat."""
    rng = np.random.default_rng(5)
    image = np.zeros((1536, 1536), np.float32)
    for size in (1, 3, 9):
        noise = cv2.GaussianBlur(rng.standard_normal(image.shape).astype(np.float32), (0, 0), size)
        image += noise / noise.std()
    return np.clip(128 + 30 * image, 0, 255).astype(np.uint8)


TEXTURE = texture()


def surfaces(rays: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Intersect rays (K, 3) from a centre with the ground (up 0) or the wall (north 15 m)."""
    with np.errstate(divide="ignore"):
        to_ground = np.where(rays[:, 2] < 0, -center[2] / rays[:, 2], np.inf)
        to_wall = np.where(rays[:, 1] > 0, (WALL_NORTH_M - center[1]) / rays[:, 1], np.inf)
    return center + rays * np.minimum(to_ground, to_wall)[:, None]


def rays_of(pixels: np.ndarray, pose: Poses) -> np.ndarray:
    """Return the viewing rays (K, 3) of pixels (K, 2) in the world frame."""
    xy = CAMERA.unproject(pixels)
    return np.column_stack([xy, np.ones(len(xy))]) @ pose.rotations[0]


def render(pose: Poses) -> np.ndarray:
    """Render the grey image (270, 480) of a pose."""
    x, y = np.meshgrid(np.arange(480) + 0.5, np.arange(270) + 0.5)
    hit = surfaces(rays_of(np.column_stack([x.ravel(), y.ravel()]), pose), pose.centers[0])
    # The wall continues the texture of the ground, so that there is no seam at its foot.
    along = np.where(hit[:, 2] > 1e-9, WALL_NORTH_M + hit[:, 2], hit[:, 1])
    u, v = (hit[:, 0] + 30) * TEXELS_PER_M, along * TEXELS_PER_M
    maps = [m.reshape(270, 480).astype(np.float32) for m in (u, v)]
    return cv2.remap(TEXTURE, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def map_points(poses: Poses) -> MapPoints:
    """Return the world points seen at a grid of pixels of the labelled frames."""
    x, y = np.meshgrid(np.arange(12, 480, 24.0), np.arange(12, 270, 24.0))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    xyz = np.concatenate(
        [surfaces(rays_of(pixels, poses[k : k + 1]), poses.centers[k]) for k in LABELLED]
    )
    xyz = xyz[np.abs(xyz[:, 0]) < 28]
    n = len(xyz)
    return MapPoints(np.arange(10, 10 + n), xyz, np.zeros((n, 3), np.uint8), np.full(n, 3))


def visible(points: MapPoints, pose: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Return ids and pixels of the points inside the image."""
    pixels = CAMERA.project((points.xyz - pose.centers[0]) @ pose.rotations[0].T)
    inside = np.all((pixels > 12) & (pixels < [468, 258]), axis=1)
    return points.ids[inside], pixels[inside]


def table(names: list[str], sources: list[str], video_frame: list[int]) -> Frames:
    """Return a frame table of one sequence at 10 fps, without telemetry."""
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
    """Label some rows of a frame table with their exact poses."""
    n = len(rows)
    chosen = frames.select(np.array(rows))
    return Labels(
        names=chosen.names,
        sequences=chosen.sequences,
        cameras=chosen.cameras,
        sources=chosen.sources,
        video_frame=chosen.video_frame,
        tracked=np.zeros(n, bool),
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
    """A flight in two video files with four labelled frames."""

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
        self.seen = LabelObservations(
            np.repeat(np.arange(len(LABELLED)), [len(ids) for ids, _ in views]),
            np.concatenate([ids for ids, _ in views]),
            np.concatenate([pixels for _, pixels in views]),
        )

    @property
    def sequence(self) -> SequenceToLabel:
        """The flight as a sequence to be labelled by tracking."""
        return SequenceToLabel(self.frames, self.labelled, self.seen, {"f": CAMERA}, self.points)

    def anchor(self, k: int) -> Anchor:
        """Return labelled frame k as an anchor."""
        ids, pixels = self.seen.of_frame(LABELLED.index(k))
        xyz = self.points.xyz[self.points.rows_of(ids)]
        return Anchor(k / 10, self.grays[k], self.poses[k : k + 1], ids, xyz, pixels)

    def segment(self, first: int, last: int) -> Segment:
        """Return the segment of frames between two labelled ones."""
        rows = np.arange(first + 1, last)
        anchors = [self.anchor(first), self.anchor(last)]
        return Segment(rows, rows / 10, [self.grays[k] for k in rows], CAMERA, anchors)
