"""Where the simulated drone is, when, and what its telemetry says of it: exact, and without rendering."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses, rotations_from_vectors
from spn_data.simulate.gnss import gnss_errors
from spn_data.simulate.paths import Motion, courtyard_loop, nadir_lines, straight_line
from spn_data.simulate.presets import MappingPaths, SimulateOptions

ROLES = ("mapping", "evaluation")


@dataclass(frozen=True, eq=False)
class FlightPath:
    """One flight with exact truth.

    role : "mapping" or "evaluation". time_s : (N,) of the video's frames. poses : at mid-exposure of the
    middle row, East-North-Up about the true origin. blurred : (N,) bool; blur_vectors : (N, 3), rotation
    of the camera during the exposure as a vector in the camera frame, radians, zero where not blurred.
    exposure_ev : (N,). motion : poses at any time, also between frames and a few seconds beyond the ends.
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


@dataclass(frozen=True, eq=False)
class FlightTelemetry:
    """What one flight's telemetry says, before rounding: one record a video frame.

    time_s : (N,) as stamped. lat_lon_deg : (N, 2). rel_alt_m, abs_alt_m : (N,). gimbal_deg : (N, 3)
    heading, pitch, roll. errors_m : (N, 3), of the position, east, north, up; is_burst : (N,) bool.
    """

    time_s: np.ndarray
    lat_lon_deg: np.ndarray
    rel_alt_m: np.ndarray
    abs_alt_m: np.ndarray
    gimbal_deg: np.ndarray
    errors_m: np.ndarray
    is_burst: np.ndarray


def flight_rng(options: SimulateOptions, flight: str, purpose: int) -> np.random.Generator:
    """Independent random numbers for each flight and purpose."""
    return np.random.default_rng([options.seed, zlib.crc32(flight.encode()), purpose])


def simulate_paths(options: SimulateOptions) -> dict[str, FlightPath]:
    """Exact paths of the flights that the options ask for, by name; mapping flights first.

    Raises InputError where `only` names no flight.
    """
    half_m = options.scene.half_m
    side = float(np.sqrt(options.area_factor)) * options.length_factor
    laps = options.length_factor
    motions: dict[str, tuple[str, float, Motion]] = {}

    def add(name: str, role: str, motion: Motion, duration_s: float) -> None:
        motions[name] = (role, duration_s, motion)

    def rng(name: str) -> np.random.Generator:
        return flight_rng(options, name, 0)

    if options.mapping_paths == MappingPaths.NADIR:
        motion, duration_s = nadir_lines(rng("nadir"), half_m, options.length_factor)
        add("nadir", "mapping", motion, duration_s)
    elif options.mapping_paths == MappingPaths.STRAIGHT:
        motion, duration_s = straight_line(rng("straight"), half_m, options.length_factor)
        add("straight", "mapping", motion, duration_s)
    else:
        # Along the facades looking forward at them, after a first look across; then the other way round,
        # looking across first and at the facades in the end: both see all, from near and far.
        motion = courtyard_loop(
            rng("flight1"), half_m, duration_s=75 * side, margin_m=8.0, laps=1.25 * laps, turn=1,
            offsets_deg=[(0.0, 150.0), (0.1, 140.0), (0.32, 40.0), (0.75, 25.0), (1.0, 40.0)],
            height_m=(1.7, 8.8), pitch_deg=(-9.3, 14.3),
        )  # fmt: skip
        add("flight1", "mapping", motion, 75 * side)
        motion = courtyard_loop(
            rng("flight2"), half_m, duration_s=60 * side, margin_m=5.5, laps=1.0 * laps, turn=-1,
            offsets_deg=[(0.0, 165.0), (0.5, 190.0), (0.8, 45.0), (1.0, 30.0)],
            height_m=(1.7, 8.0), pitch_deg=(-9.3, 14.3),
        )  # fmt: skip
        add("flight2", "mapping", motion, 60 * side)
    motion = courtyard_loop(
        rng("medium"), half_m, duration_s=30 * side, margin_m=7.2, laps=0.5 * laps, turn=1,
        offsets_deg=[(0.0, 40.0), (1.0, 28.0)], height_m=(2.5, 6.0), pitch_deg=(-9.0, 13.0),
    )  # fmt: skip
    add("medium", "evaluation", motion, 30 * side)
    motion = courtyard_loop(
        rng("low"), half_m, duration_s=25 * side, margin_m=9.0, laps=0.62 * laps, turn=-1,
        offsets_deg=[(0.0, 160.0), (0.5, 195.0), (1.0, 165.0)], height_m=(12.4, 20.6),
        pitch_deg=(-68.5, -47.0),
    )  # fmt: skip
    add("low", "evaluation", motion, 25 * side)
    wanted = options.only or ROLES
    for name in wanted:
        if name not in motions and name not in ROLES:
            raise InputError(
                f"there is no flight {name!r}; there are {', '.join([*motions, *ROLES])}"
            )
    return {
        name: _flight(options, name, role, duration_s, motion)
        for name, (role, duration_s, motion) in motions.items()
        if name in wanted or role in wanted
    }


def _flight(
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
    )


def simulate_telemetry(path: FlightPath, options: SimulateOptions) -> FlightTelemetry:
    """Telemetry of a flight. The record stamped t is of the video's time t + `time_offset_s`.

    The relative height counts from the courtyard's ground and carries the same vertical error as the
    absolute one. Gimbal angles are those of the camera plus a constant bias for the flight.
    """
    rng = flight_rng(options, path.name, 2)
    true_s = path.time_s + options.time_offset_s
    centers, angles_deg = path.motion.at(true_s)
    errors_m, is_burst = gnss_errors(true_s, options.gnss, rng)
    bias_deg = rng.standard_normal(3) * options.gimbal_sigma_deg
    found = centers + errors_m
    gimbal = angles_deg + bias_deg if options.gimbal_angles else np.full((len(true_s), 3), np.nan)
    return FlightTelemetry(
        path.time_s,
        options.origin.wgs84_from_enu(found)[:, :2],
        found[:, 2],
        found[:, 2] + options.origin.alt_m - options.geoid_m,
        gimbal,
        errors_m,
        is_burst,
    )


def exposure_poses(path: FlightPath, frame: int) -> Poses:
    """Poses (K,) of a blurred frame's exposure, evenly spaced in time and symmetric about its middle."""
    vector = path.blur_vectors[frame]
    blur_px = np.linalg.norm(vector) * max(path.camera.focal_px)
    count = 2 * max(3, int(np.ceil(blur_px / 2.4)))
    shares = (np.arange(count) + 0.5) / count - 0.5
    turns = rotations_from_vectors(shares[:, None] * vector)
    centers = np.repeat(path.poses.centers[frame][None], count, axis=0)
    return Poses.from_rotations(centers, turns @ path.poses.rotations[frame])
