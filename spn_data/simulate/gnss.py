"""What a drone's satellite positions are off by: a drifting bias, white noise, and bursts of multipath."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class GnssOptions:
    """Error model of one receiver; the bias is an Ornstein-Uhlenbeck process in its stationary state."""

    bias_sigma_m: tuple[float, float, float] = (0.7, 0.7, 1.1)  # east, north, up
    bias_time_s: float = 60.0  # after which the bias's correlation has fallen to 1/e
    white_sigma_m: float = 0.08  # per record and axis
    burst_interval_s: float = 30.0  # mean time between bursts of multipath; infinite for none
    burst_length_s: float = 1.0
    burst_m: float = 12.0  # length of a burst's error, in a random direction

    @classmethod
    def rtk(cls) -> GnssOptions:
        """A receiver with carrier-phase corrections: 3 cm of white noise, no bias, no bursts."""
        return cls(bias_sigma_m=(0.0, 0.0, 0.0), white_sigma_m=0.03, burst_interval_s=float("inf"))


def gnss_errors(
    time_s: np.ndarray, options: GnssOptions, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Errors (N, 3) in metres east, north, up at increasing times (N,), and which lie in a burst (N,).

    Uhlenbeck and Ornstein 1930; exact for any spacing of the times.
    """
    time_s = np.asarray(time_s, dtype=np.float64)
    n = len(time_s)
    if n == 0:
        return np.zeros((0, 3)), np.zeros(0, dtype=bool)
    kept = np.exp(-np.diff(time_s) / options.bias_time_s)
    drive = rng.standard_normal((n, 3))
    bias = np.empty((n, 3))
    bias[0] = drive[0]
    for i, factor in enumerate(kept):
        bias[i + 1] = factor * bias[i] + np.sqrt(1 - factor**2) * drive[i + 1]
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
