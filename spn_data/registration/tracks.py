"""Tracks of features through the frames of a sequence, and their triangulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses, to_camera


@dataclass(frozen=True, eq=False)
class Tracks:
    """T tracks: features of the same scene point, at most one per frame.

    Attributes
    ----------
    frame, feature, track : ndarray, shape (M,)
        Of every member, sorted by track.
    """

    frame: np.ndarray
    feature: np.ndarray
    track: np.ndarray

    @property
    def count(self) -> int:
        """Number of tracks."""
        return int(self.track[-1]) + 1 if len(self.track) else 0

    def of_frames(self, kept: np.ndarray) -> Tracks:
        """Return the members in some of the frames (N,) bool; tracks keep their numbers."""
        mine = kept[self.frame]
        return Tracks(self.frame[mine], self.feature[mine], self.track[mine])


def find_tracks(pairs: dict[tuple[int, int], np.ndarray], features: list[int]) -> Tracks:
    """Build tracks from the verified matches (K, 2) of pairs of frames.

    `features` is the number of features of each frame. A track with two features in one frame is
    contradictory and is dropped.
    """
    first = np.concatenate([[0], np.cumsum(features)])
    ends_a = [first[i] + matches[:, 0] for (i, _), matches in pairs.items()]
    ends_b = [first[j] + matches[:, 1] for (_, j), matches in pairs.items()]
    none = np.zeros(0, np.int64)
    a, b = np.concatenate([none, *ends_a]), np.concatenate([none, *ends_b])
    nodes = int(first[-1])
    graph = coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(nodes, nodes))
    _, component = connected_components(graph, directed=False)
    used = np.unique(np.concatenate([a, b]))
    frame = np.searchsorted(first, used, side="right") - 1
    order = np.lexsort((frame, component[used]))
    used, frame = used[order], frame[order]
    label = component[used]
    twice = np.flatnonzero((np.diff(label) == 0) & (np.diff(frame) == 0))
    keep = ~np.isin(label, label[twice])
    _, track = np.unique(label[keep], return_inverse=True)
    return Tracks(frame[keep], used[keep] - first[frame[keep]], track.astype(np.int64))


def triangulate(
    poses: Poses,
    camera: Camera,
    pixels: np.ndarray,
    frame: np.ndarray,
    track: np.ndarray,
    count: int,
    *,
    max_error_px: float,
    min_angle_deg: float,
) -> np.ndarray:
    """Triangulate tracks from pixels (M, 2) in frames with poses; return points (T, 3), NaN if undetermined.

    Minimizes the squared distances from the rays. A point is kept if its triangulation angle is at least
    `min_angle_deg`, it is in front of all cameras, and its reprojection error is at most `max_error_px` in
    every frame.
    """
    rays = np.column_stack([camera.unproject(pixels), np.ones(len(pixels))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rotations = poses.rotations[frame]
    directions = np.einsum("mji,mj->mi", rotations, rays)
    centers = poses.centers[frame]
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    a, b, mean = np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros((count, 3))
    np.add.at(a, track, across)
    np.add.at(b, track, np.einsum("mij,mj->mi", across, centers))
    np.add.at(mean, track, directions)
    members = np.bincount(track, minlength=count)
    solvable = (members >= 2) & (np.linalg.cond(a + 1e-12 * np.eye(3)) < 1e8)
    points = np.full((count, 3), np.nan)
    points[solvable] = np.linalg.solve(a[solvable], b[solvable][..., None])[..., 0]
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    spread = np.zeros(count)
    away = np.arccos(np.clip((directions * mean[track]).sum(axis=1), -1, 1))
    np.maximum.at(spread, track, np.rad2deg(away))
    in_camera = to_camera(points[track], centers, rotations)
    error = np.linalg.norm(camera.project(in_camera) - pixels, axis=1)
    worst = np.zeros(count)
    np.maximum.at(worst, track, np.where(np.isfinite(error), error, np.inf))
    good = solvable & (2 * spread >= min_angle_deg) & (worst <= max_error_px)
    return np.where(good[:, None], points, np.nan)
