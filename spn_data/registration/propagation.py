"""Poses of frames with few map points, estimated with the help of neighbouring frames."""

from __future__ import annotations

import numpy as np

from spn_data.colmap.resection import Resection, resect
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.registration.register_options import RegisterOptions
from spn_data.registration.solution import UnsolvedSequence, reprojection_errors
from spn_data.registration.tracks import triangulate

_WEAK = 200  # map points; frames with fewer need points of the sequence's own
_MIN_ANGLE_DEG = 1.5  # triangulation angle of the sequence's own points
_MAX_ROUNDS = 10


def propagate_poses(
    sequence: UnsolvedSequence,
    resections: dict[int, Resection],
    camera: Camera,
    options: RegisterOptions,
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Estimate poses of frames with few map points from the tracks that they share with neighbours.

    Adds to `resections`, or improves them, in place. Returns the putative matches including those from
    tracks, the sequence's own points (P, 3), and their measurements (M, 3): frame, feature, own point.
    """
    putative = list(sequence.putative)
    own_points, own = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    for _ in range(_MAX_ROUNDS):
        putative = _propagated_matches(sequence, resections, putative, camera, options)
        own_points, own = _own_points(sequence, resections, putative, camera, options)
        before = _total_inliers(resections)
        for row in range(len(putative)):
            enough = (
                row in resections
                and resections[row].inliers.sum() >= 2 * options.checks.min_inliers
            )
            if enough:
                continue
            own_here = own[own[:, 0] == row]
            pixels = sequence.pixels[row]
            pose = resect(
                np.concatenate([pixels[putative[row][:, 0]], pixels[own_here[:, 1]]]),
                np.concatenate([sequence.map_xyz[putative[row][:, 1]], own_points[own_here[:, 2]]]),
                camera,
                max_error_px=options.max_error_px,
                seed=options.seed,
            )
            if pose is not None and (
                row not in resections or pose.inliers.sum() > resections[row].inliers.sum()
            ):
                resections[row] = pose
        if _total_inliers(resections) == before:
            break
    return putative, own_points, own


def _total_inliers(resections: dict[int, Resection]) -> int:
    return sum(int(pose.inliers.sum()) for pose in resections.values())


def _propagated_matches(
    sequence: UnsolvedSequence,
    resections: dict[int, Resection],
    putative: list[np.ndarray],
    camera: Camera,
    options: RegisterOptions,
) -> list[np.ndarray]:
    """Extend putative matches along tracks.

    A feature also gets the map points that agree with another frame's pose at a feature of the same track.
    """
    tracks = sequence.tracks
    track_of = {
        (int(f), int(k)): int(t)
        for f, k, t in zip(tracks.frame, tracks.feature, tracks.track, strict=True)
    }
    points_of: dict[int, set[int]] = {}
    for row, pose in resections.items():
        if pose.inliers.sum() < options.checks.min_inliers:
            continue
        matches = putative[row]
        error_px = reprojection_errors(
            pose.pose,
            camera,
            sequence.map_xyz[matches[:, 1]],
            sequence.pixels[row][matches[:, 0]],
        )
        agreeing = matches[error_px <= options.max_error_px]
        for feature, point in agreeing.tolist():
            track = track_of.get((row, feature))
            if track is not None:
                points_of.setdefault(track, set()).add(point)
    propagated: dict[int, list[tuple[int, int]]] = {}
    for f, k, t in zip(
        tracks.frame.tolist(), tracks.feature.tolist(), tracks.track.tolist(), strict=True
    ):
        for point in points_of.get(t, ()):
            propagated.setdefault(f, []).append((k, point))
    result = []
    for row, matches in enumerate(putative):
        known = set(map(tuple, matches.tolist()))
        new = sorted(set(propagated.get(row, [])) - known)
        result.append(np.concatenate([matches, np.array(new, np.int64).reshape(-1, 2)]))
    return result


def _own_points(
    sequence: UnsolvedSequence,
    resections: dict[int, Resection],
    putative: list[np.ndarray],
    camera: Camera,
    options: RegisterOptions,
) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate the tracks that contain a weak frame and no map point.

    Returns the points and their measurements in all frames.
    """
    tracks = sequence.tracks
    none = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    strong = np.array(
        [
            row in resections and resections[row].inliers.sum() >= options.checks.min_inliers
            for row in range(len(putative))
        ]
    )
    weak = np.array(
        [
            row not in resections or resections[row].inliers.sum() < _WEAK
            for row in range(len(putative))
        ]
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
    known = Poses.concatenate(one.pose for one in resections.values())
    pixels = sequence.pixels_of(tracks.frame[usable], tracks.feature[usable])
    points = triangulate(
        known.at_rows(list(resections), len(putative)),
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
