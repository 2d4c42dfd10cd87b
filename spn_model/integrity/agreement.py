"""Agreement of poses over time: the state of the localization, m of n after a loss, impossible jumps."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from spn_model.integrity.fix import FixState


@dataclass(frozen=True, kw_only=True)
class MotionLimits:
    """What a drone can do between two images, and how many fixes have to agree.

    Attributes
    ----------
    max_speed_m_s : float
    max_turn_deg_s : float
    confirm : int
        Number of the last `window` images whose poses agree before one is usable.
    window : int
    coast_s : float
        Time without a fix after which the localization is lost.
    """

    max_speed_m_s: float = 20.0
    max_turn_deg_s: float = 180.0
    confirm: int = 2
    window: int = 3
    coast_s: float = 1.0


@dataclass(frozen=True, eq=False)
class _Passed:
    time_us: int
    center: np.ndarray
    rotation: np.ndarray
    sigma_m: float


class Agreement:
    """State of a localization. Poses that passed their own judgement go in, states come out.

    Parameters
    ----------
    limits : MotionLimits, optional
    """

    def __init__(self, limits: MotionLimits | None = None):
        self.limits = limits or MotionLimits()
        self.state = FixState.BOOT
        self._window: deque[_Passed | None] = deque(maxlen=self.limits.window)
        self._last: _Passed | None = None

    def passed(
        self, time_us: int, center: np.ndarray, rotation: np.ndarray, sigma_m: float
    ) -> FixState:
        """Take a pose that passed; return the state, which says whether the pose is usable.

        Parameters
        ----------
        time_us : int
            Later than that of the last image.
        center : ndarray, shape (3,)
        rotation : ndarray, shape (3, 3)
        sigma_m : float
            Standard deviation of the position.

        Returns
        -------
        FixState
            TRACK: the pose agrees with `confirm` of the last `window`, itself included. CONFIRM: not yet.
        """
        new = _Passed(time_us, center, rotation, sigma_m)
        self._window.append(new)
        agreeing = sum(old is not None and self._agree(old, new) for old in self._window)
        follows = self._last is not None and self._agree(self._last, new)
        tracked = self.state in (FixState.TRACK, FixState.COAST) and follows
        if tracked or agreeing >= self.limits.confirm:
            self.state, self._last = FixState.TRACK, new
        elif self.state not in (FixState.TRACK, FixState.COAST):
            self.state = FixState.CONFIRM
        else:
            return self._missed(time_us)
        return self.state

    def failed(self, time_us: int) -> FixState:
        """Take an image without a pose; return the state."""
        self._window.append(None)
        return self._missed(time_us)

    def _missed(self, time_us: int) -> FixState:
        if self._last is not None:
            age_s = (time_us - self._last.time_us) * 1e-6
            self.state = FixState.COAST if age_s <= self.limits.coast_s else FixState.LOST
        elif self.state is FixState.BOOT or not any(self._window):
            self.state = FixState.SEARCH
        return self.state

    def _agree(self, old: _Passed, new: _Passed) -> bool:
        if old is new:
            return True
        between_s = abs(new.time_us - old.time_us) * 1e-6
        moved = float(np.linalg.norm(new.center - old.center))
        cosine = (np.trace(new.rotation @ old.rotation.T) - 1) / 2
        turned = float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))))
        return (
            moved <= self.limits.max_speed_m_s * between_s + 3 * np.hypot(old.sigma_m, new.sigma_m)
            and turned <= self.limits.max_turn_deg_s * between_s + 2.0
        )
