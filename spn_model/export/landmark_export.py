"""Landmark map of a bundle: chosen from the map that its data set was made from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spn_data.area.names import GEO
from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import Role
from spn_data.errors import InputError
from spn_data.inputs.landmark_source import LandmarkSource
from spn_data.matching.features import FeatureOptions
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
    source: LandmarkSource,
    data: Dataset,
    network: str,
    offset: np.ndarray,
    *,
    max_bytes: int,
) -> LandmarkSummary:
    """Choose the landmarks of a map for a bundle, and write them.

    Parameters
    ----------
    path : Path
        Target file.
    source : LandmarkSource
        The map that the data set was made from.
    data : Dataset
        Supplies the names of the training frames.
    network : str
        SHA-256 of the float32 graph.
    offset : ndarray, shape (3,)
        Of the view of the bundle.
    max_bytes : int

    Returns
    -------
    LandmarkSummary

    Raises
    ------
    InputError
        If the data set was made from another map, or a map this small holds no landmark.
    """
    if data.info.fingerprints.get(GEO) != source.fingerprint:
        raise InputError(
            "was not made from the map of this area, so landmarks of that map would not fit its network; "
            "give the data set of the area, or --map-mb 0 to export without landmarks",
            path=data.path,
        )
    facts = LandmarkFacts(
        features=FEATURES, noise_px=_NOISE_PX, map_hash=source.map_hash, network=network
    )
    chosen, frames = select_landmarks(
        source, training_names(data), offset, facts, max_bytes=max_bytes
    )
    chosen.save(path)
    return LandmarkSummary(
        landmarks=len(chosen), descriptors=len(chosen.descriptors), training_frames=frames
    )


def training_names(data: Dataset) -> set[str]:
    """Return the names of the training frames, the only ones that a bundle is made from."""
    return {str(name) for group in data.of_role(Role.TRAIN) for name in group.names}
