"""Anchors: landmarks of one image followed into the images after it, on rendered images with exact poses."""

from __future__ import annotations

import numpy as np
import pytest

from spn_data.geometry.pose import to_camera
from spn_data.geometry.rotations import rotation_vectors
from spn_model.integrity.judgement import IntegrityLimits, judge
from spn_model.landmarks.anchor import LandmarkAnchor
from spn_model.landmarks.search import Candidate, Hypothesis, witness_of
from spn_model.landmarks.solver import Sightings, solve
from tests.worlds.tracking_world import CAMERA, path, rays_of, render, surfaces

POSES = path()
FIRST = 3
NOISE_PX = 0.2
WRONG = 10  # measurements that are of something else


def anchor(seed: int = 0) -> LandmarkAnchor:
    """Return the anchor of an image of the flight, with landmarks at a grid of its pixels."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(12, 480, 24.0), np.arange(12, 270, 24.0))
    pixels = np.column_stack([x.ravel(), y.ravel()]) + rng.uniform(-8, 8, (x.size, 2))
    pose, focal_px = POSES[FIRST : FIRST + 1], CAMERA.focal_px[0]
    xyz = surfaces(rays_of(pixels, pose), pose.centers[0])
    measured = pixels + rng.normal(0, NOISE_PX, pixels.shape)
    measured[:WRONG] += 20.0
    seen = Sightings(
        landmarks=np.arange(len(xyz)),
        features=np.arange(len(xyz)),
        xyz=xyz,
        covariance=np.tile(np.eye(3) * 1e-6, (len(xyz), 1, 1)),
        at=CAMERA.unproject(measured) * focal_px,
        sigma_px=np.full(len(xyz), NOISE_PX),
        focal_px=focal_px,
    )
    solved = solve(seen, pose.centers[0], pose.rotations[0])
    assert solved is not None
    half_view = np.abs(CAMERA.unproject(np.array([[0, 0], [480, 270.0]]))).max(axis=0)
    candidate = Candidate(source="track", pose=solved, seen=seen)
    return LandmarkAnchor.of(render(pose), CAMERA, candidate, half_view)


def guess(row: int) -> Hypothesis:
    """Return the pose of an image of the flight."""
    return Hypothesis("track", POSES.centers[row], POSES.rotations[row], 30.0)


@pytest.mark.parametrize("covered", [False, True])
def test_images_after_an_anchor_have_their_pose_with_a_true_covariance(covered):
    """Images from a start 0.1 s off: centimetres, and NEES holds, also if another picture covers a third."""
    nees = []
    for row in (FIRST + 1, FIRST + 3, FIRST + 6):
        image = render(POSES[row : row + 1])
        if covered:
            image[:, :160] = render(POSES[20:21])[:, 200:360]
        known = anchor(seed=row)
        found = known.follow(image, guess(row - 1))
        verdict = judge(witness_of(found, known), IntegrityLimits())
        pose = found.best.pose
        turn = POSES.rotations[row] @ pose.rotation.T
        off = np.concatenate([POSES.centers[row] - pose.center, rotation_vectors(turn[None])[0]])
        assert verdict.reason == ""
        assert np.linalg.norm(off[:3]) < 0.06
        assert np.hypot(*off[:2]) < verdict.horizontal_m
        nees.append(off @ np.linalg.solve(verdict.covariance, off) / 6)
    assert 0.2 < np.mean(nees) < 2


def test_another_picture_is_not_followed():
    """An image of another place, noise and black give nothing."""
    known = anchor()
    noise = np.random.default_rng(0).integers(0, 255, known.gray.shape).astype(np.uint8)
    for image in (known.gray[::-1, ::-1].copy(), noise, np.zeros_like(noise)):
        assert known.follow(image, guess(FIRST)) is None


def test_an_anchor_keeps_what_agrees():
    """Landmarks that contradict the pose are not followed, nor more than 240."""
    known = anchor()
    assert known.seen.landmarks.min() >= WRONG
    x = to_camera(known.seen.xyz, POSES.centers[FIRST], POSES.rotations[FIRST])
    assert 60 < len(known.seen) <= 240
    assert np.abs(CAMERA.project(x) - known.pixels).max() < 5 * NOISE_PX
