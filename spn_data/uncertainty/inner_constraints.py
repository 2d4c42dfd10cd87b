"""The inverse of a map's information, which a similarity leaves singular, under conditions on its centres."""

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

_SMALLEST_PIVOT = 1e-10  # of the information scaled to a unit diagonal: less is rounding
_UNTIED = "the map's measurements do not tie its frames together"


@dataclass(frozen=True, eq=False)
class InnerConstraintInverse:
    """K = T G T^T, the inverse of an information S (n, n) under seven conditions, by a sparse factor.

    The conditions (the centres together neither move, turn nor scale) are those of a best similarity.
    G = (S + F F^T)^-1 is a generalised inverse of S: F pins one frame and one coordinate of another, and
    keeps S sparse. T projects onto the conditions along the gauge.
    scale : (n,) to a unit diagonal; factor : of the scaled S + F F^T; directions, conditions : (n, 7);
    inner : (7, 7).
    """

    scale: np.ndarray
    factor: Any
    directions: np.ndarray
    conditions: np.ndarray
    inner: np.ndarray

    @classmethod
    def of(
        cls, information: sparse.csr_matrix, scene: Scene, unknowns: Unknowns
    ) -> InnerConstraintInverse:
        """Raises GeometryError where more than a similarity is free."""
        diagonal = information.diagonal()
        if not np.all(diagonal > 0):
            frame = int(np.argmin(diagonal > 0)) // POSE
            name = scene.names[frame] if frame < len(scene.names) else "a lens"
            raise GeometryError(f"{name} is not fixed by the map's measurements")
        scale = 1 / np.sqrt(diagonal)
        scaling = sparse.diags(scale)
        pinned = scaling @ information @ scaling + sparse.diags(_pins(scene, len(scale)))
        try:
            factor = splu(
                pinned.tocsc(),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:
            raise GeometryError(_UNTIED) from error
        if float(np.min(factor.U.diagonal())) < _SMALLEST_PIVOT:
            raise GeometryError(_UNTIED)
        directions = gauge_null_space(scene, unknowns)
        conditions = np.zeros_like(directions)
        centers = (POSE * np.arange(len(scene.names))[:, None] + np.arange(3)).ravel()
        conditions[centers] = directions[centers]
        return cls(scale, factor, directions, conditions, np.linalg.inv(conditions.T @ directions))

    def solve(self, right: np.ndarray) -> np.ndarray:
        """K right, (n, r)."""
        right = right - self.conditions @ (self.inner.T @ (self.directions.T @ right))
        solved = self.scale[:, None] * self.factor.solve(self.scale[:, None] * right)
        return solved - self.directions @ (self.inner @ (self.conditions.T @ solved))


def _pins(scene: Scene, unknowns: int) -> np.ndarray:
    """(n,) one on the unknowns that fix the gauge: a frame at the rim, and a coordinate of another."""
    assert GAUGE == POSE + 1
    centers = scene.poses.centers
    first = int(np.argmax(((centers - centers.mean(axis=0)) ** 2).sum(axis=1)))
    apart = centers - centers[first]
    last = int(np.argmax((apart**2).sum(axis=1)))
    pins = np.zeros(unknowns)
    pins[POSE * first : POSE * (first + 1)] = 1.0
    pins[POSE * last + int(np.argmax(np.abs(apart[last])))] = 1.0
    return pins
