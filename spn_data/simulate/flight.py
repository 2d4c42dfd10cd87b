"""Exact trajectories of the simulated flights and their telemetry, without rendering."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_vectors
from spn_data.simulate.gnss import gnss_errors
from spn_data.simulate.light import Sunlight
from spn_data.simulate.paths import Motion
from spn_data.simulate.plans import planned
from spn_data.simulate.presets import SimulateOptions

ROLES = ("mapping", "evaluation")


@dataclass(frozen=True, eq=False)
class FlightPath:
    """One flight with its exact trajectory; N is the number of video frames.

    Attributes
    ----------
    name : str
        Name of the flight.
    role : str
        "mapping" or "evaluation".
    camera : Camera
        Intrinsics of all frames.
    time_s : ndarray, shape (N,)
        Times of the video frames.
    poses : Poses
        Poses at mid-exposure of the middle row, East-North-Up about the true origin.
    blurred : ndarray of bool, shape (N,)
        Whether the frame has motion blur.
    blur_vectors : ndarray, shape (N, 3)
        Rotation of the camera during the exposure, as a rotation vector in the camera frame in radians;
        zero if not blurred.
    exposure_ev : ndarray, shape (N,)
        Exposure of the frames, in EV.
    motion : Motion
        Poses at any time, also between frames and a few seconds beyond both ends.
    clock_s : float
        Time of day at the first frame, on which the places of moving things depend.
    sunlight : Sunlight or None
        Light during the flight; None if surfaces look as they are painted.
    """

    name: str
    role: str
    camera: Camera
    time_s: np.ndarray
    poses: Poses
    blurred: np.ndarray
    blur_vectors: np.ndarray
    exposure_ev: np.ndarray
    motion: Motion
    clock_s: float = 0.0
    sunlight: Sunlight | None = None


@dataclass(frozen=True, eq=False)
class FlightTelemetry:
    """Telemetry of one flight before rounding, with one record per video frame.

    Attributes
    ----------
    time_s : ndarray, shape (N,)
        Timestamps as recorded.
    lat_lon_deg : ndarray, shape (N, 2)
        Recorded positions.
    rel_alt_m, abs_alt_m : ndarray, shape (N,)
        Recorded heights.
    gimbal_deg : ndarray, shape (N, 3)
        Heading, pitch and roll.
    errors_m : ndarray, shape (N, 3)
        Errors of the positions east, north and up.
    is_burst : ndarray of bool, shape (N,)
        Whether the position is affected by a multipath burst.
    """

    time_s: np.ndarray
    lat_lon_deg: np.ndarray
    rel_alt_m: np.ndarray
    abs_alt_m: np.ndarray
    gimbal_deg: np.ndarray
    errors_m: np.ndarray
    is_burst: np.ndarray


def flight_rng(options: SimulateOptions, flight: str, purpose: int) -> np.random.Generator:
    """Return a random generator that is independent for each flight and purpose."""
    return np.random.default_rng([options.seed, zlib.crc32(flight.encode()), purpose])


def simulate_paths(options: SimulateOptions) -> dict[str, FlightPath]:
    """Compute the exact trajectories of the requested flights.

    Parameters
    ----------
    options : SimulateOptions
        What to simulate; `only` restricts the flights.

    Returns
    -------
    dict of str to FlightPath
        Flights by name, mapping flights first.

    Raises
    ------
    InputError
        If `only` names an unknown flight or role.
    """
    motions = planned(options, lambda name: flight_rng(options, name, 0))
    wanted = options.only or ROLES
    for name in wanted:
        if name not in motions and name not in ROLES:
            raise InputError(
                f"unknown flight {name!r}; choose from {', '.join([*motions, *ROLES])}"
            )
    return {
        name: _flight_path(options, name, role, duration_s, motion)
        for name, (role, duration_s, motion) in motions.items()
        if name in wanted or role in wanted
    }


def _flight_path(
    options: SimulateOptions, name: str, role: str, duration_s: float, motion: Motion
) -> FlightPath:
    rng = flight_rng(options, name, 1)
    n = max(1, round(duration_s * options.fps))
    time_s = np.arange(n) / options.fps
    lens = options.mapping_lens if role == "mapping" else options.evaluation_lens
    blurred = np.zeros(n, dtype=bool)
    blurred[rng.permutation(n)[: round(options.blur_share * n)]] = True
    # Yaw and pitch shake more than roll.
    axes = rng.standard_normal((n, 3)) * [1.0, 1.0, 0.3]
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.deg2rad(rng.uniform(*options.blur_deg, (n, 1)))
    slow = sum(
        np.sin(2 * np.pi * time_s / period_s + rng.uniform(0, 2 * np.pi))
        for period_s in (7.0, 19.0, 43.0)
    )
    return FlightPath(
        name,
        role,
        lens.camera(options.width, options.height),
        time_s,
        motion.poses(time_s),
        blurred,
        np.where(blurred[:, None], angles * axes, 0.0),
        options.exposure_sigma_ev * np.sqrt(2 / 3) * slow,
        motion,
        float(flight_rng(options, name, 3).uniform(0, 3600)),
        Sunlight.draw(options.light, flight_rng(options, name, 4)) if options.light.sun else None,
    )


def simulate_telemetry(path: FlightPath, options: SimulateOptions) -> FlightTelemetry:
    """Simulate the telemetry of a flight.

    Parameters
    ----------
    path : FlightPath
        Exact trajectory of the flight.
    options : SimulateOptions
        Error model; a record with timestamp t belongs to the video time t + `time_offset_s`.

    Returns
    -------
    FlightTelemetry
        One record per video frame.

    Notes
    -----
    The relative height refers to the ground of the courtyard and has the same vertical error as the
    absolute one. Gimbal angles are those of the camera plus a bias that is constant for the flight.
    """
    rng = flight_rng(options, path.name, 2)
    true_s = path.time_s + options.time_offset_s
    centers, angles_deg = path.motion.at(true_s)
    errors_m, is_burst = gnss_errors(true_s, options.gnss, rng)
    errors_m += options.gnss.draw_constant(flight_rng(options, "day", 5))
    bias_deg = rng.standard_normal(3) * options.gimbal_sigma_deg
    measured = centers + errors_m
    gimbal = angles_deg + bias_deg if options.gimbal_angles else np.full((len(true_s), 3), np.nan)
    return FlightTelemetry(
        path.time_s,
        options.origin.wgs84_from_enu(measured)[:, :2],
        measured[:, 2],
        measured[:, 2] + options.origin.alt_m - options.geoid_m,
        gimbal,
        errors_m,
        is_burst,
    )


def exposure_poses(path: FlightPath, frame: int) -> Poses:
    """Return K poses during a blurred frame's exposure, evenly spaced in time, symmetric about its middle."""
    vector = path.blur_vectors[frame]
    blur_px = np.linalg.norm(vector) * max(path.camera.focal_px)
    count = 2 * max(3, int(np.ceil(blur_px / 2.4)))
    shares = (np.arange(count) + 0.5) / count - 0.5
    turns = rotations_from_vectors(shares[:, None] * vector)
    centers = np.repeat(path.poses.centers[frame][None], count, axis=0)
    return Poses.from_rotations(centers, turns @ path.poses.rotations[frame])
