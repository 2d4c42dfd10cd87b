"""Sentences for the user about what a reconstruction tried and found."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spn_data.geometry.camera import Camera
from spn_data.reconstruction.attempts import Attempt
from spn_data.reconstruction.contradiction import Contradiction, FocalChange, ShapeError


def attempt_note(attempt: Attempt, submodels: tuple[int, ...], frames: int) -> str:
    """Return the result of an attempt; `submodels` are numbers of images, largest first."""
    how = f"{attempt.name} attempt{f' ({attempt.why})' if attempt.why else ''}"
    if not submodels:
        return f"{how}: no model"
    rest = f"; sub-models of {', '.join(map(str, submodels[1:]))}" if len(submodels) > 1 else ""
    return f"{how}: {submodels[0]} of {frames} frames in the largest model{rest}"


def misplaced_note(wrong: list[str]) -> str:
    """Return which frames were removed because of wrong poses."""
    return (
        f"{len(wrong)} of them removed again: they match other frames, but observe almost no points of the "
        f"model ({', '.join(wrong[:3])}{', ...' if len(wrong) > 3 else ''})"
    )


def bend_note(bend_m: float) -> str:
    """Return by how much doming was corrected."""
    return (
        f"the model was bent by {bend_m:.1f} m (median): straightened with the flight's positions before "
        "the final bundle adjustment"
    )


def principal_point_note(key: str, camera: Camera, sigma_px: np.ndarray) -> str:
    """Return where a principal point was found, and its standard deviations (2,)."""
    x, y = camera.matrix[:2, 2] - np.array([camera.width, camera.height]) / 2
    return (
        f"camera {key}: the principal point was estimated: {x:+.1f} px across and {y:+.1f} px down "
        f"from the centre of the image (sigma {np.max(sigma_px):.1f} px)"
    )


def contradiction_note(wrong: list[Contradiction]) -> str:
    """Return the worst contradicted pair and the number of others."""
    worst = wrong[0]
    others = f", and {len(wrong) - 1} more such pairs" if len(wrong) > 1 else ""
    return (
        f"parts of the model are inconsistent: {worst.images[0]} and {worst.images[1]} share "
        f"{worst.matches} matches, but its poses explain only {worst.share:.0%} of them{others}"
    )


def shape_note(error: ShapeError) -> str:
    """Return how far the shape of a model is from that of its fixes."""
    return (
        "fixes contradict the shape of the model: distances between cameras are off by "
        f"{error.error_m:.1f} m (median; they are {error.distance_m:.1f} m apart), so places that look alike "
        "may be taken for one, or the fixes belong to another flight"
    )


def checked_note(kept: int, pairs: int) -> str:
    """Return how many pairs were left out because their images may show different places."""
    return (
        f"{pairs - kept} of {pairs} pairs were left out: models of neighbours in time say that their images "
        "show different places that look alike, or do not say that they show the same place"
    )


def drift_note(drifted: list[FocalChange]) -> str:
    """Return the focal lengths that changed too much."""
    lenses = ", ".join(
        f"{one.camera} from {one.known_px:.0f} to {one.estimated_px:.0f} px" for one in drifted
    )
    return f"the focal lengths drifted: {lenses}"


def failure_message(work: Path, frames: int, registered: int, notes: list[str]) -> str:
    """Return why there is no model, and what to do."""
    return (
        f"no usable model: only {registered} of {frames} frames could be registered "
        f"({'; '.join(notes)}). Frames must overlap by at least two thirds, be sharp, and show "
        f"textured, rigid surfaces from changing positions; see COLMAP's log {work / 'mapping.log'}"
    )
