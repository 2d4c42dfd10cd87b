"""Coverage of evaluation sequences or planned waypoints, and a plan for another mapping flight."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import COVERAGE, EVALUATION, GEO, MODEL, PLANNED_COVERAGE, TRACKED
from spn_data.coverage.nearest_frame import CoverageOptions
from spn_data.coverage.refly import ReflightPlan, ReflyOptions, plan_reflight, reach_notes
from spn_data.coverage.sequence_table import (
    Coverage,
    MappingFrames,
    Queries,
    assess_coverage,
    coverage_notes,
    write_coverage,
)
from spn_data.coverage.view_share import SeenMap
from spn_data.coverage.waypoints import WaypointFrame, read_waypoints, waypoint_columns
from spn_data.errors import FormatError, InputError, StageError
from spn_data.geometry.camera import Camera
from spn_data.geometry.geodesy import HeightReference
from spn_data.geometry.pose import Poses
from spn_data.inputs.area_labels import LabelledArea, read_labelled_area
from spn_data.labels.labels import Labels
from spn_data.pipeline.geo_stage import recorded_options
from spn_data.storage.json_files import (
    VERSION,
    finite,
    kind_of,
    read_json,
    reporting_damage,
    write_json,
)
from spn_data.work.timing import Progress

WAYPOINTS = "waypoints"  # name of the plan, in place of the name of a sequence
_FILE = "coverage.json"


@dataclass(frozen=True, kw_only=True)
class CoverageStageOptions:
    """Options of the coverage stage.

    Attributes
    ----------
    coverage : CoverageOptions or None
        Limits of the strata. None: the defaults, or no strata if the map is not in metres.
    refly : ReflyOptions
        Options of the plan for another flight.
    camera : Camera or None
        Camera of waypoints that name none; None: the one with most mapping frames.
    fov_deg : float or None
        Instead of `camera`: horizontal field of view, with the image size of that camera.
    """

    coverage: CoverageOptions | None = None
    refly: ReflyOptions = field(default_factory=ReflyOptions)
    camera: Camera | None = None
    fov_deg: float | None = None


@dataclass(frozen=True, eq=False)
class AreaCoverage:
    """Result of the coverage stage.

    Attributes
    ----------
    folder : Path
        Where it was written.
    units : str
        "m" or "model".
    options : CoverageOptions or None
        None if there are no strata.
    by_name : dict of str to Coverage
        Coverage of each sequence, or of the plan.
    fly_again : ReflightPlan or None
        One plan for all of them; None if scale or up direction of the map are unknown.
    stops : dict of str to list of str
        Cells of the CSV of the plan, by column.
    notes : tuple of str
        Sentences for the user.
    """

    folder: Path
    units: str
    options: CoverageOptions | None
    by_name: dict[str, Coverage]
    fly_again: ReflightPlan | None
    stops: dict[str, list[str]]
    notes: tuple[str, ...]


def cover_area(
    area: Area,
    options: CoverageStageOptions,
    progress: Progress,
    *,
    waypoints: Path | None = None,
) -> AreaCoverage:
    """Assess the coverage of all evaluation sequences, or of waypoints, and write it to the area.

    The result of an earlier run is replaced.

    Parameters
    ----------
    area : Area
    options : CoverageStageOptions
    progress : Progress
    waypoints : Path or None
        CSV file of planned waypoints, to assess instead of the evaluation sequences.

    Returns
    -------
    AreaCoverage

    Raises
    ------
    StageError
        If no evaluation sequence is registered, or waypoints are given but the map is not georegistered.
    InputError
        If the waypoints are invalid or name an unknown camera.
    """
    labelled = read_labelled_area(area)
    frame = _waypoint_frame(area, labelled)
    if waypoints is None:
        folder = area.folder(COVERAGE)
        queries = {
            name: _queries_of(labels, labelled) for name, labels in labelled.evaluation.items()
        }
        if not queries:
            raise StageError(
                f"{area.root}: no evaluation sequence is registered; add one with spn-data register VIDEO "
                "--name NAME, or assess a plan with --waypoints FILE.csv"
            )
    else:
        folder = area.folder(PLANNED_COVERAGE)
        queries = {WAYPOINTS: read_plan(area, labelled, options, waypoints)}
    result = _assess(labelled, queries, frame, options, folder, progress)
    _write(area, result, options, str(waypoints.name) if waypoints else "")
    return result


def compute_coverage(
    labelled: LabelledArea,
    name: str,
    options: CoverageOptions | None = None,
    progress: Progress = lambda *_: None,
) -> Coverage:
    """Compute the coverage of one evaluation sequence without writing anything.

    Parameters
    ----------
    labelled : LabelledArea
        The labels of an area.
    name : str
        Name of the evaluation sequence.
    options : CoverageOptions, optional
        Limits of the strata; by default those in metres. A map without metres has no strata unless they
        are given.
    progress : callable, optional
        Called with the step, the amount done and the total.

    Returns
    -------
    Coverage

    Raises
    ------
    InputError
        If the area has no such sequence.
    """
    if name not in labelled.evaluation:
        known = ", ".join(labelled.evaluation) or "none"
        raise InputError(f"there is no evaluation sequence {name!r}; the area has: {known}")
    is_metric = labelled.units == "m"
    limits = options or (CoverageOptions() if is_metric else None)
    queries = _queries_of(labelled.evaluation[name], labelled)
    return assess_coverage(queries, _mapping_frames(labelled, has_up=is_metric), limits, progress)


def check_output_file(path: Path, *, overwrite: bool) -> None:
    """Raise InputError if a CSV file cannot be created, or exists and `overwrite` is false."""
    if path.suffix.lower() != ".csv" or path.is_dir():
        raise InputError("is not the name of a CSV file; it must end in .csv", path=path)
    if any((parent / "stage.json").exists() for parent in path.resolve().parents):
        raise InputError("is inside a stage of an area; choose another folder", path=path)
    if path.exists() and not overwrite:
        raise InputError("already exists; use --overwrite to replace it", path=path)
    if not path.parent.is_dir():
        raise InputError("its folder does not exist", path=path)


def read_coverage(area: Area, folder: str = COVERAGE) -> dict[str, Any] | None:
    """Read coverage.json (docs/coverage.md); None if coverage was not assessed yet."""
    path = area.folder(folder) / _FILE
    if not path.exists():
        return None
    value: dict[str, Any] = read_json(path)
    if not value.keys() >= {"sequences", "made_of", "fly_again", "units", "options"}:
        raise FormatError(f"{path}: is not a coverage file written by this program")
    with reporting_damage(path, "a coverage file"):
        for name in ("sequences", "made_of", "options"):
            # Without metres there are no options.
            if not isinstance(value[name], dict) and (name != "options" or value[name] is not None):
                raise TypeError(f"{name!r} is {kind_of(value[name])} instead of an object")
        if not isinstance(value["fly_again"], list | None):
            raise TypeError(f"'fly_again' is {kind_of(value['fly_again'])} instead of a list")
        if value["units"] not in ("m", "model"):
            raise ValueError("'units' is neither m nor model")
    return value


def stale_because(area: Area, coverage: Mapping[str, Any]) -> str | None:
    """Return why the result of `read_coverage` is out of date, or None."""
    before = dict(coverage["made_of"])
    now = _fingerprints(area, of_plan=bool(coverage.get("waypoints")))
    for stage in sorted({*before, *now}):
        if stage not in now:
            return f"{stage} is missing"
        if stage not in before:
            return f"{stage} was added since"
        if before[stage] != now[stage]:
            return f"{stage} was redone since"
    return None


def _assess(
    labelled: LabelledArea,
    queries: Mapping[str, Queries],
    frame: WaypointFrame | None,
    options: CoverageStageOptions,
    folder: Path,
    progress: Progress,
) -> AreaCoverage:
    is_metric = labelled.units == "m"
    chosen = options.coverage or (CoverageOptions() if is_metric else None)
    mapping = _mapping_frames(labelled, has_up=is_metric)
    by_name = {
        name: assess_coverage(each, mapping, chosen, progress) for name, each in queries.items()
    }
    fly_again, stops = None, {}
    if frame is not None and chosen is not None:
        poses, strata = _known_poses(by_name)
        fly_again = plan_reflight(poses, strata, chosen, options.refly, map_xyz=labelled.points.xyz)
        stops = waypoint_columns(fly_again.poses.centers, fly_again.angles_deg, frame)
        numbers = {"stop": [str(k + 1) for k in range(len(fly_again))]}
        stops = {**numbers, **stops, "serves": [str(n) for n in fly_again.serves]}
    notes = tuple(
        sentence for name, each in by_name.items() for sentence in coverage_notes(name, each)
    )
    notes += () if fly_again is None else reach_notes(fly_again, options.refly)
    if not is_metric:
        notes = (
            "The map is not georegistered: lengths are in units of the model and up is unknown"
            + ("." if options.coverage else "; there are no strata."),
            *notes,
        )
    return AreaCoverage(folder, labelled.units, chosen, by_name, fly_again, stops, notes)


def _mapping_frames(labelled: LabelledArea, *, has_up: bool) -> MappingFrames:
    """Return the registered chosen frames of the mapping flights, and the map points they see.

    Tracked frames are left out: computing poses for them does not change what was flown.
    """
    labels, seen = labelled.mapping, labelled.mapping_seen
    known = np.flatnonzero(labels.registered)
    centers = labels.poses.centers  # NaN without a pose: such an observation does not count
    rows = labelled.points.rows_of(seen.point_ids)
    return MappingFrames(
        labels.names[known],
        labels.poses[known],
        SeenMap.build(labelled.points.xyz, centers, seen.frame_idx, rows),
        has_up,
    )


def _queries_of(labels: Labels, labelled: LabelledArea) -> Queries:
    return Queries(
        labels.names,
        labels.poses,
        [labelled.cameras[key] for key in labels.cameras.tolist()],
        labels.reason,
    )


def read_plan(
    area: Area, labelled: LabelledArea, options: CoverageStageOptions, path: Path
) -> Queries:
    """Read planned waypoints with their cameras.

    Raises StageError if the map is not georegistered, InputError, with the line, for invalid waypoints or an
    unknown camera.
    """
    frame = _waypoint_frame(area, labelled)
    if frame is None:
        raise StageError(
            f"{area.root}: --waypoints needs a georegistered map; run spn-data georegister first"
        )
    plan = read_waypoints(path, frame)
    default = _main_camera(labelled)
    if options.camera is not None:
        default = options.camera
    elif options.fov_deg is not None:
        default = Camera.from_horizontal_fov(default.width, default.height, options.fov_deg)
    cameras = []
    for line, key in zip(plan.lines.tolist(), plan.cameras.tolist(), strict=True):
        if key and key not in labelled.cameras:
            raise InputError(
                f"the area has no camera {key!r}; cameras are {', '.join(sorted(labelled.cameras))}",
                path=path,
                line=line,
            )
        cameras.append(labelled.cameras[key] if key else default)
    names = np.array([f"line {line}" for line in plan.lines.tolist()], dtype=np.str_)
    return Queries(names, plan.poses, cameras, np.full(len(plan), "", dtype="<U1"))


def _main_camera(labelled: LabelledArea) -> Camera:
    """Return the camera with most mapping frames."""
    labels = labelled.mapping
    keys, counts = np.unique(labels.cameras[labels.registered], return_counts=True)
    return labelled.cameras[str(keys[counts.argmax()])]


def _waypoint_frame(area: Area, labelled: LabelledArea) -> WaypointFrame | None:
    """Return the coordinate frame of waypoints; None if the area is not georegistered."""
    origin = labelled.origin
    if origin is None:
        return None
    if origin.height_reference is HeightReference.TAKEOFF:
        return WaypointFrame(origin, 0.0)
    fit = recorded_options(area.record(GEO)).fit
    is_same = fit.height_reference is origin.height_reference
    if fit.takeoff_alt_m is not None and is_same:
        return WaypointFrame(origin, fit.takeoff_alt_m - origin.alt_m)
    return WaypointFrame(origin)


def _known_poses(by_name: Mapping[str, Coverage]) -> tuple[Poses, np.ndarray]:
    """Return poses and strata of all queries that have a pose."""
    every = [(each, each.queries.known) for each in by_name.values()]
    return (
        Poses.concatenate(each.queries.poses[known] for each, known in every),
        np.concatenate([each.stratum[known] for each, known in every]),
    )


def _fingerprints(area: Area, *, of_plan: bool) -> dict[str, str]:
    """Return fingerprints of the stages that coverage depends on; a plan needs no evaluation sequence."""
    kept = [stage for stage in area.stages() if stage in (MODEL, GEO)]
    if not of_plan:
        names = area.sequences(EVALUATION)
        kept += [f"{EVALUATION}/{name}" for name in names]
        kept += [f"{TRACKED}/{name}" for name in area.sequences(TRACKED) if name in names]
    return {stage: area.record(stage).fingerprint() for stage in kept}


def _write(area: Area, found: AreaCoverage, options: CoverageStageOptions, waypoints: str) -> None:
    """Write the folder atomically, replacing that of an earlier run."""
    name = found.folder.name
    path = area.partial(name)
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir(parents=True)
    for sequence, coverage in found.by_name.items():
        write_coverage(path / f"{sequence}.csv", coverage)
    value = {
        "version": VERSION,
        "units": found.units,
        "options": asdict(found.options) if found.options else None,
        "refly_options": asdict(options.refly),
        "waypoints": waypoints,
        "made_of": _fingerprints(area, of_plan=bool(waypoints)),
        "sequences": {n: c.summary() for n, c in found.by_name.items()},
        "fly_again": None if found.fly_again is None else _stops(found.stops),
        "notes": list(found.notes),
    }
    write_json(path / _FILE, finite(value))
    area.put_in_place(name, path)


def _stops(columns: Mapping[str, list[str]]) -> list[dict[str, float]]:
    """Return one row per stop, with counts as integers."""
    convert = {name: int if name in ("stop", "serves") else float for name in columns}
    rows = zip(*columns.values(), strict=True)
    return [
        {name: convert[name](cell) for name, cell in zip(columns, row, strict=True)} for row in rows
    ]
