"""Mounting of the camera in its gimbal, from labels and the angles in the telemetry."""

from __future__ import annotations

import numpy as np
import pytest

from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles, rotations_from_vectors
from spn_data.inputs.landmark_source import LandmarkSource
from spn_model.export.gimbal_mounting import measure_mounting

TURN_DEG = np.array([1.2, 0.0, -0.8])


def source(
    *biases_deg: float, noise_deg: float = 0.1, shuffled: bool = False, count: int = 60
) -> LandmarkSource:
    """Return frames of flights whose pitch is stated with a bias of each flight, and with noise."""
    rng = np.random.default_rng(3)
    flights = np.repeat(np.arange(len(biases_deg)), count)
    true = np.column_stack(
        [
            rng.uniform(0, 360, len(flights)),
            rng.uniform(-40, 5, len(flights)),
            rng.normal(0, 2, len(flights)),
        ]
    )
    stated = true + rng.normal(0, noise_deg, true.shape)
    stated[:, 1] += np.array(biases_deg)[flights]
    stated[:, 0] += 40.0  # the compass is off
    turn = rotations_from_vectors(np.deg2rad(TURN_DEG)[None])
    if shuffled:
        stated = stated[rng.permutation(len(stated))]
    nothing = np.zeros(0)
    return LandmarkSource(
        fingerprint="",
        map_hash="",
        xyz=np.zeros((0, 3)),
        names=tuple(f"{k}" for k in range(len(flights))),
        poses=Poses.from_rotations(np.zeros((len(flights), 3)), turn @ rotations_from_angles(true)),
        flights=tuple(f"flight{k}" for k in flights),
        gimbal_deg=stated,
        focal_px=nothing,
        sizes=nothing,
        frame=nothing,
        point=nothing,
        pixels=nothing,
        scales=nothing,
        descriptors=nothing,
    )


def test_the_turn_of_the_camera_is_found():
    """A turn of 1.4 degrees is found to 0.1 degrees; with one flight alone, up is not known to a degree."""
    given = source(0.0, 0.0)
    found, note = measure_mounting(given, set(given.names))
    assert found.turn_deg == pytest.approx(tuple(TURN_DEG), abs=0.1)
    assert (found.sigma_deg, found.frames, found.flights) == (0.5, 120, 2)
    assert "(120 frames; flights: flight0, flight1)" in note
    alone = source(0.0)
    assert measure_mounting(alone, set(alone.names))[0].sigma_deg == 1.0


def test_flights_that_differ_count_alike():
    """Two flights whose gimbals differ by 2 degrees give their mean, and a deviation that says so."""
    given = source(1.0, -1.0)
    training = {name for k, name in enumerate(given.names) if k < 60 or k % 2}
    found, _ = measure_mounting(given, training)
    assert found.turn_deg == pytest.approx(tuple(TURN_DEG), abs=0.15)
    assert 0.6 < found.sigma_deg < 0.9  # 1 degree along one of two axes


def test_angles_of_another_flight_are_no_mounting():
    """Angles that do not belong to the images, and too few, give none, with a reason."""
    given = source(0.0, 0.0, shuffled=True)
    found, note = measure_mounting(given, set(given.names))
    assert found is None
    assert "so the mounting of the camera is not known" in note
    found, note = measure_mounting(given, set(given.names[:19]))
    assert found is None
    assert note.startswith("19 training frames have gimbal angles, 20 are needed")
