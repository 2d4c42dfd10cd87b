"""Which frames the page holds, where an area has more than a browser likes."""

from __future__ import annotations

import numpy as np

from spn_data.report.data import FrameTable


def thin_frames(frames: FrameTable, limit: int) -> tuple[FrameTable, dict[str, int]]:
    """At most about `limit` frames, and how many of what kind are left out.

    Frames that failed, and chosen ones, all stay; candidates that were not chosen go first, then tracked
    frames
    with a pose, each thinned evenly in time.
    """
    keep = np.ones(len(frames), bool)
    left_out: dict[str, int] = {}
    kinds = {
        "candidates that were not chosen": ~frames.tried,
        "tracked frames with a pose": frames.tracked & frames.registered,
    }
    for kind, mask in kinds.items():
        excess = int(keep.sum()) - limit
        if excess <= 0:
            break
        rows = np.flatnonzero(mask)
        stay = max(0, len(rows) - excess)
        kept = rows[np.linspace(0, len(rows) - 1, stay).astype(np.int64)] if stay else rows[:0]
        keep[rows] = False
        keep[kept] = True
        if len(rows) > stay:
            left_out[kind] = len(rows) - stay
    return frames.select(keep), left_out
