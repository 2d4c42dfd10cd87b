"""What GNSS says about the focal lengths of a model, before it is georegistered."""

from __future__ import annotations

from spn_data.area.area import Area
from spn_data.colmap.model import Scene
from spn_data.errors import GeometryError
from spn_data.geometry.initial_lens import GUESS_SIGMA
from spn_data.georegistration.focal_witness import focal_lengths_by_fixes
from spn_data.georegistration.georegister import fit_telemetry
from spn_data.pipeline.geo_stage import (
    GeoStageOptions,
    read_tracks,
    registered_frames,
    telemetry_of,
    time_offsets,
)
from spn_data.reconstruction.correspondences import FramesToMap
from spn_data.reconstruction.focal_trial import Statement
from spn_data.uncertainty.map_covariance import MapCovariance
from spn_data.work.timing import Progress

# Sigma of a time offset that the flight does not determine; a larger one shows as large residuals.
_UNKNOWN_CLOCK_S = 5.0


def focal_lengths_by_gnss(
    area: Area,
    scene: Scene,
    covariance: MapCovariance | None,
    frames: FramesToMap,
    options: GeoStageOptions,
    progress: Progress,
) -> tuple[dict[str, Statement], float]:
    """Return what the fixes of the flights say about the focal length of each camera.

    Parameters
    ----------
    area : Area
        It has stage 1-frames.
    scene : Scene
        The model, in its own gauge.
    covariance : MapCovariance or None
        Its covariance.
    frames : FramesToMap
    options : GeoStageOptions
        How the model will be georegistered.
    progress : Progress

    Returns
    -------
    statements : dict of str to Statement
        By camera; empty if fixes do not determine a georegistration.
    metres : float
        Length of a unit of the model; NaN then.
    """
    tracks = read_tracks(area)
    if covariance is None or not any(track.has_fix.any() for track in tracks.values()):
        return {}, float("nan")
    registered = registered_frames(area, scene)
    try:
        offsets = time_offsets(scene, registered, tracks, options, progress)
        fitted = fit_telemetry(
            scene.poses,
            telemetry_of(registered, tracks, offsets),
            registered.sequences.tolist(),
            registered.time_s,
            options.fit,
        )
    except GeometryError:
        return {}, float("nan")  # stage 3-geo says why
    clock_s = {
        name: _UNKNOWN_CLOCK_S if offset.offset_s is None else offset.sigma_s
        for name, offset in offsets.items()
    }
    changes = covariance.focal_changes()
    key_of = {i: key for key, i in frames.camera_ids(scene).items()}
    focal_px = {key_of[i]: scene.cameras[i].focal_px[0] for i in changes.by_focal}
    found = focal_lengths_by_fixes(
        scene.poses,
        fitted,
        {key_of[i]: change for i, change in changes.by_focal.items()},
        changes.by_lens_errors,
        {key: GUESS_SIGMA * px for key, px in focal_px.items()},
        clock_s,
    )
    statements = {
        key: Statement("GNSS", focal_px[key] + one.shift_px, one.sigma_px)
        for key, one in found.items()
    }
    return statements, fitted.world_from_model.scale
