"""Segments of a video, read once: frames with the labelled frames before and after them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from spn_data.capture import video
from spn_data.capture.frames import Frames, FrameStatus
from spn_data.geometry.camera import Camera
from spn_data.labels.labels import LabelObservations, Labels
from spn_data.labels.map_points import MapPoints
from spn_data.tracking.tracked_frames import Anchor, Segment, TrackingOptions


@dataclass(frozen=True, eq=False)
class SequenceToLabel:
    """One sequence: all its frames, the labelled ones with the map points that they observe, and the map.

    Attributes
    ----------
    frames : Frames
    labelled : Labels
    seen : LabelObservations
    cameras : dict of str to Camera
        By key, in pixels of the full-size image.
    points : MapPoints
    """

    frames: Frames
    labelled: Labels
    seen: LabelObservations
    cameras: dict[str, Camera]
    points: MapPoints

    @property
    def wanted(self) -> np.ndarray:
        """Rows of the frames to label. Photos have no frames between them."""
        named = np.isin(self.frames.names, self.labelled.names)
        return np.flatnonzero(~named & (self.frames.video_frame >= 0))

    def labelled_rows(self) -> dict[int, int]:
        """Map the rows of labelled frames with a pose to their rows in the labels."""
        row_of = {name: row for row, name in enumerate(self.frames.names.tolist())}
        registered = np.flatnonzero(self.labelled.registered).tolist()
        return {row_of[str(self.labelled.names[k])]: k for k in registered}


@dataclass
class _PendingFrames:
    """Frames of one camera that wait for the next labelled frame."""

    camera: Camera | None = None
    anchors: list[Anchor] = field(default_factory=list)  # the last two
    head: list[tuple[int, np.ndarray]] = field(default_factory=list)  # before the first anchor
    waiting: list[tuple[int, np.ndarray]] = field(default_factory=list)
    start_flushed: bool = False  # the first frames after the last anchor were passed on


def read_segments(
    sequence: SequenceToLabel,
    videos: Sequence[Path],
    options: TrackingOptions,
    reasons: dict[int, str],
) -> Iterator[Segment]:
    """Yield the segments in the order of time; fill `reasons` for the frames that belong to none.

    Raises InputError if a video cannot be read.
    """
    frames = sequence.frames
    wanted, labelled = set(sequence.wanted.tolist()), sequence.labelled_rows()
    key, state = "", _PendingFrames()
    for row, gray in _images(frames, videos, options):
        if frames.cameras[row] != key:
            yield from _flush_rest(state, sequence, reasons)
            key = str(frames.cameras[row])
            state = _PendingFrames(camera=sequence.cameras.get(key))
        if row in labelled and state.camera is not None:
            anchor = _anchor(sequence, labelled[row], row, gray)
            yield from _flush_between(state, anchor, sequence)
        elif row in wanted and frames.status[row] == FrameStatus.UNREADABLE:
            reasons[row] = str(frames.reason[row])
        elif row in wanted:
            state.waiting.append((row, gray))
            yield from _limit_memory(
                state, sequence, reasons, options.max_batch_mb * 1e6 / gray.size
            )
    yield from _flush_rest(state, sequence, reasons)


def _images(
    frames: Frames, videos: Sequence[Path], options: TrackingOptions
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield row and grey image of each frame in the order of time."""
    row_of = {
        (str(source), int(index)): row
        for row, (source, index) in enumerate(zip(frames.sources, frames.video_frame, strict=True))
    }
    for path in videos:
        for item in video.decode_gray(path, max_width=options.max_width_px):
            row = row_of.get((path.name, item.index))
            if row is not None and item.image is not None:
                yield row, item.image


def _anchor(sequence: SequenceToLabel, label: int, row: int, gray: np.ndarray) -> Anchor:
    """Create an anchor; the points with the longest tracks, which are the most accurate, come first."""
    ids, pixels = sequence.seen.of_frame(label)
    points = sequence.points.rows_of(ids)
    order = np.argsort(-sequence.points.track_lengths[points], kind="stable")
    return Anchor(
        float(sequence.frames.time_s[row]),
        gray,
        sequence.labelled.poses[label : label + 1],
        ids[order],
        sequence.points.xyz[points[order]],
        pixels[order],
    )


def _flush_between(
    state: _PendingFrames, anchor: Anchor, sequence: SequenceToLabel
) -> Iterator[Segment]:
    """Yield the frames that waited for this labelled frame."""
    if not state.anchors:
        state.head, state.waiting = state.waiting, []
    else:
        pair = [state.anchors[-1], anchor]
        yield from _segment(state, state.head, pair, sequence)
        yield from _segment(state, state.waiting, pair, sequence)
        state.head, state.waiting = [], []
    state.anchors = [*state.anchors[-1:], anchor]
    state.start_flushed = False


def _limit_memory(
    state: _PendingFrames, sequence: SequenceToLabel, reasons: dict[int, str], max_images: float
) -> Iterator[Segment]:
    """Limit the number of waiting images.

    In a long gap, the beginning is tracked from the labelled frames before it; of the rest only the end is
    kept.
    """
    if len(state.waiting) <= max_images:
        return
    if state.anchors and not state.start_flushed:
        for part in (state.head, state.waiting):
            yield from _segment(state, part, state.anchors, sequence)
        state.head, state.waiting, state.start_flushed = [], [], True
    else:
        row, _ = state.waiting.pop(0)
        reasons[row] = "too far from any labelled frame"


def _flush_rest(
    state: _PendingFrames, sequence: SequenceToLabel, reasons: dict[int, str]
) -> Iterator[Segment]:
    """Yield the remaining frames, after which no labelled frame follows."""
    for rest in (state.head, state.waiting):
        if state.anchors and not (rest is state.waiting and state.start_flushed):
            yield from _segment(state, rest, state.anchors, sequence)
        else:
            why = (
                "too far from any labelled frame"
                if state.anchors
                else "no labelled frame of its camera"
            )
            reasons.update((row, why) for row, _ in rest)


def _segment(
    state: _PendingFrames,
    images: list[tuple[int, np.ndarray]],
    anchors: list[Anchor],
    sequence: SequenceToLabel,
) -> Iterator[Segment]:
    if images and state.camera is not None:
        rows = np.array([row for row, _ in images], dtype=np.int64)
        times = sequence.frames.time_s[rows]
        yield Segment(rows, times, [gray for _, gray in images], state.camera, list(anchors))
