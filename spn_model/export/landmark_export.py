"""Landmark map of a bundle: chosen from the map of an area, and calibrated on frames that are not in it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import DATABASE, GEO, MODEL, SPLIT
from spn_data.colmap.model import Scene, read_scene
from spn_data.dataset.hdf5_reader import Dataset
from spn_data.dataset.hdf5_schema import Role
from spn_data.errors import InputError, SpnError
from spn_data.geometry.rotations import rotation_vectors
from spn_data.inputs.frame_images import image_path
from spn_data.labels.map_hash import map_hash
from spn_data.matching.features import FeatureOptions, extract
from spn_data.work.timing import Progress
from spn_model.evaluation.validation import spread_rows
from spn_model.export.landmark_selection import select_landmarks
from spn_model.landmarks.landmark_map import LandmarkFacts, LandmarkMap
from spn_model.landmarks.matching import ImageFeatures
from spn_model.landmarks.search import search

FEATURES = FeatureOptions(max_features=1024, max_image_size_px=640)
_NOISE_PX = 0.3  # before it is measured
_MAX_FRAMES = 40  # that noise and covariances are measured on
_MIN_FRAMES = 5
_UNMEASURED_FACTOR = 4.0
_MAX_TRUE_SIGMAS = 30.0  # poses farther off are wrong ones, which no factor should cover


@dataclass(frozen=True, kw_only=True)
class LandmarkSummary:
    """What the landmark map of a bundle holds, and what was measured when it was made.

    Attributes
    ----------
    landmarks, descriptors : int
    training_frames : int
        Of the map; nothing of other frames enters.
    calibration_frames : int
        Validation frames that noise and covariances were measured on; 0 if there are too few.
    noise_px : float
        Standard deviation of a measurement along one axis, at the width of detection.
    covariance_factor : float
        Factor on covariances of poses.
    """

    landmarks: int
    descriptors: int
    training_frames: int
    calibration_frames: int
    noise_px: float
    covariance_factor: float


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
    """Choose the landmarks of an area's map for a bundle, measure their noise, and write them.

    Parameters
    ----------
    path : Path
        Target file.
    area : Area
        Area with the map that the data set was made from.
    data : Dataset
        Supplies the names of training and validation frames.
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
    others = [str(name) for group in data.of_role(Role.VALIDATION) for name in group.names]
    facts = LandmarkFacts(
        features=FEATURES,
        noise_px=_NOISE_PX,
        covariance_factor=1.0,
        map_hash=map_hash(geo),
        network=network,
    )
    progress("landmarks", 0, 1)
    chosen = select_landmarks(
        geo, area.folder(MODEL) / DATABASE, training, offset, facts, max_bytes=max_bytes
    )
    chosen.save(path)
    scene = read_scene(geo)
    rows = [row for row, name in enumerate(scene.names) if name in set(others) - training]
    rows = [rows[k] for k in spread_rows(len(rows), _MAX_FRAMES)] if rows else []
    facts, measured = _calibrated(LandmarkMap.load(path), area, scene, rows, offset, progress)
    replace(chosen, facts=facts).save(path)
    return LandmarkSummary(
        landmarks=len(chosen),
        descriptors=len(chosen.descriptors),
        training_frames=len(training & set(scene.names)),
        calibration_frames=measured,
        noise_px=facts.noise_px,
        covariance_factor=facts.covariance_factor,
    )


def _calibrated(
    landmarks: LandmarkMap,
    area: Area,
    scene: Scene,
    rows: list[int],
    offset: np.ndarray,
    progress: Progress,
) -> tuple[LandmarkFacts, int]:
    """Measure noise and covariance factor on frames of known pose; return the facts and how many counted."""
    spread, normalised = [], []
    for done, row in enumerate(rows):
        progress("landmarks", done, len(rows))
        name = scene.names[row]
        image = cv2.imread(str(image_path(area, name, name.split("/")[0])), cv2.IMREAD_GRAYSCALE)
        if image is None:
            continue
        camera = scene.cameras[int(scene.camera_ids[row])]
        found_features = extract(image, None, FEATURES)
        features = ImageFeatures.of(found_features, camera, FEATURES.max_image_size_px)
        try:
            found = search(landmarks, features)
        except SpnError:
            continue
        if found is None:
            continue
        pose = found.best.pose
        turn = scene.poses.rotations[row] @ pose.rotation.T
        error = np.concatenate(
            [scene.poses.centers[row] - offset - pose.center, rotation_vectors(turn[None])[0]]
        )
        chi_sq = float(error @ pose.information @ error)
        if chi_sq < 6 * _MAX_TRUE_SIGMAS**2:
            spread.append(1.4826 * float(np.median(np.abs(pose.residuals[pose.inliers]))))
            normalised.append(chi_sq / 6)
    facts = landmarks.facts
    if len(spread) < _MIN_FRAMES:
        return replace(facts, covariance_factor=_UNMEASURED_FACTOR), 0
    scale = float(np.median(spread))
    return replace(
        facts,
        noise_px=facts.noise_px * scale,
        covariance_factor=max(1.0, float(np.mean(normalised)) / scale**2),
    ), len(spread)
