"""Input shared by all exports: frames with poses, and a description of their world frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from spn_data.errors import StageError
from spn_data.geometry.camera import Camera
from spn_data.geometry.geodesy import GeoOrigin
from spn_data.labels.labels import LabelObservations, Labels
from spn_data.labels.map_points import MapPoints


@dataclass(frozen=True, eq=False)
class ExportedFrames:
    """N frames, all with a pose, sorted by sequence and time.

    Attributes
    ----------
    units : str
        "m" (East-North-Up about `origin`) or "model" (the model's own unit; `origin` is None).
    origin : GeoOrigin or None
        Origin of the world frame; None if the map is not georegistered.
    labels : Labels
        Poses and names of the frames.
    is_evaluation : ndarray of bool, shape (N,)
        Whether the frame belongs to an evaluation sequence, which is not part of the map.
    seen : LabelObservations
        Observations of map points in the frames.
    points : MapPoints
        Points of the map.
    cameras : dict of str to Camera
        Cameras by the keys used in `labels`.
    """

    units: str
    origin: GeoOrigin | None
    labels: Labels
    is_evaluation: np.ndarray
    seen: LabelObservations
    points: MapPoints
    cameras: dict[str, Camera]

    def __len__(self) -> int:
        return len(self.labels)

    def camera_of(self, row: int) -> Camera:
        """Return the camera of a frame."""
        return self.cameras[str(self.labels.cameras[row])]

    def sequences(self) -> Iterator[tuple[str, np.ndarray]]:
        """Yield the name of each sequence with its rows (K,) in temporal order."""
        for name in sorted(set(self.labels.sequences.tolist())):
            yield name, np.flatnonzero(self.labels.sequences == name)

    @property
    def world(self) -> str:
        """One-line description of the world frame for file headers."""
        if self.origin is None:
            return "units: model (COLMAP's own origin, axes and unit; not metres)"
        o = self.origin
        return (
            f"units: m; axes: east north up; origin: latitude {o.lat_deg:.10f} longitude {o.lon_deg:.10f} "
            f"height {o.alt_m:.4f} above {o.height_reference.value}"
        )

    def required_origin(self, what: str) -> GeoOrigin:
        """Return the origin of the world frame; `what` is the format that needs it.

        Raises
        ------
        StageError
            If the map is not georegistered.
        """
        if self.origin is None:
            raise StageError(
                f"{what} needs a georegistered map; run spn-data georegister first, "
                "or export tum, nerfstudio, kapture, colmap or nvm"
            )
        return self.origin


def timestamps_us(time_s: np.ndarray) -> list[int]:
    """Convert ascending times to strictly ascending whole microseconds.

    Photos with the same second, or without times, are spaced one microsecond apart, which keeps their order.

    Parameters
    ----------
    time_s : ndarray, shape (N,)
        Ascending times in seconds.

    Returns
    -------
    list of int
        N timestamps in microseconds, no two equal.
    """
    stamps: list[int] = []
    for second in time_s.tolist():
        stamp = round(second * 1e6)
        stamps.append(max(stamp, stamps[-1] + 1) if stamps else stamp)
    return stamps
