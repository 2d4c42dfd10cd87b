"""Poses in a frozen map for the video frames between labelled ones: many more labels for little time."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spn_data.capture.frames import Frames
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses, pose_errors
from spn_data.labels.labels import LabelObservations, Labels
from spn_data.labels.map_points import MapPoints
from spn_data.tracking.point_tracking import between, track_segment
from spn_data.tracking.segments import SequenceToLabel, read_segments
from spn_data.tracking.tracked_frames import TrackedFrame, TrackingOptions, failed
from spn_data.work.parallel import run_batches
from spn_data.work.timing import Progress

_STEP = "label the frames between"


def track_frames(
    videos: Sequence[Path],
    frames: Frames,
    labelled: Labels,
    seen: LabelObservations,
    cameras: dict[str, Camera],
    points: MapPoints,
    options: TrackingOptions,
    *,
    workers: int = 1,
    progress: Progress | None = None,
) -> tuple[Labels, LabelObservations]:
    """Labels of all frames of one sequence that `labelled` does not name, and the map points they see.

    videos : the sequence's files in their order; frames : all its frames; labelled, seen : those whose pose
    was sought before, with the map points that each sees; cameras : by key, in pixels of the full-size
    image. The map is only read. Covariances are left NaN: they follow from `error_px`, the points and the
    pixels of each frame. Memory: about (2 workers + 1) times the grey images between two labelled frames,
    at most `options.max_batch_mb` each. Raises InputError where a video can't be read.
    """
    sequence = SequenceToLabel(frames, labelled, seen, cameras, points)
    reasons: dict[int, str] = {}
    found: dict[int, TrackedFrame] = {}
    total = len(sequence.wanted)

    def keep(batch: list[TrackedFrame]) -> None:
        found.update((frame.row, frame) for frame in batch)
        if progress is not None:
            progress(_STEP, len(found), total)

    run_batches(
        track_segment,
        (
            (str(frames.names[segment.rows[0]]), (segment, options))
            for segment in read_segments(sequence, videos, options, reasons)
        ),
        workers=workers,
        on_result=keep,
    )
    for row in sequence.wanted.tolist():
        if row not in found:
            found[row] = failed(reasons.get(row, "not among the frames that could be decoded"), row)
    drop_jumps(sequence, found, options)
    return _labels(sequence, found)


def drop_jumps(
    sequence: SequenceToLabel, found: dict[int, TrackedFrame], options: TrackingOptions
) -> None:
    """Fails, in place, frames that lie off the motion of those before and after; the worst one first."""
    times = sequence.frames.time_s
    known = {row: sequence.labelled.poses[k : k + 1] for row, k in sequence.labelled_rows().items()}
    known |= {row: frame.poses for row, frame in found.items() if not frame.reason}
    order = sorted(known)

    def excess(at: int) -> float:
        """How far off it lies, as a multiple of what is allowed."""
        row = order[at]
        if row not in found or at in (0, len(order) - 1):
            return 0.0
        before, after = order[at - 1], order[at + 1]
        ends = [(float(times[k]), known[k]) for k in (before, after)]
        expected = between(ends[0], ends[1], float(times[row]))
        apart, apart_deg = pose_errors(expected, known[row])
        # A velocity that changes bends the path by at most a/2 (t - t0) (t1 - t) between two times.
        bend_s2 = (times[row] - times[before]) * (times[after] - times[row]) / 2
        allowed = options.max_jump + options.max_acceleration * bend_s2
        allowed_deg = options.max_jump_deg + options.max_turn_deg_s2 * bend_s2
        return float(max(apart[0] / found[row].distance / allowed, apart_deg[0] / allowed_deg))

    excesses = {row: excess(at) for at, row in enumerate(order)}
    while excesses:
        worst = max(excesses, key=lambda row: excesses[row])
        if excesses[worst] <= 1:
            return
        found[worst] = failed("it lies off the motion of the frames before and after", worst)
        at = bisect_left(order, worst)
        del order[at], excesses[worst]
        for near in (at - 1, at):
            if 0 <= near < len(order):
                excesses[order[near]] = excess(near)


def _labels(
    sequence: SequenceToLabel, found: dict[int, TrackedFrame]
) -> tuple[Labels, LabelObservations]:
    frames = sequence.frames.select(sequence.wanted)
    results = [found[row] for row in sequence.wanted.tolist()]
    n = len(results)
    labels = Labels.of_frames(
        frames,
        Poses.concatenate(r.poses for r in results),
        tracked=True,
        reason=[r.reason for r in results],
        covariance=np.full((n, 6, 6), np.nan),
        inliers=np.array([len(r.point_ids) for r in results], dtype=np.int64),
        coverage=np.array([r.coverage for r in results], dtype=np.float64),
        error_px=np.array([r.error_px for r in results]),
    )
    counts = labels.inliers
    nothing = np.zeros((0, 2))
    seen = LabelObservations(
        np.repeat(np.arange(n), counts),
        np.concatenate([np.zeros(0, np.int64), *(r.point_ids for r in results)]),
        np.concatenate([nothing, *(r.pixels for r in results)]),
    )
    return labels, seen
