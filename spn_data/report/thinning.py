"""Selection of frames to show if an area has more than a browser handles well."""

from __future__ import annotations

import numpy as np

from spn_data.report.data import FrameTable


def thin_frames(frames: FrameTable, limit: int) -> tuple[FrameTable, dict[str, int]]:
    """Reduce the frames to about `limit`; return them and the number of omitted frames by kind.

    Failed frames and chosen ones are all kept. Candidates that were not chosen are thinned first, then
    tracked frames with a pose, each evenly in time.
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
