"""Covariance of a frozen map in its own gauge: of its poses, intrinsics and points.

The gauge of a map is free (translation, rotation, scale). The covariance here is that of the error after the
map's own best-fit similarity to the truth over its camera centres (inner constraints), which can be estimated
from the residuals alone.

If measurement errors were independent, poses and intrinsics would have the covariance s^2 S^+ after bundle
adjustment, where S is the normal matrix reduced by the points (Schur complement). Keypoint errors are not
independent: a keypoint that drifts as the view changes drifts alike in neighbouring frames, and one spot
gives several keypoints. Therefore only the scores (J^T r) of whole clusters of measurements are taken as
independent, and the covariance is the cluster-robust (sandwich) estimate S^+ M S^+ with M summed over
clusters. A point's own error, for which its few residuals are not enough, is predicted by a model of the
drift (`track_noise`). Whole images may err alike too: cross-validation of blocks of measurements tells by
which factor M is too small (`shared_errors`).

Some errors are shared by all measurements of a lens, and no number of measurements averages them out: the
field that the camera model does not describe (`lens_errors`), and errors of intrinsics that were held
(`shared_errors`). They are propagated to all unknowns, and add to the covariance.

References
----------
Huber 1967; White 1980; Liang and Zeger 1986, "Longitudinal data analysis using generalized linear models".
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import sparse

from spn_data.colmap.model import MapObservations, Scene
from spn_data.errors import GeometryError
from spn_data.geometry.least_squares import POSE, cluster_scores
from spn_data.uncertainty.bundle_jacobians import (
    GAUGE,
    LinearizedBundle,
    Unknowns,
    linearize_bundle,
)
from spn_data.uncertainty.focal_changes import FocalChanges, focal_changes, with_focal_errors
from spn_data.uncertainty.inner_constraints import InnerConstraintInverse
from spn_data.uncertainty.lens_errors import BLOCKS
from spn_data.uncertainty.shared_errors import (
    HeldInverse,
    LensPrior,
    LensScores,
    SharedErrors,
    held_columns,
    shared_errors,
)
from spn_data.uncertainty.track_noise import TrackNoise, fit_track_noise, whitened_point_covariances

_FRAMES_AT_ONCE = 32
_MEASUREMENTS_AT_ONCE = 200_000
_SPOT_PX = 1.0  # keypoints of one spot differ in scale and orientation, not in position
_NOISE_SAMPLE = 6000  # points, among which long tracks are selected


@dataclass(frozen=True, kw_only=True)
class MapCovarianceOptions:
    """How the map was made, and which errors are taken as independent.

    Attributes
    ----------
    lenses : mapping of int to LensPrior
        What is known of a lens from elsewhere, by camera id; `LensPrior()` for others.
    clustered : bool
        Whether only clusters of measurements are independent; False: every measurement is.
    exact_lenses : bool
        Whether lenses are exactly as modelled, and what was held is exact.
    """

    lenses: Mapping[int, LensPrior] = field(default_factory=dict)
    clustered: bool = True
    exact_lenses: bool = False


@dataclass(frozen=True, eq=False)
class Functional:
    """A linear function with r values of some of the map's points and of one of its lenses.

    Attributes
    ----------
    point_idx : ndarray, shape (K,)
        Rows in `Scene.points`.
    by_points : ndarray, shape (r, K, 3)
        Derivatives by the positions of these points.
    camera_id : int or None
        The lens; None if the function depends on none.
    by_lens : ndarray, shape (r, 8), or None
        Derivatives by fx, fy, cx, cy, k1, k2, p1, p2 of this lens.
    by_field : ndarray, shape (r, TERMS), or None
        Derivatives by the coefficients of the fields of this lens.
    """

    point_idx: np.ndarray
    by_points: np.ndarray
    camera_id: int | None = None
    by_lens: np.ndarray | None = None
    by_field: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class FunctionalCovariance:
    """Covariance of a functional with r values.

    Attributes
    ----------
    measured : ndarray, shape (r, r)
        Due to errors of measurements.
    shared : ndarray, shape (r, r)
        Due to errors that all measurements of a lens share.
    """

    measured: np.ndarray
    shared: np.ndarray


@dataclass(frozen=True, eq=False)
class MapCovariance:
    """Factorised covariance of a map, in the scene's own frame and unit.

    Attributes
    ----------
    sigma_px : float
        Standard deviation of one residual component: root of the residual sum of squares over the redundancy.
    noise : TrackNoise or None
        Correlation of the errors along a track; None if all errors are taken as independent.
    shared : SharedErrors
        Errors that all measurements of a lens share.
    """

    sigma_px: float
    noise: TrackNoise | None
    shared: SharedErrors
    _unknowns: Unknowns
    _frames: int
    _inverse: HeldInverse
    _meat: sparse.csr_matrix  # (n, n), M
    _point_row: np.ndarray  # (P,) rows of scene points in the arrays below, -1 if unmeasured
    _whitening: np.ndarray  # (p, 3, 3), see LinearizedBundle
    _coupling: sparse.csr_matrix  # (3p, n), see LinearizedBundle
    _own: np.ndarray  # (p, 3, 3), see whitened_point_covariances

    @classmethod
    def of(
        cls, scene: Scene, seen: MapObservations, options: MapCovarianceOptions | None = None
    ) -> MapCovariance:
        """Compute the covariance of a map at its bundle adjustment solution.

        Parameters
        ----------
        scene : Scene
            The map.
        seen : MapObservations
            All its measurements.
        options : MapCovarianceOptions, optional
            How it was made.

        Raises
        ------
        GeometryError
            If the measurements do not determine the map up to a similarity.
        """
        options = options or MapCovarianceOptions()
        unknowns = Unknowns.of(scene)
        rows = np.flatnonzero(np.isfinite(seen.residuals_px).all(axis=1))
        cluster = _clusters_of_points(seen, rows, len(scene.points))
        rows = rows[np.lexsort((seen.point_idx[rows], cluster[seen.point_idx[rows]]))]
        noise = None
        if options.clustered:
            sample = np.random.default_rng(0).permutation(len(scene.points))[:_NOISE_SAMPLE]
            some = rows[np.isin(seen.point_idx[rows], sample)]
            noise = fit_track_noise(linearize_bundle(scene, seen, unknowns, some))
        normal_matrix = sparse.csr_matrix((unknowns.count, unknowns.count))
        meat = sparse.csr_matrix((unknowns.count, unknowns.count))
        lens_scores = LensScores(scene, unknowns)
        squares, parts = 0.0, []
        for part in _parts(rows, cluster[seen.point_idx[rows]]):
            bundle = linearize_bundle(scene, seen, unknowns, part)
            normal = bundle.reduced_normal_matrix()
            normal_matrix = normal_matrix + normal
            squares += float(bundle.residuals @ bundle.residuals)
            if options.clustered:
                scores, of_measurement = _clustered_scores(bundle, cluster[bundle.points])
                meat = meat + scores.T @ scores
                if not options.exact_lenses:
                    lens_scores.add(bundle, normal, seen, part, of_measurement, scores)
            parts.append(
                (
                    bundle.points,
                    bundle.whitening,
                    bundle.coupling,
                    whitened_point_covariances(bundle, noise),
                )
            )
        points = np.concatenate([part[0] for part in parts])
        held = held_columns(scene, unknowns, options.lenses)
        after_points = 2 * len(rows) - 3 * len(points)
        redundancy = after_points - (unknowns.count - len(held)) + GAUGE
        if redundancy <= 0:
            raise GeometryError("the map has no more measurements than unknowns")
        variance = squares / redundancy
        own = np.concatenate([part[3] for part in parts])
        # Residuals are smaller than errors because poses and intrinsics absorbed a part of them.
        meat = after_points / redundancy * meat if options.clustered else variance * normal_matrix
        inverse = HeldInverse.of(InnerConstraintInverse.of(normal_matrix, scene, unknowns), held)
        shared = SharedErrors(np.zeros((unknowns.count, 0)))
        if options.clustered and not options.exact_lenses:
            factor = after_points / redundancy
            shared = shared_errors(
                scene, unknowns, inverse, lens_scores, meat, factor, options.lenses
            )
            meat = shared.dependence * meat
            doubts = {i: lens.focal_doubt_px for i, lens in options.lenses.items()}
            shared = with_focal_errors(shared, inverse, unknowns, doubts)
        point_row = np.full(len(scene.points), -1)
        point_row[points] = np.arange(len(points))
        return cls(
            float(np.sqrt(variance)),
            noise,
            shared,
            unknowns,
            len(scene.names),
            inverse,
            meat.tocsr(),
            point_row,
            np.concatenate([part[1] for part in parts]),
            sparse.vstack([part[2] for part in parts], format="csr"),
            own if options.clustered else variance * own,
        )

    def with_focal_errors(self, errors_px: Mapping[int, float]) -> MapCovariance:
        """Return the covariance with further errors of focal lengths, sigma in px by camera id."""
        shared = with_focal_errors(self.shared, self._inverse, self._unknowns, errors_px)
        return replace(self, shared=shared)

    def focal_changes(self) -> FocalChanges:
        """Return how the poses change with focal lengths, and by other errors of the lenses."""
        return focal_changes(self._inverse, self._unknowns, self.shared, self._frames)

    def functional_covariances(
        self, functionals: Sequence[Functional]
    ) -> list[FunctionalCovariance]:
        """Return the covariance of each functional.

        Errors of measurements act through poses and intrinsics, which all points share, and through the own
        error of each point. Errors that all measurements of a lens share are kept apart.

        Parameters
        ----------
        functionals : sequence of Functional
            Functions with r values each.

        Returns
        -------
        list of FunctionalCovariance
            One per functional.

        Raises
        ------
        ValueError
            If a functional depends on a point without measurements.
        """
        if not functionals:
            return []
        sides = [self._right_side(functional) for functional in functionals]
        rights = np.concatenate([right for _, right in sides], axis=1)
        solved, of_unknowns = self._inverse.solve(rights), rights.T @ self.shared.unknowns
        weighted = self._meat @ solved
        ends = np.cumsum([0] + [right.shape[1] for _, right in sides])
        covariances = []
        for (by_own, _), functional, a, b in zip(
            sides, functionals, ends[:-1], ends[1:], strict=True
        ):
            errors = self._own[self._point_row[functional.point_idx]]
            each = np.einsum("rki,kij->rkj", by_own, errors)
            of_points = np.tensordot(each, by_own, axes=((1, 2), (1, 2)))
            of_shared = of_unknowns[a:b]
            if functional.by_field is not None and functional.camera_id in self.shared.fields:
                of_shared = (
                    of_shared + functional.by_field @ self.shared.fields[functional.camera_id]
                )
            covariances.append(
                FunctionalCovariance(
                    solved[:, a:b].T @ weighted[:, a:b] + of_points, of_shared @ of_shared.T
                )
            )
        return covariances

    def pose_covariances(self, frames: np.ndarray | None = None) -> np.ndarray:
        """Return the covariances of mapping frames.

        Parameters
        ----------
        frames : ndarray, shape (F,), optional
            Rows of the frames; all by default.

        Returns
        -------
        ndarray, shape (F, 6, 6)
            Axes and order as in `Labels`.
        """
        wanted = np.arange(self._frames) if frames is None else np.asarray(frames)
        found = np.empty((len(wanted), POSE, POSE))
        n = self._unknowns.count
        for first in range(0, len(wanted), _FRAMES_AT_ONCE):
            some = wanted[first : first + _FRAMES_AT_ONCE]
            columns = (POSE * some[:, None] + np.arange(POSE)).ravel()
            right = np.zeros((n, len(columns)))
            right[columns, np.arange(len(columns))] = 1.0
            solved = self._inverse.solve(right)
            weighted = (self._meat @ solved).reshape(n, len(some), POSE)
            solved = solved.reshape(n, len(some), POSE)
            shared = self.shared.unknowns[columns].reshape(len(some), POSE, -1)
            found[first : first + len(some)] = np.einsum(
                "nfi,nfj->fij", solved, weighted
            ) + shared @ np.swapaxes(shared, 1, 2)
        return found

    def lens_covariances(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """Return the covariance of the intrinsics of each lens that were not held.

        Returns
        -------
        dict of int to (ndarray of bool of shape (L,), ndarray of shape (F, F))
            By camera id: which of its `estimated_names` were estimated, and the covariance of those.
        """
        found = {}
        for camera_id, columns in self._unknowns.lens_columns.items():
            is_free = ~np.isin(columns, self._inverse.held)
            free = columns[is_free]
            right = np.zeros((self._unknowns.count, len(free)))
            right[free, np.arange(len(free))] = 1.0
            solved, shared = self._inverse.solve(right), self.shared.unknowns[free]
            found[camera_id] = is_free, solved.T @ (self._meat @ solved) + shared @ shared.T
        return found

    def _right_side(self, functional: Functional) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives by the points' whitened errors (r, K, 3), and by poses and intrinsics (n, r)."""
        row = self._point_row[functional.point_idx]
        if np.any(row < 0):
            raise ValueError("a point without measurements has no covariance")
        by_own = np.einsum("rki,kji->rkj", functional.by_points, self._whitening[row])
        rows = (3 * row[:, None] + np.arange(3)).ravel()
        right = -(self._coupling[rows].T @ by_own.reshape(len(by_own), 3 * len(row)).T)
        if functional.camera_id is not None and functional.by_lens is not None:
            mixing = self._unknowns.lens_jacobian[functional.camera_id]
            right[self._unknowns.lens_columns[functional.camera_id]] += (
                functional.by_lens @ mixing
            ).T
        return by_own, right


def _clusters_of_points(seen: MapObservations, rows: np.ndarray, points: int) -> np.ndarray:
    """Return the cluster (P,) of each point, -1 without measurements.

    Points that were first seen at the same spot of the same image share a cluster.
    """
    order = rows[np.lexsort((seen.image_idx[rows], seen.point_idx[rows]))]
    point, first = np.unique(seen.point_idx[order], return_index=True)
    first = order[first]
    spots = np.floor(seen.pixels[first] / _SPOT_PX).astype(np.int64)
    width = int(np.ptp(spots[:, 0])) + 1
    height = int(np.ptp(spots[:, 1])) + 1
    spots -= spots.min(axis=0)
    keys = (seen.image_idx[first] * height + spots[:, 1]) * width + spots[:, 0]
    clusters = np.full(points, -1)
    clusters[point] = np.unique(keys, return_inverse=True)[1]
    return clusters


def _parts(rows: np.ndarray, cluster: np.ndarray) -> Iterator[np.ndarray]:
    """Yield pieces of rows sorted by cluster without splitting a cluster."""
    first = 0
    most = min(_MEASUREMENTS_AT_ONCE, -(-len(rows) // BLOCKS))
    while first < len(rows):
        last = min(first + most, len(rows))
        last = int(np.searchsorted(cluster, cluster[last - 1], side="right"))
        yield rows[first:last]
        first = last


def _clustered_scores(
    bundle: LinearizedBundle, cluster_of_point: np.ndarray
) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Return the scores (C, n) of clusters, and the cluster (M,) of each measurement, 0..C-1.

    The meat of the sandwich is the sum over clusters of the outer products of their scores.
    """
    cluster = np.unique(cluster_of_point, return_inverse=True)[1][bundle.point]
    return cluster_scores(bundle.residuals, cluster, bundle.design), cluster
