"""Motions of the simulated drone: smooth paths and camera angles as functions of time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles

STEP_S = 0.02
MARGIN_S = 6.0  # a motion extends this long before its start and after its end


@dataclass(frozen=True, eq=False)
class Motion:
    """Path sampled on a fine time grid and interpolated linearly.

    time_s : (M,), evenly spaced; centers : (M, 3) metres; angles_deg : (M, 3) heading (unwrapped),
        pitch and roll.
    """

    time_s: np.ndarray
    centers: np.ndarray
    angles_deg: np.ndarray

    def at(self, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Interpolate centres (N, 3) and angles (N, 3) in degrees; raise ValueError outside the motion."""
        time_s = np.asarray(time_s, dtype=np.float64)
        if len(time_s) and (time_s.min() < self.time_s[0] or time_s.max() > self.time_s[-1]):
            raise ValueError(
                f"the motion is defined from {self.time_s[0]} to {self.time_s[-1]} s only"
            )
        both = np.concatenate([self.centers, self.angles_deg], axis=1)
        values = np.stack([np.interp(time_s, self.time_s, column) for column in both.T], axis=1)
        return values[:, :3], values[:, 3:]

    def poses(self, time_s: np.ndarray) -> Poses:
        """Return the poses at times (N,)."""
        centers, angles_deg = self.at(time_s)
        return Poses.from_rotations(centers, rotations_from_angles(angles_deg))


def _times(duration_s: float) -> np.ndarray:
    return np.arange(-MARGIN_S, duration_s + MARGIN_S + STEP_S, STEP_S)


def _wander(
    rng: np.random.Generator, time_s: np.ndarray, periods_s: tuple[float, ...]
) -> np.ndarray:
    """Return a smooth random function of time (M,) with a standard deviation of about one."""
    waves = [
        np.sin(
            2 * np.pi * time_s / (period_s * rng.uniform(0.85, 1.18)) + rng.uniform(0, 2 * np.pi)
        )
        for period_s in periods_s
    ]
    return np.asarray(np.sqrt(2 / len(waves)) * np.sum(waves, axis=0))


def _with_shake(
    rng: np.random.Generator, time_s: np.ndarray, centers: np.ndarray, angles_deg: np.ndarray
) -> Motion:
    """Add the effects of wind and gimbal: centimetres and tenths of a degree."""
    drift = np.stack([_wander(rng, time_s, (1.7, 3.1, 5.3)) for _ in range(3)], axis=1)
    shake = np.stack([_wander(rng, time_s, (0.9, 1.6, 2.7)) for _ in range(3)], axis=1)
    return Motion(time_s, centers + 0.035 * drift, angles_deg + np.array([0.25, 0.15, 0.2]) * shake)


def courtyard_loop(
    rng: np.random.Generator,
    half_m: tuple[float, float],
    *,
    duration_s: float,
    margin_m: float,
    laps: float,
    turn: int,
    offsets_deg: list[tuple[float, float]],
    height_m: tuple[float, float],
    pitch_deg: tuple[float, float],
) -> Motion:
    """Fly around the courtyard at a margin from the facades, climbing and descending.

    Parameters
    ----------
    rng : Generator
        Source of random numbers.
    half_m : tuple of float
        Half extents of the courtyard east and north.
    duration_s : float
        Duration of the flight.
    margin_m : float
        Distance from the facades.
    laps : float
        Number of laps.
    turn : int
        1 for anticlockwise, -1 for clockwise, seen from above.
    offsets_deg : list of (float, float)
        Share of the duration, and degrees by which the camera is turned away from the adjacent facade
        towards the flight direction; 180 looks across the courtyard.
    height_m, pitch_deg : tuple of float
        Ranges; the camera looks down from high positions and up from low ones.

    Returns
    -------
    Motion
        The motion, including wind and gimbal shake.
    """
    time_s = _times(duration_s)
    a, b = half_m[0] - margin_m, half_m[1] - margin_m
    # A superellipse as a rounded rectangle, parametrized by its arc length.
    angle = np.linspace(0, 2 * np.pi, 20001)
    power = 3.5
    radius = (np.abs(np.cos(angle)) ** power + np.abs(np.sin(angle)) ** power) ** (-1 / power)
    loop = np.stack([a * radius * np.cos(angle), b * radius * np.sin(angle)], axis=1)
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(loop, axis=0), axis=1))])
    share = time_s / duration_s
    pace = share * laps + 0.012 * np.sin(2 * np.pi * time_s / 23.0 + rng.uniform(0, 6.28)) / max(
        1.0, half_m[0] / 19.5
    )
    along = np.mod(rng.uniform() + turn * pace, 1.0) * arc[-1]
    x, y = np.interp(along, arc, loop[:, 0]), np.interp(along, arc, loop[:, 1])
    outward = np.arctan2(
        np.sign(x) * np.abs(x / a) ** (power - 1) / a, np.sign(y) * np.abs(y / b) ** (power - 1) / b
    )
    outward_deg = gaussian_filter1d(np.rad2deg(np.unwrap(outward)), 0.8 / STEP_S, mode="nearest")
    shares, degrees = np.array(offsets_deg).T
    # Turns are spread over some seconds: a mapping drone does not yaw fast.
    offset = gaussian_filter1d(np.interp(share, shares, degrees), 2.0 / STEP_S, mode="nearest")
    sway = 9.0 * _wander(rng, time_s, (13.0, 21.0))
    low, high = height_m
    cycles = max(1.0, round(duration_s / 27.0))
    swing = np.sin(2 * np.pi * cycles * share + rng.uniform(0, 2 * np.pi))
    z = (low + high) / 2 + (high - low) / 2 * 0.97 * swing
    wander = 0.25 * _wander(rng, time_s, (11.0, 17.0))
    tilt = np.clip(-0.75 * swing + wander, -1.0, 1.0)
    pitch = sum(pitch_deg) / 2 + (pitch_deg[1] - pitch_deg[0]) / 2 * 0.97 * tilt
    heading = outward_deg - turn * offset + sway
    roll = 0.3 * _wander(rng, time_s, (9.0, 15.0))
    return _with_shake(
        rng, time_s, np.stack([x, y, z], axis=1), np.stack([heading, pitch, roll], axis=1)
    )


def _along_polyline(points: np.ndarray, travelled_m: np.ndarray) -> np.ndarray:
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return np.stack([np.interp(travelled_m, arc, column) for column in points.T], axis=1)


def nadir_lines(
    rng: np.random.Generator,
    half_m: tuple[float, float],
    length_factor: float,
    *,
    height_m: float = 45.0,
    spacing_m: float = 14.0,
    speed_m_s: float = 5.0,
) -> tuple[Motion, float]:
    """Fly parallel east-west lines above building and courtyard, looking down.

    Returns the motion and its duration in seconds.
    """
    reach_x, reach_y = half_m[0] + 14.0, half_m[1] + 10.0
    count = max(2, round(2 * reach_y / spacing_m) + 1)
    corners = []
    for k, y in enumerate(np.linspace(-reach_y, reach_y, count)):
        ends = [(-reach_x, y), (reach_x, y)]
        corners += ends if k % 2 == 0 else ends[::-1]
    points = np.array(corners)
    total_m = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()) * min(1.0, length_factor)
    duration_s = total_m / speed_m_s
    time_s = _times(duration_s)
    path = _along_polyline(points, np.clip(time_s * speed_m_s, 0, total_m))
    path = gaussian_filter1d(path, 0.8 / STEP_S, axis=0, mode="nearest")
    n = len(time_s)
    heading = 90.0 + 1.5 * _wander(rng, time_s, (15.0, 25.0))
    z = height_m + 0.4 * _wander(rng, time_s, (20.0, 33.0))
    angles = np.stack([heading, np.full(n, -89.2), np.zeros(n)], axis=1)
    return _with_shake(rng, time_s, np.column_stack([path, z]), angles), duration_s


def straight_line(
    rng: np.random.Generator,
    half_m: tuple[float, float],
    length_factor: float,
    *,
    height_m: float = 4.0,
    speed_m_s: float = 1.3,
) -> tuple[Motion, float]:
    """Fly a straight line along the north facade, looking at it.

    Returns the motion and its duration in seconds.
    """
    start, end = -half_m[0] + 5.0, half_m[0] - 5.0
    duration_s = (end - start) * min(1.0, length_factor) / speed_m_s
    time_s = _times(duration_s)
    n = len(time_s)
    x = np.clip(start + speed_m_s * time_s, -half_m[0] + 1.0, half_m[0] - 1.0)
    centers = np.stack([x, np.full(n, half_m[1] - 8.5), np.full(n, height_m)], axis=1)
    heading = 15.0 + 8.0 * _wander(rng, time_s, (8.0, 13.0))
    angles = np.stack([heading, np.full(n, 3.0), np.zeros(n)], axis=1)
    return _with_shake(rng, time_s, centers, angles), duration_s


def guided(
    rng: np.random.Generator,
    stations: np.ndarray,
    *,
    speed_m_s: float,
    length_factor: float,
    sway_deg: float = 4.0,
) -> tuple[Motion, float]:
    """Fly through stations at constant speed.

    Parameters
    ----------
    rng : Generator
        Source of random numbers.
    stations : ndarray, shape (K, 5)
        East, north and up in metres, and heading and pitch of the camera in degrees; headings are unwrapped.
    speed_m_s : float
        Speed.
    length_factor : float
        Share of the path to fly, at most all of it.
    sway_deg : float
        Slow changes of the heading.

    Returns
    -------
    Motion, float
        The motion and its duration in seconds.
    """
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(stations[:, :3], axis=0), axis=1))])
    total_m = arc[-1] * min(1.0, length_factor)
    duration_s = total_m / speed_m_s
    time_s = _times(duration_s)
    travelled = np.clip(time_s * speed_m_s, 0, total_m)
    values = np.stack([np.interp(travelled, arc, column) for column in stations.T], axis=1)
    values = gaussian_filter1d(values, 1.2 / STEP_S, axis=0, mode="nearest")
    sway = sway_deg * _wander(rng, time_s, (9.0, 16.0))
    roll = 0.3 * _wander(rng, time_s, (9.0, 15.0))
    angles = np.stack([values[:, 3] + sway, values[:, 4], roll], axis=1)
    return _with_shake(rng, time_s, values[:, :3], angles), duration_s
