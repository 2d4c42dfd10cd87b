"""What every export is made of: frames with poses, and how to say what their lengths mean."""

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

    units : "m" (East-North-Up about `origin`) or "model" (a model's own unit; origin is None).
    is_evaluation : (N,) bool, of an evaluation sequence, which is no part of the map.
    seen : map points that the frames see; points : of the map; cameras : by the labels' keys.
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
        return self.cameras[str(self.labels.cameras[row])]

    def sequences(self) -> Iterator[tuple[str, np.ndarray]]:
        """(name, rows (K,) in the order of time) of each sequence."""
        for name in sorted(set(self.labels.sequences.tolist())):
            yield name, np.flatnonzero(self.labels.sequences == name)

    @property
    def world(self) -> str:
        """The world frame in one line, for the head of a file."""
        if self.origin is None:
            return "units: model (COLMAP's own origin, axes and unit; not metres)"
        o = self.origin
        return (
            f"units: m; axes: east north up; origin: latitude {o.lat_deg:.10f} longitude {o.lon_deg:.10f} "
            f"height {o.alt_m:.4f} above {o.height_reference.value}"
        )

    def required_origin(self, what: str) -> GeoOrigin:
        """Raises StageError where the area has no place in the world."""
        if self.origin is None:
            raise StageError(
                f"{what} needs a place in the world, and the area has none; "
                "run spn-data georegister, or export tum, nerfstudio, kapture, colmap or nvm"
            )
        return self.origin


def timestamps_us(time_s: np.ndarray) -> list[int]:
    """Ascending whole microseconds of ascending times (N,), no two the same.

    Photos of one second, or without times, follow each other by a microsecond: their order is kept.
    """
    stamps: list[int] = []
    for second in time_s.tolist():
        stamp = round(second * 1e6)
        stamps.append(max(stamp, stamps[-1] + 1) if stamps else stamp)
    return stamps
