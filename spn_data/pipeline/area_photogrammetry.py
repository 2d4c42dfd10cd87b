"""Photogrammetric facts of an area for its report, from the map and the stored calibrations."""

from __future__ import annotations

from typing import Any

import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import CAMERA, EVALUATION, MODEL
from spn_data.errors import FormatError, GeometryError
from spn_data.geometry.camera import Camera
from spn_data.inputs.area_labels import LabelledArea
from spn_data.labels.labels import LabelObservations, Labels
from spn_data.orthophoto.ground import fit_ground
from spn_data.orthophoto.views import ground_views
from spn_data.report.photogrammetry_facts import (
    LensCalibration,
    LensFacts,
    Overlap,
    Photogrammetry,
    calibration_of,
    check_calibration,
    position_covariances,
    reprojection_errors,
)
from spn_data.storage.json_files import DAMAGE, read_json


def photogrammetry_of(area: Area, labelled: LabelledArea) -> Photogrammetry:
    """Collect the photogrammetric facts of an area.

    Parameters
    ----------
    area : Area
    labelled : LabelledArea
        Its labels.

    Returns
    -------
    Photogrammetry

    Raises
    ------
    FormatError
        If a stored calibration is damaged.
    """
    stored = _map_calibrations(area, labelled.cameras)
    lenses = [
        _lens(labelled, key, stored.get(key), labelled.mapping, labelled.mapping_seen)
        for key in np.unique(labelled.mapping.cameras[labelled.mapping.registered]).tolist()
    ]
    for name, labels in labelled.evaluation.items():
        calibration = _evaluation_calibration(area, name, labelled.cameras[name])
        lenses.append(
            _lens(
                labelled,
                name,
                calibration,
                labels,
                labelled.evaluation_seen[name],
                is_evaluation=True,
            )
        )
    overlap, reason = _overlap(labelled)
    return Photogrammetry(
        lenses=tuple(lenses),
        track_lengths=labelled.points.track_lengths,
        positions=position_covariances([labelled.mapping, *labelled.evaluation.values()]),
        overlap=overlap,
        no_overlap=reason,
    )


def _lens(
    labelled: LabelledArea,
    key: str,
    calibration: LensCalibration | None,
    labels: Labels,
    seen: LabelObservations,
    *,
    is_evaluation: bool = False,
) -> LensFacts:
    mine = labels.registered & ~labels.tracked
    if not is_evaluation:
        mine &= labels.cameras == key
    rows, camera = np.flatnonzero(mine), labelled.cameras[key]
    errors = reprojection_errors(labels, seen, labelled.points, camera, rows)
    return LensFacts(key, is_evaluation, camera, len(rows), calibration, errors)


def _map_calibrations(area: Area, cameras: dict[str, Camera]) -> dict[str, LensCalibration]:
    """Return the stored accuracies of the lenses of the map; areas of earlier versions have none."""
    found = {}
    for key, value in area.record(MODEL).counts.get("cameras", {}).items():
        if "sigma" not in value or key not in cameras:
            continue
        try:
            found[key] = _map_calibration(value, cameras[key])
        except DAMAGE as error:
            raise FormatError(
                f"{area.folder(MODEL)}: the calibration of camera {key!r} cannot be read ({error}); "
                "run spn-data reconstruct again"
            ) from error
    return found


def _map_calibration(value: dict[str, Any], camera: Camera) -> LensCalibration:
    names = tuple(value["estimated"])
    sigma, correlation = np.array(value["sigma"], float), np.array(value["correlation"], float)
    calibration = LensCalibration(names, sigma, correlation)
    check_calibration(calibration, camera)
    point = np.array(value["principal_point_sigma_px"], float)
    if not len(point):
        return calibration
    if point.shape != (2,) or np.any(point < 0):
        raise ValueError("the sigma of the principal point are not two numbers")
    # The adjustment holds the principal point; what the images say about it has no correlations.
    n = len(names)
    wider = np.full((n + 2, n + 2), np.nan)
    wider[:n, :n] = correlation
    return LensCalibration((*names, "cx", "cy"), np.concatenate([sigma, point]), wider)


def _evaluation_calibration(area: Area, name: str, camera: Camera) -> LensCalibration | None:
    """Return the accuracy in camera.json of an evaluation sequence; None if it has none."""
    path = area.folder(f"{EVALUATION}/{name}") / CAMERA
    value = read_json(path)
    if "covariance" not in value:
        return None
    try:
        names = tuple(str(one) for one in value["estimated"])
        covariance = np.array(value["covariance"], float)
        if covariance.shape != 2 * (len(names),) or not np.isfinite(covariance).all():
            raise ValueError("the covariance is not a square of numbers")
        if np.any(np.diag(covariance) < 0):
            raise ValueError("a variance is negative")
        calibration = calibration_of(names, covariance)
        check_calibration(calibration, camera)
    except DAMAGE as error:
        raise FormatError(
            f"{path}: the calibration cannot be read ({error}); run spn-data register again"
        ) from error
    return calibration


def _overlap(labelled: LabelledArea) -> tuple[Overlap | None, str]:
    """Return how many mapping frames see each cell of the ground, or why that is unknown."""
    if labelled.units != "m":
        return None, "the map is not georegistered, so that up and the ground are unknown"
    rows = np.flatnonzero(labelled.mapping.registered)
    poses = labelled.mapping.poses[rows]
    try:
        ground = fit_ground(labelled.points.xyz, poses.centers)
    except GeometryError as error:
        return None, str(error)
    views = ground_views(ground, poses, labelled.cameras, labelled.mapping.cameras[rows])
    count = np.where(np.isfinite(ground.height_m), views.count, -1)
    return Overlap(ground.low, ground.cell_m, count, poses.centers[:, :2]), ""
