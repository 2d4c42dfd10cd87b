"""Images of the evaluation sequences of an area with their labels, in the order of time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import EVALUATION, TRACK
from spn_data.errors import InputError
from spn_data.geometry.camera import Camera
from spn_data.inputs.area_labels import map_folder, read_labelled_area
from spn_data.inputs.frame_images import frame_images
from spn_data.labels.labels import Labels
from spn_data.labels.map_hash import map_hash


@dataclass(frozen=True, eq=False, kw_only=True)
class EvaluationFlight:
    """An evaluation sequence.

    Attributes
    ----------
    name : str
    camera : Camera
        In pixels of the full-size images.
    labels : Labels
        Chosen and tracked frames, sorted by time; frames without a pose too.
    area : Area
    video_folder : Path or None
        Where to look first for the video.
    """

    name: str
    camera: Camera
    labels: Labels
    area: Area = field(repr=False)
    video_folder: Path | None = None

    @property
    def telemetry(self) -> Path:
        """Its telemetry on the clock of the images, a CSV table; it may not exist."""
        return self.area.folder(f"{EVALUATION}/{self.name}") / TRACK

    def images(self, rows: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Iterate over the full-size images of frames, in the order of `rows`, which have to be ascending.

        Yields rows and images (H, W, 3), BGR. Raises InputError if a file cannot be read, StageError if the
        video of tracked frames is not found.
        """
        chosen = self.labels.select(rows)
        for k, image in frame_images(self.area, chosen, video_folder=self.video_folder):
            yield int(rows[k]), image


@dataclass(frozen=True, eq=False, kw_only=True)
class EvaluationFlights:
    """All evaluation sequences of an area whose labels are in metres.

    Attributes
    ----------
    flights : tuple of EvaluationFlight
        Those of which a frame has a pose.
    map_hash : str
        Hash of the map that the labels refer to.
    """

    flights: tuple[EvaluationFlight, ...]
    map_hash: str


def read_evaluation_flights(area: Area, *, video_folder: Path | None = None) -> EvaluationFlights:
    """Read the evaluation sequences of a georeferenced area.

    Parameters
    ----------
    area : Area
    video_folder : Path, optional
        Where to look first for the videos.

    Returns
    -------
    EvaluationFlights

    Raises
    ------
    InputError
        If the area is not georeferenced, or has no evaluation sequence with a pose.
    StageError
        If a stage is missing or stale.
    FormatError
        If a file is damaged.
    """
    found = read_labelled_area(area, mapping_covariance=False)
    if found.units != "m":
        raise InputError("is not georeferenced, so its labels have no metres", path=area.root)
    flights = tuple(
        EvaluationFlight(
            name=name,
            camera=found.cameras[name],
            labels=labels,
            area=area,
            video_folder=video_folder,
        )
        for name, labels in found.evaluation.items()
        if labels.registered.any()
    )
    if not flights:
        raise InputError(
            "has no evaluation flight with a pose; register one with spn-data register",
            path=area.root,
        )
    return EvaluationFlights(flights=flights, map_hash=map_hash(map_folder(area)))
