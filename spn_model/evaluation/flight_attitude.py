"""Known attitude of the images of an evaluation flight: recorded by its gimbal, or simulated from labels."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.rotations import rotations_from_vectors
from spn_data.inputs.evaluation_flights import EvaluationFlight
from spn_model.landmarks.aids import KnownVertical
from spn_model.onboard.attitude import GIMBAL, GimbalMounting, read_attitude

SIMULATED_DEG = 1.0  # standard deviation of a simulated attitude along each of two axes


@dataclass(frozen=True, kw_only=True)
class FlightAttitude:
    """Up in the camera for each frame of an evaluation flight.

    Attributes
    ----------
    verticals : tuple of (KnownVertical or None)
        In the order of the labels; None where it is not known.
    is_simulated : bool
        Whether it is that of the labels with noise, not one that was measured.
    text : str
        A sentence on where it is from, how exact, and for how many frames.
    """

    verticals: tuple[KnownVertical | None, ...] = field(repr=False)
    is_simulated: bool
    text: str


def attitude_of_flight(flight: EvaluationFlight, mounting: GimbalMounting | None) -> FlightAttitude:
    """Return the attitude of a flight: recorded by its gimbal, or simulated if that is not usable.

    Parameters
    ----------
    flight : EvaluationFlight
    mounting : GimbalMounting or None
        How the camera of the mapping flights is mounted in its gimbal, as the bundle states it.

    Returns
    -------
    FlightAttitude
    """
    if not flight.telemetry.is_file():
        return _simulated(flight, "it has no telemetry")
    if mounting is None:
        return _simulated(
            flight, "the bundle does not know how the camera is mounted in its gimbal"
        )
    try:
        read = read_attitude(
            flight.telemetry, of=GIMBAL, mounting=mounting, body_from_camera=np.eye(3)
        )
    except InputError as error:
        return _simulated(flight, str(error))
    recorded = tuple(read.at(time_s) for time_s in flight.labels.time_s.tolist())
    known = [one for one in recorded if one is not None]
    if not known:
        return _simulated(flight, "the angles in its telemetry are of other times")
    sigma_deg = float(np.median([one.sigma_deg for one in known]))
    return FlightAttitude(
        verticals=recorded,
        is_simulated=False,
        text=f"Attitude on {flight.name}: pitch and roll of its telemetry, corrected by the mounting of the "
        f"gimbal, to {sigma_deg:.2g} deg, for {len(known)} of {len(recorded)} images.",
    )


def _simulated(flight: EvaluationFlight, why: str) -> FlightAttitude:
    rng = np.random.default_rng(0)
    labels = flight.labels
    verticals = tuple(
        noisy_vertical(rotation, SIMULATED_DEG, rng) if has_label else None
        for rotation, has_label in zip(labels.poses.rotations, labels.registered, strict=True)
    )
    return FlightAttitude(
        verticals=verticals,
        is_simulated=True,
        text=f"Attitude on {flight.name}: simulated, that of the labels with normal noise of "
        f"{SIMULATED_DEG:g} deg about each of two axes, for {int(labels.registered.sum())} of {len(labels)} "
        f"images, because there is no recorded one: {why}.",
    )


def noisy_vertical(
    rotation: np.ndarray, sigma_deg: float, rng: np.random.Generator
) -> KnownVertical:
    """Return up in a camera of known rotation, with normal noise about each of two axes."""
    noise = np.deg2rad(sigma_deg) * np.append(rng.normal(size=2), 0.0)
    x, y, z = (rotation @ rotations_from_vectors(noise[None])[0][:, 2]).tolist()
    return KnownVertical(up=(x, y, z), sigma_deg=sigma_deg)
