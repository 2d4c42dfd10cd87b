"""Places where no flight was, and a training image moved there along with the surface that it shows."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spn_data.geometry.pose import Poses, rotations_from_vectors
from spn_model.examples.point_targets import Surface, cell_centers

_NEAREST = 0.5  # depth, in metres, before which nothing is drawn
_STEEP_DEG = (
    30.0,
    90.0,
)  # below level that a high view looks: places beside training images show the rest
_PITCH_DEG = 5.0  # around a drawn pitch: places that are looked at alike
_SAME_SURFACE = 1.05  # ratio of depths up to which two samples of a pixel are mixed
_SEAM_PX = 6.0  # by more, what neighbouring cells show lies on different surfaces


@dataclass(frozen=True, kw_only=True)
class NovelViewOptions:
    """Where virtual cameras stand, against the real one."""

    rise_m: float = 11.0  # largest, evenly from 0
    side_m: float = 4.0  # largest level move along each axis, to either side
    height_m: float = 13.0  # of a high place above the highest training image, at most
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)  # in the world, of length 1


def nearby_pose(generator: np.random.Generator, seen: Surface, options: NovelViewOptions) -> Poses:
    """(1,) pose of a camera that rose and moved, and turned the shortest way to keep its view in sight.

    Raises ValueError where nothing of the surface is known.
    """
    xyz = seen.xyz(_pixels(seen))
    xyz = xyz[np.isfinite(xyz[:, 0])]
    if not len(xyz):
        raise ValueError("nothing is known of what the image shows")
    center, rotation = seen.pose.centers[0], seen.pose.rotations[0]
    # The sky and distant hills would draw the view away from the scene.
    depth = (xyz - center) @ rotation[2]
    aim = np.median(xyz[depth < 3 * np.median(depth)], axis=0)
    up = np.array(options.up)
    aside = generator.uniform(-1, 1, 3) * options.side_m
    move = aside + up * (generator.uniform(0, options.rise_m) - aside @ up)
    before, after = aim - center, aim - center - move
    axis = np.cross(before, after)
    sine = np.linalg.norm(axis)
    angle = np.arctan2(sine, before @ after)
    turn = rotations_from_vectors((axis / max(sine, 1e-12) * angle)[None])[0]
    return Poses.from_rotations((center + move)[None], (rotation @ turn.T)[None])


def overhead_pose(
    generator: np.random.Generator,
    centers: np.ndarray,
    scene: np.ndarray,
    options: NovelViewOptions,
) -> Poses:
    """(1,) pose of a level camera above the scene, which looks down at one of its places (P, 3).

    It stands beside one of the training images' centers (N, 3), as high as half of them at least, and looks
    down by 30 degrees as often as straight down or anything between, as far as the scene has places there.
    z is up.
    Raises ValueError where nothing of the scene lies below.
    """
    center = centers[generator.integers(len(centers))].copy()
    center[:2] += generator.uniform(-1, 1, 2) * options.side_m
    lowest, highest = np.median(centers[:, 2]), centers[:, 2].max() + options.height_m
    center[2] = generator.uniform(lowest, highest)
    toward = scene - center
    toward = toward[toward[:, 2] < 0]
    if not len(toward):
        raise ValueError("nothing of the scene lies below its training images")
    pitch = np.degrees(np.arctan2(-toward[:, 2], np.hypot(toward[:, 0], toward[:, 1])))
    off = np.abs(pitch - generator.uniform(*_STEEP_DEG))
    toward = toward[off <= max(_PITCH_DEG, off.min())]
    forward = toward[generator.integers(len(toward))]
    forward = forward / np.linalg.norm(forward)
    # Straight down there is no level direction to the right but by chance.
    azimuth = generator.uniform(0, 2 * np.pi)
    level = np.hypot(forward[0], forward[1])
    if level > 1e-6:
        azimuth = np.arctan2(forward[0], forward[1])
    right = np.array([np.cos(azimuth), -np.sin(azimuth), 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Poses.from_rotations(center[None], rotation[None])


def warp_to_pose(
    image: np.ndarray, seen: Surface, pose: Poses, fill: tuple[int, int, int]
) -> tuple[np.ndarray, Surface]:
    """The image (H, W, 3) and the surface as a camera of the same K at another pose (1,) would see them.

    What the image does not show is `fill`, and unknown on the surface. Samples are drawn in the order of
    their depth on the surface's own grid; colours then come from the image at its full resolution.
    """
    step, (rows, columns) = seen.step_px, seen.inverse_depth.shape
    source = _pixels(seen)
    x = (seen.xyz(source) - pose.centers[0]) @ pose.rotations[0].T
    with np.errstate(invalid="ignore"):
        ahead = x[:, 2] > _NEAREST
    source, x = source[ahead], x[ahead]
    projected = x @ seen.matrix.T
    at = projected[:, :2] / projected[:, 2:] / step - 0.5
    inside = _within(at, -1, columns, rows)
    source, at, depth = source[inside], at[inside], x[inside, 2]
    sums = _splat(at, depth, np.column_stack([source, 1 / depth]), columns, rows)
    shown = sums[:, 3] > 0.05
    mean = sums[:, :3] / np.where(shown, sums[:, 3], np.inf)[:, None]
    inverse = np.where(shown, mean[:, 2], np.nan).reshape(rows, columns).astype(np.float32)
    moved = _colours(
        image, mean[:, :2].reshape(rows, columns, 2), shown.reshape(rows, columns), fill
    )
    return moved, Surface(inverse, step, pose, seen.matrix)


def _pixels(seen: Surface) -> np.ndarray:
    rows, columns = seen.inverse_depth.shape
    return cell_centers(columns, rows, seen.step_px / 2, seen.step_px)


def _within(at: np.ndarray, low: int, columns: int, rows: int) -> np.ndarray:
    """(N,) bool: places (N, 2) above `low` and below the grid's size; axis by axis, for it is done often."""
    x, y = at[:, 0], at[:, 1]
    return (x > low) & (x < columns) & (y > low) & (y < rows)


def _splat(
    at: np.ndarray, depth: np.ndarray, values: np.ndarray, columns: int, rows: int
) -> np.ndarray:
    """(rows * columns, V + 1) sums of values (N, V) and of weights, of the nearest surface at each cell.

    Each sample goes to the four cells around its place `at` (N, 2), by bilinear weights.
    """
    corner = np.floor(at)
    targets = []
    for offset in ((0, 0), (1, 0), (0, 1), (1, 1)):
        cell = (corner + offset).astype(np.int64)
        near = 1 - np.abs(at - cell)
        weight = near[:, 0] * near[:, 1]
        use = _within(cell, -1, columns, rows) & (weight > 1e-3)
        targets.append((cell[use, 0] + cell[use, 1] * columns, use, weight[use]))
    nearest = np.full(rows * columns, np.inf)
    for index, use, _ in targets:
        np.minimum.at(nearest, index, depth[use])
    sums = np.zeros((rows * columns, values.shape[1] + 1))
    for index, use, weight in targets:
        front = depth[use] < nearest[index] * _SAME_SURFACE
        index, weight = index[front], weight[front]
        for k, column in enumerate(values[use][front].T):
            sums[:, k] += np.bincount(index, column * weight, rows * columns)
        sums[:, -1] += np.bincount(index, weight, rows * columns)
    return sums


def _colours(
    image: np.ndarray, source: np.ndarray, shown: np.ndarray, fill: tuple[int, int, int]
) -> np.ndarray:
    """(H, W, 3) from the image at source pixels (h, w, 2), smooth within a surface, hard at its edge."""
    size = (image.shape[1], image.shape[0])
    source = source.astype(np.float32)
    near = cv2.resize(source, size, interpolation=cv2.INTER_NEAREST)
    smooth = cv2.resize(source, size, interpolation=cv2.INTER_LINEAR)
    inner = cv2.erode(shown.astype(np.uint8), np.ones((3, 3), np.uint8))
    inner = cv2.resize(inner, size, interpolation=cv2.INTER_NEAREST) != 0
    apart = np.abs(smooth - near)
    inner &= (apart[..., 0] < _SEAM_PX) & (apart[..., 1] < _SEAM_PX)
    # cv2 counts from the centre of the upper-left pixel.
    maps = np.where(inner[..., None], smooth, near) - np.float32(0.5)
    moved = cv2.remap(image, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    moved[cv2.resize(shown.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) == 0] = fill
    return moved
