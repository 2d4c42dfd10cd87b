"""Inverse of the singular normal matrix of a map under inner constraints (free-network datum)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from spn_data.colmap.model import Scene
from spn_data.errors import GeometryError
from spn_data.geometry.least_squares import POSE
from spn_data.uncertainty.bundle_jacobians import GAUGE, Unknowns, gauge_null_space

_SMALLEST_PIVOT = (
    1e-10  # of the normal matrix scaled to a unit diagonal; smaller pivots are rounding errors
)
_DISCONNECTED = "the map's measurements do not connect all its frames"


@dataclass(frozen=True, eq=False)
class InnerConstraintInverse:
    """Generalised inverse K = T G T^T of a reduced normal matrix S (n, n) under seven inner constraints.

    The constraints fix the translation, rotation and scale of the camera centres as a whole, like a best-fit
    similarity over these centres.

    Attributes
    ----------
    scale : ndarray, shape (n,)
        Scaling of S to a unit diagonal.
    factor : SuperLU
        Sparse factorisation of the scaled S + F F^T.
    null_space : ndarray, shape (n, 7)
        Null space of S.
    constraints : ndarray, shape (n, 7)
        Coefficients of the inner constraints: the null space, restricted to the camera centres.
    inner : ndarray, shape (7, 7)
        Inverse of constraints^T null_space.

    Notes
    -----
    G = (S + F F^T)^-1 is a generalised inverse of S: F pins one frame and one coordinate of another (a
    minimal datum), which keeps S sparse. T is the S-transformation that projects onto the constraints along
    the gauge.
    """

    scale: np.ndarray
    factor: Any
    null_space: np.ndarray
    constraints: np.ndarray
    inner: np.ndarray

    @classmethod
    def of(
        cls, normal_matrix: sparse.csr_matrix, scene: Scene, unknowns: Unknowns
    ) -> InnerConstraintInverse:
        """Factorise a reduced normal matrix.

        Parameters
        ----------
        normal_matrix : csr_matrix, shape (n, n)
            Reduced normal matrix.
        scene : Scene
            The map.
        unknowns : Unknowns
            Its columns.

        Raises
        ------
        GeometryError
            If the rank defect is larger than the seven degrees of freedom of a similarity.
        """
        diagonal = normal_matrix.diagonal()
        if not np.all(diagonal > 0):
            frame = int(np.argmin(diagonal > 0)) // POSE
            name = scene.names[frame] if frame < len(scene.names) else "a lens"
            raise GeometryError(f"{name} is not determined by the map's measurements")
        scale = 1 / np.sqrt(diagonal)
        scaling = sparse.diags(scale)
        pinned = scaling @ normal_matrix @ scaling + sparse.diags(_pins(scene, len(scale)))
        try:
            factor = splu(
                pinned.tocsc(),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:
            raise GeometryError(_DISCONNECTED) from error
        if float(np.min(factor.U.diagonal())) < _SMALLEST_PIVOT:
            raise GeometryError(_DISCONNECTED)
        null_space = gauge_null_space(scene, unknowns)
        constraints = np.zeros_like(null_space)
        centers = (POSE * np.arange(len(scene.names))[:, None] + np.arange(3)).ravel()
        constraints[centers] = null_space[centers]
        return cls(
            scale, factor, null_space, constraints, np.linalg.inv(constraints.T @ null_space)
        )

    def solve(self, right_side: np.ndarray) -> np.ndarray:
        """Return K right_side, shape (n, r)."""
        right_side = right_side - self.constraints @ (
            self.inner.T @ (self.null_space.T @ right_side)
        )
        solved = self.scale[:, None] * self.factor.solve(self.scale[:, None] * right_side)
        return solved - self.null_space @ (self.inner @ (self.constraints.T @ solved))


def _pins(scene: Scene, unknowns: int) -> np.ndarray:
    """Return 1 for the unknowns (n,) of a minimal datum: a frame at the rim and one coordinate of another."""
    assert GAUGE == POSE + 1
    centers = scene.poses.centers
    first = int(np.argmax(((centers - centers.mean(axis=0)) ** 2).sum(axis=1)))
    apart = centers - centers[first]
    last = int(np.argmax((apart**2).sum(axis=1)))
    pins = np.zeros(unknowns)
    pins[POSE * first : POSE * (first + 1)] = 1.0
    pins[POSE * last + int(np.argmax(np.abs(apart[last])))] = 1.0
    return pins
