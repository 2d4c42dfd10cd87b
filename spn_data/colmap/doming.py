"""Correction of the doming of a model by the positions of its flight.

Images hardly constrain the large-scale bending of a survey, and bundle adjustment removes it only in hundreds
of small steps: a long step, which rotates each camera by its share, moves the far end so far that nothing
fits any more. A thousand positions, each a metre or two off, determine a smooth bend to decimetres, and
bundle adjustment does the rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spn_data.colmap import pycolmap
from spn_data.colmap.model import registered_images
from spn_data.errors import GeometryError
from spn_data.geometry.pose import Similarity

_MIN_POSITIONS = 1000  # bundle adjustment alone suffices for smaller models
_MIN_BEND_M = (
    3.0  # median displacement; below it, slow errors of the positions may look like doming
)
_MIN_BEND_RATIO = 2.0  # median displacement divided by the median residual of the positions
_MIN_WIDTH = 5.0  # of the surface, in median residuals: a straight line does not determine the bend across it
_OUTLIER = 4.0  # median residuals; positions beyond are ignored
_ROUNDS = 5  # of outlier rejection


@dataclass(frozen=True, eq=False)
class Deformation:
    """Smooth displacement of a surface and of the points above and below it.

    Attributes
    ----------
    origin : ndarray, shape (3,)
        Origin of the surface.
    axes : ndarray, shape (3, 3)
        Axes of the surface as rows; the last one is its normal.
    extents : ndarray, shape (2,)
        Standard deviations along the first two axes; surface coordinates are in these units.
    terms : ndarray, shape (10, 3)
        Coefficients of the displacement along the axes, a cubic polynomial in the two surface coordinates.
    """

    origin: np.ndarray
    axes: np.ndarray
    extents: np.ndarray
    terms: np.ndarray

    @classmethod
    def fit(cls, centers: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> Deformation:
        """Fit the displacement from centres (N, 3) to targets (N, 3) by least squares.

        The surface is fitted to the targets. Weights (N,) are zero or one.
        """
        used = weights > 0
        origin = targets[used].mean(axis=0)
        _, singular, axes = np.linalg.svd(targets[used] - origin, full_matrices=False)
        extents = singular[:2] / np.sqrt(used.sum())
        undeformed = cls(origin, axes, extents, np.zeros((10, 3)))
        basis, _ = undeformed._basis(undeformed._to_surface(centers[used]))
        displacements = (targets - centers)[used] @ axes.T
        return cls(origin, axes, extents, np.linalg.lstsq(basis, displacements, rcond=None)[0])

    def _to_surface(self, points: np.ndarray) -> np.ndarray:
        return np.asarray((points - self.origin) @ self.axes.T)

    def _basis(self, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the polynomial basis (N, 10) and its derivatives (N, 2, 10) along the surface."""
        x, y = (local[:, :2] / self.extents).T
        one, none = np.ones_like(x), np.zeros_like(x)
        values = [one, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3]
        by_x = [none, one, none, 2 * x, y, none, 3 * x * x, 2 * x * y, y * y, none]
        by_y = [none, none, one, none, x, 2 * y, none, x * x, 2 * x * y, 3 * y * y]
        derivatives = np.stack([np.stack(by_x, axis=1), np.stack(by_y, axis=1)], axis=1)
        return np.stack(values, axis=1), derivatives / self.extents[:, None]

    def apply(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the displaced points (N, 3) and the rotations (N, 3, 3) of the surface there.

        Points above the surface stay above it.
        """
        local = self._to_surface(points)
        basis, derivatives = self._basis(local)
        along = np.eye(3)[:2] + derivatives @ self.terms  # (N, 2, 3) tangents
        frame = np.concatenate([along, np.cross(along[:, 0], along[:, 1])[:, None]], axis=1)
        u, _, vt = np.linalg.svd(frame)
        turned = np.swapaxes(u @ vt, 1, 2)  # (N, 3, 3), nearest rotation
        on_surface = local * [1, 1, 0] + basis @ self.terms
        moved = on_surface + turned[:, :, 2] * local[:, 2:]
        return moved @ self.axes + self.origin, self.axes.T @ turned @ self.axes


def correct_doming(
    native: pycolmap.Reconstruction, positions: Mapping[str, Sequence[float]]
) -> float:
    """Remove the bend of a model in place if it is larger than the noise of its positions.

    Parameters
    ----------
    native : pycolmap.Reconstruction
    positions : mapping of str to sequence of float
        Positions by image name, in metres in a Cartesian frame.

    Returns
    -------
    float
        Median displacement of the images in metres; 0 if the model was not changed.
    """
    images = [image for image in registered_images(native) if image.name in positions]
    if len(images) < _MIN_POSITIONS:
        return 0.0
    centers = np.array([image.projection_center() for image in images])
    measured = np.array([positions[image.name] for image in images])
    used = np.ones(len(images))
    try:
        for _ in range(_ROUNDS):
            model_from_world = Similarity.fit(measured, centers, used)
            targets = model_from_world.apply(measured)
            bend = Deformation.fit(centers, targets, used)
            straight, _ = bend.apply(centers)
            residuals = np.linalg.norm(targets - straight, axis=1)
            used = (residuals < _OUTLIER * np.median(residuals)).astype(np.float64)
    except GeometryError:  # collinear positions
        return 0.0
    moved = float(np.median(np.linalg.norm(straight - centers, axis=1)))
    residual = float(np.median(residuals))
    min_bend = max(_MIN_BEND_RATIO * residual, _MIN_BEND_M * model_from_world.scale)
    if moved < min_bend or bend.extents[1] < _MIN_WIDTH * residual:
        return 0.0
    _move(native, bend)
    return moved / model_from_world.scale


def _move(native: pycolmap.Reconstruction, bend: Deformation) -> None:
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
