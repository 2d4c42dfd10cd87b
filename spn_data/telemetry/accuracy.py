"""Position standard deviations from the quality figures that receivers report."""

from __future__ import annotations

import math

# Range error (1 sigma) of a single-frequency receiver under open sky.
USER_RANGE_ERROR_M = 2.0
# Vertical over horizontal error of one axis: all satellites are above the receiver.
VERTICAL_RATIO = 1.5

Sigma = tuple[float, float, float]  # east, north, up in metres
NAN_SIGMA: Sigma = (math.nan, math.nan, math.nan)


def sigma_from_dop(
    *, hdop: float = math.nan, vdop: float = math.nan, pdop: float = math.nan
) -> Sigma:
    """Return standard deviations east, north, up from dilutions of precision; NaN means not stated.

    A horizontal dilution covers two axes, a position dilution three. If only one of them is known, the
    vertical error is `VERTICAL_RATIO` times the error of a horizontal axis.
    """
    if not hdop > 0 and pdop > 0:
        hdop = pdop * math.sqrt(2 / (2 + VERTICAL_RATIO**2))
    if not hdop > 0:
        return NAN_SIGMA
    horizontal = hdop / math.sqrt(2) * USER_RANGE_ERROR_M
    vertical = vdop * USER_RANGE_ERROR_M if vdop > 0 else horizontal * VERTICAL_RATIO
    return (horizontal, horizontal, vertical)


# Fix types of MAVLink, PX4 and ArduPilot.
NO_FIX, FIX_2D, FIX_3D, FIX_DGNSS, FIX_RTK_FLOAT, FIX_RTK = 1, 2, 3, 4, 5, 6
# Of a receiver that states only the kind of its solution: chosen as typical, not measured.
_DGNSS_FACTOR = 0.5  # of the error without corrections
_RTK_SIGMA_M: dict[int, Sigma] = {FIX_RTK_FLOAT: (0.3, 0.3, 0.5), FIX_RTK: (0.02, 0.02, 0.04)}


def sigma_from_fix(
    fix_type: int,
    *,
    horizontal_m: float = math.nan,
    vertical_m: float = math.nan,
    hdop: float = math.nan,
    vdop: float = math.nan,
) -> Sigma:
    """Return standard deviations east, north, up from what a receiver states with a fix; NaN is not stated.

    Its own accuracies count first (horizontal: for each axis), then the kind of its solution if that is RTK,
    then the dilutions of precision, halved for a differential solution.
    """
    if horizontal_m > 0:
        vertical_m = vertical_m if vertical_m > 0 else horizontal_m * VERTICAL_RATIO
        return (horizontal_m, horizontal_m, vertical_m)
    if fix_type in _RTK_SIGMA_M:
        return _RTK_SIGMA_M[fix_type]
    east, north, up = sigma_from_dop(hdop=hdop, vdop=vdop)
    factor = _DGNSS_FACTOR if fix_type == FIX_DGNSS else 1.0
    return (factor * east, factor * north, factor * up)
