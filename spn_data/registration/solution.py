"""What a sequence is before it has poses, and its solution in the frozen map: one least squares."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spn_data.colmap.resection import Resection
from spn_data.geometry.camera import Camera
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
_FRAMES_FOR_LENS = 3  # fewer do not tell a lens
_FOR_A_POSE = 4  # measurements; with fewer it is not determined


@dataclass(frozen=True, eq=False)
class UnsolvedSequence:
    """What is known of N frames before they have poses.

    pixels : N arrays (K, 2) of features; putative : N arrays (M, 2) of feature and map point row;
    tracks : of features that frames share; map_xyz : (P, 3) the map's points.
    """

    pixels: list[np.ndarray]
    putative: list[np.ndarray]
    tracks: Tracks
    map_xyz: np.ndarray

    def pixels_of(self, frame: np.ndarray, feature: np.ndarray) -> np.ndarray:
        """(M, 2) of features (M,) of frames (M,)."""
        first = np.concatenate([[0], np.cumsum([len(p) for p in self.pixels])])
        return np.concatenate(self.pixels)[first[frame] + feature]


@dataclass(frozen=True, eq=False)
class SequenceSolution:
    """N frames in the map.

    posed : (N,) bool; poses : (N), NaN where there is none; camera : of all of them.
    frame, feature, point_row, own : (M,) the measurements that agree; point_row -1 where it is a point of
    the sequence's own, whose row is `own`, else -1. own_points : (P, 3).
    """

    posed: np.ndarray
    poses: Poses
    camera: Camera
    frame: np.ndarray
    feature: np.ndarray
    point_row: np.ndarray
    own: np.ndarray
    own_points: np.ndarray

    def inliers(self, row: int) -> tuple[np.ndarray, np.ndarray]:
        """(feature (K,), map point row (K,)) of the map points that one frame's pose agrees with."""
        first, last = np.searchsorted(self.frame, [row, row + 1])
        mine = first + np.flatnonzero(self.point_row[first:last] >= 0)
        return self.feature[mine], self.point_row[mine]

    def with_measurements(self, stay: np.ndarray) -> SequenceSolution:
        """Only some of the measurements (M,) bool, and own points numbered anew: those that are left."""
        own = self.own[stay]
        used = np.unique(own[own >= 0])
        return replace(
            self,
            frame=self.frame[stay],
            feature=self.feature[stay],
            point_row=self.point_row[stay],
            own=np.where(own >= 0, np.searchsorted(used, own), -1),
            own_points=self.own_points[used],
        )

    def least_squares(
        self, sequence: UnsolvedSequence
    ) -> tuple[SequenceState, SequenceObservations]:
        """The posed frames, numbered 0, 1, ..., and their measurements."""
        rows = np.flatnonzero(self.posed)
        position = np.full(len(self.posed), -1)
        position[rows] = np.arange(len(rows))
        places = np.full((len(self.frame), 3), np.nan)
        of_map = self.point_row >= 0
        places[of_map] = sequence.map_xyz[self.point_row[of_map]]
        pixels = sequence.pixels_of(self.frame, self.feature)
        observations = SequenceObservations(position[self.frame], pixels, places, self.own)
        return SequenceState(self.poses[rows], self.camera, self.own_points), observations


def refine(
    sequence: UnsolvedSequence,
    found: dict[int, Resection],
    camera: Camera,
    putative: list[np.ndarray],
    own: np.ndarray,
    own_points: np.ndarray,
    options: RegisterOptions,
) -> SequenceSolution:
    """All frames, their lens and their own points together; measurements that do not agree are left out."""
    n = len(sequence.pixels)
    posed = np.zeros(n, bool)
    posed[list(found)] = True
    poses = Poses.concatenate(one.pose for one in found.values()).at_rows(list(found), n)
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
    start = SequenceSolution(posed, poses, camera, frame, feature, point_row, own_row, own_points)
    return settle(sequence, start, options)


def settle(
    sequence: UnsolvedSequence, solution: SequenceSolution, options: RegisterOptions
) -> SequenceSolution:
    """The least squares of a solution's frames, and which of its measurements agree with it.

    A frame of which hardly any agree has no pose any more.
    """
    rows = np.flatnonzero(solution.posed)
    if not len(rows):
        return solution
    state, everything = solution.least_squares(sequence)
    lens = free_lens(solution.camera, len(rows), options)
    agree = _agree(state, everything, options.max_error_px)
    for _ in range(3):
        state = adjust(state, everything.select(agree), scale_px=SCALE_PX, lens=lens)
        before, agree = agree, _agree(state, everything, options.max_error_px)
        if np.array_equal(before, agree):
            break
    settled = replace(
        solution,
        poses=state.poses.at_rows(rows, len(solution.posed)),
        camera=state.camera,
        own_points=state.own_points,
    ).with_measurements(agree)
    left = np.bincount(settled.frame, minlength=len(solution.posed))
    open_ = solution.posed & (left < _FOR_A_POSE)
    return without(settled, open_) if open_.any() else settled


def free_lens(camera: Camera, frames: int, options: RegisterOptions) -> tuple[str, ...]:
    """The intrinsics that so many frames are to tell."""
    tells = frames >= _FRAMES_FOR_LENS and not options.hold_lens
    return lens_parameters(camera) if tells else ()


def without(solution: SequenceSolution, refused: np.ndarray) -> SequenceSolution:
    """The solution without some frames (N,) bool, nor points that only one frame sees then."""
    stay = ~refused[solution.frame]
    seen = np.bincount(solution.own[stay & (solution.own >= 0)], minlength=len(solution.own_points))
    stay &= (solution.own < 0) | (np.append(seen, 0)[solution.own] >= 2)
    kept = np.flatnonzero(~refused)
    poses = solution.poses[kept].at_rows(kept, len(refused))
    left = replace(solution, posed=solution.posed & ~refused, poses=poses)
    return left.with_measurements(stay)


def _agree(
    state: SequenceState, observations: SequenceObservations, max_error_px: float
) -> np.ndarray:
    residuals = linearize(state, observations, ()).residuals_px
    agree = np.linalg.norm(residuals, axis=1) <= max_error_px
    # A point of the sequence's own takes two frames.
    mine = observations.own >= 0
    seen = np.bincount(observations.own[mine & agree], minlength=len(state.own_points))
    return agree & (~mine | (seen[np.maximum(observations.own, 0)] >= 2 if len(seen) else False))


def reprojection_errors(
    pose: Poses, camera: Camera, points: np.ndarray, pixels: np.ndarray
) -> np.ndarray:
    """(M,) pixels; infinite behind the camera."""
    in_camera = (points - pose.centers[0]) @ pose.rotations[0].T
    error_px = np.linalg.norm(camera.project(in_camera) - pixels, axis=1)
    return np.where(np.isfinite(error_px), error_px, np.inf)
