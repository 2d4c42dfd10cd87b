"""A video read once, cut into segments of frames with the labelled frames beside them."""

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
    """One sequence: all its frames, those that are labelled with the map points they see, and the map.

    cameras : by key, in pixels of the full-size image.
    """

    frames: Frames
    labelled: Labels
    seen: LabelObservations
    cameras: dict[str, Camera]
    points: MapPoints

    @property
    def wanted(self) -> np.ndarray:
        """Rows of the frames to label. Photos have nothing between them."""
        named = np.isin(self.frames.names, self.labelled.names)
        return np.flatnonzero(~named & (self.frames.video_frame >= 0))

    def labelled_rows(self) -> dict[int, int]:
        """Row among the frames -> row among the labels, of those with a pose."""
        row_of = {name: row for row, name in enumerate(self.frames.names.tolist())}
        registered = np.flatnonzero(self.labelled.registered).tolist()
        return {row_of[str(self.labelled.names[k])]: k for k in registered}


@dataclass
class _Open:
    """Frames that wait for their next labelled frame, all of one camera."""

    camera: Camera | None = None
    anchors: list[Anchor] = field(default_factory=list)  # the last two
    head: list[tuple[int, np.ndarray]] = field(default_factory=list)  # before the first anchor
    waiting: list[tuple[int, np.ndarray]] = field(default_factory=list)
    handed_on: bool = False  # the first of those that follow the last anchor


def read_segments(
    sequence: SequenceToLabel,
    videos: Sequence[Path],
    options: TrackingOptions,
    reasons: dict[int, str],
) -> Iterator[Segment]:
    """Segments in the order of time. Fills `reasons` for the rows that come in none.

    Raises InputError where a video can't be read.
    """
    frames = sequence.frames
    wanted, labelled = set(sequence.wanted.tolist()), sequence.labelled_rows()
    key, state = "", _Open()
    for row, gray in _images(frames, videos, options):
        if frames.cameras[row] != key:
            yield from _close(state, sequence, reasons)
            key = str(frames.cameras[row])
            state = _Open(camera=sequence.cameras.get(key))
        if row in labelled and state.camera is not None:
            anchor = _anchor(sequence, labelled[row], row, gray)
            yield from _reach(state, anchor, sequence)
        elif row in wanted and frames.status[row] == FrameStatus.UNREADABLE:
            reasons[row] = str(frames.reason[row])
        elif row in wanted:
            state.waiting.append((row, gray))
            yield from _limit(state, sequence, reasons, options.max_batch_mb * 1e6 / gray.size)
    yield from _close(state, sequence, reasons)


def _images(
    frames: Frames, videos: Sequence[Path], options: TrackingOptions
) -> Iterator[tuple[int, np.ndarray]]:
    """(row, grey image) of the frames in the order of time."""
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
    """With the points of the longest tracks first: they are known best."""
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


def _reach(state: _Open, anchor: Anchor, sequence: SequenceToLabel) -> Iterator[Segment]:
    """The next labelled frame is here: what waited for it can go."""
    if not state.anchors:
        state.head, state.waiting = state.waiting, []
    else:
        pair = [state.anchors[-1], anchor]
        yield from _segment(state, state.head, pair, sequence)
        yield from _segment(state, state.waiting, pair, sequence)
        state.head, state.waiting = [], []
    state.anchors = [*state.anchors[-1:], anchor]
    state.handed_on = False


def _limit(
    state: _Open, sequence: SequenceToLabel, reasons: dict[int, str], most: float
) -> Iterator[Segment]:
    """In a long gap, its beginning is tracked from behind, and of the rest only its end is kept."""
    if len(state.waiting) <= most:
        return
    if state.anchors and not state.handed_on:
        for part in (state.head, state.waiting):
            yield from _segment(state, part, state.anchors, sequence)
        state.head, state.waiting, state.handed_on = [], [], True
    else:
        row, _ = state.waiting.pop(0)
        reasons[row] = "too far from any labelled frame"


def _close(state: _Open, sequence: SequenceToLabel, reasons: dict[int, str]) -> Iterator[Segment]:
    """No labelled frame follows."""
    for rest in (state.head, state.waiting):
        if state.anchors and not (rest is state.waiting and state.handed_on):
            yield from _segment(state, rest, state.anchors, sequence)
        else:
            why = (
                "too far from any labelled frame"
                if state.anchors
                else "no labelled frame of its camera"
            )
            reasons.update((row, why) for row, _ in rest)


def _segment(
    state: _Open,
    images: list[tuple[int, np.ndarray]],
    anchors: list[Anchor],
    sequence: SequenceToLabel,
) -> Iterator[Segment]:
    if images and state.camera is not None:
        rows = np.array([row for row, _ in images], dtype=np.int64)
        times = sequence.frames.time_s[rows]
        yield Segment(rows, times, [gray for _, gray in images], state.camera, list(anchors))
