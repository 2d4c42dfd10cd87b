"""Direction of up in the model, from gimbal angles or from cameras that fly level on average."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.errors import GeometryError

# Gimbals are accurate to a few tenths of a degree; the angles of another flight are off by degrees.
_FOREIGN_DEG = 2.0


@dataclass(frozen=True, eq=False)
class Gravity:
    """Direction of up in the model, estimated from the cameras alone.

    direction : (3,) unit vector, None if undetermined; usable : (N,) bool, frames whose gimbal angles agree
    with the reconstruction; notes : one sentence per flight whose angles disagree.
    """

    direction: np.ndarray | None
    usable: np.ndarray
    notes: tuple[str, ...]


def robust_direction(directions: np.ndarray) -> np.ndarray:
    """Return the geometric median (3,) of unit directions (K, 3), by Weiszfeld's algorithm."""
    middle = np.median(directions, axis=0)
    for _ in range(100):
        weight = 1 / np.maximum(np.linalg.norm(directions - middle, axis=1), 1e-9)
        middle = weight @ directions / weight.sum()
    return middle / np.linalg.norm(middle)


def gravity_from_gimbal(
    cam_from_model: np.ndarray,
    up_cam: np.ndarray,
    flight: np.ndarray,
    flights: tuple[str, ...],
    agreement_deg: float,
) -> Gravity:
    """Estimate up in the model from gimbal angles, after testing each flight against the reconstruction.

    cam_from_model : (N, 3, 3); up_cam : (N, 3), NaN if unknown. A flight is used if at least two thirds of
    its frames are within `agreement_deg` of its median direction, and that direction is within
    `agreement_deg` of the other flights' direction. Raises GeometryError if a flight's gimbal angles change
    differently from its cameras' orientations, because they then belong to another flight.
    """
    up_model = np.einsum("nji,nj->ni", cam_from_model, up_cam)
    known = np.isfinite(up_model).all(axis=1)
    usable = np.zeros(len(known), dtype=bool)
    notes = []
    for f, name in enumerate(flights):
        mine = known & (flight == f)
        if not mine.any():
            continue
        angle = angles_deg(up_model[mine], robust_direction(up_model[mine]))
        _require_own_telemetry(name, up_cam[mine], float(np.median(angle)))
        if np.mean(angle < agreement_deg) < 2 / 3:
            notes.append(
                f"{name}: gimbal angles disagree with the model's rotations "
                f"(median {np.median(angle):.1f} deg) and are not used."
            )
            continue
        usable[np.flatnonzero(mine)[angle < agreement_deg]] = True
    if not usable.any():
        return Gravity(None, usable, tuple(notes))
    direction = robust_direction(up_model[usable])
    for f, name in enumerate(flights):
        mine = usable & (flight == f)
        if not mine.any():
            continue
        off_deg = float(np.median(angles_deg(up_model[mine], direction)))
        if off_deg > agreement_deg:
            notes.append(
                f"{name}: gimbal angles disagree with other flights by {off_deg:.1f} deg "
                "and are not used."
            )
            usable &= ~mine
    return Gravity(direction, usable, tuple(notes))


def _require_own_telemetry(name: str, up_cam: np.ndarray, disagreement_deg: float) -> None:
    """Raise GeometryError if gimbal angles change, but not with the camera.

    Constant angles are accepted because they may simply never have been recorded.
    """
    moved_deg = float(np.median(angles_deg(up_cam, robust_direction(up_cam))))
    if min(moved_deg, disagreement_deg) > _FOREIGN_DEG:
        raise GeometryError(
            f"{name}: the gimbal angles vary by {moved_deg:.1f} deg, but not with the camera (median "
            f"disagreement {disagreement_deg:.1f} deg): this may be the telemetry of another flight, or its "
            "clock may be off by seconds. Put the right file next to the video, or use --time-offset or "
            "--ignore-gimbal"
        )


def angles_deg(directions: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the angles (K,) in degrees between unit directions (K, 3) and one direction (3,)."""
    sine = np.linalg.norm(np.cross(directions, direction), axis=1)
    return np.rad2deg(np.arctan2(sine, directions @ direction))


def up_from_level_cameras(cam_from_model: np.ndarray) -> tuple[np.ndarray, float]:
    """Estimate up in the model assuming level cameras; also return how well it is determined (0 to 1).

    For a level camera the image x axis is horizontal, so up is the direction most orthogonal to the x axes of
    all frames. This requires cameras that look in different directions. The sign follows the image's top.
    """
    right, top = cam_from_model[:, 0], -cam_from_model[:, 1]
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    up = vectors[:, 0]
    up = up * (1.0 if np.median(top @ up) >= 0 else -1.0)
    return up, float(values[1] - values[0])
