"""Bundle adjustment of a sequence in a frozen map: its poses, its lens, and the points that only it observes.

Map points stay fixed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from spn_data.geometry.camera import MODELS, Camera
from spn_data.geometry.initial_lens import InitialLens
from spn_data.geometry.least_squares import (
    POSE,
    cauchy_weights,
    lens_parameter_jacobian,
    pose_jacobians,
    projection_jacobians,
    rows_to_sparse,
)
from spn_data.geometry.pose import Poses, to_camera
from spn_data.geometry.rotations import rotations_from_vectors
from spn_data.uncertainty.lens_errors import PRINCIPAL_POINT_SIGMA

_MAX_STEPS = 50
_CONVERGED = 1e-7  # relative decrease of the cost
_DEPENDENT = 10.0  # factor of the variance of a mean of residuals over that of independent ones
_BEHIND_PX = 1e3  # residual of a point at or behind the camera, which makes it an outlier


@dataclass(frozen=True, eq=False)
class SequenceObservations:
    """M measurements in N frames.

    Attributes
    ----------
    frame : ndarray, shape (M,)
        Row of the frame, ascending.
    pixels : ndarray, shape (M, 2)
    map_xyz : ndarray, shape (M, 3)
        Position of the map point; NaN if the measurement belongs to one of the sequence's own points.
    own : ndarray, shape (M,)
        Row of that own point; -1 for a map point.
    """

    frame: np.ndarray
    pixels: np.ndarray
    map_xyz: np.ndarray
    own: np.ndarray

    def select(self, index: np.ndarray) -> SequenceObservations:
        """Return some of the measurements."""
        return SequenceObservations(
            self.frame[index], self.pixels[index], self.map_xyz[index], self.own[index]
        )


@dataclass(frozen=True, eq=False)
class SequenceState:
    """Unknowns of the bundle adjustment.

    Attributes
    ----------
    poses : Poses
        N poses.
    camera : Camera
        Shared by all frames.
    own_points : ndarray, shape (P, 3)
        Points that only the sequence observes.
    expected : InitialLens
        What is known of the lens from elsewhere.
    """

    poses: Poses
    camera: Camera
    own_points: np.ndarray
    expected: InitialLens


@dataclass(frozen=True, eq=False)
class Linearized:
    """Observations linearized at a state.

    Points behind the camera have residuals of 1,000 px.

    Attributes
    ----------
    residuals_px : ndarray, shape (M, 2)
        Projected minus measured.
    by_pose : ndarray, shape (M, 2, 6)
        Jacobian by the pose.
    by_lens : ndarray, shape (M, 2, L)
        Jacobian by the L estimated intrinsics.
    by_point : ndarray, shape (M, 2, 3)
        Jacobian by the point.
    lens : tuple of str
        Names of the estimated intrinsics.
    """

    residuals_px: np.ndarray
    by_pose: np.ndarray
    by_lens: np.ndarray
    by_point: np.ndarray
    lens: tuple[str, ...]


def lens_parameters(camera: Camera) -> tuple[str, ...]:
    """Return the names of the intrinsics that a sequence can determine.

    The principal point is estimated under a prior (`principal_point_prior`).

    Parameters
    ----------
    camera : Camera

    Returns
    -------
    tuple of str
        Those of "f", "fx", "fy", "cx", "cy", "k1", "k2" that the camera model has.
    """
    return tuple(name for name in MODELS[camera.model] if name not in ("p1", "p2"))


@dataclass(frozen=True, eq=False)
class IntrinsicsPrior:
    """Prior of the L estimated intrinsics, as additional squared residuals.

    Attributes
    ----------
    weights : ndarray, shape (L,)
        Of the squares, in px^2 of residual; 0 for an intrinsic without prior.
    offsets : ndarray, shape (L,)
        Current value minus expected value.
    """

    weights: np.ndarray
    offsets: np.ndarray

    @property
    def cost(self) -> float:
        """Sum of the weighted squares."""
        return float(self.weights @ self.offsets**2)


def principal_point_prior(
    state: SequenceState, lens: tuple[str, ...], scale_px: float
) -> IntrinsicsPrior:
    """Return the prior of the principal point: within about 1 % of the image width of its expected place.

    Errors of a sequence's measurements are dependent, and its lens has errors that none of them shows, so
    that the prior counts as much as if there were a few hundred independent measurements.
    """
    names = MODELS[state.camera.model]
    weights, offsets = np.zeros(len(lens)), np.zeros(len(lens))
    for k, name in enumerate(lens):
        if name in ("cx", "cy"):
            axis = ("cx", "cy").index(name)
            weights[k] = _DEPENDENT * (scale_px / (PRINCIPAL_POINT_SIGMA * state.camera.width)) ** 2
            offsets[k] = (
                state.camera.params[names.index(name)] - state.expected.camera.matrix[axis, 2]
            )
    return IntrinsicsPrior(weights, offsets)


def linearize(
    state: SequenceState, observations: SequenceObservations, lens: tuple[str, ...]
) -> Linearized:
    """Compute residuals and Jacobians at a state; `lens` names the estimated intrinsics."""
    rotations = state.poses.rotations[observations.frame]
    places = np.where(
        (observations.own >= 0)[:, None],
        state.own_points[observations.own] if len(state.own_points) else 0.0,
        observations.map_xyz,
    )
    in_camera = to_camera(places, state.poses.centers[observations.frame], rotations)
    behind = in_camera[:, 2] <= 1e-6 * np.linalg.norm(in_camera, axis=1)
    safe = np.where(behind[:, None], np.array([0.0, 0.0, 1.0]), in_camera)
    residuals = state.camera.project(safe) - observations.pixels
    residuals[behind] = _BEHIND_PX
    by_camera_point, by_all = projection_jacobians(state.camera, safe)
    by_camera_point[behind] = 0.0
    by_point = by_camera_point @ rotations
    by_pose = pose_jacobians(safe, by_camera_point, by_point)
    by_lens = by_all @ lens_parameter_jacobian(lens)
    return Linearized(residuals, by_pose, by_lens, by_point, lens)


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations of poses and lens; own points are eliminated (Schur complement).

    Attributes
    ----------
    matrix : sparse, shape (6N+L, 6N+L)
    right : ndarray, shape (6N+L,)
    point_inverse : ndarray, shape (P, 3, 3)
        Inverse normal matrices of the own points.
    coupling : sparse, shape (6N+L, 3P)
        Block between poses and lens and the own points.
    point_right : ndarray, shape (P, 3)
        Right-hand sides of the own points.
    """

    matrix: sparse.csc_matrix
    right: np.ndarray
    point_inverse: np.ndarray
    coupling: sparse.csr_matrix
    point_right: np.ndarray


def jacobian(
    linearized: Linearized, frame: np.ndarray, frames: int, weights: np.ndarray
) -> sparse.csr_matrix:
    """Return the sparse Jacobian (2M, 6N+L) by poses and lens, each row times the root of its weight."""
    m, lens = len(frame), linearized.by_lens.shape[2]
    values = np.concatenate([linearized.by_pose, linearized.by_lens], axis=2)
    of_lens = np.broadcast_to(POSE * frames + np.arange(lens), (m, lens))
    columns = np.concatenate([POSE * frame[:, None] + np.arange(POSE), of_lens], axis=1)
    return rows_to_sparse(values * np.sqrt(weights)[:, None, None], columns, POSE * frames + lens)


def normal_equations(
    linearized: Linearized,
    observations: SequenceObservations,
    frames: int,
    own_points: int,
    weights: np.ndarray,
    prior: IntrinsicsPrior,
    damping: float = 0.0,
) -> NormalEquations:
    """Build the normal equations of residuals and prior.

    `damping` is the factor by which the diagonal is raised (Marquardt).

    Own points are damped like the other unknowns: one with little parallax would otherwise overshoot, however
    small the step.
    """
    lens = len(prior.weights)
    root = np.sqrt(weights)[:, None]
    columns = np.concatenate([linearized.by_pose, linearized.by_lens], axis=2) * root[..., None]
    residuals = linearized.residuals_px * root
    ends = np.searchsorted(observations.frame, np.arange(frames + 1))
    blocks = np.zeros((frames, POSE + lens, POSE + lens))
    pulls = np.zeros((frames, POSE + lens))
    for k in range(frames):
        own_rows = columns[ends[k] : ends[k + 1]].reshape(-1, POSE + lens)
        blocks[k] = own_rows.T @ own_rows
        pulls[k] = own_rows.T @ residuals[ends[k] : ends[k + 1]].ravel()
    of_poses = sparse.bsr_matrix(
        (blocks[:, :POSE, :POSE], np.arange(frames), np.arange(frames + 1)),
        shape=(POSE * frames, POSE * frames),
    )
    of_both = blocks[:, :POSE, POSE:].reshape(POSE * frames, lens)
    of_lens = blocks[:, POSE:, POSE:].sum(axis=0) + np.diag(prior.weights)
    matrix = _bordered(of_poses, of_both, of_lens)
    if damping:
        diagonal = matrix.diagonal()
        matrix = (matrix + sparse.diags(damping * diagonal + 1e-12 * diagonal.max())).tocsc()
    right = -np.concatenate(
        [pulls[:, :POSE].ravel(), pulls[:, POSE:].sum(axis=0) + prior.weights * prior.offsets]
    )
    own = np.flatnonzero(observations.own >= 0)
    point_of = observations.own[own]
    by_point = linearized.by_point[own] * root[own][..., None]
    v = np.zeros((own_points, 3, 3))
    np.add.at(v, point_of, by_point.transpose(0, 2, 1) @ by_point)
    v += damping * v * np.eye(3)
    v += 1e-12 * np.eye(3) * (1 + np.trace(v, axis1=1, axis2=2)[:, None, None])
    inverse = np.linalg.inv(v)
    point_right = np.zeros((own_points, 3))
    np.add.at(point_right, point_of, -np.einsum("mij,mi->mj", by_point, residuals[own]))
    of_points = columns[own].transpose(0, 2, 1) @ by_point
    poses_points = _by_frame_and_point(
        of_points[:, :POSE], observations.frame[own], point_of, frames, own_points
    )
    lens_points = np.zeros((own_points, lens, 3))
    np.add.at(lens_points, point_of, of_points[:, POSE:])
    of_lens_points = lens_points.transpose(1, 0, 2).reshape(lens, 3 * own_points)
    coupling = sparse.vstack([poses_points, sparse.csr_matrix(of_lens_points)], format="csr")
    if own_points:
        poses_weighted = poses_points.copy()
        poses_weighted.data = poses_weighted.data @ inverse[poses_weighted.indices]
        lens_weighted = (lens_points @ inverse).transpose(1, 0, 2).reshape(lens, 3 * own_points)
        matrix = (
            matrix
            - _bordered(
                poses_weighted @ poses_points.T,
                poses_weighted @ of_lens_points.T,
                lens_weighted @ of_lens_points.T,
            )
        ).tocsc()
        moved = point_right.ravel()
        right = right - np.concatenate([poses_weighted @ moved, lens_weighted @ moved])
    return NormalEquations(matrix, right, inverse, coupling, point_right)


def _bordered(
    of_poses: sparse.bsr_matrix, of_both: np.ndarray, of_lens: np.ndarray
) -> sparse.csc_matrix:
    """Return the symmetric matrix of poses (n, n), bordered by those of both (n, L) and the lens (L, L)."""
    if not len(of_lens):
        return of_poses.tocsc()
    both = sparse.csr_matrix(of_both)
    return sparse.block_array([[of_poses, both], [both.T, of_lens]], format="csc")


def _by_frame_and_point(
    blocks: np.ndarray, frame: np.ndarray, point: np.ndarray, frames: int, points: int
) -> sparse.bsr_matrix:
    """Return the sum of blocks (M, 6, 3) at frames (M,) and points (M,), sparse (6 frames, 3 points)."""
    shape = (POSE * frames, 3 * points)
    key, group = np.unique(frame * max(points, 1) + point, return_inverse=True)
    data = np.zeros((len(key), POSE, 3))
    np.add.at(data, group, blocks)
    row_ends = np.searchsorted(key // max(points, 1), np.arange(frames + 1))
    return sparse.bsr_matrix((data, key % max(points, 1), row_ends), shape=shape)


def adjust(
    state: SequenceState,
    observations: SequenceObservations,
    *,
    scale_px: float,
    lens: tuple[str, ...],
) -> SequenceState:
    """Minimize the robust cost (Cauchy loss with scale `scale_px`) from a good start by Levenberg-Marquardt.

    `lens` names the intrinsics to estimate.
    """
    damping = 1e-6
    linearized = linearize(state, observations, lens)
    prior = principal_point_prior(state, lens, scale_px)
    cost = _cost(linearized, prior, scale_px)
    for _ in range(_MAX_STEPS):
        weights = cauchy_weights(linearized.residuals_px, scale_px)
        while True:
            normal = normal_equations(
                linearized,
                observations,
                len(state.poses),
                len(state.own_points),
                weights,
                prior,
                damping,
            )
            candidate = _step(state, normal, lens)
            ahead = linearize(candidate, observations, lens)
            ahead_prior = principal_point_prior(candidate, lens, scale_px)
            new_cost = _cost(ahead, ahead_prior, scale_px)
            if new_cost <= cost or damping > 1e6:
                break
            damping *= 10
        if new_cost > cost:
            return state
        done = cost - new_cost < _CONVERGED * cost
        state, linearized, prior, cost = candidate, ahead, ahead_prior, new_cost
        damping = max(damping / 10, 1e-9)
        if done:
            break
    return state


def _cost(linearized: Linearized, prior: IntrinsicsPrior, scale_px: float) -> float:
    squared = (linearized.residuals_px**2).sum(axis=1)
    return float(np.log1p(squared / scale_px**2).sum()) + prior.cost / scale_px**2


def _step(state: SequenceState, normal: NormalEquations, lens: tuple[str, ...]) -> SequenceState:
    change = splu(normal.matrix).solve(normal.right)
    n = len(state.poses)
    moves = change[: POSE * n].reshape(n, POSE)
    poses = Poses.from_rotations(
        state.poses.centers + moves[:, :3],
        rotations_from_vectors(moves[:, 3:]) @ state.poses.rotations,
    )
    params = state.camera.params.copy()
    for name, value in zip(lens, change[POSE * n :], strict=True):
        params[MODELS[state.camera.model].index(name)] += value
    camera = state.camera
    if min(replace(camera, params=params).focal_px) > 0.05 * max(camera.width, camera.height):
        camera = replace(camera, params=params)
    own = state.own_points
    if len(own):
        right = normal.point_right - (normal.coupling.T @ change).reshape(-1, 3)
        own = own + np.einsum("pij,pj->pi", normal.point_inverse, right)
    return SequenceState(poses, camera, own, state.expected)
