"""The direction of up in the model: from gimbal angles, or from cameras that fly level on average."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.errors import GeometryError

# Gimbals hold their angles to a few tenths of a degree; another flight's are degrees off.
_FOREIGN_DEG = 2.0


@dataclass(frozen=True, eq=False)
class Gravity:
    """Up in the model by the cameras alone.

    direction : (3,) unit, or None where nothing says it; usable : (N,) bool, frames whose gimbal angles agree
    with the reconstruction; notes : flights whose angles do not.
    """

    direction: np.ndarray | None
    usable: np.ndarray
    notes: tuple[str, ...]


def robust_direction(directions: np.ndarray) -> np.ndarray:
    """The direction (3,) with the smallest sum of distances to unit directions (K, 3) (Weiszfeld)."""
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
    """Up in the model from gimbal angles, each flight's tested against the reconstruction's own rotations.

    cam_from_model (N, 3, 3); up_cam (N, 3), NaN unknown. A flight is used where at least two thirds of its
    frames lie within `agreement_deg` of its median direction, and this within it of the other flights'.
    Raises GeometryError where a flight's angles move, but not as its cameras do: they are another flight's.
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
                f"{name}: gimbal angles disagree with the model's own rotations "
                f"(median {np.median(angle):.1f} deg): not used."
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
                f"{name}: gimbal angles disagree with other flights by {off_deg:.1f} deg: not used."
            )
            usable &= ~mine
    return Gravity(direction, usable, tuple(notes))


def _require_own_telemetry(name: str, up_cam: np.ndarray, disagreement_deg: float) -> None:
    """A gimbal that stands still may be one that was never written; one that moves must move rightly."""
    moved_deg = float(np.median(angles_deg(up_cam, robust_direction(up_cam))))
    if min(moved_deg, disagreement_deg) > _FOREIGN_DEG:
        raise GeometryError(
            f"{name}: its gimbal angles move by {moved_deg:.1f} deg, but not with its camera "
            f"(median disagreement {disagreement_deg:.1f} deg): is this telemetry of another flight, or "
            "its clock off by seconds? Put the right file beside the video, give --time-offset, or "
            "--ignore-gimbal"
        )


def angles_deg(directions: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Angles (K,) in degrees between unit directions (K, 3) and one (3,)."""
    sine = np.linalg.norm(np.cross(directions, direction), axis=1)
    return np.rad2deg(np.arctan2(sine, directions @ direction))


def level_up(cam_from_model: np.ndarray) -> tuple[np.ndarray, float]:
    """Up in the model if cameras fly level, and how well that is determined (0 no, 1 perfectly).

    The image's right side is then horizontal in every frame: up is the direction most across all of them,
    which needs cameras that look in different directions. Its sign is that of the image's top.
    """
    right, top = cam_from_model[:, 0], -cam_from_model[:, 1]
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    up = vectors[:, 0]
    up = up * (1.0 if np.median(top @ up) >= 0 else -1.0)
    return up, float(values[1] - values[0])
