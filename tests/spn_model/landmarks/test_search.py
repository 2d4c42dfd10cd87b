"""Search in a landmark map, and the judgement of what was found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spn_data.geometry.rotations import rotation_vectors
from spn_model.integrity.judgement import IntegrityLimits, judge
from spn_model.landmarks.aids import KnownHeight, KnownVertical
from spn_model.landmarks.matching import ImageFeatures
from spn_model.landmarks.search import Hypothesis, follow, search, witness_of
from spn_model.landmarks.solver import fit_focal_length
from tests.worlds.landmark_world import CAMERA, OPTIONS, pose, room, seen_from

ROOM = room()
LIMITS = IntegrityLimits()
PER_LANDMARK = ("xyz", "covariance", "descriptors", "directions", "sizes_m", "distances_m")


def features(center, rotation, *, stated=CAMERA, landmarks=ROOM, **given) -> ImageFeatures:
    """Return features of a camera in the room, with the camera that is stated for it."""
    found = seen_from(landmarks, center, rotation, **given)
    return ImageFeatures.of(found, stated, OPTIONS.max_image_size_px)


def error(found, center, rotation) -> np.ndarray:
    """Return the error (6,) of a pose: centre and rotation vector."""
    turn = rotation @ found.rotation.T
    return np.concatenate([center - found.center, rotation_vectors(turn[None])[0]])


def test_poses_are_found_with_true_covariances():
    """In 40 places, all poses pass with errors of centimetres; NEES and protection levels hold."""
    nees = []
    for k in range(40):
        center, rotation = pose(9.0 * k, east=0.2 * k - 4, north=3 - 0.15 * k)
        seen = features(center, rotation, seed=k)
        found = search(ROOM, seen)
        verdict = judge(witness_of(found, seen), LIMITS)
        assert verdict.reason == ""
        off = error(found.best.pose, center, rotation)
        assert np.linalg.norm(off[:3]) < 0.05
        assert np.hypot(*off[:2]) < verdict.horizontal_m
        assert abs(off[2]) < verdict.vertical_m
        nees.append(off @ np.linalg.solve(verdict.covariance, off) / 6)
    assert 0.7 < np.mean(nees) < 1.4


def test_a_focal_length_that_nothing_determines_is_not_fitted():
    """Landmarks behind the camera give the prior instead of a singular matrix."""
    center, rotation = pose(20.0)
    seen = features(center, rotation)
    found = search(ROOM, seen).best
    turned = replace(found.pose, rotation=np.diag([-1.0, 1.0, -1.0]) @ found.pose.rotation)
    assert fit_focal_length(found.seen, turned) == (0.0, 1.0)
    assert abs(fit_focal_length(found.seen, found.pose)[0]) < 0.01


def test_an_image_of_another_room_has_no_pose():
    """Features of a room with other landmarks give no pose that passes, in 20 places."""
    other = room(seed=1)
    for k in range(20):
        seen = features(*pose(18.0 * k), landmarks=other, seed=k)
        found = search(ROOM, seen)
        assert found is None or judge(witness_of(found, seen), LIMITS).reason


def test_a_hypothesis_is_followed():
    """A pose 0.3 m and 3 degrees away leads to the right one, and one in another corner to none."""
    center, rotation = pose(30.0)
    seen = features(center, rotation)
    near = Hypothesis("track", *pose(33.0, east=0.3), radius_px=60.0)
    assert np.linalg.norm(error(follow(ROOM, seen, near).best.pose, center, rotation)[:3]) < 0.05
    assert follow(ROOM, seen, Hypothesis("track", *pose(210.0, east=5.0), radius_px=60.0)) is None


def test_a_wrong_focal_length_is_refused():
    """A focal length that is stated 5 % too long or too short gives a reason that says so."""
    for wrong in (0.95, 1.05):
        params = CAMERA.params.copy()
        params[0] *= wrong
        seen = features(*pose(40.0), stated=replace(CAMERA, params=params))
        reason = judge(witness_of(search(ROOM, seen), seen), LIMITS).reason
        assert f"fit a focal length that is {'+' if wrong < 1 else '-'}" in reason


def test_protection_levels_cover_a_lens_that_one_wall_does_not_determine():
    """Of a wall seen head-on by a lens 2 % off, errors stay in their levels; evidence narrows them."""
    on_wall = ROOM.xyz[:, 1] == 10
    wall = replace(
        ROOM,
        **{name: getattr(ROOM, name)[on_wall] for name in PER_LANDMARK},
        landmark=np.arange(int(on_wall.sum())),
    )
    center, rotation = pose(0.0, north=7.0)
    for stated in (0.98, 1.0, 1.02):
        params = CAMERA.params.copy()
        params[0] *= stated
        lens = replace(CAMERA, params=params)
        seen = features(center, rotation, stated=lens, landmarks=wall)
        found = search(wall, seen)
        verdict = judge(witness_of(found, seen), LIMITS)
        off = error(found.best.pose, center, rotation)
        assert verdict.reason == ""
        assert np.hypot(*off[:2]) < verdict.horizontal_m
        assert abs(off[2]) < verdict.vertical_m
        assert verdict.focal_bound > 0.02
        known = judge(witness_of(found, seen, focal_bound=0.004), LIMITS)
        assert known.focal_bound == 0.004
        assert known.horizontal_m < 0.3 * verdict.horizontal_m


def test_a_group_that_moved_is_refused_or_covered():
    """Where the landmarks of one wall moved by 0.2 to 1.5 m, no pose is off by more than it is protected."""
    published = 0
    for k, by in enumerate(np.linspace(0.2, 1.5, 14)):
        moved = ROOM.xyz.copy()
        moved[moved[:, 0] > 14.9] += [0.0, by, 0.0]
        center, rotation = pose(60.0, east=0.1 * k)
        seen = features(center, rotation, landmarks=replace(ROOM, xyz=moved), seed=k)
        found = search(ROOM, seen)
        verdict = judge(witness_of(found, seen), LIMITS)
        if not verdict.reason:
            published += 1
            off = error(found.best.pose, center, rotation)
            assert np.hypot(*off[:2]) < verdict.horizontal_m
            assert abs(off[2]) < verdict.vertical_m
    assert published < 14


def test_a_vertical_that_contradicts_is_refused():
    """Up that is 10 degrees off, stated to 1 degree, is refused; the right one passes."""
    center, rotation = pose(75.0)
    seen = features(center, rotation)
    for tilt_deg, told in ((0.0, ""), (10.0, "the images contradict the stated attitude by 10.")):
        angle = np.deg2rad(tilt_deg)
        lean = np.array(
            [[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]]
        )
        up = tuple(float(v) for v in lean @ rotation[:, 2])
        vertical = KnownVertical(up=up, sigma_deg=1.0)
        found = search(ROOM, seen)
        reason = judge(witness_of(found, seen, vertical), LIMITS).reason
        assert told in reason
        assert bool(reason) == bool(told)


def test_a_height_that_contradicts_the_pose_is_named():
    """A height within its standard deviation does not matter; one that is 3 m off by 0.5 m is the reason."""
    center, rotation = pose(40.0)
    seen = features(center, rotation)
    found = search(ROOM, seen)
    for off_m, told in (
        (0.4, ""),
        (3.0, "the images contradict the stated height by 6.0 standard"),
    ):
        height = KnownHeight(up_m=float(center[2]) + off_m, sigma_m=0.5)
        reason = judge(witness_of(found, seen, height=height), LIMITS).reason
        assert reason.startswith(told)
        assert bool(reason) == bool(told)


@pytest.mark.parametrize(
    ("limit", "told"),
    [
        ({"min_inliers": 5000}, "landmarks agree, 5000 are needed"),
        ({"min_cells": 41}, "of 40 parts of the image, 41 are needed"),
        ({"min_share": 1.01}, "% of the landmarks agree"),
        ({"max_chi": 0.01}, "times as large as expected"),
        ({"max_sigma_deg": 1e-6}, "the orientation is known to"),
        ({"alarm_m": 1e-4}, "the position is protected to"),
        ({"max_contradiction": 1e-3}, "contradict each other"),
    ],
)
def test_each_limit_has_its_reason(limit, told):
    """A pose that misses one limit is refused with the figure that missed it."""
    center, rotation = pose(0.0)
    seen = features(center, rotation)
    witness = witness_of(search(ROOM, seen), seen)
    assert told in judge(witness, replace(LIMITS, **limit)).reason
