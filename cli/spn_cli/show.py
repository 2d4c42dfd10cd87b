"""Results of the stages of an area, as tables and sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

from spn_cli import console, output, show_labels
from spn_data.area.area import Area
from spn_data.area.names import (
    CHECKPOINT,
    COMPARED,
    EVALUATION,
    FRAMES,
    GEO,
    METRICS,
    MODEL,
    RUNS,
    STAGES,
    STATE,
    TRACKED,
)
from spn_data.errors import StageError
from spn_data.pipeline.frames_stage import Plan
from spn_data.storage.json_files import reporting_damage
from spn_data.storage.stage_record import StageRecord
from spn_data.telemetry.track import TelemetrySummary

_UNFINISHED = "unfinished; the same command resumes it"


class Live:
    """Display of stages: progress while one is made, its table when it is done."""

    def __init__(self, unit: str = "m") -> None:
        self.unit = unit  # of lengths in labels
        self._bars: AbstractContextManager[Any] | None = None
        self._progress: Any = None

    def __enter__(self) -> Live:
        return self

    def __exit__(self, *error: Any) -> None:
        self._close()

    def _close(self) -> None:
        if self._bars is not None:
            self._bars.__exit__(None, None, None)
            self._bars = None

    def progress(self, step: str, done: int, total: int) -> None:
        """Show the progress of a step."""
        if self._bars is None:
            self._bars = console.progress()
            self._progress = self._bars.__enter__()
        self._progress(step, done, total)

    def planned(self, found: Plan, model_cost: tuple[float, int]) -> None:
        """Show the sources, and the expected time and disk space."""
        rows = []
        for source in found.sources:
            own = "in the photos" if source.kind == "photos" else "none"
            telemetry = ", ".join(path.name for path in source.telemetry) or own
            what = (
                f"{len(source.parts)} photos" if source.kind == "photos" else _files(source.parts)
            )
            rows.append((source.sequence, what, telemetry))
        console.table("Sources", rows, ("sequence", "files", "telemetry"))
        if found.ignored:
            shown = ", ".join(f"{path} ({why})" for path, why in found.ignored[:8])
            more = f" and {len(found.ignored) - 8} more" if len(found.ignored) > 8 else ""
            console.note(f"ignored: {shown}{more}")
        cost = found.cost
        seconds, disk_bytes = model_cost
        choosing, mapping = console.duration(cost.seconds), console.duration(seconds)
        console.say(
            f"Expected: about {cost.chosen} frames of {cost.candidates} images; {choosing} for "
            f"frame selection and {mapping} for the model; "
            f"{(cost.disk_bytes + disk_bytes) / 1e6:.0f} MB on disk.\n"
        )

    def telemetry(self, sequence: str, summary: TelemetrySummary | None) -> None:
        """Show the telemetry of a sequence."""
        self._close()
        if summary is None:
            console.note(f"{sequence}: no telemetry.")
            return
        heights = [
            *(["above take-off"] if summary.has_rel_alt else []),
            *([f"absolute (reference: {summary.abs_reference})"] if summary.has_abs_alt else []),
        ]
        rate = f"{summary.rate_hz:.3g} fixes/s" if math.isfinite(summary.rate_hz) else "no rate"
        gaps = f"{len(summary.gaps)} gaps" if summary.gaps else "no gaps"
        console.say(
            f"{sequence}: {summary.kind}, {summary.with_fix} of {summary.records} records with a fix, "
            f"{rate}, {gaps}; heights {' and '.join(heights) or 'unknown'}; "
            f"gimbal {'known' if summary.has_gimbal else 'unknown'}."
        )
        for note in summary.notes:
            console.note(f"{sequence}: {note}")

    def stage(self, record: StageRecord) -> None:
        """Show the table of a finished stage."""
        self._close()
        show_labels.add_stage(record)
        group = record.stage.partition("/")[0]
        if group == EVALUATION:
            show_labels.evaluation(record, self.unit)
        else:
            tables = {
                FRAMES: frames,
                MODEL: model,
                GEO: georegistration,
                TRACKED: show_labels.tracked,
            }
            tables[group](record)

    def made(self, record: StageRecord, before: Mapping[str, StageRecord]) -> None:
        """Show a stage, or that it is unchanged if `before` contains the same record."""
        (self.unchanged if record == before.get(record.stage) else self.stage)(record)

    def unchanged(self, record: StageRecord) -> None:
        """Show that a stage was up to date."""
        self._close()
        show_labels.add_stage(record)
        console.say(f"{record.stage}: unchanged since {record.finished} ({_summary(record)}).")


def frames(record: StageRecord) -> None:
    """Print the table of 1-frames."""
    counts = record.counts
    console.table(
        f"{FRAMES}: chosen frames",
        [
            ("chosen", f"{counts['chosen']} of {counts['candidates']} images"),
            ("sequences", str(counts["sequences"])),
            ("with a fix", str(counts["with_fix"])),
            *([("unreadable", str(counts["unreadable"]))] if counts["unreadable"] else []),
            show_labels.time_row(record),
        ],
    )
    show_labels.notes(record)


def model(record: StageRecord) -> None:
    """Print the table of 2-model."""
    counts = record.counts
    console.table(
        f"{MODEL}: reconstruction",
        [
            ("registered", f"{counts['registered']} of {counts['frames']} frames in one model"),
            ("mean reprojection error", f"{counts['mean_error_px']:.2f} px"),
            ("points", f"{counts['points']} with {counts['observations']} observations"),
            ("pairs", f"{counts['pairs_verified']} verified of {counts['pairs_tried']} tried"),
            *(
                (f"camera {key}", f"{camera['focal_px']:.1f} px, {camera['fov_deg']:.1f} deg wide")
                for key, camera in counts["cameras"].items()
            ),
            show_labels.time_row(record),
        ],
    )
    show_labels.notes(record)


def georegistration(record: StageRecord) -> None:
    """Print the table of 3-geo."""
    c = record.counts
    lat, lon, alt = c["origin"]
    console.table(
        f"{GEO}: georegistration",
        [
            ("fixes", f"{c['fixes']} of {c['frames']} frames, {c['outliers']} of them outliers"),
            (
                "residuals",
                f"{_m(c['horizontal_rmse_m'])} horizontal, {_m(c['vertical_rmse_m'])} vertical (RMSE)",
            ),
            ("CE90, LE90", f"{_m(c['ce90_m'])}, {_m(c['le90_m'])}"),
            (
                "held out",
                f"{_m(c['held_out_horizontal_rmse_m'])} horizontal, {_m(c['held_out_vertical_rmse_m'])} "
                f"vertical (RMSE over {c['held_out_blocks']} blocks of time)",
            ),
            (
                "uncertainty (1 sigma)",
                f"{_m(c['sigma_horizontal_m'])} horizontal, {_m(c['sigma_vertical_m'])} vertical, "
                f"tilt {_format(c['sigma_tilt_deg'], '.2f')} deg, "
                f"heading {_format(c['sigma_heading_deg'], '.2f')} deg, "
                f"scale {_format(c['sigma_scale'], '.3%')}",
            ),
            ("from", ", ".join(c["observations"])),
            ("origin", f"{lat:.6f}, {lon:.6f}, height {alt:.2f} m ({c['height_reference']})"),
            show_labels.time_row(record),
        ],
    )
    if c.get("control"):
        surveyed(c["control"])
    show_labels.notes(record)


def surveyed(points: Sequence[Mapping[str, Any]]) -> None:
    """Print the residuals of surveyed points, and their RMSE beside what is stated."""
    output.figures(points=points)
    rows = []
    for point in points:
        role = f"{point['role']} (left out)" if point["is_outlier"] else point["role"]
        east, north, up = (_signed(v) for v in point["residual_m"])
        sigma = ", ".join(_format(v, ".3f") for v in point["sigma_m"])
        pixels = _format(point["reprojection_px"], ".2f")
        rows.append((point["name"], role, str(point["marks"]), east, north, up, sigma, pixels))
    header = ("point", "role", "marks", "east m", "north m", "up m", "sigma E, N, U", "px")
    console.table("Ground control: surveyed minus mapped", rows, header)
    for role in ("control", "check"):
        mine = [p for p in points if p["role"] == role and not p["is_outlier"]]
        if mine:
            console.say(f"{len(mine)} {role} points: {', '.join(_rmse(mine))}.")


def _rmse(points: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the RMSE east, north and up of points, and the RMS of their stated sigmas."""
    by_axis = []
    for k, axis in enumerate(("east", "north", "up")):
        pairs = [
            (p["residual_m"][k], p["sigma_m"][k]) for p in points if p["residual_m"][k] is not None
        ]
        if pairs:
            found, stated = (
                math.sqrt(sum(v * v for v in col) / len(pairs)) for col in zip(*pairs, strict=True)
            )
            by_axis.append(f"{axis} RMSE {found:.3f} m (stated {stated:.3f} m)")
    return by_axis


def _signed(value: float | None) -> str:
    return _format(value, "+.3f")


def _run(area: Area, name: str) -> tuple[str, str, str, str]:
    """Return the row of a run in the table of `status`."""
    folder = area.root / RUNS / name
    is_evaluated = (folder / METRICS).is_file()
    if name == COMPARED:
        return (
            f"{RUNS}/{name}",
            "complete" if is_evaluated else "missing",
            "several runs side by side",
            "",
        )
    if (folder / STATE).is_file() or not (folder / CHECKPOINT).is_file():
        return f"{RUNS}/{name}", _UNFINISHED, "", ""
    holds = "evaluated" if is_evaluated else f"not evaluated: spn-model evaluate --run {name}"
    return f"{RUNS}/{name}", "complete", holds, ""


def status(area: Area) -> None:
    """Print the state of every stage and run; raise StageError if no stage was begun."""
    if not any(area.has(stage) or area.partial(stage).exists() for stage in STAGES):
        raise StageError(
            f"{area.root.resolve()} is not an area; create one with spn-data reconstruct VIDEO --area AREA"
        )
    rows = []
    stages = output.current().figures.setdefault("stages", {})
    for stage in (*STAGES, *(s for s in area.stages() if s not in STAGES)):
        if not area.has(stage):
            state = _UNFINISHED if area.partial(stage).exists() else "missing"
            rows.append((stage, state, "", ""))
            stages[stage] = {"state": state}
            continue
        record = area.record(stage)
        with reporting_damage(area.folder(stage)):
            holds = _summary(record)
        reason = area.stale_because(stage)
        state = f"stale: {reason}" if reason else "complete"
        if area.partial(stage).exists():
            state += "; redoing it is unfinished"
        rows.append((stage, state, holds, record.finished))
        show_labels.add_stage(record, state=state)
    runs = [_run(area, name) for name in area.sequences(RUNS)]
    output.figures(area=area.root.resolve(), runs={name: state for name, state, _, _ in runs})
    rows += runs
    console.table(f"Area {area.root.resolve()}", rows, ("stage", "state", "holds", "made (UTC)"))
    if area.has_unfinished_addition():
        console.note("an addition is unfinished; the same command with --add resumes it.")
    verdict(area)


def verdict(area: Area) -> None:
    """Print how many frames have a pose, and the uncertainty of the georegistration."""
    if not area.has(MODEL):
        console.say("There is no model yet; run spn-data reconstruct.")
        return
    counts = area.record(MODEL).counts
    with reporting_damage(area.folder(MODEL)):
        share = counts["registered"] / max(counts["frames"], 1)
    sentence = f"{counts['registered']} of {counts['frames']} frames ({share:.1%}) have a pose"
    if area.has(GEO) and area.stale_because(GEO) is None:
        c = area.record(GEO).counts
        with reporting_damage(area.folder(GEO)):
            horizontal = _m(_twice(c["sigma_horizontal_m"]))
            vertical = _m(_twice(c["sigma_vertical_m"]))
        sentence += f" in {area.folder(GEO)}; "
        sentence += f"uncertainty of the whole model (2 sigma): horizontal {horizontal}"
        if c["height_reference"] == "unknown":
            sentence += "; its height reference is unknown."
        else:
            sentence += f", vertical {vertical}."
    else:
        sentence += f" in {area.folder(MODEL)}, in model units, not metres."
    console.say(sentence)


def _summary(record: StageRecord) -> str:
    c = record.counts
    if record.stage == FRAMES:
        return f"{c['chosen']} frames of {c['sequences']} sequences"
    if record.stage == MODEL:
        return f"{c['registered']} of {c['frames']} frames, {c['points']} points"
    if record.stage == GEO:
        horizontal, vertical = _m(c["horizontal_rmse_m"]), _m(c["vertical_rmse_m"])
        return f"{horizontal} horizontal, {vertical} vertical residual (RMSE)"
    return show_labels.summary(record)


def _files(parts: tuple[Any, ...]) -> str:
    return parts[0].name if len(parts) == 1 else f"{parts[0].name} and {len(parts) - 1} more parts"


def _m(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2f} m"


def _format(value: float | None, form: str) -> str:
    return "unknown" if value is None else format(value, form)


def _twice(value: float | None) -> float | None:
    return None if value is None else 2 * value
