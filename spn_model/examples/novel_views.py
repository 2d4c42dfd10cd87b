"""Poses where none was flown, and training images warped there together with their surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spn_data.geometry.camera import opencv_pixels
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_vectors
from spn_model.examples.point_targets import Surface, cell_centers

_NEAREST = 0.5  # near clipping depth, in metres
_STEEP_DEG = (
    30.0,
    90.0,
)  # range of pitches below the horizon of overhead views; nearby views cover the rest
_PITCH_DEG = 5.0  # tolerance around a drawn pitch within which scene points are eligible
_SAME_SURFACE = 1.05  # largest depth ratio of two samples of a pixel that are blended
_SEAM_PX = 6.0  # neighbouring cells whose source pixels differ by more are on different surfaces


@dataclass(frozen=True, kw_only=True)
class NovelViewOptions:
    """Range of the poses of virtual cameras relative to the real one."""

    rise_m: float = 11.0  # largest rise, drawn uniformly from 0
    side_m: float = 4.0  # largest horizontal shift along each axis, in both directions
    height_m: float = 13.0  # largest height of an overhead view above the highest training image
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)  # unit vector in the world


def nearby_pose(generator: np.random.Generator, seen: Surface, options: NovelViewOptions) -> Poses:
    """Draw a pose above and to the side of a training image that keeps its view in sight.

    The camera rises, shifts and then rotates by the smallest angle.

    Parameters
    ----------
    generator : np.random.Generator
        Source of randomness.
    seen : Surface
        Surface that the training image shows.
    options : NovelViewOptions
        Range of the shifts.

    Returns
    -------
    Poses
        One pose.

    Raises
    ------
    ValueError
        If no part of the surface is known.
    """
    xyz = seen.xyz(_pixels(seen))
    xyz = xyz[np.isfinite(xyz[:, 0])]
    if not len(xyz):
        raise ValueError("the surface that the image shows is unknown")
    # Without this limit, the sky and distant hills would pull the view away from the scene.
    depth = seen.pose.depths(xyz)
    aim = np.median(xyz[depth < 3 * np.median(depth)], axis=0)
    up = np.array(options.up)
    center, rotation = seen.pose.centers[0], seen.pose.rotations[0]
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
    """Draw a pose of a level camera above the scene, looking down at one of its points.

    The camera is near one of the training images and at least as high as half of them. Its pitch is drawn
    uniformly from 30 degrees below the horizon to straight down, as far as the scene has points in that
    direction. z is up.

    Parameters
    ----------
    generator : np.random.Generator
        Source of randomness.
    centers : ndarray, shape (N, 3)
        Camera centres of the training images.
    scene : ndarray, shape (P, 3)
        Points of the scene.
    options : NovelViewOptions
        Range of the shifts.

    Returns
    -------
    Poses
        One pose.

    Raises
    ------
    ValueError
        If no part of the scene is below the drawn position.
    """
    center = centers[generator.integers(len(centers))].copy()
    center[:2] += generator.uniform(-1, 1, 2) * options.side_m
    lowest, highest = np.median(centers[:, 2]), centers[:, 2].max() + options.height_m
    center[2] = generator.uniform(lowest, highest)
    toward = scene - center
    toward = toward[toward[:, 2] < 0]
    if not len(toward):
        raise ValueError("no part of the scene is below its training images")
    pitch = np.degrees(np.arctan2(-toward[:, 2], np.hypot(toward[:, 0], toward[:, 1])))
    off = np.abs(pitch - generator.uniform(*_STEEP_DEG))
    toward = toward[off <= max(_PITCH_DEG, off.min())]
    forward = toward[generator.integers(len(toward))]
    forward = forward / np.linalg.norm(forward)
    # Looking straight down, the heading is undetermined: use a random one.
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
    """Render image and surface as a camera with the same K would see them at another pose.

    Samples are splatted in depth order on the surface's own grid; colours are then taken from the image at
    its full resolution. What the image does not show gets the colour `fill` and is unknown on the surface.

    Parameters
    ----------
    image : ndarray, uint8, shape (H, W, 3)
        Training image.
    seen : Surface
        Surface that it shows.
    pose : Poses
        One pose, of the new camera.
    fill : tuple of int
        RGB colour of unknown pixels.

    Returns
    -------
    image : ndarray, uint8, shape (H, W, 3)
    surface : Surface
    """
    step, (rows, columns) = seen.step_px, seen.inverse_depth.shape
    source = _pixels(seen)
    x = pose.to_camera(seen.xyz(source))
    with np.errstate(invalid="ignore"):
        ahead = x[:, 2] > _NEAREST
    source, x = source[ahead], x[ahead]
    projected = x @ seen.matrix.T
    at = opencv_pixels(projected[:, :2] / projected[:, 2:] / step)
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
    """Return which positions (N, 2) are above `low` and below the grid's size; by axis, for speed."""
    x, y = at[:, 0], at[:, 1]
    return (x > low) & (x < columns) & (y > low) & (y < rows)


def _splat(
    at: np.ndarray, depth: np.ndarray, values: np.ndarray, columns: int, rows: int
) -> np.ndarray:
    """Splat samples onto a grid; return sums (rows * columns, V + 1) of values (N, V) and of weights.

    Each sample goes to the four cells around its position `at` (N, 2) with bilinear weights; only samples
    of the nearest surface at a cell count.
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
    """Sample the image at source pixels (h, w, 2), interpolated within a surface, nearest at its edges."""
    size = (image.shape[1], image.shape[0])
    source = source.astype(np.float32)
    near = cv2.resize(source, size, interpolation=cv2.INTER_NEAREST)
    smooth = cv2.resize(source, size, interpolation=cv2.INTER_LINEAR)
    inner = cv2.erode(shown.astype(np.uint8), np.ones((3, 3), np.uint8))
    inner = cv2.resize(inner, size, interpolation=cv2.INTER_NEAREST) != 0
    apart = np.abs(smooth - near)
    inner &= (apart[..., 0] < _SEAM_PX) & (apart[..., 1] < _SEAM_PX)
    # OpenCV's origin is the centre of the upper-left pixel.
    maps = np.where(inner[..., None], smooth, near) - np.float32(0.5)
    moved = cv2.remap(image, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    moved[cv2.resize(shown.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) == 0] = fill
    return moved
