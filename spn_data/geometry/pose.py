"""Camera poses, similarity transforms and pose errors.

This is the only module that implements quaternion operations and pose inversion. World axes are East, North,
Up once a model is georeferenced; camera axes are x right, y down, z forward.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spn_data.errors import GeometryError
from spn_data.geometry.json_values import numbers


def rotations_from_quats(quats_wxyz: np.ndarray) -> np.ndarray:
    """Convert unit quaternions (N, 4), scalar first, to rotation matrices (N, 3, 3)."""
    w, x, y, z = np.moveaxis(np.asarray(quats_wxyz, dtype=np.float64), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


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


def to_camera(points: np.ndarray, centers: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Transform world points (M, 3) into camera frames.

    Parameters
    ----------
    points : ndarray, shape (M, 3)
        In the world frame.
    centers, rotations : ndarray, shapes (3,) and (3, 3), or (M, 3) and (M, 3, 3)
        Camera centres and cam_from_world rotations: one pose for all points, or one for each point.

    Returns
    -------
    ndarray, shape (M, 3)
        In camera axes: x right, y down, z forward; in the world's unit.
    """
    offsets = points - centers
    if rotations.ndim == 2:
        return np.asarray(offsets @ rotations.T)
    return np.einsum("mij,mj->mi", rotations, offsets)


@dataclass(frozen=True, eq=False)
class Poses:
    """Camera poses of N frames, in the Cambridge convention.

    Attributes
    ----------
    centers : ndarray, shape (N, 3)
        Camera centres in the world frame, float64, in metres once georeferenced.
    quats_wxyz : ndarray, shape (N, 4)
        Unit quaternions with w >= 0, float64, that rotate world axes into camera axes (x right, y down,
        z forward): ``x_cam = R(q) @ (x_world - center)``.
    """

    centers: np.ndarray
    quats_wxyz: np.ndarray

    @classmethod
    def from_rotations(cls, centers: np.ndarray, cam_from_world: np.ndarray) -> Poses:
        """Return poses of centres (N, 3) and cam_from_world rotations (N, 3, 3)."""
        return cls(np.asarray(centers, dtype=np.float64), quats_from_rotations(cam_from_world))

    @classmethod
    def from_cam_from_world(cls, quats_xyzw: np.ndarray, translations: np.ndarray) -> Poses:
        """Return poses from COLMAP's ``x_cam = R @ x_world + t``.

        Parameters
        ----------
        quats_xyzw : ndarray, shape (N, 4)
            Quaternions of R, scalar last.
        translations : ndarray, shape (N, 3)
            Translations t.
        """
        quats = canonical_quats(np.roll(np.asarray(quats_xyzw, dtype=np.float64), 1, axis=-1))
        centers = -np.einsum("nji,nj->ni", rotations_from_quats(quats), translations)
        return cls(centers, quats)

    @classmethod
    def unknown(cls, n: int) -> Poses:
        """Return n poses that are NaN."""
        return cls(np.full((n, 3), np.nan), np.full((n, 4), np.nan))

    @classmethod
    def concatenate(cls, parts: Iterable[Poses]) -> Poses:
        """Return the poses of all parts in order."""
        parts = [Poses(np.zeros((0, 3)), np.zeros((0, 4))), *parts]
        return cls(
            np.concatenate([p.centers for p in parts]),
            np.concatenate([p.quats_wxyz for p in parts]),
        )

    def at_rows(self, rows: np.ndarray | list[int], n: int) -> Poses:
        """Return n poses with these at `rows` and NaN elsewhere."""
        poses = Poses.unknown(n)
        poses.centers[rows], poses.quats_wxyz[rows] = self.centers, self.quats_wxyz
        return poses

    def to_cam_from_world(self) -> tuple[np.ndarray, np.ndarray]:
        """Return COLMAP's scalar-last quaternions (N, 4) and translations (N, 3)."""
        translations = -np.einsum("nij,nj->ni", self.rotations, self.centers)
        return scalar_last(self.quats_wxyz), translations

    def to_camera(self, points: np.ndarray, index: int | np.ndarray = 0) -> np.ndarray:
        """Transform world points (M, 3) into camera frames: of one pose, or of one pose (M,) per point."""
        return to_camera(points, self.centers[index], rotations_from_quats(self.quats_wxyz[index]))

    def depths(self, points: np.ndarray, index: int = 0) -> np.ndarray:
        """Return the depths (M,) of world points (M, 3) along the optical axis of one pose."""
        return np.asarray((points - self.centers[index]) @ self.rotations[index][2])

    @property
    def rotations(self) -> np.ndarray:
        """Rotations (N, 3, 3) from world axes to camera axes."""
        return rotations_from_quats(self.quats_wxyz)

    def __len__(self) -> int:
        return len(self.centers)

    def __getitem__(self, index: np.ndarray | slice) -> Poses:
        return Poses(self.centers[index], self.quats_wxyz[index])

    def __iter__(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        return iter(zip(self.centers, self.quats_wxyz, strict=True))


@dataclass(frozen=True, eq=False)
class Similarity:
    """Similarity transform ``y = scale * rotation @ x + translation``; variables are named ``b_from_a``.

    Attributes
    ----------
    scale : float
        Scale, > 0.
    rotation : ndarray, shape (3, 3)
        Rotation matrix.
    translation : ndarray, shape (3,)
        Translation in the target frame.
    """

    scale: float
    rotation: np.ndarray  # (3, 3)
    translation: np.ndarray  # (3,)

    @classmethod
    def identity(cls) -> Similarity:
        """Return the identity."""
        return cls(1.0, np.eye(3), np.zeros(3))

    @classmethod
    def fit(
        cls, source: np.ndarray, target: np.ndarray, weights: np.ndarray | None = None
    ) -> Similarity:
        """Fit the least-squares target_from_source over corresponding points.

        Parameters
        ----------
        source, target : ndarray, shape (N, 3)
            Corresponding points, N >= 3.
        weights : ndarray, shape (N,), optional
            Weights >= 0; all 1 by default.

        Raises
        ------
        GeometryError
            If fewer than 3 points have weight, or if they are collinear or coincide, so that the rotation is
            undetermined.

        References
        ----------
        Umeyama 1991, "Least-squares estimation of transformation parameters between two point patterns".
        """
        source, target = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
        w = np.ones(len(source)) if weights is None else np.asarray(weights, dtype=np.float64)
        if np.count_nonzero(w) < 3:
            raise GeometryError(f"a similarity needs at least 3 points, got {np.count_nonzero(w)}")
        w = w / w.sum()
        source_mean, target_mean = w @ source, w @ target
        source_0, target_0 = source - source_mean, target - target_mean
        u, singular, vt = np.linalg.svd((target_0 * w[:, None]).T @ source_0)  # eq. 38
        if singular[1] <= 1e-9 * singular[0] or singular[0] == 0:
            raise GeometryError(
                "the points are collinear: the rotation about their line is undetermined"
            )
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
        rotation = (u * sign) @ vt  # eq. 40
        scale = float((singular * sign).sum() / (w @ (source_0**2).sum(axis=1)))  # eq. 42
        return cls(scale, rotation, target_mean - scale * rotation @ source_mean)

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON: scale, rotation (3 rows) and translation."""
        return {
            "scale": self.scale,
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Similarity:
        """Return the similarity of `to_json`. Raises KeyError, TypeError or ValueError for other values."""
        scale, rotation = float(numbers(value["scale"])), numbers(value["rotation"], 3, 3)
        if not (scale > 0 and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)):
            raise ValueError("its scale is not positive, or its rotation is none")
        if np.linalg.det(rotation) < 0:
            raise ValueError("its rotation is a reflection")
        return cls(scale, rotation, numbers(value["translation"], 3))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Transform points (..., 3) into the target frame."""
        return self.scale * np.asarray(points) @ self.rotation.T + self.translation

    def apply_to_poses(self, poses: Poses) -> Poses:
        """Transform camera poses into the target frame."""
        return Poses.from_rotations(self.apply(poses.centers), poses.rotations @ self.rotation.T)

    def inverse(self) -> Similarity:
        """Return the inverse transform."""
        rotation = self.rotation.T
        return Similarity(1 / self.scale, rotation, -rotation @ self.translation / self.scale)

    def __matmul__(self, other: Similarity) -> Similarity:
        """Compose transforms: ``c_from_b @ b_from_a`` is c_from_a."""
        return Similarity(
            self.scale * other.scale, self.rotation @ other.rotation, self.apply(other.translation)
        )


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


def pose_errors(estimated: Poses, true: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Return position errors (N,) in the world's unit and rotation errors (N,) in degrees.

    The poses are compared as they are, without alignment.
    """
    error_m = np.linalg.norm(estimated.centers - true.centers, axis=-1)
    return error_m, rotation_errors_deg(estimated.quats_wxyz, true.quats_wxyz)
