"""Ground control of an area: a file of surveyed points, found in the images of its model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import FRAMES, FRAMES_TABLE, GEO, GEO_FIT
from spn_data.capture.frames import read_frames
from spn_data.colmap.model import Scene, read_scene
from spn_data.errors import InputError
from spn_data.geometry.geodesy import GeoOrigin, HeightReference
from spn_data.geometry.pose import Similarity
from spn_data.georegistration.control import Control, PointResidual, point_residuals
from spn_data.georegistration.result import GeoFit
from spn_data.ground_control.control_file import ControlFile, PointRole, read_control_file
from spn_data.ground_control.coordinates import SurveyedPositions, surveyed_positions
from spn_data.ground_control.marks import ModelImages, marked_points
from spn_data.storage.json_files import read_json, reporting_damage
from spn_data.telemetry.track import Telemetry

_FAR_M = 5_000.0  # from the fixes: another zone, or swapped axes


@dataclass(frozen=True, kw_only=True)
class ControlOptions:
    """Ground control points and how exact they are.

    Attributes
    ----------
    file : str
        ODM's gcp_list.txt, or CSV.
    check : tuple of str
        Points to hold out besides those that the file marks as check points: names, or one number for so
        many, spread over the area.
    sigma_m : tuple of float
        Standard deviation of the survey, horizontal per axis and vertical, where the file states none.
    mark_sigma_px : float
        Standard deviation of a mark where the file states none.
    """

    file: str
    check: tuple[str, ...] = ()
    sigma_m: tuple[float, float] = (0.03, 0.05)
    mark_sigma_px: float = 1.0


def read_control(
    area: Area,
    scene: Scene,
    options: ControlOptions,
    *,
    tracks: Mapping[str, Telemetry],
    origin: GeoOrigin | None = None,
    reference: HeightReference | None = None,
) -> tuple[Control, tuple[str, ...]]:
    """Read surveyed points and find them in the model.

    Parameters
    ----------
    area : Area
    scene : Scene
        Its model, in any gauge.
    options : ControlOptions
    tracks : mapping of str to Telemetry
        Telemetry of the flights, to see whether the points are near it.
    origin : GeoOrigin, optional
        Origin to keep; otherwise it is at the points.
    reference : HeightReference, optional
        Reference that the heights must have.

    Returns
    -------
    control : Control
    notes : tuple of str

    Raises
    ------
    InputError
        If the file cannot be used; the message names the line.
    """
    file = read_control_file(Path(options.file))
    if origin is not None and origin.height_reference is not HeightReference.UNKNOWN:
        reference = origin.height_reference
    positions = surveyed_positions(file, reference)
    _require_near(file, positions, tracks)
    if origin is None:
        origin = _new_origin(positions)
    points, notes = marked_points(file, _images(area, scene), options.mark_sigma_px)
    found = np.array([not p.found.problem for p in points])
    if not found.any():
        raise InputError(
            f"none of {len(points)} points can be used: {notes[-1]}", path=options.file
        )
    check = _checked(file, options.check, positions, found)
    kept = np.flatnonzero(found)
    heights = positions.height_m
    enu = origin.enu_from_wgs84(
        np.column_stack([positions.lat_lon_deg, np.nan_to_num(heights, nan=origin.alt_m)])
    )
    enu[~np.isfinite(heights), 2] = np.nan
    horizontal, vertical = options.sigma_m
    sigma = np.array(
        [[p.sigma_h_m or horizontal] * 2 + [p.sigma_v_m or vertical] for p in file.points]
    )
    control = Control(
        tuple(file.points[k].name for k in kept),
        np.array([points[k].found.point for k in kept]),
        np.array([points[k].found.covariance for k in kept]),
        enu[kept],
        sigma[kept],
        check[kept],
        origin,
        ~check[kept],
        tuple(points[k].views.select(points[k].found.used) for k in kept),
    )
    if positions.reference is HeightReference.UNKNOWN and np.isfinite(heights).any():
        notes += (
            f"{positions.system} has no vertical datum: heights of the area are those of the ground control "
            "points, whatever they refer to; state --height-reference, or a code such as EPSG:25832+7837.",
        )
    return control, notes


def check_points(
    area: Area, options: ControlOptions
) -> tuple[tuple[PointResidual, ...], tuple[str, ...]]:
    """Compare surveyed points with the area as it is; all of them are check points, and nothing is changed.

    Parameters
    ----------
    area : Area
    options : ControlOptions

    Returns
    -------
    points : tuple of PointResidual
    notes : tuple of str

    Raises
    ------
    StageError
        If the area is not georegistered.
    InputError
        If the file cannot be used.
    """
    area.check_fresh(GEO)
    path = area.folder(GEO) / GEO_FIT
    with reporting_damage(path, "a georegistration"):
        geo = GeoFit.from_json(read_json(path))
    scene = read_scene(area.folder(GEO))
    comparable = geo.height_reference in (HeightReference.ELLIPSOID, HeightReference.AMSL)
    origin = (
        geo.origin if comparable else replace(geo.origin, height_reference=HeightReference.UNKNOWN)
    )
    control, notes = read_control(area, scene, options, tracks={}, origin=origin)
    control = replace(
        control, check=np.ones(len(control), dtype=bool), used=np.zeros(len(control), dtype=bool)
    )
    covariance = geo.uncertainty.point_covariance(control.model)
    if not comparable:
        # Whatever the heights of the area are above, the points' are above something else.
        up = float(np.nanmedian(control.enu_m[:, 2] - control.model[:, 2]))
        control = replace(control, enu_m=control.enu_m - [0.0, 0.0, up])
        covariance[:, :, 2] = covariance[:, 2, :] = 0.0
        notes = (
            *(n for n in notes if "vertical datum" not in n),
            f"Heights of the area are above {geo.height_reference.value}, those of the points are not: their "
            f"median difference of {up:+.2f} m is taken off.",
        )
    return point_residuals(control, Similarity.identity(), covariance), notes


def _images(area: Area, scene: Scene) -> ModelImages:
    """Return the images of a scene, with the names of the photos that they were made from."""
    frames = read_frames(area.folder(FRAMES) / FRAMES_TABLE)
    source = np.where(frames.video_frame < 0, frames.sources, "").tolist()
    file_of = dict(zip(frames.names.tolist(), source, strict=True))
    registered = set(scene.names)
    absent: dict[str, str] = {}
    for k, name in enumerate(frames.names.tolist()):
        if name not in registered:
            why = "it has no pose in the model" if frames.chosen[k] else str(frames.reason[k])
            for key in (name, name.partition("/")[2], source[k]):
                absent[key.lower()] = why
    return ModelImages(
        scene.names,
        [file_of[name] for name in scene.names],
        absent,
        scene.poses,
        [scene.cameras[int(i)] for i in scene.camera_ids],
    )


def _new_origin(positions: SurveyedPositions) -> GeoOrigin:
    """Return an origin in the middle of the points, at a whole metre of their heights."""
    lat, lon = np.median(positions.lat_lon_deg, axis=0)
    known = positions.height_m[np.isfinite(positions.height_m)]
    alt = float(np.round(np.median(known))) if len(known) else 0.0
    reference = positions.reference if len(known) else HeightReference.UNKNOWN
    return GeoOrigin(round(float(lat), 6), round(float(lon), 6), alt, reference)


def _require_near(
    file: ControlFile, positions: SurveyedPositions, tracks: Mapping[str, Telemetry]
) -> None:
    """Raise InputError for points far from the fixes, naming swapped axes if that explains it."""
    fixes = [track.lat_lon_deg[track.has_fix] for track in tracks.values()]
    if not any(len(f) for f in fixes):
        return
    lat, lon = np.median(np.concatenate(fixes), axis=0)
    middle = GeoOrigin(float(lat), float(lon), 0.0)

    def far_m(found: SurveyedPositions) -> np.ndarray:
        height = np.zeros(len(found.lat_lon_deg))
        enu = middle.enu_from_wgs84(np.column_stack([found.lat_lon_deg, height]))
        return np.asarray(np.linalg.norm(enu, axis=1))

    distance = far_m(positions)
    if (distance <= _FAR_M).all():
        return
    k = int(np.argmax(distance))
    point = file.points[k]
    swapped = replace(
        file, points=tuple(replace(p, east=p.north, north=p.east) for p in file.points)
    )
    try:
        is_swapped = bool((far_m(surveyed_positions(swapped)) <= _FAR_M).all())
    except InputError:
        is_swapped = False
    axes = (
        "longitude and latitude"
        if np.abs([point.east, point.north]).max() <= 180
        else "east and north"
    )
    why = f"{axes} are swapped" if is_swapped else f"is {positions.system} its coordinate system?"
    raise InputError(
        f"point {point.name!r} is {distance[k] / 1000:.0f} km from the fixes of the telemetry: {why}",
        path=file.path,
        line=point.line,
    )


def _checked(
    file: ControlFile, wanted: tuple[str, ...], positions: SurveyedPositions, found: np.ndarray
) -> np.ndarray:
    """Return which points are held out (K,); raise InputError if a name is unknown or none would be left."""
    names = [p.name for p in file.points]
    check = np.array([p.role is PointRole.CHECK for p in file.points])
    unknown = [name for name in wanted if name not in names]
    if len(wanted) == 1 and unknown and wanted[0].isdigit():
        free = np.flatnonzero(found & ~check)
        count = int(wanted[0])
        if count >= len(free):
            raise InputError(
                f"--check-points {count} would leave none of {len(free)} ground control points",
                path=file.path,
            )
        chosen = _spread(positions.lat_lon_deg[free], count)
        check[free[chosen]] = True
    elif unknown:
        raise InputError(
            f"--check-points: there is no point {unknown[0]!r}; its points are {', '.join(names[:8])}",
            path=file.path,
        )
    else:
        check |= np.isin(names, wanted)
    return check


def _spread(lat_lon: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of so many points, spread over all; the outermost ones are taken last."""
    scaled = lat_lon * [1.0, np.cos(np.deg2rad(lat_lon[0, 0]))]
    distance = np.linalg.norm(scaled - scaled.mean(axis=0), axis=1)
    order = [int(np.argmax(distance))]
    nearest = np.full(len(scaled), np.inf)
    while len(order) < len(scaled):
        nearest = np.minimum(nearest, np.linalg.norm(scaled - scaled[order[-1]], axis=1))
        nearest[order] = -1.0
        order.append(int(np.argmax(nearest)))
    # The first of this order surround the others.
    outer = min(3, len(order) - count)
    inner = np.array(order[outer:])
    return inner[np.linspace(0, len(inner) - 1, count).round().astype(int)]
