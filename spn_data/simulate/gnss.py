"""Error model of a drone's GNSS positions: a lasting and a drifting bias, white noise, multipath bursts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class GnssOptions:
    """Error model of one GNSS receiver; the bias is a stationary Ornstein-Uhlenbeck process.

    Attributes
    ----------
    bias_sigma_m : tuple of float
        Standard deviation of the bias east, north and up.
    bias_time_s : float
        Correlation time of the bias: the lag at which its correlation has fallen to 1/e.
    white_sigma_m : float
        Standard deviation of the white noise per record and axis.
    burst_interval_s : float
        Mean time between multipath bursts; infinite for none.
    burst_length_s : float
        Duration of a burst.
    burst_m : float
        Magnitude of the error during a burst, in a random direction.
    constant_sigma_m : tuple of float
        Standard deviation east, north and up of an error that all flights of the day share.
    """

    bias_sigma_m: tuple[float, float, float] = (0.7, 0.7, 1.1)
    bias_time_s: float = 60.0
    white_sigma_m: float = 0.08
    burst_interval_s: float = 30.0
    burst_length_s: float = 1.0
    burst_m: float = 12.0
    constant_sigma_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def draw_constant(self, rng: np.random.Generator) -> np.ndarray:
        """Draw the error (3,) in metres that all flights of a day share."""
        return rng.standard_normal(3) * self.constant_sigma_m

    @classmethod
    def rtk(cls) -> GnssOptions:
        """Return the model of an RTK receiver: 3 cm white noise, no bias, no bursts."""
        return cls(bias_sigma_m=(0.0, 0.0, 0.0), white_sigma_m=0.03, burst_interval_s=float("inf"))


def gnss_errors(
    time_s: np.ndarray, options: GnssOptions, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw position errors at increasing times.

    Parameters
    ----------
    time_s : ndarray, shape (N,)
        Increasing times in seconds.
    options : GnssOptions
        Error model.
    rng : Generator
        Source of random numbers.

    Returns
    -------
    errors : ndarray, shape (N, 3)
        Errors in metres east, north and up.
    is_burst : ndarray of bool, shape (N,)
        Whether a time is within a multipath burst.

    References
    ----------
    Uhlenbeck and Ornstein 1930. The discretization is exact for any spacing of the times.
    """
    time_s = np.asarray(time_s, dtype=np.float64)
    n = len(time_s)
    if n == 0:
        return np.zeros((0, 3)), np.zeros(0, dtype=bool)
    decay = np.exp(-np.diff(time_s) / options.bias_time_s)
    innovation = rng.standard_normal((n, 3))
    bias = np.empty((n, 3))
    bias[0] = innovation[0]
    for i, factor in enumerate(decay):
        bias[i + 1] = factor * bias[i] + np.sqrt(1 - factor**2) * innovation[i + 1]
    errors = bias * options.bias_sigma_m + options.white_sigma_m * rng.standard_normal((n, 3))
    is_burst = np.zeros(n, dtype=bool)
    # A burst may have begun before the first record.
    begin_s, end_s = time_s[0] - options.burst_length_s, time_s[-1]
    for start_s in rng.uniform(
        begin_s, end_s, rng.poisson((end_s - begin_s) / options.burst_interval_s)
    ):
        direction = rng.standard_normal(3)
        hit = (time_s >= start_s) & (time_s < start_s + options.burst_length_s) & ~is_burst
        errors[hit] += options.burst_m * direction / np.linalg.norm(direction)
        is_burst |= hit
    return errors, is_burst
