"""Covariance of single frames relative to the map, if their lens is known from elsewhere.

The same sum as in `covariance`, for frames that share only the lens: noise of the frame's own measurements,
errors of the map points, and errors of the lens (for a mapping lens, correlated with the map points).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spn_data.geometry.camera import Camera
from spn_data.geometry.initial_lens import GUESS_SIGMA, InitialLens
from spn_data.geometry.least_squares import LENS, POSE, cauchy_weights, projection_jacobians
from spn_data.geometry.pose import Poses
from spn_data.registration.adjustment import (
    SequenceObservations,
    SequenceState,
    lens_parameters,
    linearize,
)
from spn_data.registration.covariance import misfit_factor
from spn_data.registration.solution import SCALE_PX
from spn_data.uncertainty.lens_errors import field_values
from spn_data.uncertainty.map_covariance import Functional, MapCovariance

_FRAMES_AT_ONCE = 32


@dataclass(frozen=True, eq=False)
class LensUncertainty:
    """Uncertainty of the intrinsics.

    Attributes
    ----------
    camera_id : int or None
        Camera of the map, if the lens is a mapping lens.
    covariance : ndarray, shape (L, L), or None
        Otherwise the covariance of the intrinsics named by `lens_parameters`.
    """

    camera_id: int | None = None
    covariance: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class PointObservations:
    """Map points observed in one frame.

    Attributes
    ----------
    pixels : ndarray, shape (K, 2)
    point_rows : ndarray, shape (K,)
        Rows of the map points.
    xyz : ndarray, shape (K, 3)
        Positions of the map points.
    """

    pixels: np.ndarray
    point_rows: np.ndarray
    xyz: np.ndarray


def frame_covariances(
    poses: Poses,
    camera: Camera,
    frames: Sequence[PointObservations],
    lens: LensUncertainty,
    map_covariance: MapCovariance,
) -> np.ndarray:
    """Compute the covariance of poses that were estimated from the map points of each frame alone.

    Parameters
    ----------
    poses : Poses
        N poses.
    camera : Camera
    frames : sequence of PointObservations
        One per pose.
    lens : LensUncertainty
    map_covariance : MapCovariance

    Returns
    -------
    ndarray, shape (N, 6, 6)
        As in Labels.
    """
    covariance = np.empty((len(frames), POSE, POSE))
    for first in range(0, len(frames), _FRAMES_AT_ONCE):
        some = range(first, min(first + _FRAMES_AT_ONCE, len(frames)))
        noise, functionals, misfit = [], [], []
        for k in some:
            own, functional, sigma_px = _frame_covariance(poses[k : k + 1], camera, frames[k], lens)
            noise.append(own)
            functionals.append(functional)
            misfit.append(misfit_factor(sigma_px, map_covariance))
        of_map = map_covariance.functional_covariances(functionals)
        for k, own, b, through in zip(some, noise, misfit, of_map, strict=True):
            both = own + b * through.measured + through.shared
            covariance[k] = 0.5 * (both + both.T)
    return covariance


def _frame_covariance(
    pose: Poses, camera: Camera, frame: PointObservations, lens: LensUncertainty
) -> tuple[np.ndarray, Functional, float]:
    """Return the parts of a frame's covariance.

    These are the covariance due to noise and the frame's own lens, the Jacobian of the pose by the map, and
    the standard deviation of one residual component.
    """
    m = len(frame.pixels)
    observations = SequenceObservations(
        np.zeros(m, np.int64), frame.pixels, frame.xyz, np.full(m, -1)
    )
    names = lens_parameters(camera)
    state = SequenceState(pose, camera, np.zeros((0, 3)), InitialLens(camera, GUESS_SIGMA, ""))
    linearized = linearize(state, observations, names)
    weights = cauchy_weights(linearized.residuals_px, SCALE_PX)
    weighted = linearized.by_pose * weights[:, None, None]
    inverse = np.linalg.inv(np.einsum("mia,mib->ab", weighted, linearized.by_pose))
    squared = float((weights * (linearized.residuals_px**2).sum(axis=1)).sum())
    variance = squared / max(2 * float(weights.sum()) - POSE, 1.0)
    noise = variance * inverse
    by_points = inverse @ np.einsum("mia,mij->maj", weighted, linearized.by_point)
    rows, where = np.unique(frame.point_rows, return_inverse=True)
    together = np.zeros((len(rows), POSE, 3))
    np.add.at(together, where, by_points)
    by_lens, by_field = None, None
    if lens.camera_id is not None:
        full = projection_jacobians(camera, pose.to_camera(frame.xyz))[1]
        by_lens = inverse @ np.einsum("mia,mil->al", weighted, full)
        assert by_lens.shape == (POSE, LENS)
        values = field_values(camera, frame.pixels)
        by_field = inverse @ np.concatenate([weighted[:, k].T @ values for k in (0, 1)], axis=1)
    elif lens.covariance is not None and len(lens.covariance):
        pull = inverse @ np.einsum("mia,mil->al", weighted, linearized.by_lens)
        noise = noise + pull @ lens.covariance @ pull.T
    functional = Functional(rows, together.transpose(1, 0, 2), lens.camera_id, by_lens, by_field)
    return noise, functional, float(np.sqrt(variance))
