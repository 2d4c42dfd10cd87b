"""Height of a barometer: its zero is known within bounds at first, and is then learnt from the fixes."""

from __future__ import annotations

import math
from dataclasses import dataclass

from spn_data.errors import InputError

_MAX_M = 1000.0


@dataclass(frozen=True, kw_only=True)
class HeightErrors:
    """Standard deviations of a height.

    Attributes
    ----------
    sigma_m : float
        Of one reading: gusts, rotor wash and noise.
    zero_m : float
        Of its zero before the first fix: another place of take-off, other weather.
    drift_m : float
        Of the change of its zero within one second; it grows with the root of the time.

    Raises
    ------
    InputError
        If a value is not above 0 and at most 1000.
    """

    sigma_m: float = 0.5
    zero_m: float = 3.0
    drift_m: float = 0.05

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value <= _MAX_M:
                raise InputError(f"{name} of the height is {value:g}, not above 0 and up to 1000")


class HeightZero:
    """Zero of a height: a Kalman filter of one state, a random walk that each usable fix observes.

    With up = reading + zero, a fix observes the zero with the variance of the reading and of the fix. Errors
    of a barometer last for seconds, so that many fixes do not average them: the variance of the zero never
    falls below a quarter of that of a reading.

    Parameters
    ----------
    errors : HeightErrors

    Attributes
    ----------
    zero_m, variance : float
        Present estimate; 0 and that of `errors` before the first fix, and again after `reset`.
    """

    def __init__(self, errors: HeightErrors):
        self.errors = errors
        self.reset()

    def reset(self) -> None:
        """Forget what was learnt, because the fixes that it came from are in doubt."""
        self.zero_m, self.variance = 0.0, self.errors.zero_m**2
        self._time_us: int | None = None

    def expected(self, reading_m: float, time_us: int) -> tuple[float, float]:
        """Return up in the world and its standard deviation for a reading."""
        variance = self._variance_at(time_us) + self.errors.sigma_m**2
        return reading_m + self.zero_m, math.sqrt(variance)

    def learn(self, reading_m: float, time_us: int, up_m: float, sigma_m: float) -> None:
        """Take the height of a usable fix with its standard deviation, and the reading of the same time."""
        before = self._variance_at(time_us)
        gain = before / (before + self.errors.sigma_m**2 + sigma_m**2)
        self.zero_m += gain * (up_m - reading_m - self.zero_m)
        self.variance = max((1 - gain) * before, self.errors.sigma_m**2 / 4)
        self._time_us = time_us

    def _variance_at(self, time_us: int) -> float:
        since_s = 0.0 if self._time_us is None else max(0, time_us - self._time_us) * 1e-6
        return self.variance + self.errors.drift_m**2 * since_s
