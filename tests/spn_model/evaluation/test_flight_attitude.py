"""Known attitude of evaluation flights: recorded where it is usable, else simulated and said so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spn_data.area.area import Area
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles
from spn_data.inputs.evaluation_flights import EvaluationFlight
from spn_data.labels.labels import Labels
from spn_data.telemetry.table import write_track
from spn_data.telemetry.track import Telemetry
from spn_model.evaluation.fixes import COARSE, coarse_each
from spn_model.evaluation.flight_attitude import attitude_of_flight
from spn_model.onboard.attitude import GimbalMounting
from spn_model.onboard.localizer import Located

LEVEL = GimbalMounting(turn_deg=(0.0, 0.0, 0.0), sigma_deg=0.6, frames=50, flights=2)
ANGLES = np.array([[10.0, -30.0, 1.0], [20.0, -31.0, 2.0], [30.0, -32.0, 3.0]])


def flight(folder, time_s=(0.0, 4.0, 8.0), status=("registered",) * 3) -> EvaluationFlight:
    """Return a flight of three frames, whose labels have the angles above."""
    names = np.array([f"low/{k:06d}.jpg" for k in range(3)])
    text = np.array(["low"] * 3)
    labels = Labels(
        names=names,
        sequences=text,
        cameras=text,
        sources=text,
        video_frame=np.full(3, -1),
        tracked=np.zeros(3, bool),
        time_s=np.array(time_s),
        status=np.array(status),
        reason=np.array([""] * 3),
        poses=Poses.from_rotations(np.zeros((3, 3)), rotations_from_angles(ANGLES)),
        covariance=np.zeros((3, 6, 6)),
        inliers=np.zeros(3, int),
        coverage=np.zeros(3),
        error_px=np.zeros(3),
    )
    camera = Camera("SIMPLE_PINHOLE", 64, 36, np.array([40.0, 32.0, 18.0]))
    return EvaluationFlight(name="low", camera=camera, labels=labels, area=Area(folder))


def record(one: EvaluationFlight, gimbal_deg=ANGLES, time_s=(0.0, 4.0, 8.0)) -> None:
    """Write the telemetry of a flight."""
    one.telemetry.parent.mkdir(parents=True)
    write_track(one.telemetry, Telemetry.from_columns(np.array(time_s), gimbal_deg=gimbal_deg))


def test_a_recorded_attitude_is_that_of_the_gimbal(tmp_path):
    """Each photo has the angles of its own record, though the records are seconds apart."""
    one = flight(tmp_path)
    record(one)
    found = attitude_of_flight(one, LEVEL)
    assert not found.is_simulated
    up = [vertical.up for vertical in found.verticals]
    assert np.array(up) == pytest.approx(one.labels.poses.rotations[:, :, 2], abs=1e-6)
    assert {vertical.sigma_deg for vertical in found.verticals} == {0.6}
    assert "to 0.6 deg, for 3 of 3 images" in found.text


@pytest.mark.parametrize(
    ("recorded", "mounting", "why"),
    [
        (None, LEVEL, "it has no telemetry"),
        ({}, None, "the bundle does not know how the camera is mounted"),
        ({"gimbal_deg": np.full((3, 3), np.nan)}, LEVEL, "has no record with pitch_deg"),
        ({"time_s": (100.0, 104.0, 108.0)}, LEVEL, "the angles in its telemetry are of other"),
    ],
)
def test_without_one_it_is_simulated_and_said_so(tmp_path, recorded, mounting, why):
    """The sentence says why; noise is of one degree, and a frame without a label has no attitude."""
    one = flight(tmp_path, status=("registered", "failed", "registered"))
    if recorded is not None:
        record(one, **recorded)
    found = attitude_of_flight(one, mounting)
    assert found.is_simulated
    assert found.verticals[1] is None
    for row in (0, 2):
        cosine = np.array(found.verticals[row].up) @ one.labels.poses.rotations[row, :, 2]
        assert 0.01 < np.rad2deg(np.arccos(cosine)) < 4
    assert "simulated, that of the labels with normal noise of 1 deg" in found.text
    assert "for 2 of 3 images" in found.text
    assert why in found.text


class Asked:
    """Stands for the network or pilot of a bundle, and keeps the attitudes that it was given."""

    def __init__(self):
        self.given = []

    def localize(self, image, camera, *, vertical=None):
        self.given.append(vertical)
        return Located.failed("nothing")


def test_rows_with_an_attitude_are_apart(tmp_path, monkeypatch):
    """Each image is localized with its own attitude, and the name of the row says what kind it is."""
    one = flight(tmp_path, status=("registered", "failed", "registered"))
    monkeypatch.setattr(
        EvaluationFlight, "images", lambda _, rows: ((int(k), np.zeros((36, 64, 3))) for k in rows)
    )
    made = attitude_of_flight(one, None)
    asked = Asked()
    rows = [
        coarse_each(asked, one, lambda: None, attitude).row
        for attitude in (None, made, replace(made, is_simulated=False))
    ]
    assert rows == [COARSE, "coarse, simulated attitude", "coarse, attitude"]
    assert asked.given == [None, None, *[made.verticals[0], made.verticals[2]] * 2]
