"""Rotations: quaternions, matrices, rotation vectors, and heading, pitch and roll."""

from __future__ import annotations

import numpy as np


def rotations_from_quats(quats_wxyz: np.ndarray) -> np.ndarray:
    """Convert unit quaternions (N, 4), scalar first, to rotation matrices (N, 3, 3)."""
    quats = np.asarray(quats_wxyz, dtype=np.float64)
    w, x, y, z = (quats[..., k] for k in range(4))
    found = np.empty((*quats.shape[:-1], 3, 3))
    found[..., 0, 0] = 1 - 2 * (y * y + z * z)
    found[..., 0, 1] = 2 * (x * y - w * z)
    found[..., 0, 2] = 2 * (x * z + w * y)
    found[..., 1, 0] = 2 * (x * y + w * z)
    found[..., 1, 1] = 1 - 2 * (x * x + z * z)
    found[..., 1, 2] = 2 * (y * z - w * x)
    found[..., 2, 0] = 2 * (x * z - w * y)
    found[..., 2, 1] = 2 * (y * z + w * x)
    found[..., 2, 2] = 1 - 2 * (x * x + y * y)
    return found


def quats_from_rotations(rotations: np.ndarray) -> np.ndarray:
    """Convert rotation matrices (N, 3, 3) to unit quaternions (N, 4), scalar first and w >= 0.

    Notes
    -----
    The quaternion is the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix. It gives the nearest
    rotation if the matrix is orthogonal only up to rounding, and has no special case at 180 degrees.

    References
    ----------
    Bar-Itzhack 2000, "New method for extracting the quaternion from a rotation matrix".
    """
    m = np.asarray(rotations, dtype=np.float64)
    k = np.empty((*m.shape[:-2], 4, 4))
    k[..., 0, 0] = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    k[..., 1, 1] = m[..., 0, 0] - m[..., 1, 1] - m[..., 2, 2]
    k[..., 2, 2] = m[..., 1, 1] - m[..., 0, 0] - m[..., 2, 2]
    k[..., 3, 3] = m[..., 2, 2] - m[..., 0, 0] - m[..., 1, 1]
    k[..., 0, 1] = k[..., 1, 0] = m[..., 2, 1] - m[..., 1, 2]
    k[..., 0, 2] = k[..., 2, 0] = m[..., 0, 2] - m[..., 2, 0]
    k[..., 0, 3] = k[..., 3, 0] = m[..., 1, 0] - m[..., 0, 1]
    k[..., 1, 2] = k[..., 2, 1] = m[..., 0, 1] + m[..., 1, 0]
    k[..., 1, 3] = k[..., 3, 1] = m[..., 0, 2] + m[..., 2, 0]
    k[..., 2, 3] = k[..., 3, 2] = m[..., 1, 2] + m[..., 2, 1]
    return canonical_quats(np.linalg.eigh(k)[1][..., -1])


def canonical_quats(quats_wxyz: np.ndarray) -> np.ndarray:
    """Normalise quaternions (N, 4), scalar first, to w >= 0 (w = 0: first non-zero component positive).

    Raises
    ------
    ValueError
        If a quaternion has length zero.
    """
    quats = np.asarray(quats_wxyz, dtype=np.float64)
    norms = np.linalg.norm(quats, axis=-1, keepdims=True)
    if not np.all(norms > 0):
        raise ValueError("a quaternion of length zero does not define a rotation")
    quats = quats / norms
    first = np.argmax(np.abs(quats) > 1e-15, axis=-1)
    sign = np.sign(np.take_along_axis(quats, first[..., None], axis=-1))
    return quats * sign


def conjugate_quats(quats_wxyz: np.ndarray) -> np.ndarray:
    """Return the conjugates (N, 4) of unit quaternions (N, 4), scalar first: the inverse rotations."""
    return np.asarray(quats_wxyz, dtype=np.float64) * [1, -1, -1, -1]


def scalar_last(quats_wxyz: np.ndarray) -> np.ndarray:
    """Reorder quaternions (N, 4) from w, x, y, z to x, y, z, w."""
    return np.roll(quats_wxyz, -1, axis=-1)


def rotation_vectors(rotations: np.ndarray) -> np.ndarray:
    """Convert rotation matrices (N, 3, 3) to rotation vectors (N, 3) in radians, of length at most pi."""
    quats = quats_from_rotations(rotations)
    vector = quats[..., 1:]
    sine = np.linalg.norm(vector, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quats[..., :1])
    # For tiny angles angle/sine tends to 2.
    return vector * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-300), 2.0)


def rotations_from_vectors(vectors: np.ndarray) -> np.ndarray:
    """Convert rotation vectors (N, 3) in radians to rotation matrices (N, 3, 3)."""
    vectors = np.asarray(vectors, dtype=np.float64)
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    half = angle / 2
    # sin(a/2)/a tends to 1/2 at zero: np.sinc(x) is sin(pi x)/(pi x).
    quats = np.concatenate([np.cos(half), vectors * 0.5 * np.sinc(half / np.pi)], axis=-1)
    return rotations_from_quats(quats)


def rotations_from_angles(heading_pitch_roll_deg: np.ndarray) -> np.ndarray:
    """Convert heading, pitch and roll to rotations from an ENU world to the camera.

    Parameters
    ----------
    heading_pitch_roll_deg : ndarray, shape (N, 3)
        Angles in degrees. Heading: of the optical axis, clockwise from north. Pitch: of the optical axis
        above the horizon (-90 looks straight down, and heading is then the direction of the image's top).
        Roll: clockwise rotation of the camera about its axis as seen from behind it (its right side goes
        down).

    Returns
    -------
    ndarray, shape (N, 3, 3)
        cam_from_world rotations.

    Notes
    -----
    These are the conventions of DJI's gimbal angles.
    """
    heading, pitch, roll = np.moveaxis(
        np.deg2rad(np.asarray(heading_pitch_roll_deg, dtype=np.float64)), -1, 0
    )
    zero = np.zeros_like(heading)
    forward = np.stack(
        [np.sin(heading) * np.cos(pitch), np.cos(heading) * np.cos(pitch), np.sin(pitch)], axis=-1
    )
    level_right = np.stack([np.cos(heading), -np.sin(heading), zero], axis=-1)
    level_down = np.cross(forward, level_right)
    c, s = np.cos(roll)[..., None], np.sin(roll)[..., None]
    right = c * level_right + s * level_down
    down = c * level_down - s * level_right
    return np.stack([right, down, forward], axis=-2)


def angles_from_rotations(rotations: np.ndarray) -> np.ndarray:
    """Convert rotations from an ENU world to the camera into heading, pitch and roll.

    Parameters
    ----------
    rotations : ndarray, shape (N, 3, 3)
        cam_from_world rotations.

    Returns
    -------
    ndarray, shape (N, 3)
        Heading in [0, 360), pitch and roll in degrees, as in `rotations_from_angles`. Straight up or down,
        heading and roll are not separable: roll is 0.
    """
    m = np.asarray(rotations, dtype=np.float64)
    right, down, forward = m[..., 0, :], m[..., 1, :], m[..., 2, :]
    pitch = np.arctan2(forward[..., 2], np.hypot(forward[..., 0], forward[..., 1]))
    vertical = np.hypot(forward[..., 0], forward[..., 1]) < 1e-9
    # At the poles the image's top (downward view) or bottom (upward view) points along the heading.
    top = -down * np.where(forward[..., 2:3] < 0, 1.0, -1.0)
    heading = np.where(
        vertical, np.arctan2(top[..., 0], top[..., 1]), np.arctan2(forward[..., 0], forward[..., 1])
    )
    roll = np.where(vertical, 0.0, np.arctan2(-right[..., 2], -down[..., 2]))
    return np.stack([np.rad2deg(heading) % 360.0, np.rad2deg(pitch), np.rad2deg(roll)], axis=-1)


def rotation_errors_deg(quats_wxyz: np.ndarray, true_quats_wxyz: np.ndarray) -> np.ndarray:
    """Return the angles between pairs of rotations.

    Parameters
    ----------
    quats_wxyz, true_quats_wxyz : ndarray, shape (N, 4)
        Unit quaternions, scalar first.

    Returns
    -------
    ndarray, shape (N,)
        Angles in degrees: 4 arcsin(min |q -+ r| / 2), which is exact near zero too.
    """
    q, r = np.asarray(quats_wxyz), np.asarray(true_quats_wxyz)
    chord = np.minimum(np.linalg.norm(q - r, axis=-1), np.linalg.norm(q + r, axis=-1))
    return np.rad2deg(4 * np.arcsin(np.clip(chord / 2, 0.0, 1.0)))
