"""Standard deviations of tracked frames from residuals and geometry."""

from __future__ import annotations

import numpy as np
import pytest

from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.geometry.pose_fit import PoseFit
from spn_data.tracking.point_tracking import _check_frame, _TrackedPoints
from spn_data.tracking.tracked_frames import TrackingOptions


def test_sigma_is_a_share_of_the_distance_and_grows_with_the_residuals() -> None:
    """Residuals of 1 px, points at 10 m, and 0.04 m and 0.002 rad per pixel give the expected sigma."""
    camera = Camera("SIMPLE_PINHOLE", 640, 480, np.array([500.0, 320.0, 240.0]))
    x, y = np.meshgrid(np.arange(20.0, 640, 60), np.arange(20.0, 480, 60))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    rays = np.column_stack([(pixels - [320, 240]) / 500, np.ones(len(pixels))])
    xyz = 10 * rays / np.linalg.norm(rays, axis=1, keepdims=True)
    pose = Poses.from_rotations(np.zeros((1, 3)), np.eye(3)[None])
    inverse = np.diag([0.01, 0.04, 0.02, 0.001, 0.002, 0.0005]) ** 2
    fit = PoseFit(pose, np.full((len(pixels), 2), [0.6, -0.8]), inverse)
    points = _TrackedPoints(np.arange(len(pixels)), xyz, pixels)
    frame = _check_frame(points, fit, [], camera, TrackingOptions())
    assert frame.reason == ""
    assert frame.error_px == pytest.approx(1.0)
    assert frame.sigma == pytest.approx(0.04 / np.sqrt(2) / 10)
    assert frame.sigma_deg == pytest.approx(np.rad2deg(0.002) / np.sqrt(2))
