"""Triangulation of marked points in a model whose cameras are known, robust to one wrong mark."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses, to_camera

_ROUNDS = 15
_LIMIT_SIGMAS = 5.0  # a mark farther than this from the others' point is wrong
_LEAST_LIMIT_PX = 5.0


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
    if len(views) < 2:
        return _none(views, "it is marked in one image only, and two are needed" if len(views) else "it has no mark in an image of the model")  # fmt: skip
    limit = np.maximum(_LIMIT_SIGMAS * views.sigma_px, _LEAST_LIMIT_PX)
    while True:
        part = views.select(used)
        point, covariance = _solve(part)
        distance = _distances(views, point)
        bad = ~(distance <= limit)
        if not (bad & used).any():
            break
        worst = float(np.nanmax(np.where(np.isfinite(distance), distance, np.inf)[used]))
        told = f"{worst:.0f} px" if np.isfinite(worst) else "behind a camera"
        if used.sum() < 3:
            return _none(views, f"its two marks disagree by {told}: one of them is wrong")
        candidates = []
        for k in np.flatnonzero(used):
            rest = used.copy()
            rest[k] = False
            trial, _ = _solve(views.select(rest))
            error = _distances(views, trial)
            worse = np.where(np.isfinite(error), error / limit, np.inf)[rest].max()
            candidates.append((float(worse), int(k)))
        candidates.sort()
        if used.sum() == 3:
            fitting = [k for worse, k in candidates if worse <= 1]
            if len(fitting) != 1:
                return _none(
                    views, f"its three marks disagree by {told}, and which is wrong cannot be told"
                )
        if used.sum() <= len(views) / 2:
            return _none(views, f"its {len(views)} marks disagree by {told}")
        used[candidates[0][1]] = False
    residual = part.residuals_px(point) / part.sigma_px[:, None]
    freedom = 2 * len(part) - 3
    # One that agrees worse than its sigma says is known worse in proportion.
    scale = max(1.0, float((residual**2).sum()) / freedom)
    if not np.isfinite(covariance).all():
        return _none(views, "its rays are parallel: mark it in images from farther apart")
    return Triangulated(point, covariance * scale, used, distance)


def _none(views: Views, problem: str) -> Triangulated:
    unknown = np.full(len(views), np.nan)
    none = np.zeros(len(views), dtype=bool)
    return Triangulated(np.full(3, np.nan), np.full((3, 3), np.nan), none, unknown, problem)


def _distances(views: Views, point: np.ndarray) -> np.ndarray:
    if not np.isfinite(point).all():
        return np.full(len(views), np.inf)
    return np.linalg.norm(views.residuals_px(point), axis=1)


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
    weight = focal / views.sigma_px
    information = matrix
    for _ in range(_ROUNDS):
        x, y, z = to_camera(np.tile(point, (len(rays), 1)), centers, rotations).T
        if (np.abs(z) < 1e-12).any():
            return nothing
        error = rays - np.column_stack([x / z, y / z])
        zero = np.zeros_like(z)
        slope = np.stack(
            [
                np.stack([1 / z, zero, -x / z**2], axis=1),
                np.stack([zero, 1 / z, -y / z**2], axis=1),
            ],
            axis=1,
        )
        jacobian = (slope @ rotations * weight[:, None, None]).reshape(-1, 3)
        information = jacobian.T @ jacobian
        if np.linalg.cond(information) > 1e14:
            return nothing
        step = np.linalg.solve(information, jacobian.T @ (error * weight[:, None]).ravel())
        point = point + step
    if not np.isfinite(point).all():
        return nothing
    return point, np.linalg.inv(information)
