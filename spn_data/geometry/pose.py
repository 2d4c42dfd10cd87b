"""Camera poses, similarity transforms and pose errors.

This is the only module that implements pose inversion. World axes are East, North,
Up once a model is georeferenced; camera axes are x right, y down, z forward.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from spn_data.errors import GeometryError
from spn_data.geometry.json_values import numbers
from spn_data.geometry.rotations import (
    canonical_quats,
    quats_from_rotations,
    rotation_errors_deg,
    rotation_vectors,
    rotations_from_quats,
    rotations_from_vectors,
    scalar_last,
)


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


def position_text(position: Sequence[float]) -> str:
    """Return the coordinates of a position, separated by spaces, as short as float64 allows for metres."""
    return " ".join(f"{value:.12g}" for value in position)


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
        """Return poses of given centres and rotations.

        Parameters
        ----------
        centers : ndarray, shape (N, 3)
            Camera centres in the world frame.
        cam_from_world : ndarray, shape (N, 3, 3)
            Rotations from world axes to camera axes.

        Returns
        -------
        Poses
        """
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

        Returns
        -------
        Poses
        """
        quats = canonical_quats(np.roll(np.asarray(quats_xyzw, dtype=np.float64), 1, axis=-1))
        centers = -np.einsum("nji,nj->ni", rotations_from_quats(quats), translations)
        return cls(centers, quats)

    @classmethod
    def unknown(cls, n: int) -> Poses:
        """Return n poses that are NaN."""
        return cls(np.full((n, 3), np.nan), np.full((n, 4), np.nan))

    def moved_by(self, offset: Sequence[float]) -> Poses:
        """Return the poses with an offset (3,) added to their centres; unchanged if it is zero."""
        if not any(offset):
            return self
        return Poses(self.centers + np.asarray(offset, dtype=np.float64), self.quats_wxyz)

    @classmethod
    def concatenate(cls, parts: Iterable[Poses]) -> Poses:
        """Return the poses of all parts in order."""
        parts = [Poses(np.zeros((0, 3)), np.zeros((0, 4))), *parts]
        return cls(
            np.concatenate([p.centers for p in parts]),
            np.concatenate([p.quats_wxyz for p in parts]),
        )

    def at_rows(self, rows: np.ndarray | list[int], n: int) -> Poses:
        """Return poses with these at some rows and NaN elsewhere.

        Parameters
        ----------
        rows : ndarray or list of int, shape (N,)
            Where the poses go.
        n : int
            Number of poses of the result.

        Returns
        -------
        Poses
        """
        poses = Poses.unknown(n)
        poses.centers[rows], poses.quats_wxyz[rows] = self.centers, self.quats_wxyz
        return poses

    def to_cam_from_world(self) -> tuple[np.ndarray, np.ndarray]:
        """Return COLMAP's scalar-last quaternions (N, 4) and translations (N, 3)."""
        translations = -np.einsum("nij,nj->ni", self.rotations, self.centers)
        return scalar_last(self.quats_wxyz), translations

    def to_camera(self, points: np.ndarray, index: int | np.ndarray = 0) -> np.ndarray:
        """Transform world points into camera frames.

        Parameters
        ----------
        points : ndarray, shape (M, 3)
            Points in the world frame.
        index : int or ndarray, shape (M,), optional
            The pose for all points, or one for each point.

        Returns
        -------
        ndarray, shape (M, 3)
            Points in camera axes (x right, y down, z forward), in the world's unit.
        """
        return to_camera(points, self.centers[index], rotations_from_quats(self.quats_wxyz[index]))

    def depths(self, points: np.ndarray, index: int = 0) -> np.ndarray:
        """Return the depths of world points along the optical axis.

        Parameters
        ----------
        points : ndarray, shape (M, 3)
            Points in the world frame.
        index : int, optional
            The pose.

        Returns
        -------
        ndarray, shape (M,)
            In the world's unit; negative behind the camera.
        """
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

        Returns
        -------
        Similarity
            target_from_source.

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


def pose_errors(estimated: Poses, true: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of estimated poses; nothing is aligned first.

    Parameters
    ----------
    estimated, true : Poses
        N poses each, in the same world frame.

    Returns
    -------
    position : ndarray, shape (N,)
        Distances of the centres, in the world's unit.
    rotation_deg : ndarray, shape (N,)
        Angles between the orientations, in degrees.
    """
    error_m = np.linalg.norm(estimated.centers - true.centers, axis=-1)
    return error_m, rotation_errors_deg(estimated.quats_wxyz, true.quats_wxyz)


def interpolate_pose(
    first: tuple[float, Poses], second: tuple[float, Poses], time_s: float
) -> Poses:
    """Return the pose (1,) at a time on the constant motion through two others, also before or after them."""
    (time_a, a), (time_b, b) = first, second
    share = (time_s - time_a) / (time_b - time_a)
    turn = rotation_vectors(b.rotations @ a.rotations.transpose(0, 2, 1))
    return Poses.from_rotations(
        a.centers + share * (b.centers - a.centers),
        rotations_from_vectors(share * turn) @ a.rotations,
    )
