"""Tests of poses, quaternions and similarities, with pycolmap as independent reference."""

from __future__ import annotations

import cv2  # noqa: F401  # must load before pycolmap, else PNG writing aborts
import numpy as np
import pycolmap
import pytest

from spn_data.errors import GeometryError
from spn_data.geometry.pose import Poses, Similarity, pose_errors
from spn_data.geometry.rotations import (
    angles_from_rotations,
    canonical_quats,
    quats_from_rotations,
    rotation_errors_deg,
    rotation_vectors,
    rotations_from_angles,
    rotations_from_quats,
    rotations_from_vectors,
)


def _random_quats(n: int, seed: int = 0) -> np.ndarray:
    return canonical_quats(np.random.default_rng(seed).standard_normal((n, 4)))


def test_a_quarter_turn_about_z_takes_x_to_y():
    """The quaternion (cos 45, 0, 0, sin 45) rotates x into y."""
    half = np.sqrt(0.5)
    rotation = rotations_from_quats(np.array([half, 0, 0, half]))
    assert rotation @ [1, 0, 0] == pytest.approx([0, 1, 0])


def test_rotation_matrices_agree_with_pycolmap():
    """Rotation matrices equal those of pycolmap, whose quaternions are scalar-last."""
    for quat in _random_quats(20):
        theirs = pycolmap.Rotation3d(np.roll(quat, -1)).matrix()
        assert rotations_from_quats(quat) == pytest.approx(theirs, abs=1e-14)


def test_quaternions_survive_the_way_through_matrices_and_vectors():
    """Quaternions survive conversion to matrices and vectors, also at zero and half a turn."""
    special = [
        [0, 1, 0, 0],
        [0, 0, 1, 0],
        [0, 0, 0, 1],
        [1, 0, 0, 0],
        [1e-9, 0, 1, 0],
        [1, 1e-9, 0, 0],
    ]
    quats = np.concatenate([_random_quats(200), canonical_quats(np.array(special, dtype=float))])
    rotations = rotations_from_quats(quats)
    assert rotation_errors_deg(quats_from_rotations(rotations), quats).max() < 1e-6
    vectors = rotation_vectors(rotations)
    assert np.linalg.norm(vectors, axis=1).max() <= np.pi + 1e-12
    assert rotations_from_vectors(vectors) == pytest.approx(rotations, abs=1e-12)


def test_a_quaternion_and_its_negative_are_one_rotation():
    """canonical_quats maps q and -q to the same unit quaternion with w >= 0, and refuses zero."""
    quats = _random_quats(50)
    assert canonical_quats(-3 * quats) == pytest.approx(quats)
    assert (quats[:, 0] >= 0).all()
    assert canonical_quats(np.array([0.0, 0, -1, 0])) == pytest.approx([0, 0, 1, 0])
    with pytest.raises(ValueError, match="length zero"):
        canonical_quats(np.zeros((1, 4)))


def test_small_rotation_errors_are_exact():
    """Rotation errors of 1e-6 degrees are measured accurately, which arccos cannot do."""
    quats = _random_quats(20)
    for angle_deg in (1e-6, 1e-3, 1.0, 90.0, 179.999):
        turn = rotations_from_vectors(np.tile([0, np.deg2rad(angle_deg), 0], (20, 1)))
        turned = quats_from_rotations(turn @ rotations_from_quats(quats))
        assert rotation_errors_deg(turned, quats) == pytest.approx(angle_deg, rel=1e-6, abs=1e-12)
        assert rotation_errors_deg(-turned, quats) == pytest.approx(angle_deg, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize(
    ("angles", "forward", "right"),
    [
        ((0, 0, 0), (0, 1, 0), (1, 0, 0)),  # north, level
        ((90, 0, 0), (1, 0, 0), (0, -1, 0)),  # east: right is south
        ((0, -90, 0), (0, 0, -1), (1, 0, 0)),  # down, image top to the north
        ((90, -90, 0), (0, 0, -1), (0, -1, 0)),  # down, image top to the east
        ((0, 0, 90), (0, 1, 0), (0, 0, -1)),  # rolled: right is down
        ((0, 45, 0), (0, np.sqrt(0.5), np.sqrt(0.5)), (1, 0, 0)),
    ],
)
def test_heading_pitch_roll_point_where_the_gimbal_says(angles, forward, right):
    """Rotations from angles have the expected right and forward axes in East-North-Up."""
    rotation = rotations_from_angles(np.array(angles, dtype=float))
    assert rotation[2] == pytest.approx(forward, abs=1e-12)
    assert rotation[0] == pytest.approx(right, abs=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_angles_survive_the_way_through_rotations():
    """All angles are recovered; looking straight up or down, roll is 0 and heading the image's top."""
    rng = np.random.default_rng(1)
    angles = np.column_stack(
        [rng.uniform(0, 360, 100), rng.uniform(-89, 89, 100), rng.uniform(-179, 179, 100)]
    )
    assert angles_from_rotations(rotations_from_angles(angles)) == pytest.approx(angles, abs=1e-9)
    down = np.array([[123.0, -90.0, 0.0], [300.0, 90.0, 0.0]])
    assert angles_from_rotations(rotations_from_angles(down)) == pytest.approx(down, abs=1e-6)


def test_poses_agree_with_pycolmap_s_projection_center():
    """Conversion from and to COLMAP's cam_from_world agrees with pycolmap; the centre is -R^T t."""
    rng = np.random.default_rng(2)
    quats_xyzw = np.roll(_random_quats(10, 3), -1, axis=1)
    translations = rng.standard_normal((10, 3))
    poses = Poses.from_cam_from_world(quats_xyzw, translations)
    for k in range(10):
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(quats_xyzw[k]), translations[k])
        assert poses.centers[k] == pytest.approx(rigid.inverse().translation, abs=1e-12)
        assert poses.rotations[k] == pytest.approx(rigid.rotation.matrix(), abs=1e-12)
    back_quats, back_translations = poses.to_cam_from_world()
    assert back_quats == pytest.approx(quats_xyzw, abs=1e-12)
    assert back_translations == pytest.approx(translations, abs=1e-12)


def test_points_in_camera_axes_agree_with_pycolmap():
    """Camera coordinates and depths equal pycolmap's, with one pose or one pose per point."""
    rng = np.random.default_rng(5)
    poses = Poses(rng.standard_normal((4, 3)), _random_quats(4, 6))
    points, index = rng.standard_normal((9, 3)), rng.integers(0, 4, 9)
    quats_xyzw, translations = poses.to_cam_from_world()
    rigid = [
        pycolmap.Rigid3d(pycolmap.Rotation3d(q), t)
        for q, t in zip(quats_xyzw, translations, strict=True)
    ]
    expected = np.array([[r * point for point in points] for r in rigid])
    for k in range(4):
        assert poses.to_camera(points, k) == pytest.approx(expected[k], abs=1e-12)
        assert poses.depths(points, k) == pytest.approx(expected[k, :, 2], abs=1e-12)
    assert poses.to_camera(points, index) == pytest.approx(expected[index, range(9)], abs=1e-12)


def test_poses_can_be_picked_and_walked():
    """Poses support masks, slices and iteration."""
    poses = Poses(np.arange(12.0).reshape(4, 3), _random_quats(4))
    assert len(poses[np.array([True, False, True, False])]) == 2
    assert poses[1:3].centers[0].tolist() == [3, 4, 5]
    assert [center.tolist() for center, _ in poses][3] == [9, 10, 11]


def test_a_similarity_agrees_with_pycolmap_s_estimate():
    """Umeyama's fit to noisy points equals pycolmap's estimate."""
    rng = np.random.default_rng(4)
    source = rng.standard_normal((30, 3))
    true = Similarity(
        2.5, rotations_from_vectors(np.array([0.3, -2.0, 1.0])), np.array([5.0, 0, -7])
    )
    target = true.apply(source) + 0.05 * rng.standard_normal((30, 3))
    ours = Similarity.fit(source, target)
    theirs = pycolmap.estimate_sim3d(source, target)
    assert theirs is not None
    assert ours.scale == pytest.approx(theirs.scale, rel=1e-9)
    assert ours.rotation == pytest.approx(theirs.rotation.matrix(), abs=1e-9)
    assert ours.translation == pytest.approx(theirs.translation, abs=1e-9)
    assert 1e-5 < abs(ours.scale - true.scale) < 0.1


def test_a_similarity_never_mirrors():
    """Fitting points to their mirror image gives a proper rotation."""
    source = np.random.default_rng(5).standard_normal((20, 3))
    fit = Similarity.fit(source, source * [1, 1, -1])
    assert np.linalg.det(fit.rotation) == pytest.approx(1)


def test_a_plane_is_enough_for_a_similarity_and_a_line_is_not():
    """Coplanar points determine a similarity; collinear, coincident or two points do not."""
    rng = np.random.default_rng(6)
    flat = np.column_stack([rng.standard_normal((10, 2)), np.zeros(10)])
    true = Similarity(3.0, rotations_from_vectors(np.array([1.0, 2.0, 0.5])), np.ones(3))
    assert Similarity.fit(flat, true.apply(flat)).rotation == pytest.approx(true.rotation, abs=1e-9)
    line = np.outer(np.arange(10.0), [1, 2, 3])
    for points in (line, np.zeros((5, 3))):
        with pytest.raises(GeometryError, match="collinear"):
            Similarity.fit(points, points)
    with pytest.raises(GeometryError, match="at least 3 points"):
        Similarity.fit(flat, flat, np.array([1.0, 1.0] + [0.0] * 8))


def test_weights_of_a_similarity_count_points_as_often():
    """A weight of two equals a repeated point, and a weight of zero an omitted one."""
    rng = np.random.default_rng(7)
    source, target = rng.standard_normal((6, 3)), rng.standard_normal((6, 3))
    weighted = Similarity.fit(source, target, np.array([2.0, 1, 1, 1, 1, 0]))
    index = [0, 0, 1, 2, 3, 4]
    repeated = Similarity.fit(source[index], target[index])
    assert weighted.apply(source) == pytest.approx(repeated.apply(source), abs=1e-12)


def test_similarities_compose_and_invert():
    """``c_from_b @ b_from_a`` applies b_from_a first; the inverse undoes a transform, also for cameras."""
    b_from_a = Similarity(
        2.0, rotations_from_vectors(np.array([0.1, 0.2, 0.3])), np.array([1.0, 2, 3])
    )
    c_from_b = Similarity(
        0.5, rotations_from_vectors(np.array([-1.0, 0, 2])), np.array([0.0, -1, 4])
    )
    points = np.random.default_rng(8).standard_normal((7, 3))
    assert (c_from_b @ b_from_a).apply(points) == pytest.approx(
        c_from_b.apply(b_from_a.apply(points))
    )
    assert (b_from_a.inverse() @ b_from_a).apply(points) == pytest.approx(points)
    poses = Poses(points, _random_quats(7))
    error_m, error_deg = pose_errors(
        b_from_a.inverse().apply_to_poses(b_from_a.apply_to_poses(poses)), poses
    )
    assert error_m.max() < 1e-12
    assert error_deg.max() < 1e-6


def test_a_moved_camera_still_sees_its_points_at_the_same_pixels():
    """A similarity scales camera coordinates, so projections do not change."""
    b_from_a = Similarity(
        3.0, rotations_from_vectors(np.array([0.4, -1.0, 0.3])), np.array([9.0, 2, 3])
    )
    poses = Poses(np.random.default_rng(9).standard_normal((4, 3)), _random_quats(4))
    point = np.array([5.0, -2.0, 3.0])
    moved = b_from_a.apply_to_poses(poses)
    seen = np.einsum("nij,nj->ni", poses.rotations, point - poses.centers)
    seen_after = np.einsum("nij,nj->ni", moved.rotations, b_from_a.apply(point) - moved.centers)
    assert seen_after == pytest.approx(3.0 * seen, abs=1e-12)


def test_poses_are_put_together_and_at_rows_and_the_rest_is_unknown():
    """Rows without a pose are NaN, never the identity; concatenating nothing gives no poses."""
    some = Poses(np.array([[1.0, 2, 3], [4, 5, 6]]), np.array([[1.0, 0, 0, 0], [0, 1, 0, 0]]))
    both = Poses.concatenate([some[1:], some])
    assert both.centers[:, 0].tolist() == [4, 1, 4]
    spread = some.at_rows([2, 0], 4)
    assert spread.centers[:, 0].tolist()[::2] == [4, 1]
    assert np.isnan(spread.centers[1::2]).all()
    assert np.isnan(spread.quats_wxyz[1::2]).all()
    assert len(Poses.concatenate([])) == 0
