"""Training images from places where no flight was: what several images show, seen by another camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from spn_data.dataset.hdf5_reader import FramePoints
from spn_data.geometry.pose import Poses
from spn_model.examples.ground import Ground
from spn_model.examples.point_targets import Surface, SurfaceOptions, cell_centers, surface
from spn_model.examples.source_images import Occluders, SourceImages, projected
from spn_model.examples.training_set import TrainingSet

_SOURCES = 16  # images that a view is made of, at most
_MARGIN_PX = 40.0  # around a view: map points there hold surfaces that reach into it
_HIDING_PX = 12  # side of the cells in which a map point hides what lies behind it
_HIDDEN = 1.25  # ratio of depths to the nearest point around, from which a point is hidden
_BEFORE_PX = 4  # around a map point that lies before the ground, which is not drawn there
_SAME = (0.9, 1.08)  # ratio of depths of one surface, as a source and as the view has it
_STRANGE = 2.0  # times by which a colour differs from two others, more than they do from each other
_STRANGE_LEVELS = 20.0  # and by so many grey levels more
_ALIKE = 40.0  # grey levels by which two sources of the same ground may differ
_BLURRED = 0.1  # a source that shows less of a pixel shows nothing
_GOOD = 0.6  # one that shows so much is enough for a surface that it has too, three for others
_MOST_REDUCED = 3  # halvings of a source's image, where it is finer than the view


def fused_view(
    data: TrainingSet,
    sources: SourceImages,
    surface_of: Callable[[int], Surface],
    pose: Poses,
    matrix: np.ndarray,
    shrink: int,
    fill: tuple[int, int, int],
    options: SurfaceOptions,
) -> tuple[np.ndarray, Surface]:
    """The image (h, w, 3) and the surface, one cell a pixel, that a camera at a pose (1,) would see.

    matrix : its K (3, 3) for images of the data's size, which are made `shrink` times smaller. surface_of :
    a training image's own, by its row. First the surface: between the map points that the best sources see,
    and on level ground; then the colour of each of its pixels, from the source that shows it best and has
    nothing before it. A surface counts where a source has it too. What no source shows is `fill`, and
    unknown on the surface.
    """
    chosen = sources.best(pose, matrix, data.size, _SOURCES)
    points = _points(data, sources, chosen, pose, matrix)
    small = np.diag([1 / shrink, 1 / shrink, 1.0]) @ matrix
    between = surface(
        points, pose, matrix, data.size, replace(options, step_px=shrink)
    ).inverse_depth
    seen = Surface(np.full_like(between, np.nan), 1, pose, small)
    rows, columns = between.shape
    image = np.empty((rows, columns, 3), np.uint8)
    image[:] = fill
    ground = sources.ground
    hypotheses = [(between, True)]
    if ground is not None:
        hypotheses.append((_ground_depth(ground, points, pose, small, data.size, shrink), False))
    for inverse, confirmed in hypotheses:
        # Its own normals: where two surfaces meet, neither has the other's.
        normals = _normals(inverse, small)
        inverse = np.where(np.isnan(seen.inverse_depth), inverse, np.nan)
        y, x = np.nonzero(np.isfinite(inverse))
        at = np.column_stack([x, y]) + 0.5
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
    """Colours (N, 3) of points (N, 3) of surfaces with normals (N, 3), and which are shown (N,).

    confirmed : only where the source's own surface has the point too; else also where it is unknown.
    """
    toward = xyz - pose.centers[0]
    distance = np.sqrt(_dot(toward, toward))
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
        there = xyz[index] - source.centers[0]
        length = np.sqrt(_dot(there, there))
        facing = np.abs(_dot(there, normal[index])) / length
        finer = np.sqrt(facing) * distance[index] / length
        alike = _dot(there, toward[index]) / (length * distance[index])
        value = np.minimum(finer, 1) * np.maximum(alike, 0.05)
        take = value > _BLURRED
        if take.any():
            index, at = index[take], at[take]
            values[index, n] = value[take]
            reduced = shrink * float(np.median(finer[take]))
            colours[index, n] = _colours(data.image(row), at, reduced)
            good[index] += value[take] > _GOOD
            left = left[good[left] < (1 if confirmed else 3)]
    colour, agreed = _agreed(values, colours)
    return colour, (values.max(axis=1) > 0) & (confirmed | agreed)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("nk,nk->n", a, b)


def _agreed(values: np.ndarray, colours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) of colours (N, S, 3) that of the largest value (N, S), unless the two next ones deny it.

    And (N,) bool: whether another one is like it.

    What hides a surface from a source without having map points is painted onto it; other sources, which
    look from elsewhere, are not misled by it.
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
    data: TrainingSet, sources: SourceImages, chosen: list[int], pose: Poses, matrix: np.ndarray
) -> FramePoints:
    """Map points of the chosen sources that a camera would see, in and around its image."""
    points = [data.points(int(sources.rows[k])) for k in chosen]
    xyz, ids = np.empty((0, 3)), np.empty(0, np.int64)
    if points:
        ids, first = np.unique(np.concatenate([p.ids for p in points]), return_index=True)
        xyz = np.concatenate([p.xyz for p in points])[first]
    index, at, depth = projected(xyz, pose, matrix, data.size, _MARGIN_PX)
    shown = ~_hidden(at, depth, data.size)
    return FramePoints(ids[index[shown]], at[shown], xyz[index[shown]])


def _ground_depth(
    ground: Ground,
    points: FramePoints,
    pose: Poses,
    small: np.ndarray,
    size: tuple[int, int],
    shrink: int,
) -> np.ndarray:
    """(h, w) float32 inverse depth of the ground, as a small image of K `small` sees it."""
    columns, rows = (side // shrink for side in size)
    pixels = cell_centers(columns, rows, 0.5, 1.0)
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(small).T
    depth = ground.intersect(pose.centers[0], rays @ pose.rotations[0])
    above = ~ground.is_at_or_below(points.xyz)
    before = Occluders.from_points(
        points.pixels[above],
        (points.xyz[above] - pose.centers[0]) @ pose.rotations[0][2],
        size,
        _BEFORE_PX,
    )
    inside = np.isfinite(depth)
    inside[inside] = ~before.hide(pixels[inside] * shrink, depth[inside])
    return np.where(inside, 1 / depth, np.nan).astype(np.float32).reshape(rows, columns)


def _hidden(at: np.ndarray, depth: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(N,) bool: points at pixels (N, 2) with another one near them in the image and clearly before them."""
    cell = np.floor((at + _MARGIN_PX) / _HIDING_PX).astype(np.int64)
    columns, rows = (int(side + 2 * _MARGIN_PX) // _HIDING_PX + 1 for side in size)
    nearest = np.full(rows * columns, 1e30, np.float32)
    np.minimum.at(nearest, cell @ np.array([1, columns]), depth.astype(np.float32))
    nearest = cv2.erode(nearest.reshape(rows, columns), np.ones((3, 3), np.uint8))
    hidden: np.ndarray = depth > _HIDDEN * nearest[cell[:, 1], cell[:, 0]]
    return hidden


def _normals(inverse: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """(h, w, 3) normals of length 1 in the camera; along the ray where it is not known on both sides."""
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
    """(N, 3) of an image at its pixels (N, 2); first reduced where it is finer than what is made of it."""
    by = 2 ** int(np.clip(np.round(np.log2(finer)), 0, _MOST_REDUCED))
    if by > 1:
        size = (image.shape[1] // by, image.shape[0] // by)
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    # cv2 counts from the centre of the upper-left pixel, and takes maps of less than 32767 rows.
    maps = (at / by - 0.5).astype(np.float32)
    side = int(np.ceil(np.sqrt(len(maps))))
    maps = np.resize(maps, (side, side, 2))
    drawn = cv2.remap(image, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(drawn).reshape(-1, 3)[: len(at)]
