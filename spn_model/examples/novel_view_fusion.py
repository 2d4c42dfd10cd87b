"""Novel views for training: several images fused into the view of a camera where none was flown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from spn_data.dataset.hdf5_reader import FramePoints
from spn_data.geometry.camera import colmap_pixels, opencv_pixels
from spn_data.geometry.pose import Poses
from spn_model.examples.ground import Ground
from spn_model.examples.point_targets import Surface, SurfaceOptions, cell_centers, surface
from spn_model.examples.source_images import Occluders, SourceImages, projected
from spn_model.examples.training_set import TrainingSet

_SOURCES = 16  # largest number of source images of a view
_MARGIN_PX = 40.0  # margin around a view: map points there support surfaces that reach into it
_HIDING_PX = 12  # side of the cells in which a map point occludes points behind it
_HIDDEN = 1.25  # depth ratio to the nearest point around, above which a point is occluded
_BEFORE_PX = 4  # radius around a map point in front of the ground where no ground is drawn
_SAME = (0.9, 1.08)  # depth ratios for which source and view show the same surface
# A colour is an outlier if it differs from two others this many times more than these differ,
_STRANGE = 2.0
_STRANGE_LEVELS = 20.0  # plus so many grey levels.
_ALIKE = 40.0  # largest difference in grey levels between two sources of the same ground
_BLURRED = 0.1  # quality below which a source is not used for a pixel
_GOOD = 0.6  # quality from which one source suffices for a confirmed surface, three for others
_MOST_REDUCED = 3  # largest number of halvings of a source image finer than the view


def fused_view(
    data: TrainingSet,
    sources: SourceImages,
    surface_of: Callable[[int], Surface],
    pose: Poses,
    matrix: np.ndarray,
    shrink: int,
    fill: tuple[int, int, int],
    options: SurfaceOptions,
    size: tuple[int, int] | None = None,
) -> tuple[np.ndarray, Surface]:
    """Render image and surface that a camera at a new pose would see, from several training images.

    First the surface is built, from triangles between the map points that the best sources see and from
    level ground. Then each of its pixels is coloured from the source that shows it best without an occluder
    in front. A triangle counts only where a source's own surface contains it too, the ground also where
    that is unknown and sources agree. Pixels that no source shows get the colour `fill` and are unknown on
    the surface.

    Parameters
    ----------
    data : TrainingSet
        Training images.
    sources : SourceImages
        Which of them can be used, and what they see.
    surface_of : callable
        Returns the surface of a training image by its row.
    pose : Poses
        One pose, of the new camera.
    matrix : ndarray, shape (3, 3)
        Intrinsic matrix K for images of the given size.
    shrink : int
        Factor by which the rendered view is smaller than that.
    fill : tuple of int
        RGB colour of unknown pixels.
    options : SurfaceOptions
        Limits of the triangles.
    size : tuple of int, optional
        Width and height of the camera's images; by default those of the data set's.

    Returns
    -------
    image : ndarray, uint8, shape (h, w, 3)
    surface : Surface
        With one cell for each pixel of the image.
    """
    size = size or data.size
    chosen = sources.best(pose, matrix, size, _SOURCES)
    points = _points(data, sources, chosen, pose, matrix, size)
    small = np.diag([1 / shrink, 1 / shrink, 1.0]) @ matrix
    between = surface(points, pose, matrix, size, replace(options, step_px=shrink)).inverse_depth
    seen = Surface(np.full_like(between, np.nan), 1, pose, small)
    rows, columns = between.shape
    image = np.empty((rows, columns, 3), np.uint8)
    image[:] = fill
    ground = sources.ground
    hypotheses = [(between, True)]
    if ground is not None:
        hypotheses.append((_ground_depth(ground, points, pose, small, size, shrink), False))
    for inverse, confirmed in hypotheses:
        # Normals of this hypothesis alone, so that none are mixed where two surfaces meet.
        normals = _normals(inverse, small)
        inverse = np.where(np.isnan(seen.inverse_depth), inverse, np.nan)
        y, x = np.nonzero(np.isfinite(inverse))
        at = colmap_pixels(np.column_stack([x, y]))
        xyz = replace(seen, inverse_depth=inverse).xyz(at)
        normal = normals[y, x] @ pose.rotations[0]
        colours, shown = _painted(
            data, sources, surface_of, chosen, pose, xyz, normal, shrink, confirmed
        )
        y, x = y[shown], x[shown]
        image[y, x] = colours[shown]
        seen.inverse_depth[y, x] = inverse[y, x]
    return image, seen


def _painted(
    data: TrainingSet,
    sources: SourceImages,
    surface_of: Callable[[int], Surface],
    chosen: list[int],
    pose: Poses,
    xyz: np.ndarray,
    normal: np.ndarray,
    shrink: int,
    confirmed: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Colour points (N, 3) of surfaces with normals (N, 3); return colours (N, 3) and which are shown (N,).

    If `confirmed`, a point is accepted only if the source's own surface contains it; otherwise also if that
    is unknown there.
    """
    view_ray = xyz - pose.centers[0]
    distance = np.sqrt(_dot(view_ray, view_ray))
    values = np.zeros((len(xyz), max(len(chosen), 3)), np.float32)
    colours = np.zeros((len(xyz), max(len(chosen), 3), 3), np.uint8)
    left, good = np.arange(len(xyz)), np.zeros(len(xyz), np.int64)
    for n, k in enumerate(chosen):
        row = int(sources.rows[k])
        source = data.poses[row : row + 1]
        index, at, depth = projected(xyz[left], source, data.intrinsics[row], data.size)
        index = left[index]
        own = surface_of(row)
        with np.errstate(invalid="ignore"):
            ratio = depth * own.at(at)
            shown = (ratio > _SAME[0]) & (ratio < _SAME[1])
        if not confirmed:
            shown |= np.isnan(ratio) & ~sources.occluders[k].hide(at, depth)
        valid = data.valid(row)
        if valid is not None:
            shown &= valid[at[:, 1].astype(np.int64), at[:, 0].astype(np.int64)]
        index, at = index[shown], at[shown]
        source_ray = xyz[index] - source.centers[0]
        length = np.sqrt(_dot(source_ray, source_ray))
        facing = np.abs(_dot(source_ray, normal[index])) / length
        resolution = np.sqrt(facing) * distance[index] / length
        alignment = _dot(source_ray, view_ray[index]) / (length * distance[index])
        value = np.minimum(resolution, 1) * np.maximum(alignment, 0.05)
        take = value > _BLURRED
        if take.any():
            index, at = index[take], at[take]
            values[index, n] = value[take]
            reduced = shrink * float(np.median(resolution[take]))
            colours[index, n] = _colours(data.image(row), at, reduced)
            good[index] += value[take] > _GOOD
            left = left[good[left] < (1 if confirmed else 3)]
    colour, agreed = _agreed(values, colours)
    return colour, (values.max(axis=1) > 0) & (confirmed | agreed)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("nk,nk->n", a, b)


def _agreed(values: np.ndarray, colours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Select for each point the colour of the largest value, unless the next two contradict it.

    Takes values (N, S) and colours (N, S, 3), returns colours (N, 3) and (N,) bool: whether another source
    has a similar colour.

    An occluder without map points is painted onto the surface behind it; other sources, which look from
    elsewhere, do not show it there.
    """
    every = np.arange(len(values))
    best = np.argpartition(-values, 2, axis=1)[:, :3]
    best = np.take_along_axis(best, np.argsort(-values[every[:, None], best], axis=1), axis=1)
    three = colours[every[:, None], best].astype(np.float32)
    first, second, third = three.transpose(1, 0, 2)
    apart = np.abs(second - third).max(axis=1)
    there = values[every[:, None], best] > 0
    off = np.minimum(
        np.where(there[:, 1], np.abs(first - second).max(axis=1), np.inf),
        np.where(there[:, 2], np.abs(first - third).max(axis=1), np.inf),
    )
    strange = (off > _STRANGE * apart + _STRANGE_LEVELS) & there[:, 2]
    agreed = np.where(strange, apart, off) < _ALIKE
    return colours[every, np.where(strange, best[:, 1], best[:, 0])], agreed


def _points(
    data: TrainingSet,
    sources: SourceImages,
    chosen: list[int],
    pose: Poses,
    matrix: np.ndarray,
    size: tuple[int, int],
) -> FramePoints:
    """Return the map points of the chosen sources that a camera would see, in and around its image."""
    points = [data.points(int(sources.rows[k])) for k in chosen]
    xyz, ids = np.empty((0, 3)), np.empty(0, np.int64)
    if points:
        ids, first = np.unique(np.concatenate([p.ids for p in points]), return_index=True)
        xyz = np.concatenate([p.xyz for p in points])[first]
    index, at, depth = projected(xyz, pose, matrix, size, _MARGIN_PX)
    shown = ~_hidden(at, depth, size)
    return FramePoints(ids[index[shown]], at[shown], xyz[index[shown]])


def _ground_depth(
    ground: Ground,
    points: FramePoints,
    pose: Poses,
    small: np.ndarray,
    size: tuple[int, int],
    shrink: int,
) -> np.ndarray:
    """Return the inverse depth (h, w) float32 of the ground in a small image whose K is `small`."""
    columns, rows = (side // shrink for side in size)
    pixels = cell_centers(columns, rows, 0.5, 1.0)
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(small).T
    depth = ground.intersect(pose.centers[0], rays @ pose.rotations[0])
    above = ~ground.is_at_or_below(points.xyz)
    before = Occluders.from_points(
        points.pixels[above],
        pose.depths(points.xyz[above]),
        size,
        _BEFORE_PX,
    )
    inside = np.isfinite(depth)
    inside[inside] = ~before.hide(pixels[inside] * shrink, depth[inside])
    return np.where(inside, 1 / depth, np.nan).astype(np.float32).reshape(rows, columns)


def _hidden(at: np.ndarray, depth: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return which points at pixels (N, 2) are occluded by a clearly nearer one around them, (N,) bool."""
    cell = np.floor((at + _MARGIN_PX) / _HIDING_PX).astype(np.int64)
    columns, rows = (int(side + 2 * _MARGIN_PX) // _HIDING_PX + 1 for side in size)
    nearest = np.full(rows * columns, 1e30, np.float32)
    np.minimum.at(nearest, cell @ np.array([1, columns]), depth.astype(np.float32))
    nearest = cv2.erode(nearest.reshape(rows, columns), np.ones((3, 3), np.uint8))
    hidden: np.ndarray = depth > _HIDDEN * nearest[cell[:, 1], cell[:, 0]]
    return hidden


def _normals(inverse: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return unit normals (h, w, 3) in the camera; along the ray where neighbours are unknown."""
    rows, columns = inverse.shape
    rays = np.concatenate([cell_centers(columns, rows, 0.5, 1.0), np.ones((rows * columns, 1))], 1)
    rays = (rays @ np.linalg.inv(matrix).T).reshape(rows, columns, 3)
    # Of a plane n . X = 1 inverse depth is n . ray.
    down, right = np.gradient(inverse.astype(np.float64))
    normal = np.stack([right * matrix[0, 0], down * matrix[1, 1], np.zeros_like(right)], axis=-1)
    normal[..., 2] = inverse - (normal * rays).sum(axis=-1)
    normal = np.where(np.isfinite(normal).all(axis=-1, keepdims=True), normal, rays)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


def _colours(image: np.ndarray, at: np.ndarray, finer: float) -> np.ndarray:
    """Sample colours (N, 3) at pixels (N, 2) of an image, first halved while it is finer."""
    by = 2 ** int(np.clip(np.round(np.log2(finer)), 0, _MOST_REDUCED))
    if by > 1:
        size = (image.shape[1] // by, image.shape[0] // by)
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    maps = opencv_pixels(at / by).astype(np.float32)
    # OpenCV's maps need fewer than 32767 rows.
    side = int(np.ceil(np.sqrt(len(maps))))
    maps = np.resize(maps, (side, side, 2))
    drawn = cv2.remap(image, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(drawn).reshape(-1, 3)[: len(at)]
