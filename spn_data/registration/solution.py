"""A sequence before it has poses, and its solution in the frozen map: one bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spn_data.colmap.resection import Resection
from spn_data.geometry.camera import Camera
from spn_data.geometry.initial_lens import InitialLens
from spn_data.geometry.pose import Poses
from spn_data.registration.adjustment import (
    SequenceObservations,
    SequenceState,
    adjust,
    lens_parameters,
    linearize,
)
from spn_data.registration.register_options import RegisterOptions
from spn_data.registration.tracks import Tracks

SCALE_PX = 0.5  # of the Cauchy loss
_MIN_FRAMES_FOR_LENS = 3  # to determine the intrinsics
_MIN_MEASUREMENTS = 4  # to determine a pose


@dataclass(frozen=True, eq=False)
class UnsolvedSequence:
    """Measurements of N frames before they have poses.

    Attributes
    ----------
    pixels : list of ndarray, shape (K, 2)
        Keypoints of each frame.
    putative : list of ndarray, shape (M, 2)
        Matches of each frame with the map: feature and map point row.
    tracks : Tracks
        Features that frames share.
    map_xyz : ndarray, shape (P, 3)
        Map points.
    """

    pixels: list[np.ndarray]
    putative: list[np.ndarray]
    tracks: Tracks
    map_xyz: np.ndarray

    def pixels_of(self, frame: np.ndarray, feature: np.ndarray) -> np.ndarray:
        """Return the pixels (M, 2) of features (M,) in frames (M,)."""
        first = np.concatenate([[0], np.cumsum([len(p) for p in self.pixels])])
        return np.concatenate(self.pixels)[first[frame] + feature]


@dataclass(frozen=True, eq=False)
class SequenceSolution:
    """N frames in the map.

    Attributes
    ----------
    posed : ndarray, shape (N,), bool
        Whether the frame has a pose.
    poses : Poses
        N poses; NaN for frames without one.
    camera : Camera
        Shared by all frames.
    frame, feature, point_row, own : ndarray, shape (M,)
        Inlier measurements. For a map point, `point_row` is its row and `own` is -1; for one of the
        sequence's own points, `point_row` is -1 and `own` is its row.
    own_points : ndarray, shape (P, 3)
        Points that only the sequence observes.
    expected : InitialLens
        What is known of the lens from elsewhere.
    """

    posed: np.ndarray
    poses: Poses
    camera: Camera
    frame: np.ndarray
    feature: np.ndarray
    point_row: np.ndarray
    own: np.ndarray
    own_points: np.ndarray
    expected: InitialLens

    def inliers(self, row: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the features (K,) of a frame that are map points, and the rows (K,) of these points."""
        first, last = np.searchsorted(self.frame, [row, row + 1])
        mine = first + np.flatnonzero(self.point_row[first:last] >= 0)
        return self.feature[mine], self.point_row[mine]

    def select_measurements(self, keep: np.ndarray) -> SequenceSolution:
        """Keep some measurements (M,) bool; renumber the own points that are left."""
        own = self.own[keep]
        used = np.unique(own[own >= 0])
        return replace(
            self,
            frame=self.frame[keep],
            feature=self.feature[keep],
            point_row=self.point_row[keep],
            own=np.where(own >= 0, np.searchsorted(used, own), -1),
            own_points=self.own_points[used],
        )

    def least_squares(
        self, sequence: UnsolvedSequence
    ) -> tuple[SequenceState, SequenceObservations]:
        """Return state and measurements of the posed frames, numbered 0, 1, ..., for bundle adjustment."""
        rows = np.flatnonzero(self.posed)
        position = np.full(len(self.posed), -1)
        position[rows] = np.arange(len(rows))
        places = np.full((len(self.frame), 3), np.nan)
        of_map = self.point_row >= 0
        places[of_map] = sequence.map_xyz[self.point_row[of_map]]
        pixels = sequence.pixels_of(self.frame, self.feature)
        observations = SequenceObservations(position[self.frame], pixels, places, self.own)
        state = SequenceState(self.poses[rows], self.camera, self.own_points, self.expected)
        return state, observations


def adjust_sequence(
    sequence: UnsolvedSequence,
    resections: dict[int, Resection],
    camera: Camera,
    putative: list[np.ndarray],
    own: np.ndarray,
    own_points: np.ndarray,
    expected: InitialLens,
    options: RegisterOptions,
) -> SequenceSolution:
    """Adjust all frames, their lens and their own points together from single resections.

    Measurements that do not agree are dropped.
    """
    n = len(sequence.pixels)
    posed = np.zeros(n, bool)
    posed[list(resections)] = True
    poses = Poses.concatenate(one.pose for one in resections.values()).at_rows(list(resections), n)
    matches = np.concatenate(putative)
    frame = np.repeat(np.arange(n), [len(m) for m in putative])
    table = np.concatenate(
        [
            np.column_stack([frame, matches, np.full(len(matches), -1)]),
            np.column_stack([own[:, :2], np.full(len(own), -1), own[:, 2]]),
        ]
    )
    table = table[posed[table[:, 0]]]
    table = table[np.lexsort(table.T[::-1])]
    frame, feature, point_row, own_row = table.T
    start = SequenceSolution(
        posed, poses, camera, frame, feature, point_row, own_row, own_points, expected
    )
    return adjust_inliers(sequence, start, options)


def adjust_inliers(
    sequence: UnsolvedSequence, solution: SequenceSolution, options: RegisterOptions
) -> SequenceSolution:
    """Alternate between bundle adjustment and the selection of inliers.

    A frame with hardly any inliers loses its pose.
    """
    rows = np.flatnonzero(solution.posed)
    if not len(rows):
        return solution
    state, everything = solution.least_squares(sequence)
    lens = estimated_intrinsics(solution.camera, len(rows), options)
    agree = _inlier_mask(state, everything, options.max_error_px)
    for _ in range(3):
        state = adjust(state, everything.select(agree), scale_px=SCALE_PX, lens=lens)
        before, agree = agree, _inlier_mask(state, everything, options.max_error_px)
        if np.array_equal(before, agree):
            break
    adjusted = replace(
        solution,
        poses=state.poses.at_rows(rows, len(solution.posed)),
        camera=state.camera,
        own_points=state.own_points,
    ).select_measurements(agree)
    left = np.bincount(adjusted.frame, minlength=len(solution.posed))
    undetermined = solution.posed & (left < _MIN_MEASUREMENTS)
    return remove_frames(adjusted, undetermined) if undetermined.any() else adjusted


def estimated_intrinsics(camera: Camera, frames: int, options: RegisterOptions) -> tuple[str, ...]:
    """Return the names of the intrinsics to estimate from a number of frames."""
    determined = frames >= _MIN_FRAMES_FOR_LENS and not options.hold_lens
    return lens_parameters(camera) if determined else ()


def remove_frames(solution: SequenceSolution, refused: np.ndarray) -> SequenceSolution:
    """Remove some frames (N,) bool, and own points that fewer than two frames observe then."""
    keep = ~refused[solution.frame]
    seen = np.bincount(solution.own[keep & (solution.own >= 0)], minlength=len(solution.own_points))
    keep &= (solution.own < 0) | (np.append(seen, 0)[solution.own] >= 2)
    kept = np.flatnonzero(~refused)
    poses = solution.poses[kept].at_rows(kept, len(refused))
    left = replace(solution, posed=solution.posed & ~refused, poses=poses)
    return left.select_measurements(keep)


def _inlier_mask(
    state: SequenceState, observations: SequenceObservations, max_error_px: float
) -> np.ndarray:
    residuals = linearize(state, observations, ()).residuals_px
    agree = np.linalg.norm(residuals, axis=1) <= max_error_px
    # One of the sequence's own points needs two frames.
    own = observations.own >= 0
    seen = np.bincount(observations.own[own & agree], minlength=len(state.own_points))
    return agree & (~own | (seen[np.maximum(observations.own, 0)] >= 2 if len(seen) else False))


def reprojection_errors(
    pose: Poses, camera: Camera, points: np.ndarray, pixels: np.ndarray
) -> np.ndarray:
    """Return reprojection errors (M,) in pixels; infinite behind the camera."""
    error_px = np.linalg.norm(camera.project(pose.to_camera(points)) - pixels, axis=1)
    return np.where(np.isfinite(error_px), error_px, np.inf)
