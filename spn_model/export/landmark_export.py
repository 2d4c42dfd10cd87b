"""Landmark map of a bundle: chosen from the map of an area."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import DATABASE, GEO, MODEL, SPLIT
from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import Role
from spn_data.errors import InputError
from spn_data.labels.map_hash import map_hash
from spn_data.matching.features import FeatureOptions
from spn_data.work.timing import Progress
from spn_model.export.landmark_selection import select_landmarks
from spn_model.landmarks.landmark_map import LandmarkFacts

FEATURES = FeatureOptions(max_features=1024, max_image_size_px=640)
# Of inliers of flights by two renderers 0.2 to 0.35; larger residuals of an image enlarge its covariance.
_NOISE_PX = 0.3


@dataclass(frozen=True, kw_only=True)
class LandmarkSummary:
    """What the landmark map of a bundle holds, and what was measured when it was made.

    Attributes
    ----------
    landmarks, descriptors : int
    training_frames : int
        Of the map; nothing of other frames enters.
    """

    landmarks: int
    descriptors: int
    training_frames: int


def write_landmarks(
    path: Path,
    area: Area,
    data: Dataset,
    network: str,
    offset: np.ndarray,
    progress: Progress,
    *,
    max_bytes: int,
) -> LandmarkSummary:
    """Choose the landmarks of an area's map for a bundle, and write them.

    Parameters
    ----------
    path : Path
        Target file.
    area : Area
        Area with the map that the data set was made from.
    data : Dataset
        Supplies the names of the training frames.
    network : str
        SHA-256 of the float32 graph.
    offset : ndarray, shape (3,)
        Of the view of the bundle.
    progress : Progress
    max_bytes : int

    Returns
    -------
    LandmarkSummary

    Raises
    ------
    InputError
        If the data set was made from another map than that of the area.
    StageError, FormatError
        If the area has no fresh map, or it is damaged.
    """
    made_from, now = data.info.fingerprints.get(GEO), area.upstream_of(SPLIT).get(GEO)
    if made_from is None or made_from != now:
        raise InputError(
            "was not made from the map of this area, so landmarks of that map would not fit its network; "
            "give the data set of the area, or --map-mb 0 to export without landmarks",
            path=data.path,
        )
    geo = area.folder(GEO)
    training = {str(name) for group in data.of_role(Role.TRAIN) for name in group.names}
    facts = LandmarkFacts(
        features=FEATURES,
        noise_px=_NOISE_PX,
        map_hash=map_hash(geo),
        network=network,
    )
    progress("landmarks", 0, 1)
    chosen, frames = select_landmarks(
        geo, area.folder(MODEL) / DATABASE, training, offset, facts, max_bytes=max_bytes
    )
    chosen.save(path)
    return LandmarkSummary(
        landmarks=len(chosen),
        descriptors=len(chosen.descriptors),
        training_frames=frames,
    )
