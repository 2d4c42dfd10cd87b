"""Whether an area is ready to train on, why, and what to do next; the rules stand in docs/report.md."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

from spn_data.report.data import STRATA, CoverageFacts, ReportData
from spn_data.split import audit
from spn_data.split.groups import OPTIMISTIC, TRAIN, VALIDATION


class Level(StrEnum):
    """How much a finding weighs."""

    GOOD = "good"
    CAUTION = "caution"
    STOP = "stop"


@dataclass(frozen=True)
class VerdictReason:
    """One reason; do : what to do about it, command : to type, both may be empty."""

    level: Level
    text: str
    do: str = ""
    command: str = ""


@dataclass(frozen=True)
class AreaVerdict:
    """level : that of the worst finding; findings : worst first."""

    level: Level
    headline: str
    findings: tuple[VerdictReason, ...]

    @property
    def next_step(self) -> VerdictReason | None:
        """The first finding that something can be done about."""
        return next((f for f in self.findings if f.do or f.command), None)


@dataclass(frozen=True, kw_only=True)
class VerdictLimits:
    """Where a figure becomes a reservation, or a reason not to train."""

    good_map_share: float = 0.95  # of the chosen frames that have a pose
    min_map_share: float = 0.80
    max_error_px: float = 1.0  # mean reprojection error
    max_held_out_ratio: float = 2.0  # of errors on fixes that the fit has not seen to its residuals
    max_heading_sigma_deg: float = 3.0
    max_scale_sigma: float = 0.03
    good_evaluation_share: float = 0.90  # of a sequence's frames that have a pose
    min_evaluation_share: float = 0.50
    max_low_share: float = 0.20  # of a sequence's covered frames in the lowest stratum
    min_training_frames: int = 100


def verdict(data: ReportData, limits: VerdictLimits | None = None) -> AreaVerdict:
    """By the rules of docs/report.md."""
    limits = limits or VerdictLimits()
    found = [
        *_stages(data),
        *_map(data, limits),
        *_place(data, limits),
        *_evaluation(data, limits),
        *_coverage(data, limits),
        *_split(data, limits),
        *_audit(data),
    ]
    order = [Level.STOP, Level.CAUTION, Level.GOOD]
    found.sort(key=lambda finding: order.index(finding.level))
    level = found[0].level if found else Level.GOOD
    n = sum(finding.level == level for finding in found)
    headline = {
        Level.GOOD: "Ready to train",
        Level.CAUTION: f"Ready to train, with {_count(n, 'reservation')}",
        Level.STOP: f"Not ready to train: {_count(n, 'thing')} to do first",
    }[level]
    return AreaVerdict(level, headline, tuple(found))


def _stages(data: ReportData) -> Iterator[VerdictReason]:
    for stage in data.stages:
        if stage.stale:
            yield VerdictReason(
                Level.STOP,
                f"{stage.record.stage} is out of date: {stage.stale}.",
                "Make this stage anew",
                f"{stage.command} --overwrite",
            )


def _map(data: ReportData, limits: VerdictLimits) -> Iterator[VerdictReason]:
    if data.model_record is None:
        yield VerdictReason(
            Level.STOP,
            "There is no model.",
            "Make the model",
            "spn-data reconstruct VIDEO --fov DEGREES",
        )
        return
    counts = data.model_record.counts
    registered, frames = int(counts["registered"]), int(counts["frames"])
    share = registered / frames
    text = f"The map holds {registered:,} of {frames:,} chosen frames ({share:.0%})"
    if share < limits.good_map_share:
        stop = share < limits.min_map_share
        yield VerdictReason(
            Level.STOP if stop else Level.CAUTION,
            text + ": it is not complete.",
            "See which passages are missing and why (below); fly them again and add them",
            "spn-data reconstruct VIDEO --add",
        )
    else:
        yield VerdictReason(Level.GOOD, text + ".")
    error = float(counts["mean_error_px"])
    text = f"Its mean reprojection error is {error:.2f} px"
    if error > limits.max_error_px:
        yield VerdictReason(
            Level.CAUTION,
            f"{text}, more than {limits.max_error_px:g} px: motion blur, rolling shutter or stabilization.",
            "Fly with a short exposure and electronic stabilization off",
        )
    else:
        yield VerdictReason(Level.GOOD, text + ".")
    rolling = [s["sequence"] for s in counts.get("shutter", []) if s.get("rolls")]
    if rolling:
        yield VerdictReason(
            Level.CAUTION,
            f"A rolling shutter shows in {', '.join(rolling)}: poses of fast passages are worse.",
            "Fly slower, or with another camera",
        )


def _place(data: ReportData, limits: VerdictLimits) -> Iterator[VerdictReason]:
    if data.model_record is None:
        return
    if data.geo is None:
        yield VerdictReason(
            Level.CAUTION,
            "The map is not georegistered: lengths are units of the model, not metres, and north and up "
            "are unknown. Errors of a trained model will have no metres either.",
            "Give telemetry with the flight (.SRT, .gpx, .csv or EXIF)",
            "spn-data georegister",
        )
        return
    stated, summary, held_out = data.geo.uncertainty, data.geo.summary, data.geo.held_out_blocks
    yield VerdictReason(
        Level.GOOD,
        f"The map is georegistered; as a whole it may lie {2 * stated.horizontal_m:.2f} m beside and "
        f"{2 * stated.vertical_m:.2f} m above or below its true place (2 sigma).",
    )
    if stated.heading_deg > limits.max_heading_sigma_deg or stated.scale > limits.max_scale_sigma:
        yield VerdictReason(
            Level.CAUTION,
            f"Its heading is known to {stated.heading_deg:.1f} deg and its scale to {stated.scale:.1%} only "
            "(1 sigma).",
            "Add a longer flight with a cross leg",
            "spn-data reconstruct VIDEO --add",
        )
    if held_out.horizontal_rmse_m > limits.max_held_out_ratio * summary.horizontal_rmse_m:
        yield VerdictReason(
            Level.CAUTION,
            f"GNSS fixes that the fit has not seen lie {held_out.horizontal_rmse_m:.2f} m away, those that "
            f"it has seen {summary.horizontal_rmse_m:.2f} m (RMSE): too few data to trust the place.",
            "Add a longer flight",
            "spn-data reconstruct VIDEO --add",
        )


def _evaluation(data: ReportData, limits: VerdictLimits) -> Iterator[VerdictReason]:
    frames = data.frames
    for name in data.evaluation_sequences:
        mine = frames.evaluation & (frames.sequences == name) & ~frames.tracked & frames.tried
        total, registered = int(mine.sum()), int((mine & frames.registered).sum())
        if not total:
            continue
        share = registered / total
        text = f"Evaluation sequence {name}: {registered:,} of {total:,} frames have a pose ({share:.0%})"
        if registered == 0:
            yield VerdictReason(
                Level.STOP,
                text + ". It is of another place, or the map lacks its views.",
                "Map those views, or remove the sequence's folders in 4-eval and 4-tracked",
            )
        elif share < limits.good_evaluation_share:
            few = "; a test on so few says little" if share < limits.min_evaluation_share else ""
            yield VerdictReason(
                Level.CAUTION,
                f"{text}{few}. Frames without a pose are the hard ones: tests look better than they are.",
                "Fly again where coverage is low and add it to the map",
                "spn-data reconstruct VIDEO --add",
            )
        else:
            yield VerdictReason(Level.GOOD, text + ".")
        yield from _own_gnss(name, data)


def _own_gnss(name: str, data: ReportData) -> Iterator[VerdictReason]:
    """The sequence's own fixes, which its labels were made without."""
    record = data.evaluation_records.get(name)
    gnss = record.counts.get("gnss") if record else None
    if not gnss or not gnss["contradicts"]:
        return
    beside = f"{math.hypot(gnss['offset_e_m'], gnss['offset_n_m']):.1f} m beside"
    if gnss["offset_u_m"] is not None:
        beside += f" and {gnss['offset_u_m']:+.1f} m above"
    yield VerdictReason(
        Level.CAUTION,
        f"The own GNSS of {name}, not used for its labels, lies {beside} them, more than it and the "
        "map's place account for: the map, or a lens, may be wrong.",
        "Compare flights and heights; see the residuals",
    )


def _coverage(data: ReportData, limits: VerdictLimits) -> Iterator[VerdictReason]:
    if data.coverage is None and data.evaluation_sequences:
        yield VerdictReason(
            Level.CAUTION,
            "How well mapping covers the evaluation sequences is not known.",
            "Measure it",
            "spn-data coverage",
        )
    if data.coverage is not None:
        for name in sorted(data.coverage.strata):
            yield from _strata(f"sequence {name}", name, data.coverage, limits)
        yield from _stale(data.coverage, "Coverage", "spn-data coverage")
    if data.plan is not None:
        for name in sorted(data.plan.strata):
            yield from _strata("the planned waypoints", name, data.plan, limits)
        command = "spn-data coverage --waypoints FILE.csv"
        yield from _stale(data.plan, "Coverage of the planned waypoints", command)


def _strata(
    what: str, name: str, coverage: CoverageFacts, limits: VerdictLimits
) -> Iterator[VerdictReason]:
    counts = coverage.strata[name]
    total = sum(counts.get(stratum, 0) for stratum in STRATA)
    if not total:
        return
    share = counts.get("low", 0) / total
    if share > limits.max_low_share:
        again = len(coverage.fly_again)
        yield VerdictReason(
            Level.CAUTION,
            f"{share:.0%} of {what} are views that no mapping frame is near to: a network has to "
            "extrapolate there.",
            f"Fly the {_count(again, 'place')} listed below and add them" if again else "",
            "spn-data reconstruct VIDEO --add",
        )
    else:
        parts = ", ".join(f"{counts.get(s, 0) / total:.0%} {s}" for s in STRATA)
        yield VerdictReason(Level.GOOD, f"Coverage of {what} by mapping frames: {parts}.")


def _stale(coverage: CoverageFacts, what: str, command: str) -> Iterator[VerdictReason]:
    if coverage.stale:
        text = f"{what} is out of date: {coverage.stale}."
        yield VerdictReason(Level.CAUTION, text, "Measure it again", command)


def _split(data: ReportData, limits: VerdictLimits) -> Iterator[VerdictReason]:
    if data.model_record is None:
        return
    if data.split is None:
        yield VerdictReason(
            Level.STOP,
            "Frames are not split into training, validation and test, and there is no dataset.h5.",
            "Split the frames",
            "spn-data split",
        )
        return
    counts = data.split.counts()
    train = counts.get(TRAIN, 0)
    text = f"{_count(train, 'frame')} to train on, {counts.get(VALIDATION, 0):,} to validate"
    if train == 0:
        yield VerdictReason(
            Level.STOP,
            "No frame is left to train on.",
            "Hold out less",
            "spn-data split --overwrite",
        )
    elif train < limits.min_training_frames:
        yield VerdictReason(
            Level.CAUTION,
            f"{text}: fewer than {limits.min_training_frames} for training.",
            "Take all frames of the video",
            "spn-data register --all-frames",
        )
    else:
        yield VerdictReason(Level.GOOD, text + ".")
    if data.split.optimistic:
        yield VerdictReason(
            Level.CAUTION,
            "The test is of the same flight as training: optimistic.",
            "Register a flight of another day as an evaluation sequence",
            "spn-data register VIDEO --name NAME",
        )


def _audit(data: ReportData) -> Iterator[VerdictReason]:
    if data.audit is None:
        if data.split is not None:
            yield VerdictReason(
                Level.STOP,
                "Whether test frames have leaked into training is not checked.",
                "Check the split",
                "spn-data audit",
            )
        return
    for check in data.audit:
        if check.verdict is audit.AuditVerdict.FAIL:
            yield VerdictReason(
                Level.STOP,
                f"The audit failed ({check.check}): {check.text}.",
                "Split anew",
                "spn-data split --overwrite",
            )
        elif check.verdict is audit.AuditVerdict.NOTICE and check.text != OPTIMISTIC:
            yield VerdictReason(Level.CAUTION, f"Audit, {check.check}: {check.text}.")
    if not audit.has_failed(data.audit):
        yield VerdictReason(Level.GOOD, f"The audit passed ({_count(len(data.audit), 'check')}).")


def _count(n: int, what: str) -> str:
    return f"{n:,} {what}{'' if n == 1 else 's'}"
