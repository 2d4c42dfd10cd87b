"""How uncertain a frozen map is in itself: covariances of its frames, lenses and points.

A map is free to move, turn and scale; what is given here is its error after its own best similarity to the
truth (over the centres of its frames), for which there is nothing else to know than its residuals.

With errors that are independent, bundle adjustment leaves the frames and lenses with the covariance
s^2 S^+, where S is their information after points are eliminated. Errors of features are not independent:
a feature that drifts as the view changes drifts alike in neighbouring frames, and one spot gives several
features. Only the pulls of whole clusters of measurements on the unknowns are taken as independent, and the
covariance is S^+ M S^+ with M summed over clusters (Liang and Zeger 1986, after Huber 1967 and White 1980).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from spn_data.bundle_jacobians import GAUGE, POSE, Bundle, gauge_directions, linearize_bundle
from spn_data.colmap.model import Observations, Scene
from spn_data.errors import GeometryError

_SMALLEST_PIVOT = 1e-10  # of the scaled information: less is rounding
_FRAMES_AT_ONCE = 32


@dataclass(frozen=True, kw_only=True)
class MapCovarianceOptions:
    """What is taken for independent."""

    clustered: bool = True  # whether only clusters of measurements are independent, or each one
    cell_px: float = 1.0  # points first seen in the same cell of an image are of one cluster
    refine_principal_point: bool = False  # whether mapping estimated it


@dataclass(frozen=True, eq=False)
class Functional:
    """A linear function of r values of the map's points, and of the lens of one camera.

    point_idx : (K,) positions in Scene.points; by_points : (r, K, 3), derivatives by their positions.
    camera_id, by_lens : (r, 8), derivatives by its fx, fy, cx, cy, k1, k2, p1, p2; None where the lens does
    not matter.
    """

    point_idx: np.ndarray
    by_points: np.ndarray
    camera_id: int | None = None
    by_lens: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class MapCovariance:
    """The uncertainty of a map, ready to be asked; all in the scene's own frame and unit.

    sigma_px : deviation of one residual component.
    """

    sigma_px: float
    _bundle: Bundle
    _inverse: _GaugedInverse
    _pull: sparse.csr_matrix  # (n, n), M

    @classmethod
    def of(
        cls,
        scene: Scene,
        seen: Observations,
        options: MapCovarianceOptions | None = None,
    ) -> MapCovariance:
        """Of a map that bundle adjustment has brought to its least squares, and its measurements.

        Raises GeometryError where the measurements do not fix the map up to a similarity.
        """
        options = options or MapCovarianceOptions()
        bundle = linearize_bundle(
            scene, seen, refine_principal_point=options.refine_principal_point
        )
        freedom = bundle.degrees_of_freedom
        if freedom <= 0:
            raise GeometryError("the map has no more measurements than unknowns")
        variance = float(bundle.residuals @ bundle.residuals) / freedom
        inverse = _GaugedInverse.of(bundle.reduced, scene)
        if options.clustered:
            pull = _clustered_pull(bundle, _clusters(bundle, options.cell_px))
        else:
            pull = (variance * bundle.reduced).tocsr()
        return cls(float(np.sqrt(variance)), bundle, inverse, pull)

    def functional_covariance(self, functional: Functional) -> np.ndarray:
        """(r, r) covariance of one functional: see functional_covariances."""
        return self.functional_covariances([functional])[0]

    def functional_covariances(self, functionals: Sequence[Functional]) -> list[np.ndarray]:
        """(r, r) each: through the frames and lenses, which all points share, and of each point by itself."""
        own, through = [], []
        for functional in functionals:
            whitened, right = self._right_side(functional)
            own.append(self.sigma_px**2 * whitened @ whitened.T)
            through.append(right)
        if not functionals:
            return []
        solved = self._inverse.solve(np.concatenate(through, axis=1))
        pulled = self._pull @ solved
        ends = np.cumsum([0] + [right.shape[1] for right in through])
        return [
            mine + solved[:, a:b].T @ pulled[:, a:b]
            for mine, a, b in zip(own, ends[:-1], ends[1:], strict=True)
        ]

    def pose_covariances(self, frames: np.ndarray | None = None) -> np.ndarray:
        """(F, 6, 6) of mapping frames at `frames` (F,), of all if None; order and frames as in Labels."""
        wanted = np.arange(len(self._inverse.centers)) if frames is None else np.asarray(frames)
        found = np.empty((len(wanted), POSE, POSE))
        n = self._bundle.reduced.shape[0]
        for first in range(0, len(wanted), _FRAMES_AT_ONCE):
            some = wanted[first : first + _FRAMES_AT_ONCE]
            right = np.zeros((n, POSE * len(some)))
            columns = (POSE * some[:, None] + np.arange(POSE)).ravel()
            right[columns, np.arange(len(columns))] = 1.0
            solved = self._inverse.solve(right).reshape(n, len(some), POSE)
            pulled = (self._pull @ solved.reshape(n, -1)).reshape(n, len(some), POSE)
            found[first : first + len(some)] = np.einsum("nfi,nfj->fij", solved, pulled)
        return found

    def lens_covariance(self, camera_id: int) -> np.ndarray:
        """(8, 8) of fx, fy, cx, cy, k1, k2, p1, p2; zero for what mapping held."""
        mixing = np.eye(8)
        nothing = np.zeros(0, dtype=np.int64)
        return self.functional_covariance(
            Functional(nothing, np.zeros((8, 0, 3)), camera_id, mixing)
        )

    def _right_side(self, functional: Functional) -> tuple[np.ndarray, np.ndarray]:
        """By the points' own whitened errors (r, 3K), and by frames and lenses (n, r)."""
        k = functional.point_idx
        whitened = np.einsum(
            "rki,kji->rkj", functional.by_points, self._bundle.whitening[k]
        ).reshape(len(functional.by_points), 3 * len(k))
        rows = (3 * k[:, None] + np.arange(3)).ravel()
        right = -(self._bundle.coupling[rows].T @ whitened.T)
        if functional.camera_id is not None and functional.by_lens is not None:
            columns = self._bundle.lens_columns[functional.camera_id]
            right[columns] += (
                functional.by_lens @ self._bundle.lens_mixing[functional.camera_id]
            ).T
        return whitened, right


@dataclass(frozen=True, eq=False)
class _GaugedInverse:
    """K = T G T^T: the inverse of a singular S under seven conditions on the centres, by a sparse factor.

    The conditions (zero mean move, turn and scaling of the centres) are what a best similarity brings about.
    G = (S + F F^T)^-1 with F one entry in each of seven rows, which pin one frame and one coordinate of
    another: a generalised inverse of S that keeps it sparse. T projects on the conditions along the gauge.
    """

    scale: np.ndarray  # (n,)
    factor: Any
    directions: np.ndarray  # (n, 7) of the gauge
    conditions: np.ndarray  # (n, 7)
    inner: np.ndarray  # (7, 7)
    centers: np.ndarray

    @classmethod
    def of(cls, reduced: sparse.csc_matrix, scene: Scene) -> _GaugedInverse:
        diagonal = reduced.diagonal()
        if not np.all(diagonal > 0):
            frame = int(np.argmin(diagonal > 0)) // POSE
            name = scene.names[frame] if frame < len(scene.names) else "a lens"
            raise GeometryError(f"{name} is not fixed by the map's measurements")
        scale = 1 / np.sqrt(diagonal)
        centers = scene.poses.centers
        first = int(np.argmax(((centers - centers.mean(axis=0)) ** 2).sum(axis=1)))
        apart = centers - centers[first]
        last = int(np.argmax((apart**2).sum(axis=1)))
        pins = np.zeros(len(scale))
        pins[POSE * first : POSE * first + POSE] = 1.0
        pins[POSE * last + int(np.argmax(np.abs(apart[last])))] = 1.0
        scaling = sparse.diags(scale)
        pinned = (scaling @ reduced @ scaling + sparse.diags(pins)).tocsc()
        try:
            factor = splu(
                pinned,
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:
            raise GeometryError("the map's measurements do not tie its frames together") from error
        if float(np.min(factor.U.diagonal())) < _SMALLEST_PIVOT:
            raise GeometryError("the map's measurements do not tie its frames together")
        directions = gauge_directions(scene, len(scale))
        conditions = np.zeros_like(directions)
        of_frames = slice(0, POSE * len(centers))
        conditions[of_frames].reshape(-1, POSE, GAUGE)[:, :3] = directions[of_frames].reshape(
            -1, POSE, GAUGE
        )[:, :3]
        inner = np.linalg.inv(conditions.T @ directions)
        return cls(scale, factor, directions, conditions, inner, centers)

    def solve(self, right: np.ndarray) -> np.ndarray:
        """K right, (n, r)."""
        right = right - self.conditions @ (self.inner.T @ (self.directions.T @ right))
        solved = self.scale[:, None] * self.factor.solve(self.scale[:, None] * right)
        return solved - self.directions @ (self.inner @ (self.conditions.T @ solved))


def _clusters(bundle: Bundle, cell_px: float) -> np.ndarray:
    """(M,) cluster of each measurement: all of a point, and of the points first seen in its cell."""
    order = np.lexsort((bundle.frame_idx, bundle.point_idx))
    points, first = np.unique(bundle.point_idx[order], return_index=True)
    first = order[first]
    cells = np.floor(bundle.pixels[first] / cell_px).astype(np.int64)
    where = np.column_stack([bundle.frame_idx[first], cells])
    cluster_of_point = np.zeros(int(points.max()) + 1, dtype=np.int64)
    cluster_of_point[points] = np.unique(where, axis=0, return_inverse=True)[1].ravel()
    return cluster_of_point[bundle.point_idx]


def _clustered_pull(bundle: Bundle, cluster: np.ndarray) -> sparse.csr_matrix:
    """(n, n) sum over clusters of the outer product of their pull on frames and lenses."""
    count = int(cluster.max()) + 1
    gather = sparse.csr_matrix(
        (bundle.residuals, (np.repeat(cluster, 2), np.arange(len(bundle.residuals)))),
        (count, len(bundle.residuals)),
    )
    pulls = (gather @ bundle.design).tocsr()
    # Residuals are smaller than errors by what frames and lenses took of them.
    points = len(np.unique(bundle.point_idx))
    after_points = len(bundle.residuals) - 3 * points
    share = after_points / bundle.degrees_of_freedom * count / (count - 1)
    return (share * (pulls.T @ pulls)).tocsr()
