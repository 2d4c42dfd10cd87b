"""The Python interface to an area: what `spn-data` wrote, as NumPy arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path

from spn_data.area.area import Area
from spn_data.area.names import DATASET, FRAMES, FRAMES_TABLE, RUNS, SPLIT
from spn_data.capture.frames import Frames, read_frames
from spn_data.coverage.nearest_frame import CoverageOptions
from spn_data.coverage.sequence_table import Coverage
from spn_data.errors import InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.geodesy import GeoOrigin
from spn_data.inputs.area_labels import LabelledArea, read_labelled_area
from spn_data.labels.labels import LabelObservations, Labels
from spn_data.labels.map_points import MapPoints
from spn_data.pipeline.area_coverage import compute_coverage

MAPPING = "mapping"
TRACKED_MAPPING = "mapping (tracked)"


@dataclass(frozen=True, eq=False)
class AreaMap:
    """The frozen map of an area.

    Attributes
    ----------
    units : str
        "m" if the area is georegistered (East, North, Up about `origin`), else "model": the unit and the
        axes of the reconstruction, which mean nothing outside of it.
    origin : GeoOrigin or None
        Place of the frame's zero on the globe; None without telemetry.
    points : MapPoints
        Ids, positions, colours and track lengths of the P map points.
    cameras : mapping of str to Camera
        Lenses by key, mapping cameras and those of evaluation sequences, in pixels of full-size images.
    """

    units: str
    origin: GeoOrigin | None
    points: MapPoints
    cameras: Mapping[str, Camera]


class AreaReader:
    """Read an area that `spn-data` made. Nothing is written; files are read when first needed.

    Parameters
    ----------
    path : str or path-like
        Folder of the area.

    Attributes
    ----------
    path : Path
        The folder.

    Raises
    ------
    InputError
        If the folder does not exist.
    StageError
        On access, if a stage that is needed is missing or stale.
    FormatError
        On access, if a file is damaged or was written by a newer version.

    Examples
    --------
    >>> area = spn_data.open_area("fields/north")
    >>> labels = area.labels("medium")
    >>> labels.poses.centers[labels.registered]
    """

    def __init__(self, path: str | PathLike[str]):
        self.path = Path(path)
        if not self.path.is_dir():
            raise InputError("is not a folder", path=self.path)
        self._area = Area(self.path)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.path)!r}, stages={list(self.stages)})"

    @property
    def stages(self) -> tuple[str, ...]:
        """Names of the stages that the area has, in processing order."""
        return self._area.stages()

    @cached_property
    def frames(self) -> Frames:
        """Candidate frames of the mapping flights, chosen or not, with their telemetry."""
        self._area.check_fresh(FRAMES)
        return read_frames(self._area.folder(FRAMES) / FRAMES_TABLE)

    @property
    def sequences(self) -> tuple[str, ...]:
        """Names that `labels` takes: "mapping", "mapping (tracked)", and each evaluation sequence."""
        return (MAPPING, TRACKED_MAPPING, *self._labelled.evaluation)

    @property
    def map(self) -> AreaMap:
        """The frozen map that all labels refer to."""
        found = self._labelled
        return AreaMap(found.units, found.origin, found.points, found.cameras)

    def labels(self, sequence: str = MAPPING) -> Labels:
        """Return the labels of a sequence: poses in the map with covariances, or why there is none.

        Parameters
        ----------
        sequence : str, optional
            "mapping" for the chosen frames of the mapping flights, "mapping (tracked)" for the other
            frames of their videos, or the name of an evaluation sequence (chosen and tracked frames).

        Returns
        -------
        Labels

        Raises
        ------
        InputError
            If there is no such sequence.
        """
        return self._part(sequence)[0]

    def observations(self, sequence: str = MAPPING) -> LabelObservations:
        """Return the map points that the frames of a sequence observe.

        Parameters
        ----------
        sequence : str, optional
            A name as in `labels`; rows refer to the labels of the same sequence.

        Returns
        -------
        LabelObservations

        Raises
        ------
        InputError
            If there is no such sequence.
        """
        return self._part(sequence)[1]

    def coverage(self, sequence: str, options: CoverageOptions | None = None) -> Coverage:
        """Compute how well the mapping frames cover an evaluation sequence.

        Parameters
        ----------
        sequence : str
            Name of an evaluation sequence.
        options : CoverageOptions, optional
            Limits of the strata.

        Returns
        -------
        Coverage
            Per frame: the nearest mapping frame, distance and angle to it, stratum, and the share of the
            view that the map has points for.

        Raises
        ------
        InputError
            If there is no such sequence.
        """
        return compute_coverage(self._labelled, sequence, options)

    @property
    def dataset(self) -> Path:
        """Path of dataset.h5. Raises StageError if the area has no split, or a stale one."""
        self._area.check_fresh(SPLIT)
        return self._area.folder(SPLIT) / DATASET

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the trained networks; `spn_model.read_run` reads one of `run_folder`."""
        names = self._area.sequences(RUNS)
        return tuple(name for name in names if self._area.run_folder(name).is_dir())

    def run_folder(self, name: str) -> Path:
        """Return the folder of a trained network. Raises InputError for an invalid name."""
        return self._area.run_folder(name)

    @cached_property
    def _labelled(self) -> LabelledArea:
        return read_labelled_area(self._area)

    def _part(self, sequence: str) -> tuple[Labels, LabelObservations]:
        found = self._labelled
        parts = {
            MAPPING: (found.mapping, found.mapping_seen),
            TRACKED_MAPPING: (found.tracked, found.tracked_seen),
            **{n: (found.evaluation[n], found.evaluation_seen[n]) for n in found.evaluation},
        }
        if sequence not in parts:
            raise InputError(f"there is no sequence {sequence!r}; the area has: {', '.join(parts)}")
        return parts[sequence]


def open_area(path: str | PathLike[str]) -> AreaReader:
    """Open an area for reading.

    Parameters
    ----------
    path : str or path-like
        Folder that `spn-data reconstruct` made.

    Returns
    -------
    AreaReader

    Raises
    ------
    InputError
        If the folder does not exist.
    """
    return AreaReader(path)
