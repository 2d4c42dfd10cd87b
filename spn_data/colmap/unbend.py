"""A large bend of a model taken out by the positions of its flight.

Images say nearly nothing of how a survey bends as a whole, and bundle adjustment straightens one in hundreds
of small steps: a long step, which turns each camera by its share, moves the far end where nothing fits. A
thousand positions, each a metre or two off, tell a smooth bend to decimetres, and adjustment does the rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spn_data.colmap import pycolmap
from spn_data.colmap.model import registered_images
from spn_data.errors import GeometryError
from spn_data.geometry.pose import Similarity

_FEWEST = 1000  # positions; smaller models are adjusted as well without
_LEAST_M = 3.0  # median displacement, below which the positions' slow errors may look like a bend
_LEAST_RATIO = 2.0  # of it to what positions deviate from the bent surface
_LEAST_WIDTH = 5.0  # of the surface, in these deviations: a straight line says nothing across
_WRONG = 4.0  # medians, from which a position is left out
_ROUNDS = 5  # of leaving out


@dataclass(frozen=True, eq=False)
class Bend:
    """A smooth displacement of a surface, and of what lies above and below it.

    origin : (3,) of the surface; axes : (3, 3) rows, the last one its normal; extents : (2,) standard
    deviations along the first two, which their coordinates count in; terms : (10, 3) of the displacement
    along the axes, cubic in the two coordinates.
    """

    origin: np.ndarray
    axes: np.ndarray
    extents: np.ndarray
    terms: np.ndarray

    @classmethod
    def fit(cls, centers: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> Bend:
        """What brings centres (N, 3) to targets (N, 3), whose surface it is; weights (N,) are zero or one."""
        used = weights > 0
        origin = targets[used].mean(axis=0)
        _, singular, axes = np.linalg.svd(targets[used] - origin, full_matrices=False)
        extents = singular[:2] / np.sqrt(used.sum())
        plain = cls(origin, axes, extents, np.zeros((10, 3)))
        basis, _ = plain._basis(plain._inside(centers[used]))
        wanted = (targets - centers)[used] @ axes.T
        return cls(origin, axes, extents, np.linalg.lstsq(basis, wanted, rcond=None)[0])

    def _inside(self, points: np.ndarray) -> np.ndarray:
        return np.asarray((points - self.origin) @ self.axes.T)

    def _basis(self, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N, 10), and its derivatives (N, 2, 10) along the surface."""
        x, y = (inside[:, :2] / self.extents).T
        one, none = np.ones_like(x), np.zeros_like(x)
        values = [one, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3]
        by_x = [none, one, none, 2 * x, y, none, 3 * x * x, 2 * x * y, y * y, none]
        by_y = [none, none, one, none, x, 2 * y, none, x * x, 2 * x * y, 3 * y * y]
        derivatives = np.stack([np.stack(by_x, axis=1), np.stack(by_y, axis=1)], axis=1)
        return np.stack(values, axis=1), derivatives / self.extents[:, None]

    def apply(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (N, 3) where they belong, and how they turn (N, 3, 3): what is above stays above."""
        inside = self._inside(points)
        basis, derivatives = self._basis(inside)
        along = np.eye(3)[:2] + derivatives @ self.terms  # (N, 2, 3) tangents
        frame = np.concatenate([along, np.cross(along[:, 0], along[:, 1])[:, None]], axis=1)
        u, _, vt = np.linalg.svd(frame)
        turned = np.swapaxes(u @ vt, 1, 2)  # (N, 3, 3), nearest rotation
        on_surface = inside * [1, 1, 0] + basis @ self.terms
        moved = on_surface + turned[:, :, 2] * inside[:, 2:]
        return moved @ self.axes + self.origin, self.axes.T @ turned @ self.axes


def unbend(native: pycolmap.Reconstruction, positions: Mapping[str, Sequence[float]]) -> float:
    """Straighten a model in place, where it is bent by more than its positions deviate.

    Returns the median displacement of its images in metres, 0 where it was left as it is.

    positions : by image name, in metres in a Cartesian frame.
    """
    images = [image for image in registered_images(native) if image.name in positions]
    if len(images) < _FEWEST:
        return 0.0
    centers = np.array([image.projection_center() for image in images])
    measured = np.array([positions[image.name] for image in images])
    used = np.ones(len(images))
    try:
        for _ in range(_ROUNDS):
            model_from_world = Similarity.fit(measured, centers, used)
            targets = model_from_world.apply(measured)
            bend = Bend.fit(centers, targets, used)
            straight, _ = bend.apply(centers)
            off = np.linalg.norm(targets - straight, axis=1)
            used = (off < _WRONG * np.median(off)).astype(np.float64)
    except GeometryError:  # all on one line
        return 0.0
    moved = float(np.median(np.linalg.norm(straight - centers, axis=1)))
    least = max(_LEAST_RATIO * float(np.median(off)), _LEAST_M * model_from_world.scale)
    if moved < least or bend.extents[1] < _LEAST_WIDTH * np.median(off):
        return 0.0
    _move(native, bend)
    return moved / model_from_world.scale


def _move(native: pycolmap.Reconstruction, bend: Bend) -> None:
    ids = list(native.points3D)
    moved, _ = bend.apply(np.array([native.points3D[i].xyz for i in ids]).reshape(-1, 3))
    for i, xyz in zip(ids, moved, strict=True):
        native.points3D[i].xyz = xyz
    images = registered_images(native)
    centers, turns = bend.apply(np.array([image.projection_center() for image in images]))
    for image, center, turn in zip(images, centers, turns, strict=True):
        rotation = image.cam_from_world().rotation.matrix() @ turn.T
        native.frames[image.frame_id].rig_from_world = pycolmap.Rigid3d(
            pycolmap.Rotation3d(rotation), -rotation @ center
        )
