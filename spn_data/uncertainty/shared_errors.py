"""Errors that all measurements of a lens share, propagated to poses, intrinsics and points of a map.

Three kinds: the field that the camera model does not describe, intrinsics that were held (every principal
point at first, and all intrinsics of a held lens), and what is doubtful about an estimated focal length
although the residuals do not show it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from spn_data.colmap.model import MapObservations, Scene
from spn_data.geometry.camera import MODELS
from spn_data.uncertainty.bundle_jacobians import LinearizedBundle, Unknowns
from spn_data.uncertainty.inner_constraints import InnerConstraintInverse
from spn_data.uncertainty.lens_errors import field_px, field_values

PRINCIPAL_POINT_SIGMA = 0.01  # of the image width: usual distance from the centre of the image
_PRINCIPAL_POINT = ("cx", "cy")


@dataclass(frozen=True, kw_only=True)
class LensPrior:
    """What is known of a lens besides the measurements of the map.

    Attributes
    ----------
    held : bool
        Whether mapping held its intrinsics.
    focal_sigma_px : float
        Standard deviation of a held focal length; of an estimated one, what is doubtful about it beyond its
        residuals.
    """

    held: bool = False
    focal_sigma_px: float = 0.0


@dataclass(frozen=True)
class PrincipalPoint:
    """What the measurements of a map say about the principal point of a lens.

    Attributes
    ----------
    shift_px : ndarray, shape (2,)
        Its estimate minus its current value, by one Gauss-Newton step of all unknowns.
    sigma_px : ndarray, shape (2,)
        Standard deviation of that estimate, which includes the errors of the lens model.
    """

    shift_px: np.ndarray
    sigma_px: np.ndarray


def held_columns(unknowns: Unknowns, scene: Scene, priors: Mapping[int, LensPrior]) -> np.ndarray:
    """Return the columns (h,) of the unknowns that are taken as held: principal points, and held lenses."""
    held = []
    for camera_id, columns in unknowns.lens_columns.items():
        names = MODELS[scene.cameras[camera_id].model]
        whole = priors.get(camera_id, LensPrior()).held
        held += [
            c
            for c, name in zip(columns.tolist(), names, strict=True)
            if whole or name in _PRINCIPAL_POINT
        ]
    return np.array(held, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class HeldInverse:
    """Generalised inverse of a normal matrix of which some unknowns are held.

    Attributes
    ----------
    free : InnerConstraintInverse
        Inverse with all unknowns free.
    held : ndarray, shape (h,)
        Columns of the held unknowns.
    by_held : ndarray, shape (n, h)
        Change of all unknowns per unit of the held ones.
    columns : ndarray, shape (n, h)
        Columns of the free inverse.
    """

    free: InnerConstraintInverse
    held: np.ndarray
    by_held: np.ndarray
    columns: np.ndarray

    @classmethod
    def of(cls, free: InnerConstraintInverse, held: np.ndarray) -> HeldInverse:
        """Hold some unknowns (h,)."""
        n = len(free.scale)
        units = np.zeros((n, len(held)))
        units[held, np.arange(len(held))] = 1.0
        columns = free.solve(units)
        return cls(free, held, np.linalg.solve(columns[held].T, columns.T).T, columns)

    def solve(self, right_side: np.ndarray) -> np.ndarray:
        """Return the inverse times right_side (n, r), with zeros for the held unknowns."""
        return self.free.solve(right_side) - self.by_held @ (self.columns.T @ right_side)


class LensScores:
    """Scores (J^T r) of the fields of each lens, summed over the measurements of a map."""

    def __init__(self, scene: Scene, unknowns: Unknowns):
        self._scene = scene
        self._sums = {
            camera_id: np.zeros((unknowns.count, 0)) for camera_id in unknowns.lens_columns
        }
        self._measured: dict[int, list[tuple[np.ndarray, np.ndarray, np.ndarray]]] = {
            camera_id: [] for camera_id in unknowns.lens_columns
        }

    def add(
        self,
        bundle: LinearizedBundle,
        seen: MapObservations,
        rows: np.ndarray,
        cluster_of_point: np.ndarray,
    ) -> None:
        """Add the linearized measurements of some rows (M,) of `seen`; cluster_of_point (P,)."""
        ids = self._scene.camera_ids[seen.image_idx[rows]]
        by_points = bundle.by_points()
        residuals = bundle.residuals.reshape(-1, 2)
        for camera_id in np.unique(ids).tolist():
            own = np.flatnonzero(ids == camera_id)
            pixels = seen.pixels[rows[own]]
            values = field_values(self._scene.cameras[camera_id], pixels)
            scores = []
            for component in (0, 1):
                lines = 2 * own + component
                through_points = by_points[lines].T @ values
                scores.append(bundle.design[lines].T @ values - bundle.coupling.T @ through_points)
            both = np.concatenate(scores, axis=1)
            self._sums[camera_id] = both + (
                self._sums[camera_id] if self._sums[camera_id].size else 0.0
            )
            self._measured[camera_id].append(
                (pixels, residuals[own], cluster_of_point[bundle.point[own]])
            )

    def scaled(self, loss: float) -> np.ndarray:
        """Return the scores (n, s) of one standard deviation of each field.

        `loss` is the number of residuals over their redundancy after points: the points absorb the rest.
        """
        columns = []
        for camera_id, sums in self._sums.items():
            pixels, residuals, cluster = (
                np.concatenate(part) for part in zip(*self._measured[camera_id], strict=True)
            )
            size_px = field_px(self._scene.cameras[camera_id], pixels, residuals, cluster)
            # The square of the field's size is shared among its polynomials.
            columns.append(sums * size_px * np.sqrt(loss / (sums.shape[1] / 2)))
        return np.concatenate(columns, axis=1)


def shared_errors(
    scene: Scene,
    unknowns: Unknowns,
    inverse: HeldInverse,
    meat: sparse.csr_matrix,
    gradient: np.ndarray,
    fields: np.ndarray,
    priors: Mapping[int, LensPrior],
) -> tuple[np.ndarray, dict[int, PrincipalPoint]]:
    """Propagate the shared errors to the unknowns.

    Parameters
    ----------
    scene : Scene
    unknowns : Unknowns
        The n unknowns.
    inverse : HeldInverse
    meat : csr_matrix, shape (n, n)
        Covariance of the gradient by independent clusters of measurements.
    gradient : ndarray, shape (n,)
        J^T r at the solution.
    fields : ndarray, shape (n, s)
        Scores of one standard deviation of each field.
    priors : mapping of int to LensPrior

    Returns
    -------
    effects : ndarray, shape (n, t)
        Change of the unknowns by one standard deviation of each of t independent errors.
    principal_points : dict of int to PrincipalPoint
    """
    columns, held = inverse.columns, inverse.held
    step = -(columns.T @ gradient)
    of_fields = columns.T @ fields
    covariance = columns.T @ (meat @ columns) + of_fields @ of_fields.T
    prior = np.zeros(len(held))
    points = {}
    effects = [inverse.solve(fields)]
    for camera_id, own in unknowns.lens_columns.items():
        camera, told = scene.cameras[camera_id], priors.get(camera_id, LensPrior())
        for name, column in zip(MODELS[camera.model], own.tolist(), strict=True):
            place = np.flatnonzero(held == column)
            if name in _PRINCIPAL_POINT:
                prior[place] = PRINCIPAL_POINT_SIGMA * camera.width
            elif name[0] == "f" and len(place):
                prior[place] = told.focal_sigma_px
        point = [
            int(np.flatnonzero(held == own[MODELS[camera.model].index(n)])[0])
            for n in _PRINCIPAL_POINT
        ]
        points[camera_id] = PrincipalPoint(step[point], np.sqrt(np.diag(covariance)[point]))
        if not told.held and told.focal_sigma_px > 0:
            effects.append(told.focal_sigma_px * _by_focal(camera.model, own, unknowns, inverse))
    variance = np.diag(prior**2)
    gain = np.linalg.solve(variance + covariance, variance).T  # of the measurements over the prior
    expected = gain @ step
    second_moment = variance - gain @ variance + np.outer(expected, expected)
    values, vectors = np.linalg.eigh(0.5 * (second_moment + second_moment.T))
    effects.append(inverse.by_held @ (vectors * np.sqrt(np.maximum(values, 0.0))))
    return np.concatenate(effects, axis=1), points


def _by_focal(
    model: str, columns: np.ndarray, unknowns: Unknowns, inverse: HeldInverse
) -> np.ndarray:
    """Return the change (n, 1) of all unknowns per pixel of a lens's focal length (fx and fy alike)."""
    focal = [c for c, name in zip(columns.tolist(), MODELS[model], strict=True) if name[0] == "f"]
    units = np.zeros((unknowns.count, len(focal)))
    units[focal, np.arange(len(focal))] = 1.0
    solved = inverse.solve(units)
    return np.asarray(solved @ np.linalg.solve(solved[focal], np.ones((len(focal), 1))))
