"""View share: the share of a camera's view for which the map has points that could be matched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from spn_data.geometry.camera import Camera
from spn_data.geometry.grouping import rank_within_group
from spn_data.geometry.pose import Poses
from spn_data.work.timing import Progress

_BORDER_STEPS = 17
_BLOCK = 64  # points that are culled together by their bounding sphere
_FIRST = 4  # points of a cell that are tested before the others


@dataclass(frozen=True, kw_only=True)
class ViewShareOptions:
    """Image grid and visibility criteria of the view share.

    A point looks similar from two places only if both view it from about the same direction
    (`max_turn_deg`) and distance (`max_range_factor`). A point is occluded if at least `occluders` points of
    its grid cell are nearer than `occluder_ratio` times its distance.
    """

    columns: int = 16  # of the grid over the image
    rows: int = 9
    max_turn_deg: float = 40.0
    max_range_factor: float = 2.0
    occluders: int = 3
    occluder_ratio: float = 0.75


@dataclass(frozen=True, eq=False)
class SeenMap:
    """Map points, and the directions and distances from which mapping frames observed them.

    Attributes
    ----------
    xyz : ndarray, shape (P, 3)
        Points, reordered so that each block of `_BLOCK` consecutive points is compact and can be culled by
        one test.
    block_center, block_radius : ndarray, shapes (B, 3) and (B,)
        Bounding spheres of the blocks.
    starts : ndarray of int, shape (P + 1,)
        Sightings are sorted by point; those of point p are ``starts[p]`` to ``starts[p + 1]``.
    directions : ndarray, shape (S, 3)
        Unit vectors from the point to the frame, by sighting.
    ranges : ndarray, shape (S,)
        Distances between point and frame, by sighting.
    """

    xyz: np.ndarray
    block_center: np.ndarray
    block_radius: np.ndarray
    starts: np.ndarray
    directions: np.ndarray
    ranges: np.ndarray

    @classmethod
    def build(
        cls, xyz: np.ndarray, centers: np.ndarray, frame_idx: np.ndarray, point_idx: np.ndarray
    ) -> SeenMap:
        """Build from points (P, 3), frame centres (M, 3), and frame and point index of each sighting (S,)."""
        near_order = cKDTree(xyz).indices if len(xyz) else np.zeros(0, np.int64)
        xyz = np.asarray(xyz, np.float64)[near_order]
        new_idx = np.empty(len(xyz), dtype=np.int64)
        new_idx[near_order] = np.arange(len(xyz))
        point_idx = new_idx[point_idx]
        order = np.argsort(point_idx, kind="stable")
        point_idx, frame_idx = point_idx[order], frame_idx[order]
        rays = centers[frame_idx] - xyz[point_idx]
        ranges = np.linalg.norm(rays, axis=1)
        known = ranges > 0  # excludes NaN of frames without a pose
        point_idx, rays, ranges = point_idx[known], rays[known], ranges[known]
        starts = np.searchsorted(point_idx, np.arange(len(xyz) + 1))
        directions = (rays / ranges[:, None]).astype(np.float32)
        center, radius = _blocks(xyz)
        return cls(xyz, center, radius, starts, directions, ranges.astype(np.float32))


def _blocks(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return bounding spheres of each block of `_BLOCK` points: centres (B, 3), radii (B,)."""
    first = np.arange(0, len(xyz), _BLOCK)
    if len(first) == 0:
        return np.zeros((0, 3)), np.zeros(0)
    counts = np.diff(np.append(first, len(xyz)))
    center = np.add.reduceat(xyz, first) / counts[:, None]
    distance = np.linalg.norm(xyz - np.repeat(center, counts, axis=0), axis=1)
    return center, np.maximum.reduceat(distance, first)


def view_shares(
    poses: Poses,
    cameras: Sequence[Camera],
    seen: SeenMap,
    options: ViewShareOptions | None = None,
    progress: Progress | None = None,
) -> np.ndarray:
    """Return the share (N,) of grid cells of each image that contain a visible and matchable map point.

    cameras : one per pose. A point is visible if it is in front of the camera, inside the image, and not
    occluded by nearer points. It is matchable if a mapping frame observed it from a direction within
    `max_turn_deg` and a distance within `max_range_factor` of the pose's own.
    """
    options = options or ViewShareOptions()
    borders = {id(camera): _border(camera) for camera in cameras}
    shares = np.zeros(len(poses))
    for k, camera in enumerate(cameras):
        shares[k] = _share(poses[k : k + 1], camera, borders[id(camera)], seen, options)
        if progress is not None and (k % 100 == 99 or k == len(cameras) - 1):
            progress("view", k + 1, len(cameras))
    return shares


def _share(
    pose: Poses,
    camera: Camera,
    border: tuple[np.ndarray, np.ndarray],
    seen: SeenMap,
    options: ViewShareOptions,
) -> float:
    points, x, y, ranges = _in_view(pose, camera, border, seen)
    count = options.columns * options.rows
    column = (x * (options.columns / camera.width)).astype(np.int64)
    row = (y * (options.rows / camera.height)).astype(np.int64)
    cells = row * options.columns + column
    free = ~_hidden(cells, ranges, count, options)
    points, ranges, cells = points[free], ranges[free], cells[free]
    covered = np.zeros(count, dtype=bool)
    # One matchable point covers a cell. It is usually among the first few, so the rest are rarely tested.
    is_first = rank_within_group(cells, count) < _FIRST
    for wanted in (is_first, ~is_first):
        part = np.flatnonzero(wanted & ~covered[cells])
        covered[
            cells[part][_matchable(pose.centers[0], points[part], ranges[part], seen, options)]
        ] = True
    return float(covered.mean())


def _border(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and largest normalised (x, y) inside the image.

    Far outside the image, the distortion polynomial can fold back into it; such points are not in the view.
    """
    steps = np.linspace(0, 1, _BORDER_STEPS)
    zero, one = np.zeros(_BORDER_STEPS), np.ones(_BORDER_STEPS)
    sides = [(steps, zero), (steps, one), (zero, steps), (one, steps)]
    pixels = np.concatenate([np.stack(side, axis=1) for side in sides])
    rays = camera.unproject(pixels * [camera.width, camera.height])
    return rays.min(axis=0), rays.max(axis=0)


def _in_view(
    pose: Poses,
    camera: Camera,
    border: tuple[np.ndarray, np.ndarray],
    seen: SeenMap,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the points (K,) in the image, their pixels x and y (K,), and their distances (K,)."""
    near = _inside(pose.to_camera(seen.block_center), border, seen.block_radius)
    points = (near[:, None] * _BLOCK + np.arange(_BLOCK)).ravel()
    points = points[points < len(seen.xyz)]
    rays = pose.to_camera(seen.xyz[points])
    inside = _inside(rays, border, np.zeros(1))
    points, rays = points[inside], rays[inside]
    pixels = camera.project(rays)
    inside = np.flatnonzero(((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1))
    ranges = np.linalg.norm(rays[inside], axis=1)
    return points[inside], pixels[inside, 0], pixels[inside, 1], ranges


def _inside(
    rays: np.ndarray, border: tuple[np.ndarray, np.ndarray], radius: np.ndarray
) -> np.ndarray:
    """Return rows of points (N, 3), in the camera frame, whose sphere of given radius intersects the view."""
    x, y, z = rays.T
    (left, top), (right, bottom) = border
    inside = [z > -radius]
    for across, low, high in ((x, left, right), (y, top, bottom)):
        inside.append(across - low * z >= -radius * np.hypot(1, low))
        inside.append(high * z - across >= -radius * np.hypot(1, high))
    return np.flatnonzero(np.logical_and.reduce(inside))


def _hidden(
    cells: np.ndarray, ranges: np.ndarray, count: int, options: ViewShareOptions
) -> np.ndarray:
    """Return a mask (K,) of points that are occluded by `occluders` nearer points of their cell."""
    if len(ranges) == 0:
        return np.zeros(0, dtype=bool)
    # Encode cell and distance in one number, so that a single sort orders by both.
    scale = 1.0 / (ranges.max() * 1.001)
    ordered = np.sort(cells + ranges * scale)
    starts = np.searchsorted(ordered, np.arange(count + 1))
    occluder_range = np.full(count, np.inf)
    full = np.flatnonzero(np.diff(starts) >= options.occluders)
    occluder_range[full] = (ordered[starts[full] + options.occluders - 1] - full) / scale
    return np.asarray(occluder_range[cells] < options.occluder_ratio * ranges)


def _matchable(
    center: np.ndarray,
    points: np.ndarray,
    ranges: np.ndarray,
    seen: SeenMap,
    options: ViewShareOptions,
) -> np.ndarray:
    """Return a mask (K,) of points with a sighting of similar direction and distance."""
    first, counts = seen.starts[points], np.diff(seen.starts)[points]
    last = np.cumsum(counts)
    owner = np.repeat(np.arange(len(points)), counts)
    sightings = np.arange(last[-1] if len(last) else 0) + np.repeat(first - (last - counts), counts)
    toward = ((center - seen.xyz[points]) / ranges[:, None]).astype(np.float32)
    cosine = np.einsum("ki,ki->k", seen.directions[sightings], toward[owner])
    ratio = seen.ranges[sightings] / ranges.astype(np.float32)[owner]
    factor = options.max_range_factor
    alike = (
        (cosine >= np.cos(np.deg2rad(options.max_turn_deg)))
        & (ratio <= factor)
        & (ratio >= 1 / factor)
    )
    return np.bincount(owner[alike], minlength=len(points)) > 0
