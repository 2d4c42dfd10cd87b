"""Coasting: the pose between and after images, moved on from two fixes, with a covariance that grows.

With fixes at the times a < b and t > b, and s = (t - a) / (b - a), motion at constant velocity is

    x(t) = x_a + s (x_b - x_a),    C(t) = (s - 1)^2 C_a + s^2 C_b + (A (t - a) (t - b) / 2)^2 I,

the last term of which is the error of that motion under an acceleration A. Errors of the two fixes are taken
as independent; they have the map in common, so C(t) is rather too large. Rotation vectors of the two are
added as if in one camera frame, which holds for small turns.
"""

from __future__ import annotations

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.pose import Poses, interpolate_pose
from spn_model.integrity.fix import Fix, FixSource, FixState, NoFix

MAX_QUALITY = 49  # of a prediction; a fix has at least 50, the share of landmarks that must agree
ACCELERATION_M_S2, ACCELERATION_RAD_S2 = 3.0, 3.0  # standard deviations, along each axis
BASELINE_US = 500_000  # of the fixes that a motion is taken from
_SIGMAS = 4.0  # of protection levels, as for fixes


def check_coast(coast_s: float) -> None:
    """Raise InputError if predictions cannot go out for so many seconds after a fix."""
    if not 0 <= coast_s <= 1:
        raise InputError(f"predictions go out for {coast_s!r} s, not 0 to 1")


def coasted(first: Fix, last: Fix, time_us: int, *, shared_by: int = 1) -> Fix:
    """Predict the pose at a time after two fixes.

    Parameters
    ----------
    first, last : Fix
        In the order of their times.
    time_us : int
        After that of `last`.
    shared_by : int
        Number of predictions from the same fix that a receiver takes as independent measurements. Each has
        so many times the variance, so that together they weigh as much as one.

    Returns
    -------
    Fix
        Of the state COAST, with a quality of at most 49.
    """
    b, t = (1e-6 * (time - first.time_us) for time in (last.time_us, time_us))
    share = t / b
    pose = interpolate_pose((0.0, _pose(first)), (b, _pose(last)), t)
    bent = t * (t - b) / 2
    grown = np.repeat(np.square([ACCELERATION_M_S2 * bent, ACCELERATION_RAD_S2 * bent]), 3)
    covariance = (share - 1) ** 2 * first.covariance + share**2 * last.covariance + np.diag(grown)
    covariance *= shared_by
    sigma_m = np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]), np.sqrt(covariance[2, 2])
    return Fix(
        time_us=time_us,
        center=pose.centers[0],
        quat_wxyz=pose.quats_wxyz[0],
        covariance=covariance,
        horizontal_protection_m=last.horizontal_protection_m
        + _SIGMAS * (sigma_m[0] - last.horizontal_sigma_m),
        vertical_protection_m=last.vertical_protection_m
        + _SIGMAS * (sigma_m[1] - last.vertical_sigma_m),
        state=FixState.COAST,
        source=FixSource.TRACK,
        quality=min(MAX_QUALITY, last.quality),
        processing_s=0.0,
    )


class RecentFixes:
    """Usable fixes of the last half second, from which poses are predicted."""

    def __init__(self) -> None:
        self._fixes: list[Fix] = []

    @property
    def last_us(self) -> int:
        """Time of the last fix; 0 if there is none."""
        return self._fixes[-1].time_us if self._fixes else 0

    def add(self, fix: Fix) -> None:
        """Take a fix; one that is not later than the last one is ignored."""
        if fix.time_us > self.last_us:
            since = fix.time_us - BASELINE_US
            self._fixes = [*(f for f in self._fixes if f.time_us >= since), fix]

    def clear(self) -> None:
        """Forget the fixes, since the motion may have changed."""
        self._fixes.clear()

    def follow(self, item: Fix | NoFix) -> None:
        """Take the result of an image; after a single one without a pose (state COAST), predictions go on."""
        if isinstance(item, Fix) and item.usable:
            self.add(item)
        elif item.state != FixState.COAST:
            self.clear()

    def predicted(self, time_us: int, *, shared_by: int = 1) -> Fix | None:
        """Return the pose at a time after the last fix; None if it is not, or the motion is not known."""
        if len(self._fixes) < 2 or time_us <= self.last_us:
            return None
        return coasted(self._fixes[0], self._fixes[-1], time_us, shared_by=shared_by)


def _pose(fix: Fix) -> Poses:
    return Poses(fix.center[None], fix.quat_wxyz[None])
