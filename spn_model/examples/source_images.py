"""Selection of the training images that best show what a camera at a new pose would see."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spn_data.geometry.pose import Poses
from spn_model.examples.ground import Ground, fit_level_ground
from spn_model.examples.training_set import TrainingSet

_MOST_IMAGES = 600  # largest number of source images; neighbouring video frames show the same
_VOXEL = 0.05  # side of a voxel that counts as one scene sample, in spreads of the scene
_FINE = 0.005  # grid on which occluding map points are thinned, in spreads
_APART = 0.05  # smallest distance between sources of one view with the same direction, in spreads
_SAME_WAY = 0.9  # cosine between optical axes from which two directions count as the same
_OCCLUDER_PX = 6  # cell size in a source: a map point occludes at least this far around it
_CLEARLY = 0.93  # depth ratio below which a point is in front of another
_NEAREST = 0.1  # near clipping depth, in metres
_GRID = (16, 9)  # parts of a view, which are weighted equally
_SEEN = 0.6  # loss of a sample's weight once a source shows it; the rest asks for confirmation
_WORTH = 0.005  # smallest fraction of a view that another source must add


@dataclass(frozen=True, eq=False)
class Occluders:
    """Depth map of the nearest map points of one image.

    Attributes
    ----------
    depth : ndarray, shape (rows, columns)
        Smallest depth around each cell.
    cell_px : int
        Side of a cell.
    """

    depth: np.ndarray
    cell_px: int

    @classmethod
    def from_points(
        cls, pixels: np.ndarray, depth: np.ndarray, size: tuple[int, int], cell_px: int
    ) -> Occluders:
        """Build the map from points at pixels (N, 2) with depths (N,); each point covers 3 x 3 cells."""
        columns, rows = (-(-side // cell_px) for side in size)
        cell = np.floor(pixels / cell_px).astype(np.int64)
        inside = (cell >= 0).all(axis=1) & (cell < [columns, rows]).all(axis=1) & (depth > 0)
        nearest = np.full(rows * columns, 1e30, np.float32)
        index = cell[inside] @ np.array([1, columns])
        np.minimum.at(nearest, index, depth[inside].astype(np.float32))
        return cls(cv2.erode(nearest.reshape(rows, columns), np.ones((3, 3), np.uint8)), cell_px)

    def hide(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Return which points at pixels (N, 2) and depths (N,) have an occluder in front, (N,) bool."""
        x, y = (pixels / self.cell_px).astype(np.int64).T
        return self.depth[y, x] < _CLEARLY * depth


def projected(
    xyz: np.ndarray, pose: Poses, matrix: np.ndarray, size: tuple[int, int], margin: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project points (N, 3); return indices (K,), pixels (K, 2) and depths (K,) of those in the image."""
    # Compute by coordinates, for speed: this runs for every pixel of a view and every source.
    x, y, depth = (matrix @ pose.rotations[0]) @ (xyz - pose.centers[0]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = x / depth, y / depth
        inside = (depth > _NEAREST) & (x > -margin) & (x < size[0] + margin)
        inside &= (y > -margin) & (y < size[1] + margin)
    index = np.flatnonzero(inside)
    return index, np.column_stack([x[index], y[index]]), depth[index]


class SourceImages:
    """Training images from which novel views are rendered, and what they see.

    Attributes
    ----------
    rows : ndarray, shape (S,)
        Rows of the images in the training set.
    centers : ndarray, shape (S, 3)
        Their camera centres.
    ground : Ground or None
        Level ground; None if there is none or up is unknown.
    occluders : list of Occluders
        One for each source.
    samples : ndarray, shape (P, 3)
        Sample points of the scene, for which it is known which sources see them and how well.
    """

    def __init__(self, data: TrainingSet, center: np.ndarray, spread: float, far: float):
        count = min(len(data), _MOST_IMAGES)
        self.rows = np.unique(np.linspace(0, len(data) - 1, count).round().astype(np.int64))
        seen = [data.points(int(row)) for row in self.rows]
        owner = np.repeat(np.arange(len(seen)), [len(points.ids) for points in seen])
        xyz = np.concatenate([points.xyz for points in seen])
        near = np.linalg.norm(xyz - center, axis=1) < far
        owner, xyz = owner[near], xyz[near]
        self.ground: Ground | None = None
        if data.up_is_known and len(xyz):
            self.ground = fit_level_ground(xyz, spread)
        self.centers = data.poses.centers[self.rows]
        self._axes = data.poses.rotations[self.rows, 2]
        self._apart = _APART * spread
        self.occluders = self._all_occluders(data, xyz, _FINE * spread)
        # Samples of the scene: one for each voxel with map points and one for each cell of the ground.
        voxel = np.floor((xyz - center) / (_VOXEL * spread)).astype(np.int64)
        _, first, place = np.unique(
            voxel @ np.array([1, 1 << 20, 1 << 40]), return_index=True, return_inverse=True
        )
        self.samples = xyz[first]
        self._source, self._place = np.unique(np.column_stack([owner, place]), axis=0).T
        facing = np.ones(len(self._source))
        if self.ground is not None:
            facing = np.concatenate([facing, self._see_ground(data, self.ground)])
        toward = self.samples[self._place] - self.centers[self._source]
        distance = np.linalg.norm(toward, axis=1)
        self._resolution = (np.sqrt(facing) / distance).astype(np.float32)
        self._toward = (toward / distance[:, None]).astype(np.float32)

    def _all_occluders(self, data: TrainingSet, xyz: np.ndarray, step: float) -> list[Occluders]:
        """Return the occluders of all sources from all map points: one image has few on smooth surfaces."""
        hiding = np.unique(np.round(xyz / step).astype(np.int64), axis=0) * step
        # The ground occludes nothing, and at grazing angles its near parts project close below its far ones.
        if self.ground is not None:
            hiding = hiding[~self.ground.is_at_or_below(hiding)]
        made = []
        for row in self.rows:
            data.check()
            pose = data.poses[row : row + 1]
            _, pixels, depth = projected(hiding, pose, data.intrinsics[row], data.size)
            made.append(Occluders.from_points(pixels, depth, data.size, _OCCLUDER_PX))
        return made

    def _see_ground(self, data: TrainingSet, ground: Ground) -> np.ndarray:
        """Add the ground's cells to the samples that sources see; return the sines of the viewing angles."""
        cells = ground.samples()
        sources, places, sines = [self._source], [self._place], [np.empty(0)]
        for k, row in enumerate(self.rows):
            data.check()
            pose = data.poses[row : row + 1]
            index, pixels, depth = projected(cells, pose, data.intrinsics[row], data.size)
            index = index[~self.occluders[k].hide(pixels, depth)]
            sources.append(np.full(len(index), k))
            places.append(index + len(self.samples))
            away = pose.centers[0] - cells[index]
            sines.append(np.maximum(away[:, 2], 0) / np.linalg.norm(away, axis=1))
        self.samples = np.concatenate([self.samples, cells])
        self._source, self._place = np.concatenate(sources), np.concatenate(places)
        return np.concatenate(sines)

    def best(self, pose: Poses, matrix: np.ndarray, size: tuple[int, int], count: int) -> list[int]:
        """Select up to `count` sources that together show most of what a camera would see.

        All parts of the view have equal weight; a source is rated by its resolution of a sample and by the
        similarity of its viewing direction.

        Parameters
        ----------
        pose : Poses
            One pose, of the camera.
        matrix : ndarray, shape (3, 3)
            Intrinsic matrix K.
        size : tuple of int
            Width and height of the image.
        count : int
            Largest number of sources.

        Returns
        -------
        list of int
            Indices into `rows`.
        """
        index, pixels, _ = projected(self.samples, pose, matrix, size)
        if not len(index):
            return []
        columns, rows = _GRID
        part = np.floor(pixels / size * _GRID).astype(np.int64) @ [1, columns]
        weight = 1 / np.bincount(part, minlength=columns * rows)[part] / (columns * rows)
        order = np.full(len(self.samples), -1)
        order[index] = np.arange(len(index))
        place = order[self._place]
        use = place >= 0
        place, source = place[use], self._source[use]
        toward = self.samples[index] - pose.centers[0]
        distance = np.linalg.norm(toward, axis=1)
        alike = (self._toward[use] * (toward / distance[:, None])[place]).sum(axis=1)
        value = np.minimum(self._resolution[use] * distance[place], 1) * np.maximum(alike, 0.05)
        wanted, taken = weight, np.zeros(len(self.rows), bool)
        chosen: list[int] = []
        for _ in range(count):
            total = np.bincount(source, value * wanted[place], len(self.rows))
            total[taken] = 0
            best = int(total.argmax())
            if total[best] < _WORTH:
                break
            chosen.append(best)
            # Neighbouring frames share the same errors, so that they do not confirm each other.
            near = np.linalg.norm(self.centers - self.centers[best], axis=1) < self._apart
            taken |= near & (self._axes @ self._axes[best] > _SAME_WAY)
            mine = source == best
            wanted[place[mine]] *= 1 - _SEEN * value[mine]
        return chosen
