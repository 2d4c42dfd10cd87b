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
