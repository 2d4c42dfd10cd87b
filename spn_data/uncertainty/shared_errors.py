"""Errors that all measurements of a lens share, propagated to poses, intrinsics and points of a map.

They are the fields that the camera model does not describe, principal points among them (`lens_errors`), and
focal lengths that were held.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy import sparse

from spn_data.colmap.model import MapObservations, Scene
from spn_data.geometry.initial_lens import Hold, InitialLens
from spn_data.uncertainty.bundle_jacobians import LinearizedBundle, Unknowns, estimated_names
from spn_data.uncertainty.inner_constraints import InnerConstraintInverse
from spn_data.uncertainty.lens_errors import CONSTANT, TERMS, estimate_field, field_values


@dataclass(frozen=True)
class LensPrior:
    """What is known of a lens besides the measurements of the map.

    Attributes
    ----------
    hold : Hold
        What mapping held.
    focal_sigma_px : float
        Standard deviation of a held focal length.
    focal_doubt_px : float
        Error of the focal length by what contradicts the measurements.
    """

    hold: Hold = Hold.NOTHING
    focal_sigma_px: float = 0.0
    focal_doubt_px: float = 0.0

    @classmethod
    def of(cls, lens: InitialLens, focal_doubt_px: float = 0.0) -> LensPrior:
        """Return what is known of a lens with which mapping began."""
        held = 0.0 if lens.hold is Hold.NOTHING else lens.focal_sigma
        return cls(lens.hold, held * float(np.mean(lens.camera.focal_px)), focal_doubt_px)


@dataclass(frozen=True, eq=False)
class PrincipalPoint:
    """What the measurements of a map say about the principal point of a lens.

    Attributes
    ----------
    shift_px : ndarray, shape (2,)
        Its expected value minus the current one.
    covariance : ndarray, shape (2, 2)
    """

    shift_px: np.ndarray
    covariance: np.ndarray

    @property
    def sigma_px(self) -> np.ndarray:
        """Standard deviations (2,)."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True)
class FocalLength:
    """What the measurements of a map say about the focal length of a lens.

    Attributes
    ----------
    shift_px : float
        Its expected value minus the current one, if the lens has the fields that the residuals show.
    sigma_px : float
        Standard deviation of that, errors of measurements included.
    """

    shift_px: float
    sigma_px: float

    @property
    def error_px(self) -> float:
        """Root mean square error to be expected of the current value."""
        return float(np.hypot(self.shift_px, self.sigma_px))


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """t independent errors of unit variance, and what they change.

    Attributes
    ----------
    unknowns : ndarray, shape (n, t)
        Changes of the unknowns.
    fields : dict of int to ndarray, shape (TERMS, t)
        Coefficients of the fields of each lens, by camera id.
    principal_points : dict of int to PrincipalPoint
    focal_lengths : dict of int to FocalLength
        Of lenses whose focal length was estimated.
    dependence : float
        Factor (at least 1) by which whole blocks of measurements vary more than their tracks explain.
    """

    unknowns: np.ndarray
    fields: dict[int, np.ndarray] = field(default_factory=dict)
    principal_points: dict[int, PrincipalPoint] = field(default_factory=dict)
    focal_lengths: dict[int, FocalLength] = field(default_factory=dict)
    dependence: float = 1.0


@dataclass(frozen=True, eq=False)
class HeldInverse:
    """Generalised inverse of a normal matrix of which some unknowns are held.

    Attributes
    ----------
    free : InnerConstraintInverse
        Inverse with all unknowns free.
    held : ndarray, shape (h,)
        Columns of the held unknowns.
    columns : ndarray, shape (n, h)
        Their columns of the free inverse.
    by_held : ndarray, shape (n, h)
        Change of all unknowns per unit of the held ones.
    """

    free: InnerConstraintInverse
    held: np.ndarray
    columns: np.ndarray
    by_held: np.ndarray

    @classmethod
    def of(cls, free: InnerConstraintInverse, held: np.ndarray) -> HeldInverse:
        """Hold some unknowns (h,)."""
        columns = free.solve(_units(len(free.scale), held))
        return cls(free, held, columns, np.linalg.solve(columns[held].T, columns.T).T)

    def solve(self, right_side: np.ndarray) -> np.ndarray:
        """Return the inverse times right_side (n, r), with zeros for the held unknowns."""
        return self.free.solve(right_side) - self.by_held @ (self.columns.T @ right_side)

    def change_by(self, columns: np.ndarray) -> np.ndarray:
        """Return the change (n, 1) of all unknowns if some of the held ones (k,) are raised by 1."""
        raised = np.isin(self.held, columns)
        return np.asarray(self.by_held[:, raised].sum(axis=1, keepdims=True))


def _units(n: int, columns: np.ndarray) -> np.ndarray:
    units = np.zeros((n, len(columns)))
    units[columns, np.arange(len(columns))] = 1.0
    return units


def held_columns(scene: Scene, unknowns: Unknowns, priors: Mapping[int, LensPrior]) -> np.ndarray:
    """Return the columns (h,) of the intrinsics that mapping held."""
    held = []
    for camera_id, columns in unknowns.lens_columns.items():
        hold = priors.get(camera_id, LensPrior()).hold
        for column, name in zip(
            columns.tolist(), estimated_names(scene.cameras[camera_id]), strict=True
        ):
            if hold is Hold.LENS or (hold is Hold.FOCAL and name[0] == "f"):
                held.append(column)
    return np.array(held, dtype=np.int64)


def _variance(information: np.ndarray, noise: np.ndarray) -> float:
    """Return the ratio of noise to information (TERMS, TERMS), over their best determined directions."""
    values, vectors = np.linalg.eigh(information)
    best = vectors[:, values >= np.median(values)]
    of_noise, of_information = (np.trace(best.T @ m @ best) for m in (noise, information))
    return float(of_noise / max(of_information, 1e-300))


@dataclass(frozen=True, eq=False)
class _Block:
    """Sums over one block of measurements; F, J and r are those of `LensScores`.

    Attributes
    ----------
    normal : csr_matrix, shape (n, n)
        J^T J.
    gradient : ndarray, shape (n,)
        J^T r.
    information : dict of int to ndarray, shape (TERMS, TERMS)
        F^T F by camera id.
    cross : dict of int to csr_matrix, shape (n, TERMS)
        J^T F.
    pull : dict of int to ndarray, shape (TERMS,)
        -F^T r.
    """

    normal: sparse.csr_matrix
    gradient: np.ndarray
    information: dict[int, np.ndarray]
    cross: dict[int, sparse.csr_matrix]
    pull: dict[int, np.ndarray]


class LensScores:
    """Sums over blocks of measurements of a map from which the fields of each lens are estimated.

    F are the derivatives of the residuals by the coefficients of the fields, J those by the unknowns, both
    with the points projected out; r are the residuals.
    """

    def __init__(self, scene: Scene, unknowns: Unknowns):
        self._scene = scene
        ids = sorted(unknowns.lens_columns)
        self._blocks: list[_Block] = []
        self.cross = {i: np.zeros((unknowns.count, TERMS)) for i in ids}  # J^T F
        self.noise = {
            i: np.zeros((TERMS, TERMS)) for i in ids
        }  # of -F^T r, if tracks are independent
        self.noise_cross = {
            i: np.zeros((unknowns.count, TERMS)) for i in ids
        }  # of J^T r and -F^T r

    def add(
        self,
        bundle: LinearizedBundle,
        normal: sparse.csr_matrix,
        seen: MapObservations,
        rows: np.ndarray,
        cluster: np.ndarray,
        scores: sparse.csr_matrix,
    ) -> None:
        """Add a block of linearized measurements.

        Parameters
        ----------
        bundle : LinearizedBundle
        normal : csr_matrix, shape (n, n)
            Its reduced normal matrix.
        seen : MapObservations
        rows : ndarray, shape (M,)
            The linearized rows of `seen`.
        cluster : ndarray, shape (M,)
            Cluster of each measurement, 0..C-1.
        scores : csr_matrix, shape (C, n)
            Scores J^T r of the clusters.
        """
        block = _Block(normal, bundle.design.T @ bundle.residuals, {}, {}, {})
        ids = self._scene.camera_ids[seen.image_idx[rows]]
        by_points = bundle.by_points()
        clusters = scores.shape[0]
        for camera_id in np.unique(ids).tolist():
            own = np.flatnonzero(ids == camera_id)
            values = field_values(self._scene.cameras[camera_id], seen.pixels[rows[own]])
            half = values.shape[1]
            gather = sparse.csr_matrix(
                (np.ones(len(own)), (cluster[own], np.arange(len(own)))), (clusters, len(own))
            )
            through, cross, pulls = [], [], []
            for component in (0, 1):
                lines = 2 * own + component
                through.append(by_points[lines].T @ values)
                cross.append(bundle.design[lines].T @ values)
                pulls.append(gather @ (-values * bundle.residuals[lines][:, None]))
            of_points = np.concatenate(through, axis=1)
            of_clusters = np.concatenate(pulls, axis=1)
            mixed = np.concatenate(cross, axis=1) - bundle.coupling.T @ of_points
            information = -of_points.T @ of_points
            information[:half, :half] += values.T @ values
            information[half:, half:] += values.T @ values
            block.information[camera_id] = information
            block.cross[camera_id] = sparse.csr_matrix(mixed)
            block.pull[camera_id] = of_clusters.sum(axis=0)
            self.cross[camera_id] += mixed
            self.noise[camera_id] += of_clusters.T @ of_clusters
            self.noise_cross[camera_id] += scores.T @ of_clusters
        self._blocks.append(block)

    def projected(self, camera_id: int, response: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return information (B, TERMS, TERMS) and pull (B, TERMS) of a lens, all unknowns projected out.

        `response` (n, TERMS) is minus the change of the unknowns per unit of each coefficient.
        """
        information, pulls = [], []
        for block in self._blocks:
            of_unknowns = response.T @ (block.normal @ response)
            pull = response.T @ block.gradient
            if camera_id in block.pull:
                mixed = block.cross[camera_id].T @ response
                of_unknowns = of_unknowns + block.information[camera_id] - mixed - mixed.T
                pull = pull + block.pull[camera_id]
            information.append(0.5 * (of_unknowns + of_unknowns.T))
            pulls.append(pull)
        return np.stack(information), np.stack(pulls)


def shared_errors(
    scene: Scene,
    unknowns: Unknowns,
    inverse: HeldInverse,
    sums: LensScores,
    meat: sparse.csr_matrix,
    noise_factor: float,
    priors: Mapping[int, LensPrior],
) -> SharedErrors:
    """Estimate the errors that measurements of a lens share, and propagate them to the unknowns.

    Parameters
    ----------
    scene : Scene
    unknowns : Unknowns
        The n unknowns.
    inverse : HeldInverse
    sums : LensScores
    meat : csr_matrix, shape (n, n)
        Covariance of the gradient J^T r, if tracks are independent.
    noise_factor : float
        Factor by which the clusters' scores in `sums` underestimate errors; `meat` contains it.
    priors : mapping of int to LensPrior

    Returns
    -------
    SharedErrors
    """
    effects: list[np.ndarray] = []
    roots: dict[int, np.ndarray] = {}
    points: dict[int, PrincipalPoint] = {}
    focal_lengths: dict[int, FocalLength] = {}
    dependences: dict[int, float] = {}
    for camera_id in unknowns.lens_columns:
        # Minus the change of the unknowns per unit of each coefficient.
        response = inverse.solve(sums.cross[camera_id])
        mixed = response.T @ sums.noise_cross[camera_id]
        noise = noise_factor * (sums.noise[camera_id] + mixed + mixed.T)
        noise = noise + response.T @ (meat @ response)
        information, pull = sums.projected(camera_id, response)
        of_tracks = _variance(information.sum(axis=0), noise)
        estimate = estimate_field(scene.cameras[camera_id], information, pull, of_tracks)
        dependences[camera_id] = max(1.0, estimate.variance_px2 / of_tracks)
        constant = list(CONSTANT)
        points[camera_id] = PrincipalPoint(
            estimate.coefficients_px[constant], estimate.covariance[np.ix_(constant, constant)]
        )
        column = unknowns.lens_columns[camera_id][:1]  # f or fx
        if not np.isin(column, inverse.held).any():
            solved = inverse.solve(_units(unknowns.count, column))
            by_field = response[column[0]]
            variance = by_field @ estimate.covariance @ by_field
            variance += dependences[camera_id] * float((solved.T @ (meat @ solved)).item())
            shift = -by_field @ estimate.coefficients_px
            focal_lengths[camera_id] = FocalLength(float(shift), float(np.sqrt(variance)))
        roots[camera_id] = estimate.root
        effects.append(-response @ estimate.root)
    for camera_id, prior in priors.items():
        if prior.focal_sigma_px > 0 and camera_id in unknowns.lens_columns:
            names = estimated_names(scene.cameras[camera_id])
            columns = unknowns.lens_columns[camera_id]
            focal = [c for c, name in zip(columns.tolist(), names, strict=True) if name[0] == "f"]
            effects.append(prior.focal_sigma_px * inverse.change_by(np.array(focal)))
    together = np.concatenate(effects, axis=1)
    fields, first = {}, 0
    for camera_id, root in roots.items():
        fields[camera_id] = np.zeros((TERMS, together.shape[1]))
        fields[camera_id][:, first : first + root.shape[1]] = root
        first += root.shape[1]
    return SharedErrors(
        together, fields, points, focal_lengths, max(dependences.values(), default=1.0)
    )
