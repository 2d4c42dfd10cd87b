"""Selection of photos: all but repeats."""

from __future__ import annotations

import numpy as np

from spn_data.capture.frames import FrameStatus
from spn_data.capture.measurement import Measurements, displacement, homogeneous
from spn_data.capture.selection import FrameChoice, SelectionOptions


def choose_photos(
    measured: Measurements, options: SelectionOptions, *, position_m: np.ndarray | None = None
) -> FrameChoice:
    """Choose all readable photos except repeats of the previously chosen one: same place, image unmoved.

    Parameters
    ----------
    measured : Measurements
        The photos, N rows.
    options : SelectionOptions
        Supplies `still_share` and `still_m`.
    position_m : ndarray, shape (N, 3), optional
        Positions as in `choose`.

    Returns
    -------
    FrameChoice
        N rows.
    """
    n = len(measured)
    status = np.full(n, str(FrameStatus.CHOSEN), dtype="U10")
    reason = np.full(n, "chosen: photo", dtype=object)
    motion_px = np.full(n, np.nan)
    last: int | None = None
    total = np.eye(3)
    for row in range(n):
        total = homogeneous(measured.motion[row]) @ total
        if not measured.readable[row]:
            status[row], reason[row] = FrameStatus.UNREADABLE, measured.problem[row]
            continue
        if last is not None:
            share = displacement(total)
            motion_px[row] = share * measured.width[row] if np.isfinite(share) else np.nan
            apart = np.nan
            if position_m is not None:
                apart = float(np.linalg.norm(position_m[row, :2] - position_m[last, :2]))
            if share < options.still_share and not apart > options.still_m:
                status[row] = FrameStatus.SKIPPED
                reason[row] = f"skipped: repeats the photo before, {motion_px[row]:.1f} px apart"
                continue
        last, total = row, np.eye(3)
    return FrameChoice(status, reason.astype(np.str_), motion_px)
