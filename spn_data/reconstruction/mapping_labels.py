"""Labels of the frames that a model is made from, with the map points that they observe."""

from __future__ import annotations

import numpy as np

from spn_data.capture.frames import Frames
from spn_data.colmap.model import MapObservations, Scene
from spn_data.labels.labels import LabelObservations, Labels
from spn_data.labels.map_points import MapPoints, covered_share
from spn_data.uncertainty.map_covariance import MapCovariance


def mapping_labels(
    chosen: Frames,
    scene: Scene,
    observations: MapObservations,
    points: MapPoints,
    reasons: dict[str, str],
    covariance: MapCovariance | None = None,
) -> tuple[Labels, LabelObservations]:
    """Return labels of the mapping frames in the frame that the model is in.

    Parameters
    ----------
    chosen : Frames
        All N frames that went into reconstruction; those that it left out have no pose.
    scene, observations, points
        The model, as `spn_data.colmap.model.read_map` reads it.
    reasons : dict of str to str
        Why a frame is missing, by name.
    covariance : MapCovariance, optional
        Covariance of the model; without it, those of the frames are NaN.

    Returns
    -------
    labels : Labels
        N rows, with covariances relative to the map.
    seen : LabelObservations
        Map points that the frames observe.
    """
    n = len(chosen)
    row_of = {name: k for k, name in enumerate(chosen.names.tolist())}
    rows = np.array([row_of[name] for name in scene.names], dtype=np.int64)
    inliers, coverage, error_px = np.zeros(n, np.int64), np.zeros(n), np.full(n, np.nan)
    ends = np.searchsorted(observations.image_idx, np.arange(len(scene.names) + 1))
    squared = (observations.residuals_px**2).sum(axis=1)
    for k, row in enumerate(rows):
        mine = slice(ends[k], ends[k + 1])
        camera = scene.cameras[int(scene.camera_ids[k])]
        inliers[row] = mine.stop - mine.start
        coverage[row] = covered_share(observations.pixels[mine], camera.width, camera.height)
        error_px[row] = np.sqrt(squared[mine].mean()) if inliers[row] else np.nan
    covariances = np.full((n, 6, 6), np.nan)
    if covariance is not None:
        covariances[rows] = covariance.pose_covariances()
    labels = Labels.of_frames(
        chosen,
        scene.poses.at_rows(rows, n),
        tracked=False,
        reason=[reasons.get(name, "") for name in chosen.names.tolist()],
        covariance=covariances,
        inliers=inliers,
        coverage=coverage,
        error_px=error_px,
    )
    order = np.argsort(rows[observations.image_idx], kind="stable")
    seen = LabelObservations(
        rows[observations.image_idx][order],
        points.ids[observations.point_idx[order]],
        observations.pixels[order],
    )
    return labels, seen
