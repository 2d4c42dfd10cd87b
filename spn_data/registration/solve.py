"""Poses and lens of a sequence in the frozen map: from putative matches to one least-squares solution."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spn_data.camera import Camera
from spn_data.colmap.resection import Resection, resect
from spn_data.pose import Poses
from spn_data.registration.adjustment import (
    SequenceObservations,
    SequenceState,
    adjust,
    lens_parameters,
    linearize,
)
from spn_data.registration.options import RegisterOptions
from spn_data.registration.tracks import Tracks, triangulate

_LENS_FRAMES = 60  # that the lens is first found from
_FOCAL_FRAMES = 12  # that a focal length is guessed from
_WEAK = 200  # map points below which a frame's other features are worth triangulating
_MIN_ANGLE_DEG = 1.5  # at which the rays of the sequence's own points meet
_ROUNDS = 10  # of carrying poses to neighbours
_SCALE_PX = 1.0  # of the Cauchy loss


@dataclass(frozen=True, eq=False)
class Sequence:
    """What is known of N frames before they have poses.

    pixels : N arrays (K, 2) of features; putative : N arrays (M, 2) of feature and map point row;
    tracks : of features that frames share; map_xyz : (P, 3) the map's points.
    """

    pixels: list[np.ndarray]
    putative: list[np.ndarray]
    tracks: Tracks
    map_xyz: np.ndarray


@dataclass(frozen=True, eq=False)
class Solution:
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
        mine = (self.frame == row) & (self.point_row >= 0)
        return self.feature[mine], self.point_row[mine]


def solve(
    sequence: Sequence, start: Camera, focal_is_known: bool, options: RegisterOptions
) -> Solution:
    """Poses where there is any agreement with the map; whether they are good enough, `checks` says.

    start : intrinsics to begin with, of which only the principal point is kept.
    """
    camera = radial(start)
    if not focal_is_known:
        camera = _guess_focal(sequence, camera, options)
    camera = _find_lens(sequence, camera, options)
    found = {
        row: pose
        for row in range(len(sequence.pixels))
        if (pose := _resect(sequence, row, sequence.putative[row], camera, options)) is not None
    }
    putative, own_points, own = _carry(sequence, found, camera, options)
    return refine(sequence, found, camera, putative, own, own_points, options)


def radial(camera: Camera) -> Camera:
    """The camera with two terms of radial distortion, or as it is where it has them."""
    if camera.model in ("RADIAL", "OPENCV"):
        return camera
    k1 = float(camera.opencv_distortion[0])
    f, (cx, cy) = float(np.mean(camera.focal_px)), camera.matrix[:2, 2]
    return Camera("RADIAL", camera.width, camera.height, np.array([f, cx, cy, k1, 0.0]))


def _with_focal(camera: Camera, focal_px: float) -> Camera:
    params = camera.params.copy()
    params[: 2 if camera.model == "OPENCV" else 1] = focal_px
    return replace(camera, params=params)


def _strongest(sequence: Sequence, count: int) -> list[int]:
    """Frames with most putative matches, spread by nothing else."""
    sizes = np.array([len(m) for m in sequence.putative])
    return [int(row) for row in np.argsort(-sizes, kind="stable")[:count]]


def _guess_focal(sequence: Sequence, camera: Camera, options: RegisterOptions) -> Camera:
    focals, weights = [], []
    for row in _strongest(sequence, _FOCAL_FRAMES):
        matches = sequence.putative[row]
        found = resect(
            sequence.pixels[row][matches[:, 0]],
            sequence.map_xyz[matches[:, 1]],
            camera,
            max_error_px=options.start_error_px,
            find_focal=True,
            seed=options.seed,
        )
        if found is not None and found.inliers.sum() >= options.checks.min_inliers:
            focals.append(found.camera.focal_px[0])
            weights.append(int(found.inliers.sum()))
    if not focals:
        return camera
    order = np.argsort(focals)
    half = np.searchsorted(np.cumsum(np.array(weights)[order]), sum(weights) / 2)
    return _with_focal(camera, float(np.array(focals)[order][half]))


def _find_lens(sequence: Sequence, camera: Camera, options: RegisterOptions) -> Camera:
    """Focal length and distortion from the frames that agree best with the map, by growing strictness."""
    rows = _strongest(sequence, _LENS_FRAMES)
    for max_error_px in (options.start_error_px, options.start_error_px / 2, options.max_error_px):
        poses, frame, pixels, places = [], [], [], []
        for row in rows:
            matches = sequence.putative[row]
            found = _resect(
                sequence, row, matches, camera, replace(options, max_error_px=max_error_px)
            )
            if found is None or found.inliers.sum() < options.checks.min_inliers:
                continue
            kept = matches[found.inliers]
            frame.append(np.full(len(kept), len(poses)))
            pixels.append(sequence.pixels[row][kept[:, 0]])
            places.append(sequence.map_xyz[kept[:, 1]])
            poses.append(found.pose)
        if not poses:
            return camera
        observations = SequenceObservations(
            np.concatenate(frame),
            np.concatenate(pixels),
            np.concatenate(places),
            np.full(sum(map(len, frame)), -1),
        )
        state = SequenceState(_join(poses), camera, np.zeros((0, 3)))
        lens = lens_parameters(camera) if len(poses) >= 3 else ()
        camera = adjust(state, observations, scale_px=_SCALE_PX, lens=lens).camera
    return camera


def _resect(
    sequence: Sequence, row: int, matches: np.ndarray, camera: Camera, options: RegisterOptions
) -> Resection | None:
    return resect(
        sequence.pixels[row][matches[:, 0]],
        sequence.map_xyz[matches[:, 1]],
        camera,
        max_error_px=options.max_error_px,
        seed=options.seed,
    )


def _join(poses: list[Poses]) -> Poses:
    return Poses(
        np.concatenate([p.centers for p in poses]), np.concatenate([p.quats_wxyz for p in poses])
    )


def _carry(
    sequence: Sequence, found: dict[int, Resection], camera: Camera, options: RegisterOptions
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Let neighbours carry poses to frames that see too little of the map; `found` grows.

    Returns putative matches with those that tracks bring, the sequence's own points (P, 3), and their
    measurements (M, 3): frame, feature, own point.
    """
    putative = list(sequence.putative)
    own_points, own = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    for _ in range(_ROUNDS):
        putative = _carried_matches(sequence, found, putative)
        own_points, own = _own_points(sequence, found, putative, camera, options)
        before = _total(found)
        for row in range(len(putative)):
            enough = row in found and found[row].inliers.sum() >= 2 * options.checks.min_inliers
            if enough:
                continue
            mine = own[own[:, 0] == row]
            pixels = sequence.pixels[row]
            pose = resect(
                np.concatenate([pixels[putative[row][:, 0]], pixels[mine[:, 1]]]),
                np.concatenate([sequence.map_xyz[putative[row][:, 1]], own_points[mine[:, 2]]]),
                camera,
                max_error_px=options.max_error_px,
                seed=options.seed,
            )
            if pose is not None and (
                row not in found or pose.inliers.sum() > found[row].inliers.sum()
            ):
                found[row] = pose
        if _total(found) == before:
            break
    return putative, own_points, own


def _total(found: dict[int, Resection]) -> int:
    return sum(int(pose.inliers.sum()) for pose in found.values())


def _carried_matches(
    sequence: Sequence, found: dict[int, Resection], putative: list[np.ndarray]
) -> list[np.ndarray]:
    """Putative matches, and those with map points that other frames of a feature's track agree with."""
    tracks = sequence.tracks
    track_of = {
        (int(f), int(k)): int(t)
        for f, k, t in zip(tracks.frame, tracks.feature, tracks.track, strict=True)
    }
    points_of: dict[int, set[int]] = {}
    for row, pose in found.items():
        agreeing = putative[row][: len(pose.inliers)][pose.inliers[: len(putative[row])]]
        for feature, point in agreeing.tolist():
            track = track_of.get((row, feature))
            if track is not None:
                points_of.setdefault(track, set()).add(point)
    brought: dict[int, list[tuple[int, int]]] = {}
    for f, k, t in zip(
        tracks.frame.tolist(), tracks.feature.tolist(), tracks.track.tolist(), strict=True
    ):
        for point in points_of.get(t, ()):
            brought.setdefault(f, []).append((k, point))
    result = []
    for row, matches in enumerate(putative):
        known = set(map(tuple, matches.tolist()))
        new = sorted(set(brought.get(row, [])) - known)
        # Those that were there stay in front: the masks of `found` count on it.
        result.append(np.concatenate([matches, np.array(new, np.int64).reshape(-1, 2)]))
    return result


def _own_points(
    sequence: Sequence,
    found: dict[int, Resection],
    putative: list[np.ndarray],
    camera: Camera,
    options: RegisterOptions,
) -> tuple[np.ndarray, np.ndarray]:
    """Points of tracks that touch a weak frame and no map point; and their measurements in all frames."""
    tracks = sequence.tracks
    none = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    strong = np.array(
        [
            row in found and found[row].inliers.sum() >= options.checks.min_inliers
            for row in range(len(putative))
        ]
    )
    weak = np.array(
        [row not in found or found[row].inliers.sum() < _WEAK for row in range(len(putative))]
    )
    in_map = np.zeros(tracks.count, bool)
    matched = [set(matches[:, 0].tolist()) for matches in putative]
    members = zip(
        tracks.frame.tolist(), tracks.feature.tolist(), tracks.track.tolist(), strict=True
    )
    for f, k, t in members:
        in_map[t] |= k in matched[f]
    touches_weak = np.zeros(tracks.count, bool)
    touches_weak[tracks.track[weak[tracks.frame]]] = True
    wanted = (touches_weak & ~in_map)[tracks.track]
    usable = np.flatnonzero(wanted & strong[tracks.frame])
    if not len(usable):
        return none
    poses = Poses(np.full((len(putative), 3), np.nan), np.full((len(putative), 4), np.nan))
    for row, pose in found.items():
        poses.centers[row], poses.quats_wxyz[row] = pose.pose.centers[0], pose.pose.quats_wxyz[0]
    pixels = _pixels(sequence, tracks.frame[usable], tracks.feature[usable])
    points = triangulate(
        poses,
        camera,
        pixels,
        tracks.frame[usable],
        tracks.track[usable],
        tracks.count,
        max_error_px=options.max_error_px,
        min_angle_deg=_MIN_ANGLE_DEG,
    )
    good = np.isfinite(points[:, 0])
    row_of = np.cumsum(good) - 1
    seen = np.flatnonzero(wanted & good[tracks.track])
    own = np.column_stack([tracks.frame[seen], tracks.feature[seen], row_of[tracks.track[seen]]])
    return points[good], own.astype(np.int64)


def _pixels(sequence: Sequence, frame: np.ndarray, feature: np.ndarray) -> np.ndarray:
    first = np.concatenate([[0], np.cumsum([len(p) for p in sequence.pixels])])
    return np.concatenate(sequence.pixels)[first[frame] + feature]


def refine(
    sequence: Sequence,
    found: dict[int, Resection],
    camera: Camera,
    putative: list[np.ndarray],
    own: np.ndarray,
    own_points: np.ndarray,
    options: RegisterOptions,
) -> Solution:
    """All frames, their lens and their own points together; measurements that do not agree are left out."""
    n = len(sequence.pixels)
    posed = np.zeros(n, bool)
    posed[list(found)] = True
    if not found:
        nothing = np.zeros(0, np.int64)
        poses = Poses(np.full((n, 3), np.nan), np.full((n, 4), np.nan))
        return Solution(posed, poses, camera, *([nothing] * 4), np.zeros((0, 3)))
    rows = np.flatnonzero(posed)
    position = np.full(n, -1)
    position[rows] = np.arange(len(rows))
    frame = np.concatenate([np.full(len(putative[r]), r) for r in rows])
    matches = np.concatenate([putative[r] for r in rows])
    own = own[posed[own[:, 0]]]
    frame = np.concatenate([frame, own[:, 0]])
    feature = np.concatenate([matches[:, 0], own[:, 1]])
    point_row = np.concatenate([matches[:, 1], np.full(len(own), -1)])
    own_row = np.concatenate([np.full(len(matches), -1), own[:, 2]])
    order = np.lexsort((own_row, point_row, feature, frame))
    frame, feature, point_row, own_row = (a[order] for a in (frame, feature, point_row, own_row))
    places = np.where((point_row >= 0)[:, None], sequence.map_xyz[point_row], np.nan)
    everything = SequenceObservations(
        position[frame], _pixels(sequence, frame, feature), places, own_row
    )
    state = SequenceState(_join([found[int(r)].pose for r in rows]), camera, own_points)
    lens = lens_parameters(camera) if len(rows) >= 3 else ()
    agree = _agree(state, everything, options.max_error_px)
    for _ in range(3):
        state = adjust(state, everything.select(agree), scale_px=_SCALE_PX, lens=lens)
        before, agree = agree, _agree(state, everything, options.max_error_px)
        if np.array_equal(before, agree):
            break
    poses = Poses(np.full((n, 3), np.nan), np.full((n, 4), np.nan))
    poses.centers[rows], poses.quats_wxyz[rows] = state.poses.centers, state.poses.quats_wxyz
    return Solution(
        posed,
        poses,
        state.camera,
        frame[agree],
        feature[agree],
        point_row[agree],
        own_row[agree],
        state.own_points,
    )


def _agree(
    state: SequenceState, observations: SequenceObservations, max_error_px: float
) -> np.ndarray:
    residuals = linearize(state, observations, ()).residuals_px
    agree = np.linalg.norm(residuals, axis=1) <= max_error_px
    # A point of the sequence's own takes two frames.
    mine = observations.own >= 0
    seen = np.bincount(observations.own[mine & agree], minlength=len(state.own_points))
    return agree & (~mine | (seen[np.maximum(observations.own, 0)] >= 2 if len(seen) else False))
