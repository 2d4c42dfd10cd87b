"""Mounting of the camera in its gimbal: labels of mapping flights against the angles in their telemetry."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from spn_data.geometry.rotations import rotations_from_angles, rotations_from_vectors
from spn_data.inputs.landmark_source import LandmarkSource
from spn_model.onboard.attitude import MAX_TURN_DEG, GimbalMounting

_MIN_FRAMES = 20
_MAX_SIGMA_DEG = 3.0  # above it, angles and images are not of the same time or camera
# Least standard deviations of another flight's angles: of two or more flights, and of one, whose own error
# cannot be told from the mounting.
_LEAST_DEG, _LEAST_ALONE_DEG = 0.5, 1.0
_PRIOR_DEG = 2.0  # of a mounting; holds what the flights do not determine, such as a turn about up
_STEPS = 20
_FLOOR_DEG = 0.05


def measure_mounting(
    source: LandmarkSource, training: Collection[str]
) -> tuple[GimbalMounting | None, str]:
    """Measure how the camera is turned from what its gimbal states.

    Parameters
    ----------
    source : LandmarkSource
        Frames of the map with the angles in their telemetry.
    training : collection of str
        Names of the training frames; no other frame is used.

    Returns
    -------
    mounting : GimbalMounting or None
        None if too few frames have angles, or the angles do not belong to the images.
    note : str
        What was measured, or why nothing was.

    Notes
    -----
    Robust least squares (Geman-McClure) over the differences between up in the camera from the labels and
    from the angles, for each flight. Heading is not used: it comes from a compass, and up does not depend on
    it. The standard deviation includes what differs between the flights.
    """
    angles = source.gimbal_deg.copy()
    angles[:, 0] = 0.0
    kept = np.isfinite(angles).all(axis=1) & np.array([n in training for n in source.names])
    count = int(kept.sum())
    if count < _MIN_FRAMES:
        return None, (
            f"{count} training frames have gimbal angles, {_MIN_FRAMES} are needed to measure the mounting "
            "of the camera"
        )
    true = source.poses.rotations[kept][:, :, 2]
    stated = rotations_from_angles(angles[kept])[:, :, 2]
    flight = np.array(source.flights)[kept]
    flights = sorted(set(flight.tolist()))
    # Each flight counts once: what changes from flight to flight is larger than what changes during one.
    turn = np.mean([_turn_of(stated[flight == f], true[flight == f]) for f in flights], axis=0)
    off_deg = np.rad2deg(true - stated @ rotations_from_vectors(turn[None])[0].T)
    sigma_deg = float(np.sqrt((off_deg**2).sum(axis=1).mean() / 2))
    turn_deg = np.rad2deg(turn)
    if sigma_deg > _MAX_SIGMA_DEG or np.linalg.norm(turn_deg) > MAX_TURN_DEG:
        return None, (
            f"gimbal angles and labels of {count} training frames differ by {np.linalg.norm(turn_deg):.1f} "
            f"deg, with a scatter of {sigma_deg:.1f} deg, so the mounting of the camera is not known"
        )
    x, y, z = turn_deg.tolist()
    least = _LEAST_DEG if len(flights) > 1 else _LEAST_ALONE_DEG
    made = GimbalMounting(
        turn_deg=(x, y, z), sigma_deg=max(sigma_deg, least), frames=count, flights=len(flights)
    )
    return made, (
        f"the camera is turned by {np.linalg.norm(turn_deg):.2f} deg from its gimbal's angles, which give up "
        f"to {made.sigma_deg:.2f} deg ({count} frames; flights: {', '.join(flights)})"
    )


def _turn_of(stated: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the rotation vector (3,) that turns stated unit vectors (N, 3) into true ones."""
    turn, prior = np.zeros(3), np.eye(3) / np.deg2rad(_PRIOR_DEG) ** 2
    for _ in range(_STEPS):
        expected = stated @ rotations_from_vectors(turn[None])[0].T
        off = true - expected
        sigma = max(1.4826 * float(np.median(np.abs(off))), np.deg2rad(_FLOOR_DEG))
        weights = (1 + (off**2).sum(axis=1) / (3 * sigma) ** 2) ** -2 / sigma**2
        by = np.cross(np.eye(3), expected[:, None]).transpose(0, 2, 1)  # turn x expected
        turn = turn + np.linalg.solve(
            np.einsum("n,nij,nik->jk", weights, by, by) + prior,
            np.einsum("n,nij,ni->j", weights, by, off) - prior @ turn,
        )
    return turn
