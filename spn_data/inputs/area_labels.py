"""All labels of an area in the world frame: mapping frames, tracked frames, evaluation sequences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import (
    CAMERA,
    EVALUATION,
    FRAMES,
    FRAMES_TABLE,
    GEO,
    GEO_FIT,
    MODEL,
    OBSERVATIONS,
    POSES,
    REGISTRATION,
    TRACKED,
)
from spn_data.capture.frames import Frames, read_frames
from spn_data.colmap.model import MapObservations, Scene, read_map
from spn_data.errors import FormatError
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_from_json
from spn_data.geometry.geodesy import GeoOrigin
from spn_data.geometry.pose import Similarity
from spn_data.georegistration.result import GeoFit
from spn_data.inputs.lens_file import map_lens_priors
from spn_data.labels.labels import LabelObservations, Labels, read_label_observations, read_labels
from spn_data.labels.map_points import MapPoints
from spn_data.reconstruction.mapping_labels import mapping_labels
from spn_data.reconstruction.registration_file import read_reasons
from spn_data.storage.json_files import DAMAGE, read_json, reporting_damage
from spn_data.uncertainty.map_covariance import MapCovariance, MapCovarianceOptions


@dataclass(frozen=True, eq=False)
class LabelledArea:
    """Labels of all frames of an area, with the map and the map points that each frame observes.

    Attributes
    ----------
    units : str
        "m" (East-North-Up about `origin`) or "model" (COLMAP's gauge).
    origin : GeoOrigin or None
        None if the area is not georegistered.
    points : MapPoints
    cameras : dict of str to Camera
        Camera of each key, in pixels of the full-size images.
    mapping, mapping_seen : Labels, LabelObservations
        Chosen frames of the mapping flights.
    tracked, tracked_seen : Labels, LabelObservations
        Tracked frames of the mapping flights.
    evaluation, evaluation_seen : dict of str to Labels, dict of str to LabelObservations
        Chosen and tracked frames of each evaluation sequence, by its name.
    """

    units: str
    origin: GeoOrigin | None
    points: MapPoints
    cameras: dict[str, Camera]
    mapping: Labels
    mapping_seen: LabelObservations
    tracked: Labels
    tracked_seen: LabelObservations
    evaluation: dict[str, Labels]
    evaluation_seen: dict[str, LabelObservations]

    def parts(self) -> list[tuple[Labels, LabelObservations]]:
        """Return mapping frames, their tracked frames, and each evaluation sequence, in this order."""
        return [
            (self.mapping, self.mapping_seen),
            (self.tracked, self.tracked_seen),
            *((self.evaluation[n], self.evaluation_seen[n]) for n in self.evaluation),
        ]


def map_folder(area: Area) -> Path:
    """Return the folder of the map: 3-geo, or 2-model if the area is not georegistered."""
    return area.folder(GEO if area.has(GEO) else MODEL)


def read_labelled_area(
    area: Area, *, mapping_covariance: bool = True, tracked: bool = True
) -> LabelledArea:
    """Read all labels of an area, in metres if it is georegistered.

    Parameters
    ----------
    area : Area
    mapping_covariance : bool
        If false, covariances of mapping frames may be left unknown (NaN), which is faster.
    tracked : bool
        If false, tracked frames are left out and their stages may be stale.

    Returns
    -------
    LabelledArea

    Raises
    ------
    StageError
        If a stage is missing or stale.
    FormatError, InputError
        If a file is damaged.
    """
    area.upstream_of(GEO)  # raises if frames or model are missing or stale
    for stage in area.stages():
        if stage.partition("/")[0] in (GEO, EVALUATION, *([TRACKED] if tracked else [])):
            area.check_fresh(stage)
    scene, observations, points = read_map(map_folder(area))
    chosen = chosen_frames(area)
    mapping, mapping_seen = _mapping_labels(
        area, scene, observations, points, chosen, covariance=mapping_covariance
    )
    cameras = {
        str(key): scene.cameras[int(scene.camera_ids[scene.names.index(name)])]
        for key, name in _camera_samples(chosen, scene).items()
    }
    geo = read_geo(area)
    world_from_model = Similarity.identity() if geo is None else geo.world_from_model
    tracked_names = area.sequences(TRACKED) if tracked else ()
    evaluation, evaluation_seen = {}, {}
    for name in area.sequences(EVALUATION):
        stage = f"{EVALUATION}/{name}"
        parts = [_read_stage(area, stage, world_from_model)]
        if name in tracked_names:
            parts.append(_read_stage(area, f"{TRACKED}/{name}", world_from_model))
        evaluation[name], evaluation_seen[name] = merge_labels(parts)
        cameras[name] = _read_camera(area.folder(stage) / CAMERA)
    tracked_parts = [
        _read_stage(area, f"{TRACKED}/{name}", world_from_model)
        for name in tracked_names
        if name not in evaluation
    ]
    if not tracked_parts:
        no_rows = np.zeros(0, np.int64)
        tracked_parts = [(mapping.select(no_rows), mapping_seen.select(no_rows))]
    tracked_labels, tracked_seen = merge_labels(tracked_parts)
    return LabelledArea(
        units="m" if area.has(GEO) else "model",
        origin=None if geo is None else geo.origin,
        points=points,
        cameras=cameras,
        mapping=mapping,
        mapping_seen=mapping_seen,
        tracked=tracked_labels,
        tracked_seen=tracked_seen,
        evaluation=evaluation,
        evaluation_seen=evaluation_seen,
    )


def chosen_frames(area: Area) -> Frames:
    """Return the frames of the mapping flights that were selected for reconstruction."""
    frames = read_frames(area.folder(FRAMES) / FRAMES_TABLE)
    return frames.select(frames.chosen)


def read_geo(area: Area) -> GeoFit | None:
    """Read the georegistration of an area; None if it has none."""
    if not area.has(GEO):
        return None
    path = area.folder(GEO) / GEO_FIT
    with reporting_damage(path, "a georegistration"):
        return GeoFit.from_json(read_json(path))


def read_world_from_model(area: Area) -> Similarity:
    """Read the similarity from COLMAP's gauge to the frame of the labels: the identity without 3-geo."""
    geo = read_geo(area)
    return Similarity.identity() if geo is None else geo.world_from_model


def _camera_samples(chosen: Frames, scene: Scene) -> dict[str, str]:
    """Return one registered image of each camera key."""
    registered = set(scene.names)
    pairs = zip(chosen.cameras.tolist(), chosen.names.tolist(), strict=True)
    return {key: name for key, name in pairs if name in registered}


def _mapping_labels(
    area: Area,
    scene: Scene,
    map_observations: MapObservations,
    points: MapPoints,
    chosen: Frames,
    *,
    covariance: bool,
) -> tuple[Labels, LabelObservations]:
    """Read the labels written by the model stage; compute them for areas of older versions."""
    folder = area.folder(MODEL)
    if (folder / POSES).exists():
        labels = read_labels(folder / POSES).transformed(read_world_from_model(area))
        return labels, read_label_observations(folder / OBSERVATIONS)
    computed = None
    if covariance:
        options = MapCovarianceOptions(lenses=map_lens_priors(area, scene))
        computed = MapCovariance.of(scene, map_observations, options)
    reasons = read_reasons(folder)
    return mapping_labels(chosen, scene, map_observations, points, reasons, computed)


def _read_stage(
    area: Area, stage: str, world_from_model: Similarity
) -> tuple[Labels, LabelObservations]:
    """Read the labels of one stage in the present world frame: the georegistration may have changed since."""
    folder = area.folder(stage)
    labels = read_labels(folder / POSES)
    written = read_written_world(folder / REGISTRATION)
    if written.to_json() != world_from_model.to_json():
        labels = labels.transformed(world_from_model @ written.inverse())
    return labels, read_label_observations(folder / OBSERVATIONS)


def read_written_world(path: Path) -> Similarity:
    """Read from registration.json the world frame that the labels of a stage were written in.

    Raises FormatError if the file is damaged.
    """
    with reporting_damage(path, "a registration"):
        return Similarity.from_json(read_json(path)["world_from_model"])


def merge_labels(
    parts: Sequence[tuple[Labels, LabelObservations]],
) -> tuple[Labels, LabelObservations]:
    """Concatenate labels with their observations and sort the frames by sequence and time."""
    labels = Labels.concatenate([part for part, _ in parts])
    first = np.cumsum([0, *(len(part) for part, _ in parts)])
    seen = LabelObservations(
        np.concatenate([s.frame_idx + first[k] for k, (_, s) in enumerate(parts)]),
        np.concatenate([s.point_ids for _, s in parts]),
        np.concatenate([s.pixels for _, s in parts]),
    )
    order = np.lexsort((labels.time_s, labels.sequences))
    return labels.select(order), seen.select(order)


def _read_camera(path: Path) -> Camera:
    try:
        return camera_from_json(read_json(path))
    except DAMAGE as error:
        raise FormatError(f"{path}: is not a camera file ({error})") from error
