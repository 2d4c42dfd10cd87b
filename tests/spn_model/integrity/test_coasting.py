"""Poses predicted from two fixes."""

from __future__ import annotations

import numpy as np

from spn_data.geometry.pose import Poses, pose_errors
from spn_data.geometry.rotations import rotation_vectors, rotations_from_angles
from spn_model.integrity.coasting import RecentFixes, coasted
from spn_model.integrity.fix import FixState
from tests.worlds.autopilots import NOW_US, make_fix

SIGMA = np.array([0.02, 0.02, 0.02, 0.002, 0.002, 0.002])


def flight(seconds):
    """Return the pose of a camera that flies and turns at constant velocity."""
    angles = np.array([[20 + 30 * seconds, -10.0, 0.0]])
    return Poses.from_rotations(
        np.array([[4.0 * seconds, 2.0, 30 - seconds]]), rotations_from_angles(angles)
    )


def fixed(seconds, rng):
    """Return a fix of the flight with errors of its covariance."""
    pose = flight(seconds)
    return make_fix(
        time_us=NOW_US + round(1e6 * seconds),
        center=pose.centers[0] + rng.normal(0, SIGMA[:3]),
        quat_wxyz=pose.quats_wxyz[0],
        covariance=np.diag(SIGMA**2),
    )


def test_the_covariance_of_a_prediction_holds_and_grows():
    """Over 300 draws, errors of positions are those that the covariance states without acceleration."""
    rng = np.random.default_rng(0)
    errors = np.zeros((300, 3))
    for k in range(len(errors)):
        found = coasted(fixed(0.0, rng), fixed(0.4, rng), NOW_US + 500_000)
        errors[k] = found.center - flight(0.5).centers[0]
        assert (
            pose_errors(Poses(found.center[None], found.quat_wxyz[None]), flight(0.5))[1][0] < 0.3
        )
    bent = 3.0 * 0.5 * 0.1 / 2
    stated = found.covariance[0, 0] - bent**2
    assert np.isclose(stated, (0.25**2 + 1.25**2) * SIGMA[0] ** 2)
    assert np.isclose(errors.std(), np.sqrt(stated), rtol=0.1)
    later = coasted(fixed(0.0, rng), fixed(0.4, rng), NOW_US + 700_000)
    assert (np.diag(later.covariance) > np.diag(found.covariance)).all()
    assert later.horizontal_protection_m > found.horizontal_protection_m > 1.5
    assert (found.state, found.quality) == (FixState.COAST, 49)
    turn = rotation_vectors(flight(0.5).rotations @ flight(0.4).rotations.transpose(0, 2, 1))
    assert np.rad2deg(np.linalg.norm(turn)) > 2  # so the 0.3 degrees above mean something


def test_a_motion_needs_two_fixes_of_the_last_half_second():
    """One fix, fixes a second apart and a time before the last fix give no prediction."""
    rng, recent = np.random.default_rng(0), RecentFixes()
    assert recent.predicted(NOW_US) is None
    recent.add(fixed(0.0, rng))
    assert recent.predicted(NOW_US + 100_000) is None
    recent.add(fixed(1.0, rng))
    assert recent.predicted(NOW_US + 1_100_000) is None
    recent.add(fixed(1.2, rng))
    assert recent.predicted(NOW_US + 1_100_000) is None
    assert recent.predicted(NOW_US + 1_300_000) is not None
    recent.clear()
    assert recent.predicted(NOW_US + 1_300_000) is None
