"""Limits between which COLMAP believes a focal length."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

# Of the longer image side. Shorter focal lengths (127 degrees) only fit the noise of a weak geometry; longer
# ones are of telephoto lenses, which have to be stated.
_SHORTEST, _LONGEST = 0.25, 10.0
_CHANGE = 2.0  # factor by which a longer one may still change


def limit_focal_lengths(options: Any, cameras: Iterable[Any]) -> None:
    """Set the limits of COLMAP's options so that the initial focal lengths of its cameras are within them."""
    options.min_focal_length_ratio = _SHORTEST
    options.max_focal_length_ratio = max(
        [_LONGEST, *(_CHANGE * c.mean_focal_length() / max(c.width, c.height) for c in cameras)]
    )
