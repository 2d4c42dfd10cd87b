"""Map points tracked from labelled frames into the frames between them, and the poses that follow.

Patches are always taken from a labelled frame, never from the previous frame, so tracking does not drift.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from spn_data.geometry.camera import Camera
from spn_data.geometry.grouping import rank_within_group
from spn_data.geometry.pose import Poses, interpolate_pose, pose_errors
from spn_data.geometry.pose_fit import PoseFit, fit_pose
from spn_data.labels.map_points import covered_share
from spn_data.matching.patches import track_points
from spn_data.tracking.tracked_frames import (
    Anchor,
    Segment,
    TrackedFrame,
    TrackingOptions,
    failed_frame,
)


def track_segment(segment: Segment, options: TrackingOptions) -> list[TrackedFrame]:
    """Track the frames of a segment and return them in its order. A pure function.

    Frames closest to a labelled frame are processed first, so that each frame starts from the poses of its
    neighbours.
    """
    height, width = segment.grays[0].shape
    full, camera = segment.camera, segment.camera.scaled(width, height)
    scale = np.array([width / full.width, height / full.height])
    anchors = [_PreparedAnchor.prepare(a, camera, scale, options) for a in segment.anchors]
    known = {a.time_s: a.poses for a in segment.anchors}
    away = np.abs(segment.time_s[:, None] - np.array(list(known))).min(axis=1)
    results: dict[int, TrackedFrame] = {}
    for k in np.argsort(away, kind="stable").tolist():
        time_s = float(segment.time_s[k])
        near = sorted(anchors, key=lambda a: abs(a.time_s - time_s))
        frame = _track_frame(segment.grays[k], camera, near, _guesses(known, time_s), options)
        if not frame.reason:
            known[time_s] = frame.poses
        results[k] = replace(
            frame,
            row=int(segment.rows[k]),
            pixels=frame.pixels / scale,
            error_px=frame.error_px / float(scale.mean()),
        )
    return [results[k] for k in range(len(segment.rows))]


def _guesses(known: dict[float, Poses], time_s: float) -> list[Poses]:
    """Return initial poses, the most likely first.

    These are constant velocity, interpolation between two neighbours, and the poses of the neighbours.
    """
    before = sorted((t for t in known if t < time_s), reverse=True)
    after = sorted(t for t in known if t > time_s)
    sides = sorted((s for s in (before, after) if s), key=lambda s: abs(s[0] - time_s))
    guesses = []
    near = sides[0]
    # Two distant frames say little about the current velocity.
    if len(near) > 1 and abs(near[0] - near[1]) <= 2 * abs(time_s - near[0]):
        guesses.append(
            interpolate_pose((near[1], known[near[1]]), (near[0], known[near[0]]), time_s)
        )
    if before and after:
        guesses.append(
            interpolate_pose((before[0], known[before[0]]), (after[0], known[after[0]]), time_s)
        )
    return [*guesses, *(known[side[0]] for side in sides)]


@dataclass(frozen=True, eq=False)
class _PreparedAnchor:
    """Anchor reduced to the points that are tracked; pixels refer to its image."""

    time_s: float
    gray: np.ndarray
    small: np.ndarray  # reduced image for the first search
    start: np.ndarray  # rows of the points for the first search
    point_ids: np.ndarray
    xyz: np.ndarray
    pixels: np.ndarray

    @classmethod
    def prepare(
        cls, anchor: Anchor, camera: Camera, scale: np.ndarray, options: TrackingOptions
    ) -> _PreparedAnchor:
        pixels = anchor.pixels * scale
        rows = spread_points(pixels, camera.width, camera.height, options.max_points)
        pixels = pixels[rows]
        start = spread_points(pixels, camera.width, camera.height, options.start_points)
        small = _downsample(anchor.gray, options)
        ids, xyz = anchor.point_ids[rows], anchor.xyz[rows]
        return cls(anchor.time_s, anchor.gray, small, start, ids, xyz, pixels)


def _downsample(gray: np.ndarray, options: TrackingOptions) -> np.ndarray:
    """Return the image for the first search (cv2.pyrDown would shift it by half a pixel)."""
    size = (gray.shape[1] >> options.start_halvings, gray.shape[0] >> options.start_halvings)
    return cv2.resize(gray, size, interpolation=cv2.INTER_AREA)


def spread_points(pixels: np.ndarray, width: int, height: int, count: int) -> np.ndarray:
    """Return the rows of at most `count` pixels (K, 2) spread over the image.

    From each cell of a grid, the first pixels are taken.
    """
    if len(pixels) <= count:
        return np.arange(len(pixels))
    side = 2 * np.sqrt(width * height / count)  # about four points per cell
    columns = int(np.ceil(width / side))
    x, y = (pixels // side).astype(np.int64).T
    cells = y * columns + x
    rank_in_cell = rank_within_group(cells, int(cells.max()) + 1)
    return np.sort(np.argsort(rank_in_cell, kind="stable")[:count])


def _track_frame(
    gray: np.ndarray,
    camera: Camera,
    anchors: list[_PreparedAnchor],
    guesses: list[Poses],
    options: TrackingOptions,
) -> TrackedFrame:
    """Estimate the pose of a frame and check it.

    Each labelled frame gives a rough pose from a few points, with which all its points are tracked. Each
    starts independently, so that one with a wrong pose contradicts the other instead of misleading it.
    """
    small = _downsample(gray, options)
    tracks = []
    for anchor in anchors:
        rough = _rough_pose(small, camera, anchor, guesses, options)
        if rough is not None:
            tracks.append(_track_anchor(anchor, gray, rough, camera, options))
            guesses = [rough, *guesses]
    if not tracks:
        return failed_frame("the points of the adjacent labelled frames were not found in it")
    merged = _merge(tracks)
    if len(merged.point_ids) < options.min_inliers:
        return failed_frame(
            f"only {len(merged.point_ids)} points of the adjacent labelled frames were found in it"
        )
    fit = _fit(merged, guesses[0], camera)
    if fit is None:
        return failed_frame("no pose agrees with its points")
    enough = [t for t in tracks if len(t.point_ids) >= options.min_inliers]
    answers = [_fit(t, fit.poses, camera) for t in enough]
    return _check_frame(merged, fit, [a for a in answers if a is not None], camera, options)


def _rough_pose(
    small: np.ndarray,
    camera: Camera,
    anchor: _PreparedAnchor,
    guesses: list[Poses],
    options: TrackingOptions,
) -> Poses | None:
    """Return the pose from the first initial pose with which the anchor's points are consistent."""
    height, width = small.shape
    scale = np.array([width / camera.width, height / camera.height])
    lens = camera.scaled(width, height)
    xyz, pixels = anchor.xyz[anchor.start], anchor.pixels[anchor.start] * scale
    for guess in guesses:
        expected = _project(lens, guess, xyz)
        there, found = track_points(
            anchor.small,
            small,
            pixels,
            expected,
            levels=options.start_levels,
            window_px=options.window_px,
            round_trip_px=options.round_trip_px,
        )
        enough = max(12.0, options.min_inlier_ratio * np.count_nonzero(found))
        if np.count_nonzero(found) < enough:
            continue
        fit = fit_pose(lens, guess, xyz[found], there[found], first_px=8.0, last_px=0.5)
        if fit and np.count_nonzero(fit.inliers(options.max_error_px)) >= enough:
            return fit.poses
    return None


def _project(camera: Camera, poses: Poses, xyz: np.ndarray) -> np.ndarray:
    return camera.project(poses.to_camera(xyz))


@dataclass(frozen=True, eq=False)
class _TrackedPoints:
    """Map points found in a frame: point_ids (K,), xyz (K, 3), pixels (K, 2)."""

    point_ids: np.ndarray
    xyz: np.ndarray
    pixels: np.ndarray


def _track_anchor(
    anchor: _PreparedAnchor,
    gray: np.ndarray,
    rough: Poses,
    camera: Camera,
    options: TrackingOptions,
) -> _TrackedPoints:
    expected = _project(camera, rough, anchor.xyz)
    there, found = track_points(
        anchor.gray,
        gray,
        anchor.pixels,
        expected,
        levels=options.levels,
        window_px=options.window_px,
        round_trip_px=options.round_trip_px,
    )
    return _TrackedPoints(anchor.point_ids[found], anchor.xyz[found], there[found])


def _merge(tracks: list[_TrackedPoints]) -> _TrackedPoints:
    """Merge points of several anchors; a point tracked from two anchors gets the mean pixel."""
    ids = np.concatenate([t.point_ids for t in tracks])
    unique, first, back = np.unique(ids, return_index=True, return_inverse=True)
    pixels = np.zeros((len(unique), 2))
    np.add.at(pixels, back, np.concatenate([t.pixels for t in tracks]))
    pixels /= np.bincount(back, minlength=len(unique))[:, None]
    return _TrackedPoints(unique, np.concatenate([t.xyz for t in tracks])[first], pixels)


def _fit(tracks: _TrackedPoints, start: Poses, camera: Camera) -> PoseFit | None:
    return fit_pose(camera, start, tracks.xyz, tracks.pixels, first_px=2.0, last_px=1.0)


def _check_frame(
    tracks: _TrackedPoints,
    fit: PoseFit,
    answers: list[PoseFit],
    camera: Camera,
    options: TrackingOptions,
) -> TrackedFrame:
    """Return the frame with its figures, or a failed one if they speak against its pose."""
    good = fit.inliers(options.max_error_px)
    if np.count_nonzero(good) < options.min_inliers:
        return failed_frame(f"only {np.count_nonzero(good)} map points agree with its pose")
    distance = float(np.median(np.linalg.norm(tracks.xyz[good] - fit.poses.centers, axis=1)))
    error_px = float(np.sqrt((fit.residuals_px[good] ** 2).sum(axis=1).mean()))
    by_position, by_turn = (
        float(np.sqrt(np.linalg.eigvalsh(block)[-1]))
        for block in (fit.inverse[:3, :3], fit.inverse[3:, 3:])
    )
    split = split_deg = np.nan
    if len(answers) == 2:
        apart, apart_deg = pose_errors(answers[0].poses, answers[1].poses)
        split, split_deg = float(apart[0]) / distance, float(apart_deg[0])
    frame = TrackedFrame(
        row=-1,
        reason="",
        poses=fit.poses,
        point_ids=tracks.point_ids[good],
        pixels=tracks.pixels[good],
        coverage=covered_share(tracks.pixels[good], camera.width, camera.height),
        error_px=error_px,
        inlier_ratio=float(good.mean()),
        distance=distance,
        sigma=error_px / np.sqrt(2) * by_position / distance,
        sigma_deg=error_px / np.sqrt(2) * float(np.rad2deg(by_turn)),
        split=split,
        split_deg=split_deg,
    )
    reason = _rejection_reason(frame, options)
    return failed_frame(reason) if reason else frame


def _rejection_reason(frame: TrackedFrame, options: TrackingOptions) -> str:
    """Return why a pose is rejected, or an empty string."""
    if frame.inlier_ratio < options.min_inlier_ratio:
        return f"only {frame.inlier_ratio:.0%} of its points agree with its pose"
    if frame.coverage < options.min_coverage:
        return f"its map points cover only {frame.coverage:.0%} of the image"
    if frame.sigma > options.max_sigma or frame.sigma_deg > options.max_sigma_deg:
        return "its map points don't determine its pose"
    if frame.split > options.max_split or frame.split_deg > options.max_split_deg:
        return "ambiguous: the adjacent labelled frames disagree about its pose"
    return ""
