"""Limits of COLMAP's options that depend on the focal lengths of the cameras."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

# Of the longer image side. Shorter focal lengths (127 degrees) only fit the noise of a weak geometry; longer
# ones are of telephoto lenses, which have to be stated.
_SHORTEST, _LONGEST = 0.25, 10.0
_CHANGE = 2.0  # factor by which a longer one may still change
_ANGLES = ("create_max_angle_error", "continue_max_angle_error", "re_max_angle_error")


def fit_to_lenses(options: Any, cameras: Iterable[Any]) -> None:
    """Fit the limits of a mapper or of a triangulation to the initial lenses of COLMAP's cameras.

    The angles between a ray and its point are limits for wide lenses: 2 degrees are more than a telephoto
    sees, and any match would become a point.
    """
    ratios = [camera.mean_focal_length() / max(camera.width, camera.height) for camera in cameras]
    options.min_focal_length_ratio = _SHORTEST
    options.max_focal_length_ratio = max([_LONGEST, *(_CHANGE * ratio for ratio in ratios)])
    for name in _ANGLES:
        if hasattr(options, name):
            setattr(options, name, getattr(options, name) / max(1.0, min(ratios)))
