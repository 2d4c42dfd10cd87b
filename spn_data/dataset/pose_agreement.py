"""Agreement of the poses of a list and of a model, and the name of the convention that separates them."""

from __future__ import annotations

import numpy as np

from spn_data.errors import GeometryError
from spn_data.geometry.pose import Poses, Similarity, pose_errors
from spn_data.geometry.rotations import canonical_quats, conjugate_quats

# If poses of list and model differ by more, they refer to different worlds, or to different versions of one.
_SAME_POSITION_SHARE = 1e-3  # of the frames' median distance from their middle
_SAME_ROTATION_DEG = 0.1
_EXPLAINED_SHARE = 0.9
_ROLLS = {
    90: (1, 1),
    180: (0, 1),
    270: (1, -1),
}  # cosine and sine of half the angle, up to a factor


def same_poses(poses: Poses, others: Poses) -> np.ndarray:
    """Return which poses agree.

    Parameters
    ----------
    poses, others : Poses
        N poses each.

    Returns
    -------
    ndarray of bool, shape (N,)
        Whether the centres differ by at most a thousandth of the median distance of `others` from their
        middle, and the rotations by at most 0.1 degrees.
    """
    if not len(poses):
        return np.zeros(0, dtype=bool)
    distance, angle_deg = pose_errors(others, poses)
    spread = np.median(np.linalg.norm(others.centers - np.median(others.centers, axis=0), axis=1))
    far = _SAME_POSITION_SHARE * spread + 1e-5
    return np.asarray((distance <= far) & (angle_deg <= _SAME_ROTATION_DEG))


def name_disagreement(listed: Poses, model: Poses) -> str:
    """Return how poses of a list would have to be read to agree with those of a model.

    Parameters
    ----------
    listed, model : Poses
        N poses of the same images that disagree.

    Returns
    -------
    str
        The convention that explains at least 90 % of them, as a sentence that says what to do; empty if none
        does.
    """
    for rotation, quats in _readings_of_rotation(listed.quats_wxyz):
        for position, centers in _readings_of_position(listed.centers, quats):
            sentence = " and ".join(part for part in (rotation, position) if part)
            if sentence and same_poses(Poses(centers, quats), model).mean() >= _EXPLAINED_SHARE:
                return sentence
    return _other_world(listed, model)


def _readings_of_rotation(quats: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Return all ways to read quaternions (N, 4), with what to do in each case."""
    scalar_last = canonical_quats(quats[:, [3, 0, 1, 2]])
    camera_to_world = "the quaternions rotate camera axes into world axes (conjugate them)"
    order = "the quaternions are in the order x y z w (write w first)"
    opengl = np.array([0.0, 1, 0, 0])  # half a turn about x: y up and z backward
    readings = [
        ("", quats),
        (camera_to_world, conjugate_quats(quats)),
        (order, scalar_last),
        (f"{order} and rotate camera axes into world axes", conjugate_quats(scalar_last)),
    ]
    axes = (
        "the camera's axes are y up and z backward, as in OpenGL (y down and z forward is expected)"
    )
    readings += [
        (axes, _product(opengl, quats)),
        (
            f"{axes} and the quaternions rotate camera axes into world axes",
            _product(opengl, conjugate_quats(quats)),
        ),
    ]
    for angle_deg, (cosine, sine) in _ROLLS.items():
        roll = np.array([cosine, 0, 0, sine]) / np.hypot(cosine, sine)
        readings.append(
            (
                f"the cameras are turned by {angle_deg} degrees about their optical axis (the list is of "
                "images of another orientation)",
                _product(roll, quats),
            )
        )
    return readings


def _readings_of_position(centers: np.ndarray, quats: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Return all ways to read positions (N, 3), given the rotations from world to camera."""
    rotations = Poses(centers, quats).rotations
    return [
        ("", centers),
        (
            "the positions are the translation t = -R C (write the camera's centre C = -R^T t)",
            -np.einsum("nji,nj->ni", rotations, centers),
        ),
        (
            "the positions are -R^T C (write the camera's centre C)",
            -np.einsum("nij,nj->ni", rotations, centers),
        ),
    ]


def _other_world(listed: Poses, model: Poses) -> str:
    """Return how the worlds differ if a similarity maps the positions of one onto those of the other."""
    try:
        listed_from_model = Similarity.fit(model.centers, listed.centers)
    except (GeometryError, ValueError, np.linalg.LinAlgError):
        return ""
    if same_poses(listed_from_model.apply_to_poses(model), listed).mean() < _EXPLAINED_SHARE:
        return ""
    return (
        "the model is moved into the world of the list (1 unit of the model is "
        f"{listed_from_model.scale:.6g} of the list, with other origin or axes)"
    )


def _product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the product of one quaternion (4,) with each of (N, 4): first the right, then the left."""
    w, x, y, z = left
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return canonical_quats(right @ matrix.T)
