"""Poses in a frozen map for the video frames between labelled ones: many more labels at low cost."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spn_data.capture.frames import Frames
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses, interpolate_pose, pose_errors
from spn_data.labels.labels import LabelObservations, Labels
from spn_data.labels.map_points import MapPoints
from spn_data.tracking.point_tracking import track_segment
from spn_data.tracking.segments import SequenceToLabel, read_segments
from spn_data.tracking.tracked_frames import TrackedFrame, TrackingOptions, failed_frame
from spn_data.work.parallel import run_batches
from spn_data.work.timing import Progress

_STEP = "tracked frames"


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
    """Label all video frames of one sequence that `labelled` does not contain.

    The map is only read. Memory: about (2 workers + 1) times the grey images between two labelled frames, at
    most `options.max_batch_mb` each.

    Parameters
    ----------
    videos : sequence of Path
        Video files of the sequence in order.
    frames : Frames
        All frames of the sequence.
    labelled : Labels
        Frames whose pose was estimated before, with or without success.
    seen : LabelObservations
        Map points that each of these observes.
    cameras : dict of str to Camera
        By key, in pixels of the full-size image.
    points : MapPoints
    options : TrackingOptions
    workers : int
        Number of worker processes.
    progress : Progress, optional

    Returns
    -------
    Labels
        Of the frames to label. Covariances are NaN; compute them from `error_px`, points and pixels of each
        frame.
    LabelObservations
        Map points that each of these frames observes.

    Raises
    ------
    InputError
        If a video cannot be read.
    """
    sequence = SequenceToLabel(frames, labelled, seen, cameras, points)
    reasons: dict[int, str] = {}
    tracked: dict[int, TrackedFrame] = {}
    total = len(sequence.wanted)

    def keep(batch: list[TrackedFrame]) -> None:
        tracked.update((frame.row, frame) for frame in batch)
        if progress is not None:
            progress(_STEP, len(tracked), total)

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
        if row not in tracked:
            tracked[row] = failed_frame(reasons.get(row, "it could not be decoded"), row)
    drop_jumps(sequence, tracked, options)
    return _labels(sequence, tracked)


def drop_jumps(
    sequence: SequenceToLabel, tracked: dict[int, TrackedFrame], options: TrackingOptions
) -> None:
    """Reject, in place, frames whose pose deviates from the motion of the frames before and after.

    The worst frame is rejected first, then the others are compared again.
    """
    times = sequence.frames.time_s
    known = {row: sequence.labelled.poses[k : k + 1] for row, k in sequence.labelled_rows().items()}
    known |= {row: frame.poses for row, frame in tracked.items() if not frame.reason}
    order = sorted(known)

    def excess(at: int) -> float:
        """Return the deviation as a multiple of the tolerance."""
        row = order[at]
        if row not in tracked or at in (0, len(order) - 1):
            return 0.0
        before, after = order[at - 1], order[at + 1]
        ends = [(float(times[k]), known[k]) for k in (before, after)]
        expected = interpolate_pose(ends[0], ends[1], float(times[row]))
        apart, apart_deg = pose_errors(expected, known[row])
        # An acceleration a moves the path by at most a/2 (t - t0) (t1 - t) between two times.
        half_s2 = (times[row] - times[before]) * (times[after] - times[row]) / 2
        allowed = options.max_jump + options.max_acceleration * half_s2
        allowed_deg = options.max_jump_deg + options.max_turn_deg_s2 * half_s2
        return float(max(apart[0] / tracked[row].distance / allowed, apart_deg[0] / allowed_deg))

    excesses = {row: excess(at) for at, row in enumerate(order)}
    while excesses:
        worst = max(excesses, key=lambda row: excesses[row])
        if excesses[worst] <= 1:
            return
        reason = "its pose deviates from the motion of the frames before and after"
        tracked[worst] = failed_frame(reason, worst)
        at = bisect_left(order, worst)
        del order[at], excesses[worst]
        for near in (at - 1, at):
            if 0 <= near < len(order):
                excesses[order[near]] = excess(near)


def _labels(
    sequence: SequenceToLabel, tracked: dict[int, TrackedFrame]
) -> tuple[Labels, LabelObservations]:
    frames = sequence.frames.select(sequence.wanted)
    results = [tracked[row] for row in sequence.wanted.tolist()]
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
