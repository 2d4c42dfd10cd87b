"""Coverage of an area's evaluation sequences, or of planned waypoints, and where to fly again."""

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
from spn_data.coverage.refly import ReflightPlan, ReflyOptions, plan_reflight
from spn_data.coverage.sequence_table import (
    Coverage,
    MappingFrames,
    Queries,
    assess_coverage,
    coverage_notes,
    write_coverage,
)
from spn_data.coverage.view_share import SeenMap
from spn_data.coverage.waypoints import WaypointFrame, Waypoints, read_waypoints, waypoint_columns
from spn_data.errors import FormatError, InputError, StageError
from spn_data.geometry.camera import Camera
from spn_data.geometry.geodesy import HeightReference
from spn_data.geometry.pose import Poses
from spn_data.inputs.area_labels import LabelledArea, read_labelled_area
from spn_data.labels.labels import Labels
from spn_data.pipeline.geo_stage import recorded_options
from spn_data.storage.json_files import VERSION, finite, read_json, write_json
from spn_data.work.timing import Progress

WAYPOINTS = "waypoints"  # name of the plan, as of a sequence
_FILE = "coverage.json"


@dataclass(frozen=True, kw_only=True)
class CoverageStageOptions:
    """Of what, and by which measure."""

    # None: the default strata, or none where the map has no metres.
    coverage: CoverageOptions | None = None
    refly: ReflyOptions = field(default_factory=ReflyOptions)
    camera: Camera | None = None  # of waypoints that name none; None: the one that mapped most
    fov_deg: float | None = None  # or that one's image with this horizontal field of view


@dataclass(frozen=True, eq=False)
class AreaCoverage:
    """What was found. folder : where it was written.

    units : "m" or "model". options : None where there are no strata. by_name : of each sequence, or of the
    plan. fly_again : over all of them together; None where the map has no metres or no up. stops : cells
    of its CSV by column. notes : sentences for the user.
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
    """Coverage of every evaluation sequence, or of the waypoints in a file instead; written to the area.

    What an earlier run wrote there is replaced. Raises StageError where there is nothing to cover, or
    where waypoints meet a map that has no East, North and Up.
    """
    labelled = read_labelled_area(area)
    place = _place(area, labelled)
    if waypoints is None:
        folder = area.folder(COVERAGE)
        queries = {
            name: _queries_of(labels, labelled) for name, labels in labelled.evaluation.items()
        }
        if not queries:
            raise StageError(
                f"{area.root}: no evaluation sequence is registered; "
                "spn-data register VIDEO --name NAME adds one, --waypoints FILE.csv takes a plan instead"
            )
    else:
        folder = area.folder(PLANNED_COVERAGE)
        if place is None:
            raise StageError(
                f"{area.root}: the map has no East, North and Up, which waypoints are stated in; "
                "it needs telemetry: spn-data georegister"
            )
        plan = read_waypoints(waypoints, place)
        queries = {WAYPOINTS: _planned(plan, labelled, options, waypoints)}
    found = _measured(labelled, queries, place, options, folder, progress)
    _write(area, found, options, str(waypoints.name) if waypoints else "")
    return found


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
    return assess_coverage(queries, _mapping(labelled, has_up=is_metric), limits, progress)


def check_new(path: Path, *, overwrite: bool) -> None:
    """Raises InputError where a file can't be made, or would be replaced without being asked to."""
    if path.suffix.lower() != ".csv" or path.is_dir():
        raise InputError("is not the name of a CSV file: it ends in .csv", path=path)
    if any((parent / "stage.json").exists() for parent in path.resolve().parents):
        raise InputError("lies in a stage of an area; name a file elsewhere", path=path)
    if path.exists() and not overwrite:
        raise InputError("exists already; --overwrite replaces it", path=path)
    if not path.parent.is_dir():
        raise InputError("its folder does not exist", path=path)


def read_coverage(area: Area, folder: str = COVERAGE) -> dict[str, Any] | None:
    """What coverage.json holds (docs/coverage.md); None where coverage was not asked for yet."""
    path = area.folder(folder) / _FILE
    if not path.exists():
        return None
    value: dict[str, Any] = read_json(path)
    if not value.keys() >= {"sequences", "made_of", "fly_again", "units", "options"}:
        raise FormatError(f"{path}: is no coverage of this program")
    return value


def stale_because(area: Area, coverage: Mapping[str, Any]) -> str | None:
    """Why what `read_coverage` gave no longer fits the area, or None."""
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


def _measured(
    labelled: LabelledArea,
    queries: Mapping[str, Queries],
    place: WaypointFrame | None,
    options: CoverageStageOptions,
    folder: Path,
    progress: Progress,
) -> AreaCoverage:
    is_metric = labelled.units == "m"
    chosen = options.coverage or (CoverageOptions() if is_metric else None)
    mapping = _mapping(labelled, has_up=is_metric)
    by_name = {
        name: assess_coverage(each, mapping, chosen, progress) for name, each in queries.items()
    }
    fly_again, stops = None, {}
    if place is not None and chosen is not None:
        poses, strata = _together(by_name)
        fly_again = plan_reflight(poses, strata, chosen, options.refly)
        stops = waypoint_columns(fly_again.poses.centers, fly_again.angles_deg, place)
        numbers = {"stop": [str(k + 1) for k in range(len(fly_again))]}
        stops = {**numbers, **stops, "serves": [str(n) for n in fly_again.serves]}
    notes = tuple(
        sentence for name, each in by_name.items() for sentence in coverage_notes(name, each)
    )
    if not is_metric:
        notes = (
            "The map is in units of the model: lengths are no metres, no axis points up"
            + ("." if options.coverage else ", and there are no strata."),
            *notes,
        )
    return AreaCoverage(folder, labelled.units, chosen, by_name, fly_again, stops, notes)


def _mapping(labelled: LabelledArea, *, has_up: bool) -> MappingFrames:
    """The chosen frames of the mapping flights that have a pose, and what they saw.

    Their tracked frames are left out: whether poses were computed for those changes nothing in the flight.
    """
    labels, seen = labelled.mapping, labelled.mapping_seen
    known = np.flatnonzero(labels.registered)
    centers = labels.poses.centers  # NaN where there is no pose: such a sighting does not count
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


def _planned(
    plan: Waypoints, labelled: LabelledArea, options: CoverageStageOptions, path: Path
) -> Queries:
    """The plan's poses. Raises InputError, with the line, for a camera that the area does not hold."""
    usual = _usual_camera(labelled)
    if options.camera is not None:
        usual = options.camera
    elif options.fov_deg is not None:
        usual = Camera.from_horizontal_fov(usual.width, usual.height, options.fov_deg)
    cameras = []
    for line, key in zip(plan.lines.tolist(), plan.cameras.tolist(), strict=True):
        if key and key not in labelled.cameras:
            raise InputError(
                f"the area holds no camera {key!r}; it holds {', '.join(sorted(labelled.cameras))}",
                path=path,
                line=line,
            )
        cameras.append(labelled.cameras[key] if key else usual)
    names = np.array([f"line {line}" for line in plan.lines.tolist()], dtype=np.str_)
    return Queries(names, plan.poses, cameras, np.full(len(plan), "", dtype="<U1"))


def _usual_camera(labelled: LabelledArea) -> Camera:
    """The one that took most mapping frames."""
    labels = labelled.mapping
    keys, counts = np.unique(labels.cameras[labels.registered], return_counts=True)
    return labelled.cameras[str(keys[counts.argmax()])]


def _place(area: Area, labelled: LabelledArea) -> WaypointFrame | None:
    """What is known of the area's place and heights."""
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


def _together(by_name: Mapping[str, Coverage]) -> tuple[Poses, np.ndarray]:
    """Poses and strata of all queries that have a pose."""
    every = [(each, each.queries.known) for each in by_name.values()]
    return (
        Poses.concatenate(each.queries.poses[known] for each, known in every),
        np.concatenate([each.stratum[known] for each, known in every]),
    )


def _fingerprints(area: Area, *, of_plan: bool) -> dict[str, str]:
    """Of the stages that coverage is made from, by name; a plan's needs no evaluation sequence."""
    kept = [stage for stage in area.stages() if stage in (MODEL, GEO)]
    if not of_plan:
        names = area.sequences(EVALUATION)
        kept += [f"{EVALUATION}/{name}" for name in names]
        kept += [f"{TRACKED}/{name}" for name in area.sequences(TRACKED) if name in names]
    return {stage: area.record(stage).fingerprint() for stage in kept}


def _write(area: Area, found: AreaCoverage, options: CoverageStageOptions, waypoints: str) -> None:
    """The folder appears whole, in place of that of an earlier run."""
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
    """A stop each, numbers and counts apart."""
    convert = {name: int if name in ("stop", "serves") else float for name in columns}
    rows = zip(*columns.values(), strict=True)
    return [
        {name: convert[name](cell) for name, cell in zip(columns, row, strict=True)} for row in rows
    ]
