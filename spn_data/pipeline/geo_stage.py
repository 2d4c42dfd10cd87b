"""Stage 3-geo: the model in ENU metres, with the uncertainty of its georegistration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.area.area import Area, StageWork
from spn_data.area.names import FRAMES, FRAMES_TABLE, GEO, GEO_FIT, MODEL, TELEMETRY
from spn_data.capture.frames import Frames, read_frames
from spn_data.colmap.model import Scene, read_scene, write_transformed
from spn_data.errors import FormatError, GeometryError, InputError
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.georegistration.control import Control
from spn_data.georegistration.georegister import georegister as fit
from spn_data.georegistration.georegister_options import GeoregisterOptions, Heights
from spn_data.georegistration.observe import align_telemetry
from spn_data.georegistration.offset import TimeOffset, estimate_time_offset
from spn_data.georegistration.result import GeoFit
from spn_data.inputs.label_move import move_labels
from spn_data.pipeline.ground_control import ControlOptions, read_control
from spn_data.storage.fingerprints import content_fingerprint
from spn_data.storage.json_files import finite, finite_or_none, write_json
from spn_data.storage.stage_record import StageRecord
from spn_data.telemetry.table import read_track
from spn_data.telemetry.track import Telemetry
from spn_data.work.timing import Progress, Stopwatch


@dataclass(frozen=True, kw_only=True)
class GeoStageOptions:
    """Options of georegistration.

    Attributes
    ----------
    fit : GeoregisterOptions
    time_offset_s : mapping of str to float
        Added to the times of the telemetry, by sequence ("*" for all). It is estimated for other sequences.
    control : ControlOptions or None
        Ground control points.
    """

    fit: GeoregisterOptions = field(default_factory=GeoregisterOptions)
    time_offset_s: Mapping[str, float] = field(default_factory=dict)
    control: ControlOptions | None = None


def recorded_options(record: StageRecord) -> GeoStageOptions:
    """Return the options of an earlier georegistration; raise FormatError if they cannot be read."""
    try:
        fit = dict(record.options["fit"])
        sigma, reference, origin = fit["gnss_sigma_m"], fit["height_reference"], fit["origin"]
        bias, control = fit.get("gnss_bias_m"), record.options.get("control")
        if origin is not None:
            place = HeightReference(origin["height_reference"])
            origin = GeoOrigin(**{**origin, "height_reference": place})
        fit |= {
            "gnss_sigma_m": None if sigma is None else tuple(sigma),
            "gnss_bias_m": None if bias is None else tuple(bias),
            "heights": Heights(fit["heights"]),
            "height_reference": None if reference is None else HeightReference(reference),
            "origin": origin,
        }
        if control is not None:
            lists = {"check": tuple(control["check"]), "sigma_m": tuple(control["sigma_m"])}
            control = ControlOptions(**{**control, **lists})
        return GeoStageOptions(
            fit=GeoregisterOptions(**fit),
            time_offset_s=dict(record.options["time_offset_s"]),
            control=control,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{record.stage}: its options cannot be read ({error!r})") from error


def has_fixes(area: Area) -> bool:
    """Return whether any telemetry of the mapping flights has a position."""
    return any(track.has_fix.any() for track in read_tracks(area).values())


def read_tracks(area: Area) -> dict[str, Telemetry]:
    """Return the stored telemetry of each mapping sequence, without time offsets."""
    folder = area.folder(FRAMES) / TELEMETRY
    return {path.stem: read_track(path) for path in sorted(folder.glob("*.csv"))}


def georegister(
    area: Area, options: GeoStageOptions, progress: Progress, *, overwrite: bool = False
) -> StageRecord:
    """Georegister the area's model, and transform all labels with it, to ENU metres.

    Parameters
    ----------
    area : Area
    options : GeoStageOptions
    progress : Progress
    overwrite : bool
        Whether a georegistration with other options may be replaced.

    Returns
    -------
    StageRecord

    Raises
    ------
    GeometryError
        If telemetry and ground control do not determine the similarity.
    InputError
        If the ground control points cannot be used.
    StageError
        If frames or model are missing or stale.
    """
    inputs = {}
    if options.control is not None:
        inputs["ground control"] = content_fingerprint(Path(options.control.file))
    begun = area.begin(GEO, asdict(options), inputs, overwrite=overwrite)
    if isinstance(begun, StageRecord):
        record = begun
    else:
        try:
            record = _georegister(area, begun, options, progress)
        except (GeometryError, InputError):
            begun.discard()  # nothing in it could be reused
            raise
    move_labels(area)  # also after an interrupted call that did not get this far
    return record


def _georegister(
    area: Area, work: StageWork, options: GeoStageOptions, progress: Progress
) -> StageRecord:
    stopwatch = Stopwatch()
    tracks = read_tracks(area)
    if options.control is None and not any(track.has_fix.any() for track in tracks.values()):
        raise GeometryError(
            f"{area.root}: no telemetry with a fix; the model stays in its own gauge (units: model). Put "
            "telemetry next to the sources and run spn-data reconstruct VIDEO --overwrite"
        )
    scene = read_scene(area.folder(MODEL))
    frames = registered_frames(area, scene)
    with stopwatch.step("ground control"):  # first: a mistake in its file is told at once
        control, notes = _control(area, scene, options, tracks)
    with stopwatch.step("time offset"):
        offsets = time_offsets(scene, frames, tracks, options, progress)
    with stopwatch.step("fit"):
        telemetry = telemetry_of(frames, tracks, offsets)
        sequences = frames.sequences.tolist()
        result = fit(scene.poses, telemetry, sequences, frames.time_s, options.fit, control)
    with stopwatch.step("write"):
        write_transformed(area.folder(MODEL), work.path, result.world_from_model)
        write_json(
            work.path / GEO_FIT,
            {
                **result.to_json(),
                "frames": list(scene.names),
                "time_offsets": {name: asdict(offset) for name, offset in offsets.items()},
            },
        )
    return work.finish(
        counts=_counts(result),
        seconds=stopwatch.seconds,
        cpu_seconds=stopwatch.cpu_seconds,
        notes=(*(o.describe(name) for name, o in offsets.items()), *notes, *result.notes),
    )


def _control(
    area: Area, scene: Scene, options: GeoStageOptions, tracks: Mapping[str, Telemetry]
) -> tuple[Control | None, tuple[str, ...]]:
    """Return the ground control points, if there are any, and notes on them."""
    if options.control is None:
        return None, ()
    origin = options.fit.origin
    if origin is not None and origin.height_reference is HeightReference.TAKEOFF:
        raise InputError(
            "heights of the area are above take-off, those of ground control points are not: run spn-data "
            f"georegister --gcp {options.control.file} --overwrite first, then add",
            path=options.control.file,
        )
    reference = options.fit.height_reference
    control, notes = read_control(
        area, scene, options.control, tracks=tracks, origin=origin, reference=reference
    )
    if control.check.all():
        raise InputError(
            f"all of its {len(control)} points that can be used are check points: leave some to the fit, or "
            "compare them with spn-data check-points",
            path=options.control.file,
        )
    return control, notes


def registered_frames(area: Area, scene: Scene) -> Frames:
    """Return the frames of a scene's images, in the order of the scene."""
    frames = read_frames(area.folder(FRAMES) / FRAMES_TABLE)
    row = {name: k for k, name in enumerate(frames.names.tolist())}
    return frames.select(np.array([row[name] for name in scene.names], dtype=np.int64))


def telemetry_of(
    frames: Frames, tracks: Mapping[str, Telemetry], offsets: Mapping[str, TimeOffset]
) -> Telemetry:
    """Return the telemetry at the times of some frames, with the time offset of each flight."""
    shifted = {
        name: track.shifted(offsets[name].applied_s if name in offsets else 0.0)
        for name, track in tracks.items()
    }
    return align_telemetry(shifted, frames.sequences.tolist(), frames.time_s)


def time_offsets(
    scene: Scene,
    frames: Frames,
    tracks: Mapping[str, Telemetry],
    options: GeoStageOptions,
    progress: Progress,
) -> dict[str, TimeOffset]:
    """Return the time offset of each flight, given or estimated; photos with their own tags have none."""
    offsets: dict[str, TimeOffset] = {}
    moving = [name for name, track in tracks.items() if track.kind != "exif"]
    for k, name in enumerate(moving):
        progress("time offset", k, len(moving))
        given = options.time_offset_s.get(name, options.time_offset_s.get("*"))
        mine = frames.sequences == name
        if given is not None:
            offsets[name] = TimeOffset(given, 0.0)
        elif mine.any():
            offsets[name] = estimate_time_offset(
                scene.poses[mine], frames.time_s[mine], tracks[name], options.fit
            )
    if moving:
        progress("time offset", len(moving), len(moving))
    return offsets


def _counts(result: GeoFit) -> dict[str, Any]:
    summary, stated = result.summary, result.uncertainty
    return {
        "frames": summary.frames,
        "fixes": summary.fixes,
        "outliers": summary.outliers,
        "effective_fixes": _rounded(summary.effective_fixes),
        "horizontal_rmse_m": _rounded(summary.horizontal_rmse_m),
        "vertical_rmse_m": _rounded(summary.vertical_rmse_m),
        "ce90_m": _rounded(summary.ce90_m),
        "le90_m": _rounded(summary.le90_m),
        "held_out_horizontal_rmse_m": _rounded(result.held_out_blocks.horizontal_rmse_m),
        "held_out_vertical_rmse_m": _rounded(result.held_out_blocks.vertical_rmse_m),
        "held_out_blocks": result.held_out_blocks.folds,
        "sigma_horizontal_m": _rounded(stated.horizontal_m),
        "sigma_vertical_m": _rounded(stated.vertical_m),
        "sigma_tilt_deg": _rounded(stated.tilt_deg),
        "sigma_heading_deg": _rounded(stated.heading_deg),
        "sigma_scale": _rounded(stated.scale, 6),
        "control": [finite(asdict(point)) for point in result.control],
        "observations": list(result.observations),
        "height_reference": result.height_reference.value,
        "origin": [result.origin.lat_deg, result.origin.lon_deg, result.origin.alt_m],
    }


def _rounded(value: float, digits: int = 4) -> float | None:
    """Return a number for stage.json; None if it is not finite."""
    return finite_or_none(round(float(value), digits))
