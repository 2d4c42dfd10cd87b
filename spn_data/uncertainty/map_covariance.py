"""How uncertain a frozen map is in itself: covariances of its frames, lenses and points.

A map is free to move, turn and scale; what is given here is its error after its own best similarity to the
truth (over the centres of its frames), for which there is nothing else to know than its residuals.

With errors that are independent, bundle adjustment leaves the frames and lenses with the covariance
s^2 S^+, where S is their information after points are eliminated. Errors of features are not independent:
a feature that drifts as the view changes drifts alike in neighbouring frames, and one spot gives several
features. Only the pulls of whole clusters of measurements on the unknowns are taken as independent, and the
covariance is S^+ M S^+ with M summed over clusters (Liang and Zeger 1986, after Huber 1967 and White 1980).
A point's own error, which its few residuals cannot tell, is that of a model of the drift (track_noise).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

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
from spn_data.uncertainty.inner_constraints import InnerConstraintInverse
from spn_data.uncertainty.track_noise import TrackNoise, fit_track_noise, own_errors

_FRAMES_AT_ONCE = 32
_MEASUREMENTS_AT_ONCE = 200_000
_SPOT_PX = 1.0  # features of one spot differ in scale and orientation, not in place
_NOISE_SAMPLE = 6000  # points, of which long tracks are chosen


@dataclass(frozen=True, kw_only=True)
class MapCovarianceOptions:
    """What is known of how the map was made, and what is taken for independent."""

    refine_principal_point: bool = False  # whether mapping estimated it
    clustered: bool = True  # only clusters of measurements are independent; False: each one is


@dataclass(frozen=True, eq=False)
class Functional:
    """A linear function, of r values, of positions of the map's points and of one of its lenses.

    point_idx : (K,) positions in Scene.points; by_points : (r, K, 3), derivatives by their positions.
    camera_id, by_lens : (r, 8), derivatives by its fx, fy, cx, cy, k1, k2, p1, p2; None where no lens of the
    map matters.
    """

    point_idx: np.ndarray
    by_points: np.ndarray
    camera_id: int | None = None
    by_lens: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class MapCovariance:
    """The uncertainty of a map, ready to be asked; all in the scene's own frame and unit.

    sigma_px : root mean square of one residual component, for its degrees of freedom.
    noise : how the errors of one track hang together, None where all are taken as independent.
    """

    sigma_px: float
    noise: TrackNoise | None
    _unknowns: Unknowns
    _frames: int
    _inverse: InnerConstraintInverse
    _pull: sparse.csr_matrix  # (n, n), M
    _place: (
        np.ndarray
    )  # (P,) of each point of the scene in the following, -1 of one that nothing measures
    _whitening: np.ndarray  # (p, 3, 3), see Bundle
    _coupling: sparse.csr_matrix  # (3p, n), see Bundle
    _own: np.ndarray  # (p, 3, 3), see own_errors

    @classmethod
    def of(
        cls, scene: Scene, seen: MapObservations, options: MapCovarianceOptions | None = None
    ) -> MapCovariance:
        """Of a map that bundle adjustment has brought to its least squares, and all its measurements.

        Raises GeometryError where the measurements do not fix the map up to a similarity.
        """
        options = options or MapCovarianceOptions()
        unknowns = Unknowns.of(scene, refine_principal_point=options.refine_principal_point)
        rows = np.flatnonzero(np.isfinite(seen.residuals_px).all(axis=1))
        cluster = _clusters_of_points(seen, rows, len(scene.points))
        rows = rows[np.lexsort((seen.point_idx[rows], cluster[seen.point_idx[rows]]))]
        noise = None
        if options.clustered:
            sample = np.random.default_rng(0).permutation(len(scene.points))[:_NOISE_SAMPLE]
            some = rows[np.isin(seen.point_idx[rows], sample)]
            noise = fit_track_noise(linearize_bundle(scene, seen, unknowns, some))
        information = sparse.csr_matrix((unknowns.count, unknowns.count))
        pull = sparse.csr_matrix((unknowns.count, unknowns.count))
        squares, parts = 0.0, []
        for part in _parts(rows, cluster[seen.point_idx[rows]]):
            bundle = linearize_bundle(scene, seen, unknowns, part)
            information = information + bundle.reduced_normal_matrix()
            squares += float(bundle.residuals @ bundle.residuals)
            if options.clustered:
                pull = pull + _clustered_pull(bundle, cluster[bundle.points])
            parts.append(
                (bundle.points, bundle.whitening, bundle.coupling, own_errors(bundle, noise))
            )
        points = np.concatenate([part[0] for part in parts])
        after_points = 2 * len(rows) - 3 * len(points)
        freedom = after_points - unknowns.count + GAUGE
        if freedom <= 0:
            raise GeometryError("the map has no more measurements than unknowns")
        variance = squares / freedom
        own = np.concatenate([part[3] for part in parts])
        # Residuals are smaller than errors by what frames and lenses took of them.
        pull = after_points / freedom * pull if options.clustered else variance * information
        place = np.full(len(scene.points), -1)
        place[points] = np.arange(len(points))
        return cls(
            float(np.sqrt(variance)),
            noise,
            unknowns,
            len(scene.names),
            InnerConstraintInverse.of(information, scene, unknowns),
            pull.tocsr(),
            place,
            np.concatenate([part[1] for part in parts]),
            sparse.vstack([part[2] for part in parts], format="csr"),
            own if options.clustered else variance * own,
        )

    def functional_covariances(self, functionals: Sequence[Functional]) -> list[np.ndarray]:
        """(r, r) each: through frames and lenses, which all points share, and of each point by itself."""
        if not functionals:
            return []
        sides = [self._right_side(functional) for functional in functionals]
        solved = self._inverse.solve(np.concatenate([right for _, right in sides], axis=1))
        pulled = self._pull @ solved
        ends = np.cumsum([0] + [right.shape[1] for _, right in sides])
        found = []
        for (by_own, _), functional, a, b in zip(
            sides, functionals, ends[:-1], ends[1:], strict=True
        ):
            errors = self._own[self._place[functional.point_idx]]
            each = np.einsum("rki,kij->rkj", by_own, errors)
            of_points = np.tensordot(each, by_own, axes=((1, 2), (1, 2)))
            found.append(solved[:, a:b].T @ pulled[:, a:b] + of_points)
        return found

    def pose_covariances(self, frames: np.ndarray | None = None) -> np.ndarray:
        """(F, 6, 6) of the mapping frames at `frames` (F,), of all if None; axes and order as in Labels."""
        wanted = np.arange(self._frames) if frames is None else np.asarray(frames)
        found = np.empty((len(wanted), POSE, POSE))
        n = self._unknowns.count
        for first in range(0, len(wanted), _FRAMES_AT_ONCE):
            some = wanted[first : first + _FRAMES_AT_ONCE]
            columns = (POSE * some[:, None] + np.arange(POSE)).ravel()
            right = np.zeros((n, len(columns)))
            right[columns, np.arange(len(columns))] = 1.0
            solved = self._inverse.solve(right)
            pulled = (self._pull @ solved).reshape(n, len(some), POSE)
            solved = solved.reshape(n, len(some), POSE)
            found[first : first + len(some)] = np.einsum("nfi,nfj->fij", solved, pulled)
        return found

    def _right_side(self, functional: Functional) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives by the points' own whitened errors (r, K, 3), and by frames and lenses (n, r)."""
        place = self._place[functional.point_idx]
        if np.any(place < 0):
            raise ValueError("a point that nothing in the map measures has no covariance")
        by_own = np.einsum("rki,kji->rkj", functional.by_points, self._whitening[place])
        rows = (3 * place[:, None] + np.arange(3)).ravel()
        right = -(self._coupling[rows].T @ by_own.reshape(len(by_own), 3 * len(place)).T)
        if functional.camera_id is not None and functional.by_lens is not None:
            mixing = self._unknowns.lens_jacobian[functional.camera_id]
            right[self._unknowns.lens_columns[functional.camera_id]] += (
                functional.by_lens @ mixing
            ).T
        return by_own, right


def _clusters_of_points(seen: MapObservations, rows: np.ndarray, points: int) -> np.ndarray:
    """(P,) cluster of each point: those of one spot of the image that first saw them; -1 where none did."""
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
    """Pieces of rows that are sorted by cluster, none of which is cut."""
    first = 0
    while first < len(rows):
        last = min(first + _MEASUREMENTS_AT_ONCE, len(rows))
        last = int(np.searchsorted(cluster, cluster[last - 1], side="right"))
        yield rows[first:last]
        first = last


def _clustered_pull(bundle: LinearizedBundle, cluster_of_point: np.ndarray) -> sparse.csr_matrix:
    """(n, n) sum over clusters of the outer product of their pull on frames and lenses."""
    cluster = np.unique(cluster_of_point, return_inverse=True)[1]
    pulls = cluster_scores(bundle.residuals, cluster[bundle.point], bundle.design)
    return (pulls.T @ pulls).tocsr()
