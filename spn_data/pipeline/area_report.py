"""report.html: contents of an area, and whether it is ready for training."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.area.area import Area, command_of
from spn_data.area.names import (
    AUDIT,
    BUNDLE,
    CAMERA,
    CHECKPOINT,
    COVERAGE,
    EVALUATION,
    FRAMES,
    FRAMES_TABLE,
    GEO,
    GEO_FIT,
    METRICS,
    MODEL,
    PLANNED_COVERAGE,
    REPORT,
    RUNS,
    SPLIT,
    SPLIT_FILE,
)
from spn_data.capture.frames import Frames, read_frames
from spn_data.coverage.sequence_table import read_strata
from spn_data.errors import FormatError, InputError, StageError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.georegistration.result import GeoFit
from spn_data.inputs.area_labels import LabelledArea, read_labelled_area
from spn_data.inputs.expected_plans import read_expected_plans
from spn_data.inputs.network_runs import read_runs, trained_runs
from spn_data.labels.labels import Labels, pose_sigmas
from spn_data.pipeline import area_coverage as coverage_stage
from spn_data.pipeline.area_audit import read_audit
from spn_data.pipeline.area_photogrammetry import photogrammetry_of
from spn_data.pipeline.area_pictures import pictures_of
from spn_data.pipeline.fresh_stages import FreshStages
from spn_data.report.area_verdict import AreaVerdict, judge
from spn_data.report.data import CoverageFacts, FrameTable, PlaceToFly, ReportData, StageFacts
from spn_data.report.html import render
from spn_data.report.network_state import RecordedFlight
from spn_data.split.split_file import read_split
from spn_data.storage.files import write_atomically
from spn_data.storage.json_files import DAMAGE, read_json, reporting_damage
from spn_data.storage.stage_record import versions

# Written after the stages: their records do not say when.
_CHANGED_LATER = (
    *(f"{folder}/*.json" for folder in (COVERAGE, PLANNED_COVERAGE)),
    f"{SPLIT}/{AUDIT}",
    *(f"{RUNS}/*/{file}" for file in (CHECKPOINT, METRICS, f"{BUNDLE}/*")),
)


@dataclass(frozen=True, kw_only=True)
class ReportOptions:
    """Limits of the page; more points and frames are thinned out, which the page states."""

    max_points: int = 100_000
    max_frames: int = 30_000


def write_report(area: Area, options: ReportOptions | None = None) -> tuple[Path, AreaVerdict]:
    """Write report.html in the area's folder, replacing an earlier one.

    Stale stages are named but otherwise left out.

    Parameters
    ----------
    area : Area
    options : ReportOptions or None

    Returns
    -------
    path : Path
        The page.
    verdict : AreaVerdict
        On data, networks and flight, with the next step.

    Raises
    ------
    StageError
        If the area has no frames yet.
    FormatError, InputError
        If a file is damaged.
    """
    options = options or ReportOptions()
    path, data = area.root / REPORT, report_data(area, photogrammetry=True)
    judged = judge(data)
    html = render(
        data,
        judged,
        pictures=pictures_of(area, data),
        max_points=options.max_points,
        max_frames=options.max_frames,
    )
    write_atomically(path, html)
    return path, judged


def judge_area(area: Area) -> AreaVerdict:
    """Return the verdict on an area; raises the same errors as `write_report`."""
    return judge(report_data(area))


def _last_change(area: Area, stages: tuple[StageFacts, ...]) -> str:
    """Return when a stage was finished last, or a file was written that the page shows too."""
    times = [datetime.fromisoformat(stage.record.finished) for stage in stages]
    for pattern in _CHANGED_LATER:
        for path in area.root.glob(pattern):
            times.append(datetime.fromtimestamp(path.stat().st_mtime, UTC))
    return max(times).strftime("%Y-%m-%d %H:%M UTC")


def report_data(area: Area, *, photogrammetry: bool = False) -> ReportData:
    """Collect the contents of the report; raises the same errors as `write_report`.

    photogrammetry : whether to collect what only the section on photogrammetry shows.
    """
    if not area.has(FRAMES):
        raise StageError(f"{area.root} contains no frames; run {command_of(FRAMES)} first")
    stages = tuple(
        StageFacts(area.record(stage), area.stale_because(stage), _command_of(area, stage))
        for stage in area.stages()
    )
    fresh = FreshStages(area)
    labelled = read_labelled_area(fresh) if fresh.has(MODEL) else None
    geo, residuals = None, {}
    if fresh.has(GEO):
        path = fresh.folder(GEO) / GEO_FIT
        value = read_json(path)
        with reporting_damage(path, "a georegistration"):
            geo = GeoFit.from_json(value)
            residuals = _residuals(path, value, geo)
    split, checks = None, None
    if fresh.has(SPLIT):
        split = read_split(fresh.folder(SPLIT) / SPLIT_FILE)
        path = fresh.folder(SPLIT) / AUDIT
        checks = read_audit(path) if path.exists() else None
    groups = dict(zip(split.names.tolist(), split.group.tolist(), strict=True)) if split else {}
    candidates = read_frames(area.folder(FRAMES) / FRAMES_TABLE)
    frames = frame_table(candidates, labelled, residuals, _strata(area), groups)
    runs, broken_runs = read_runs(area)
    plans, broken_plans = read_expected_plans(area)
    return ReportData(
        title=area.root.resolve().name,
        path=str(area.root.resolve()),
        # Not the time of writing, so that the page of an unchanged area does not change.
        made=_last_change(area, stages),
        version=versions()["squeezeposenet-toolkit"],
        units="m" if geo is not None else "model",
        stages=stages,
        model_record=area.record(MODEL) if fresh.has(MODEL) else None,
        geo=geo,
        frames=frames,
        points=labelled.points if labelled else None,
        fov_tan={} if labelled is None else {k: _tangents(c) for k, c in labelled.cameras.items()},
        coverage=_coverage(area, COVERAGE),
        plan=_coverage(area, PLANNED_COVERAGE),
        split=split,
        audit=checks,
        evaluation_records={
            name: area.record(f"{EVALUATION}/{name}") for name in fresh.sequences(EVALUATION)
        },
        runs=runs,
        broken_runs=broken_runs,
        plans=plans,
        broken_plans=broken_plans,
        trained=trained_runs(area, runs),
        expect_low=frozenset(area.facts.expect_low),
        recorded=_recorded_flight(area),
        photogrammetry=photogrammetry_of(fresh, labelled) if photogrammetry and labelled else None,
    )


def _command_of(area: Area, stage: str) -> str:
    """Return the command that makes a stage, with the sources that are where they were."""
    command, name = command_of(stage), stage.partition("/")[2]
    if command.startswith("spn-data register VIDEO"):
        video = _found(area, area.facts.evaluation.get(name, ""))
        return command.replace("VIDEO", shlex.quote(video)) if video else command
    if command == "spn-data reconstruct":
        sources = [_found(area, source) for source in area.facts.sources]
        words = sources if sources and all(sources) else ["VIDEO"]
        return f"{command} {shlex.join(words)}"
    return command


def _found(area: Area, stored: str) -> str:
    """Return the path of a source as stored in area.toml; empty if it is not there."""
    try:
        path = (area.root.resolve() / stored).resolve()
        return str(path) if stored and path.exists() else ""
    except (OSError, ValueError):  # not a path of this machine
        return ""


def _recorded_flight(area: Area) -> RecordedFlight | None:
    """Return an evaluation flight whose video is where it was, rather one that is not far from the map."""
    names = sorted(
        area.sequences(EVALUATION), key=lambda name: (name in area.facts.expect_low, name)
    )
    for name in names:
        video = _found(area, area.facts.evaluation.get(name, ""))
        camera = area.folder(f"{EVALUATION}/{name}") / CAMERA
        if video and Path(video).is_file() and camera.is_file():
            return RecordedFlight(video, camera.relative_to(area.root).as_posix())
    return None


def frame_table(
    candidates: Frames,
    labelled: LabelledArea | None,
    residuals: Mapping[str, tuple[np.ndarray, bool]],
    strata: Mapping[str, str],
    groups: Mapping[str, str],
) -> FrameTable:
    """Return one row per frame: mapping candidates, their tracked frames, evaluation frames.

    Parameters
    ----------
    candidates : Frames
        Candidate frames of the mapping flights.
    labelled : LabelledArea or None
        None if there is no model; the status of selected frames is then "chosen".
    residuals : mapping of str to (ndarray of shape (3,), bool)
        Fix minus pose, and whether it is an outlier, by frame.
    strata, groups : mapping of str to str
        Coverage stratum and group of the split, by frame.

    Returns
    -------
    FrameTable
    """
    if labelled is None:
        return _candidate_rows(candidates, candidates.names != "")
    labelled_names = set(labelled.tracked.names.tolist())
    rest = ~candidates.chosen & ~np.isin(candidates.names, list(labelled_names))
    parts = [
        _label_rows(labelled.mapping, evaluation=False),
        _label_rows(labelled.tracked, evaluation=False),
        _candidate_rows(candidates, rest),
        *(_label_rows(labels, evaluation=True) for labels in labelled.evaluation.values()),
    ]
    frames = FrameTable.concatenate(parts)
    order = np.lexsort((frames.time_s, frames.sequences, frames.evaluation))
    return frames.select(order).with_facts(residuals, strata, groups)


def _label_rows(labels: Labels, *, evaluation: bool) -> FrameTable:
    n = len(labels)
    sigma_m, sigma_deg = pose_sigmas(labels.covariance)
    return FrameTable(
        names=labels.names,
        sequences=labels.sequences,
        cameras=labels.cameras,
        evaluation=np.full(n, evaluation),
        tracked=labels.tracked,
        time_s=labels.time_s,
        status=labels.status,
        reason=labels.reason,
        poses=labels.poses,
        sigma_m=sigma_m,
        sigma_deg=sigma_deg,
        inliers=labels.inliers,
        error_px=labels.error_px,
        **FrameTable.no_facts(n),
    )


def _candidate_rows(frames: Frames, mask: np.ndarray) -> FrameTable:
    """Return candidates without a pose, with the reason why they were not chosen."""
    found = frames.select(mask)
    n = len(found)
    unknown = np.full(n, np.nan)
    return FrameTable(
        names=found.names,
        sequences=found.sequences,
        cameras=found.cameras,
        evaluation=np.zeros(n, bool),
        tracked=np.zeros(n, bool),
        time_s=found.time_s,
        status=found.status,
        reason=found.reason,
        poses=Poses.unknown(n),
        sigma_m=unknown,
        sigma_deg=unknown,
        inliers=np.zeros(n, np.int64),
        error_px=unknown,
        **FrameTable.no_facts(n),
    )


def _residuals(
    path: Path, value: Mapping[str, Any], geo: GeoFit
) -> dict[str, tuple[np.ndarray, bool]]:
    names = value.get("frames", [])
    if len(names) != len(geo.residuals_m):
        raise FormatError(f"{path}: the numbers of residuals and frames differ")
    return {
        str(name): (residual, bool(outlier))
        for name, residual, outlier in zip(names, geo.residuals_m, geo.outlier, strict=True)
    }


def _tangents(camera: Camera) -> tuple[float, float]:
    """Return the tangents of half the horizontal and vertical field of view."""
    fx, fy = camera.focal_px
    return camera.width / 2 / fx, camera.height / 2 / fy


def _coverage(area: Area, folder: str) -> CoverageFacts | None:
    """Read the result of `spn-data coverage` for evaluation sequences or planned waypoints."""
    value = coverage_stage.read_coverage(area, folder)
    if value is None:
        return None
    try:
        counts = {
            str(name): {
                str(stratum): int(count)
                for stratum, count in {**summary["strata"], "failed": summary["failed"]}.items()
            }
            for name, summary in value["sequences"].items()
        }
        stops = tuple(
            PlaceToFly(
                (float(stop["x_m"]), float(stop["y_m"]), float(stop["z_m"])),
                (float(stop["lat_deg"]), float(stop["lon_deg"])),
                float(stop["heading_deg"]),
                float(stop["pitch_deg"]),
                int(stop["serves"]),
            )
            for stop in value["fly_again"] or ()
        )
        limits = _limits(value["options"])
    except DAMAGE as error:
        raise _damaged(area.folder(folder), error) from error
    return CoverageFacts(counts, stops, limits, coverage_stage.stale_because(area, value))


def _strata(area: Area) -> dict[str, str]:
    """Read the coverage stratum of each evaluation frame, by name; empty before `spn-data coverage`."""
    strata: dict[str, str] = {}
    folder = area.folder(COVERAGE)
    try:
        for table in sorted(folder.glob("*.csv")):
            strata |= read_strata(table)
    except InputError as error:
        raise _damaged(folder, error) from error
    return strata


def _damaged(folder: Path, error: Exception) -> FormatError:
    return FormatError(f"{folder}: cannot be read ({error!r}); run spn-data coverage again")


def _limits(options: Mapping[str, Any] | None) -> str:
    if options is None:
        return "There are no strata, because the map is not in metres."
    high, medium = (
        f"at most {options[f'{s}_m']:g} m and {options[f'{s}_deg']:g} deg from a mapping frame"
        for s in ("high", "medium")
    )
    return f"high: {high}; medium: {medium}; low: farther; failed: no pose."
