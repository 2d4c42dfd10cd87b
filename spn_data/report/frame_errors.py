"""Errors of single frames by one method, as the evaluation of a network wrote them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class FlightErrors:
    """Errors of one method on N frames.

    Attributes
    ----------
    method : str
        Network, or fixes of its bundle.
    names : ndarray of str, shape (N,)
    error : ndarray, shape (N,)
        Distance of the estimated position from the label, in the map's unit; NaN without an estimate.
    error_deg : ndarray, shape (N,)
        Angle between the estimated and the labelled rotation.
    """

    method: str
    names: np.ndarray
    error: np.ndarray
    error_deg: np.ndarray

    def at(self, names: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return whether frames (M,) were asked, with their error and angle; NaN if not."""
        row = {name: k for k, name in enumerate(self.names.tolist())}
        index = np.array([row.get(name, -1) for name in names.tolist()], dtype=np.int64)
        asked = index >= 0
        if not len(self.names):
            return asked, np.full(len(names), np.nan), np.full(len(names), np.nan)
        return (
            asked,
            np.where(asked, self.error[index], np.nan),
            np.where(asked, self.error_deg[index], np.nan),
        )
