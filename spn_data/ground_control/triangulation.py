"""Triangulation of marked points in a model whose cameras are known, robust to one wrong mark."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses, to_camera

_ROUNDS = 15
_LIMIT_SIGMAS = 5.0  # a mark farther than this from the others' point is wrong
_LEAST_LIMIT_PX = 5.0
_TRIED_EACH = 8  # up to so many marks, the wrong one is found by leaving out each


@dataclass(frozen=True, eq=False)
class Views:
    """M marks of one point.

    Attributes
    ----------
    pixels : ndarray, shape (M, 2)
        In the images of the model.
    sigma_px : ndarray, shape (M,)
    poses : Poses
        M poses.
    cameras : tuple of Camera
        Camera of each mark.
    """

    pixels: np.ndarray
    sigma_px: np.ndarray
    poses: Poses
    cameras: tuple[Camera, ...]

    def __len__(self) -> int:
        return len(self.pixels)

    def select(self, mask: np.ndarray) -> Views:
        """Return the marks of a mask (M,)."""
        return Views(
            self.pixels[mask],
            self.sigma_px[mask],
            self.poses[mask],
            tuple(c for c, m in zip(self.cameras, mask, strict=True) if m),
        )

    def residuals_px(self, point: np.ndarray) -> np.ndarray:
        """Return mark minus projection (M, 2) of a point (3,); NaN behind a camera."""
        in_camera = to_camera(
            np.tile(point, (len(self), 1)), self.poses.centers, self.poses.rotations
        )
        projected = [c.project(p[None])[0] for c, p in zip(self.cameras, in_camera, strict=True)]
        return self.pixels - np.array(projected).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class Triangulated:
    """A point from its marks.

    Attributes
    ----------
    point : ndarray, shape (3,)
        In the model; NaN if it cannot be had.
    covariance : ndarray, shape (3, 3)
    used : ndarray of bool, shape (M,)
        Marks that agree.
    distance_px : ndarray, shape (M,)
        Of each mark from the point's projection.
    problem : str
        Why there is no point; empty if there is one.
    """

    point: np.ndarray
    covariance: np.ndarray
    used: np.ndarray
    distance_px: np.ndarray
    problem: str = ""


def triangulate(views: Views) -> Triangulated:
    """Triangulate a point; with four or more marks, one or more that disagree with the others are left out.

    Parameters
    ----------
    views : Views

    Returns
    -------
    Triangulated
    """
    used = np.ones(len(views), dtype=bool)
    if not len(views):
        return _none(views, "it has no mark in an image of the model")
    if len(views) == 1:
        return _none(views, "it is marked in one image only, and two are needed")
    limit = np.maximum(_LIMIT_SIGMAS * views.sigma_px, _LEAST_LIMIT_PX)
    while True:
        part = views.select(used)
        point, covariance = _solve(part)
        if not np.isfinite(point).all():
            return _none(views, "its rays do not cross: mark it in images from farther apart")
        distance = _distances(views, point)
        if (distance[used] <= limit[used]).all():
            break
        told = f"its {used.sum()} marks disagree by {_shown(distance[used])}"
        wrong = _wrong_mark(views, used, distance / limit, limit)
        if wrong is None or used.sum() <= len(views) / 2:
            return _none(views, f"{told}, and which is wrong cannot be told")
        used[wrong] = False
    residual = part.residuals_px(point) / part.sigma_px[:, None]
    # A point whose marks agree worse than their sigma says is known worse in proportion.
    scale = max(1.0, float((residual**2).sum()) / (2 * len(part) - 3))
    return Triangulated(point, covariance * scale, used, distance)


def marks_meet(views: Views, limit_px: float) -> bool:
    """Return whether all marks are within a distance of one point's projections."""
    point, _ = _solve(views)
    return bool((_distances(views, point) <= limit_px).all())


def _wrong_mark(
    views: Views, used: np.ndarray, relative: np.ndarray, limit: np.ndarray
) -> int | None:
    """Return the mark without which the others agree best; None if that cannot be told."""
    rows = np.flatnonzero(used)
    if len(rows) < 3:
        return None
    if len(rows) > _TRIED_EACH:
        return int(rows[np.argmax(relative[rows])])
    worst = []
    for k in rows:
        rest = used.copy()
        rest[k] = False
        point, _ = _solve(views.select(rest))
        worst.append(float((_distances(views, point) / limit)[rest].max()))
    if len(rows) == 3 and sum(w <= 1 for w in worst) != 1:
        return None  # two marks nearly always agree
    return int(rows[np.argmin(worst)])


def _shown(distance: np.ndarray) -> str:
    """Return the largest distance in words."""
    known = distance[np.isfinite(distance)]
    return f"{known.max():.0f} px" if len(known) else "more than can be measured"


def _none(views: Views, problem: str) -> Triangulated:
    unknown = np.full(len(views), np.nan)
    none = np.zeros(len(views), dtype=bool)
    return Triangulated(np.full(3, np.nan), np.full((3, 3), np.nan), none, unknown, problem)


def _distances(views: Views, point: np.ndarray) -> np.ndarray:
    """Return the distances (M,) in pixels of the marks from a point's projections; infinite if unknown."""
    distance = np.linalg.norm(views.residuals_px(point), axis=1)
    return np.where(np.isfinite(distance), distance, np.inf)


def _solve(views: Views) -> tuple[np.ndarray, np.ndarray]:
    """Return the least-squares point (3,) and its covariance (3, 3); NaN if the rays do not meet."""
    nothing = np.full(3, np.nan), np.full((3, 3), np.nan)
    rays = np.array(
        [c.unproject(p[None])[0] for c, p in zip(views.cameras, views.pixels, strict=True)]
    )
    rotations, centers = views.poses.rotations, views.poses.centers
    directions = np.einsum("mji,mj->mi", rotations, np.column_stack([rays, np.ones(len(rays))]))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # The point nearest to all rays.
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    matrix = across.sum(axis=0)
    if np.linalg.cond(matrix) > 1e9 or not np.isfinite(matrix).all():
        return nothing
    point = np.linalg.solve(matrix, np.einsum("mij,mj->i", across, centers))
    focal = np.array([np.mean(c.focal_px) for c in views.cameras])
    weight = (focal / views.sigma_px)[:, None]
    reach = float(np.linalg.norm(point - centers, axis=1).max())
    for _ in range(_ROUNDS):
        in_camera = to_camera(np.tile(point, (len(rays), 1)), centers, rotations)
        depth = in_camera[:, 2:]
        if (np.abs(depth) < 1e-9 * reach).any():
            return nothing
        seen = in_camera[:, :2] / depth
        # Derivatives of x/z and y/z.
        slope = (rotations[:, :2] - seen[:, :, None] * rotations[:, 2:]) / depth[:, :, None]
        jacobian = (slope * weight[:, :, None]).reshape(-1, 3)
        information = jacobian.T @ jacobian
        try:
            step = np.linalg.solve(information, jacobian.T @ ((rays - seen) * weight).ravel())
        except np.linalg.LinAlgError:
            return nothing
        point = point + step
        if np.linalg.norm(step) < 1e-9 * reach:
            break
    if np.linalg.cond(information) > 1e14:
        return nothing
    if not np.isfinite(point).all():
        return nothing
    return point, np.linalg.inv(information)
