"""Map points followed from labelled frames into the frames between them, and the poses that they give.

A patch is always taken from a labelled frame, never from the frame before: nothing drifts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from spn_data.geometry.camera import Camera
from spn_data.geometry.grouping import rank_within_group
from spn_data.geometry.pose import Poses, pose_errors, rotation_vectors, rotations_from_vectors
from spn_data.geometry.pose_fit import PoseFit, fit_pose
from spn_data.labels.map_points import covered_share
from spn_data.tracking.tracked_frames import Anchor, Segment, TrackedFrame, TrackingOptions, failed


def track_segment(segment: Segment, options: TrackingOptions) -> list[TrackedFrame]:
    """The frames of a segment in its order; a pure function.

    Those nearest to a labelled frame come first, so that each begins where its neighbours point to.
    """
    height, width = segment.grays[0].shape
    full, camera = segment.camera, segment.camera.scaled(width, height)
    shrunk = np.array([width / full.width, height / full.height])
    anchors = [_Prepared.of(a, camera, shrunk, options) for a in segment.anchors]
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
            pixels=frame.pixels / shrunk,
            error_px=frame.error_px / float(shrunk.mean()),
        )
    return [results[k] for k in range(len(segment.rows))]


def _guesses(known: dict[float, Poses], time_s: float) -> list[Poses]:
    """Where to begin, the likeliest first: velocity stays, between two neighbours, where a neighbour is."""
    before = sorted((t for t in known if t < time_s), reverse=True)
    after = sorted(t for t in known if t > time_s)
    sides = sorted((s for s in (before, after) if s), key=lambda s: abs(s[0] - time_s))
    guesses = []
    near = sides[0]
    # Two frames far apart tell little of the velocity now.
    if len(near) > 1 and abs(near[0] - near[1]) <= 2 * abs(time_s - near[0]):
        guesses.append(between((near[1], known[near[1]]), (near[0], known[near[0]]), time_s))
    if before and after:
        guesses.append(between((before[0], known[before[0]]), (after[0], known[after[0]]), time_s))
    return [*guesses, *(known[side[0]] for side in sides)]


def between(first: tuple[float, Poses], second: tuple[float, Poses], time_s: float) -> Poses:
    """Pose (1,) at a time on the constant motion through two others, each with its time."""
    (time_a, a), (time_b, b) = first, second
    share = (time_s - time_a) / (time_b - time_a)
    turn = rotation_vectors(b.rotations @ a.rotations.transpose(0, 2, 1))
    return Poses.from_rotations(
        a.centers + share * (b.centers - a.centers),
        rotations_from_vectors(share * turn) @ a.rotations,
    )


@dataclass(frozen=True, eq=False)
class _Prepared:
    """An anchor, reduced to the points that are followed; pixels at the size of its image."""

    time_s: float
    gray: np.ndarray
    small: np.ndarray  # for the first search
    start: np.ndarray  # rows of the points of the first search
    point_ids: np.ndarray
    xyz: np.ndarray
    pixels: np.ndarray

    @classmethod
    def of(
        cls, anchor: Anchor, camera: Camera, shrunk: np.ndarray, options: TrackingOptions
    ) -> _Prepared:
        pixels = anchor.pixels * shrunk
        rows = spread(pixels, camera.width, camera.height, options.max_points)
        pixels = pixels[rows]
        start = spread(pixels, camera.width, camera.height, options.start_points)
        small = _small(anchor.gray, options)
        ids, xyz = anchor.point_ids[rows], anchor.xyz[rows]
        return cls(anchor.time_s, anchor.gray, small, start, ids, xyz, pixels)


def _small(gray: np.ndarray, options: TrackingOptions) -> np.ndarray:
    """The image of the first search. (cv2.pyrDown would shift it by half a pixel.)"""
    size = (gray.shape[1] >> options.start_halvings, gray.shape[0] >> options.start_halvings)
    return cv2.resize(gray, size, interpolation=cv2.INTER_AREA)


def spread(pixels: np.ndarray, width: int, height: int, count: int) -> np.ndarray:
    """Rows, at most `count`, of pixels (K, 2) spread over the image: of each cell, the first ones."""
    if len(pixels) <= count:
        return np.arange(len(pixels))
    side = 2 * np.sqrt(width * height / count)  # about four points a cell
    columns = int(np.ceil(width / side))
    x, y = (pixels // side).astype(np.int64).T
    cells = y * columns + x
    rank_in_cell = rank_within_group(cells, int(cells.max()) + 1)
    return np.sort(np.argsort(rank_in_cell, kind="stable")[:count])


def follow(
    from_gray: np.ndarray,
    to_gray: np.ndarray,
    pixels: np.ndarray,
    expected: np.ndarray,
    levels: int,
    options: TrackingOptions,
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (K, 2) of patches in another image, begun at the expected ones, and which (K,) were found.

    Lucas-Kanade there and back (Bouguet 2001): found are those that come back to where they began.
    """
    height, width = to_gray.shape
    found = np.all((expected > 0) & (expected < [width, height]), axis=1)  # not where NaN
    result = np.full((len(pixels), 2), np.nan)
    rows = np.flatnonzero(found)
    if len(rows) == 0:
        return result, found
    half = np.float32(0.5)  # OpenCV's pixel centres lie on integers
    start = pixels[rows].astype(np.float32) - half
    there = expected[rows].astype(np.float32) - half
    search = (
        (options.window_px, options.window_px),
        levels,
        (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01),
        cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    there, ok, _ = cv2.calcOpticalFlowPyrLK(from_gray, to_gray, start, there, None, None, *search)
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(
        to_gray, from_gray, there, start.copy(), None, None, *search
    )
    closed = np.linalg.norm(back - start, axis=1) <= options.round_trip_px
    inside = np.all((there >= 0) & (there <= [width - 1, height - 1]), axis=1)
    result[rows] = there.astype(np.float64) + 0.5
    found[rows] = (ok.ravel() == 1) & (ok_back.ravel() == 1) & closed & inside
    return result, found


def _track_frame(
    gray: np.ndarray,
    camera: Camera,
    anchors: list[_Prepared],
    guesses: list[Poses],
    options: TrackingOptions,
) -> TrackedFrame:
    """From each labelled frame a rough pose by few points, then all its points; then the checks.

    Each begins for itself, so that one in a wrong place is contradicted by the other, not led astray.
    """
    small = _small(gray, options)
    tracks = []
    for anchor in anchors:
        rough = _rough_pose(small, camera, anchor, guesses, options)
        if rough is not None:
            tracks.append(_tracks(anchor, gray, rough, camera, options))
            guesses = [rough, *guesses]
    if not tracks:
        return failed("the points of the labelled frames beside it were not found in it")
    together = _once(tracks)
    if len(together.point_ids) < options.min_inliers:
        return failed(
            f"only {len(together.point_ids)} points of the labelled frames beside it were found in it"
        )
    fit = _fit(together, guesses[0], camera)
    if fit is None:
        return failed("no pose agrees with its points")
    enough = [t for t in tracks if len(t.point_ids) >= options.min_inliers]
    answers = [_fit(t, fit.poses, camera) for t in enough]
    return _checked(together, fit, [a for a in answers if a is not None], camera, options)


def _rough_pose(
    small: np.ndarray,
    camera: Camera,
    anchor: _Prepared,
    guesses: list[Poses],
    options: TrackingOptions,
) -> Poses | None:
    """From the first guess with which the anchor's points agree with each other."""
    height, width = small.shape
    shrunk = np.array([width / camera.width, height / camera.height])
    lens = camera.scaled(width, height)
    xyz, pixels = anchor.xyz[anchor.start], anchor.pixels[anchor.start] * shrunk
    for guess in guesses:
        expected = _project(lens, guess, xyz)
        there, found = follow(anchor.small, small, pixels, expected, options.start_levels, options)
        enough = max(12.0, options.min_inlier_ratio * np.count_nonzero(found))
        if np.count_nonzero(found) < enough:
            continue
        fit = fit_pose(lens, guess, xyz[found], there[found], first_px=8.0, last_px=0.5)
        if fit and np.count_nonzero(fit.inliers(options.max_error_px)) >= enough:
            return fit.poses
    return None


def _project(camera: Camera, poses: Poses, xyz: np.ndarray) -> np.ndarray:
    return camera.project((xyz - poses.centers[0]) @ poses.rotations[0].T)


@dataclass(frozen=True, eq=False)
class _Tracks:
    """Map points found in a frame: point_ids (K,), xyz (K, 3), pixels (K, 2)."""

    point_ids: np.ndarray
    xyz: np.ndarray
    pixels: np.ndarray


def _tracks(
    anchor: _Prepared, gray: np.ndarray, rough: Poses, camera: Camera, options: TrackingOptions
) -> _Tracks:
    expected = _project(camera, rough, anchor.xyz)
    there, found = follow(anchor.gray, gray, anchor.pixels, expected, options.levels, options)
    return _Tracks(anchor.point_ids[found], anchor.xyz[found], there[found])


def _once(tracks: list[_Tracks]) -> _Tracks:
    """Each point once: the mean pixel where two anchors led to it."""
    ids = np.concatenate([t.point_ids for t in tracks])
    unique, first, back = np.unique(ids, return_index=True, return_inverse=True)
    pixels = np.zeros((len(unique), 2))
    np.add.at(pixels, back, np.concatenate([t.pixels for t in tracks]))
    pixels /= np.bincount(back, minlength=len(unique))[:, None]
    return _Tracks(unique, np.concatenate([t.xyz for t in tracks])[first], pixels)


def _fit(tracks: _Tracks, start: Poses, camera: Camera) -> PoseFit | None:
    return fit_pose(camera, start, tracks.xyz, tracks.pixels, first_px=2.0, last_px=1.0)


def _checked(
    tracks: _Tracks, fit: PoseFit, answers: list[PoseFit], camera: Camera, options: TrackingOptions
) -> TrackedFrame:
    """The frame with its figures; without its label where they speak against it."""
    good = fit.inliers(options.max_error_px)
    if np.count_nonzero(good) < options.min_inliers:
        return failed(f"only {np.count_nonzero(good)} map points agree with its pose")
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
    objection = _objection(frame, options)
    return failed(objection) if objection else frame


def _objection(frame: TrackedFrame, options: TrackingOptions) -> str:
    """Why a pose is not to be trusted; empty where it is."""
    if frame.inlier_ratio < options.min_inlier_ratio:
        return f"only {frame.inlier_ratio:.0%} of its points agree with its pose"
    if frame.coverage < options.min_coverage:
        return f"its map points cover only {frame.coverage:.0%} of the image"
    if frame.sigma > options.max_sigma or frame.sigma_deg > options.max_sigma_deg:
        return "its map points don't determine its pose"
    if frame.split > options.max_split or frame.split_deg > options.max_split_deg:
        return "ambiguous: the labelled frames beside it disagree about its pose"
    return ""
