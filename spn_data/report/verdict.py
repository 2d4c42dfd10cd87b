"""Verdict on the data of an area: whether they are ready for training, and why (see docs/report.md)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

from spn_data.report.data import STRATA, CoverageFacts, ReportData
from spn_data.split import audit
from spn_data.split.groups import OPTIMISTIC, TRAIN, VALIDATION

_FAR = "It is declared to be far from the map (expect_low in area.toml)."


class Level(StrEnum):
    """Severity of a finding."""

    GOOD = "good"
    CAUTION = "caution"
    STOP = "stop"
    UNKNOWN = "unknown"  # not measured


@dataclass(frozen=True)
class VerdictReason:
    """One reason for the verdict. do : remedy, command : what to type; both may be empty."""

    level: Level
    text: str
    do: str = ""
    command: str = ""


@dataclass(frozen=True)
class DataVerdict:
    """Verdict on the data of an area.

    Attributes
    ----------
    level : Level
        Severity of the worst finding.
    headline : str
        The verdict in one line.
    findings : tuple of VerdictReason
        All findings, worst first.
    """

    level: Level
    headline: str
    findings: tuple[VerdictReason, ...]


@dataclass(frozen=True, kw_only=True)
class VerdictLimits:
    """Thresholds at which a figure becomes a reservation or a reason not to train."""

    good_map_share: float = 0.95  # of the chosen frames that have a pose
    min_map_share: float = 0.80
    max_error_px: float = 1.0  # mean reprojection error
    max_held_out_ratio: float = 2.0  # ratio of errors on held-out fixes to residuals of the fit
    max_heading_sigma_deg: float = 3.0
    max_scale_sigma: float = 0.03
    good_evaluation_share: float = 0.90  # of a sequence's frames that have a pose
    min_evaluation_share: float = 0.50
    max_low_share: float = 0.20  # of a sequence's covered frames in the lowest stratum
    min_training_frames: int = 100


def judge_data(data: ReportData, limits: VerdictLimits | None = None) -> DataVerdict:
    """Judge the data of an area by the rules of docs/report.md.

    Parameters
    ----------
    data : ReportData
        State of the area.
    limits : VerdictLimits, optional
        Thresholds; the documented ones by default.

    Returns
    -------
    DataVerdict
        Verdict and findings, worst first.
    """
    limits = limits or VerdictLimits()
    found = [
        *_stages(data),
        *_map(data, limits),
        *_place(data, limits),
        *_declared(data),
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
        Level.CAUTION: f"Ready to train, with {count_of(n, 'reservation')}",
        Level.STOP: f"Not ready to train: {count_of(n, 'thing')} to do first",
    }[level]
    return DataVerdict(level, headline, tuple(found))


def _stages(data: ReportData) -> Iterator[VerdictReason]:
    for stage in data.stages:
        if stage.stale:
            yield VerdictReason(
                Level.STOP,
                f"{stage.record.stage} is out of date: {stage.stale}.",
                "Redo this stage",
                f"{stage.command} --overwrite",
            )


def _map(data: ReportData, limits: VerdictLimits) -> Iterator[VerdictReason]:
    if data.model_record is None:
        yield VerdictReason(
            Level.STOP,
            "There is no model.",
            "Reconstruct the model",
            "spn-data reconstruct VIDEO --fov DEGREES",
        )
        return
    counts = data.model_record.counts
    registered, frames = int(counts["registered"]), int(counts["frames"])
    share = registered / frames
    text = f"The map contains {registered:,} of {frames:,} chosen frames ({share:.0%})"
    if share < limits.good_map_share:
        stop = share < limits.min_map_share
        yield VerdictReason(
            Level.STOP if stop else Level.CAUTION,
            text + ": it is incomplete.",
            "See below which parts are missing and why, fly them again and add the flight",
            "spn-data reconstruct VIDEO --add",
        )
    else:
        yield VerdictReason(Level.GOOD, text + ".")
    if counts.get("contradicted"):
        yield VerdictReason(
            Level.STOP,
            "Matches or fixes contradict the map: parts of it lie at wrong places. Places may look alike; "
            "the notes on the model name the worst contradiction.",
            "Fly again with more overlap and from farther away, where several places are seen together",
            "spn-data reconstruct VIDEO --add",
        )
    error = float(counts["mean_error_px"])
    text = f"The mean reprojection error is {error:.2f} px"
    if error > limits.max_error_px:
        yield VerdictReason(
            Level.CAUTION,
            f"{text}, more than {limits.max_error_px:g} px; likely causes are motion blur, rolling shutter "
            "or electronic stabilization.",
            "Fly with a short exposure time and electronic stabilization switched off",
        )
    else:
        yield VerdictReason(Level.GOOD, text + ".")
    rolling = [s["sequence"] for s in counts.get("shutter", []) if s.get("rolls")]
    if rolling:
        yield VerdictReason(
            Level.CAUTION,
            f"Rolling shutter affects {', '.join(rolling)}: poses are less accurate in fast motion.",
            "Fly slower, or use another camera",
        )


def _place(data: ReportData, limits: VerdictLimits) -> Iterator[VerdictReason]:
    if data.model_record is None:
        return
    if data.geo is None:
        yield VerdictReason(
            Level.CAUTION,
            "The map is not georegistered: lengths are in model units, not metres, and north and up are "
            "unknown. Errors of a trained network will not be in metres either.",
            "Provide telemetry with the flight (.SRT, .gpx, .csv or EXIF)",
            "spn-data georegister",
        )
        return
    stated, summary, held_out = data.geo.uncertainty, data.geo.summary, data.geo.held_out_blocks
    yield VerdictReason(
        Level.GOOD,
        "The map is georegistered; uncertainty of the whole map: horizontal "
        f"{2 * stated.horizontal_m:.2f} m, vertical {2 * stated.vertical_m:.2f} m (2 sigma).",
    )
    if stated.heading_deg > limits.max_heading_sigma_deg or stated.scale > limits.max_scale_sigma:
        yield VerdictReason(
            Level.CAUTION,
            f"The orientation and scale of the map are uncertain: heading {stated.heading_deg:.1f} deg, "
            f"scale {stated.scale:.1%} (1 sigma).",
            "Add a longer flight with crossing legs",
            "spn-data reconstruct VIDEO --add",
        )
    if held_out.horizontal_rmse_m > limits.max_held_out_ratio * summary.horizontal_rmse_m:
        yield VerdictReason(
            Level.CAUTION,
            f"The horizontal RMSE is {held_out.horizontal_rmse_m:.2f} m for held-out GNSS fixes but "
            f"{summary.horizontal_rmse_m:.2f} m for fitted ones: too few data for a reliable fit.",
            "Add a longer flight",
            "spn-data reconstruct VIDEO --add",
        )


def _declared(data: ReportData) -> Iterator[VerdictReason]:
    unknown = sorted(data.expect_low - set(data.evaluation_sequences))
    if unknown:
        yield VerdictReason(
            Level.CAUTION,
            f"area.toml expects low coverage of {', '.join(unknown)}, which is no evaluation sequence of the "
            "area: the declaration has no effect.",
            "Correct expect_low in area.toml, or register the sequence",
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
        if name in data.expect_low:
            nothing = "; nothing can be tested on it" if registered == 0 else ""
            yield VerdictReason(
                Level.CAUTION if nothing else Level.GOOD, f"{text}{nothing}. {_FAR}"
            )
        elif registered == 0:
            yield VerdictReason(
                Level.STOP,
                text + ". It shows another place, or the map does not cover its views.",
                "Map those views, or remove the sequence's folders in 4-eval and 4-tracked",
            )
        elif share < limits.good_evaluation_share:
            few = (
                "; a test on so few frames is hardly meaningful"
                if share < limits.min_evaluation_share
                else ""
            )
            yield VerdictReason(
                Level.CAUTION,
                f"{text}{few}. Frames without a pose tend to be the difficult ones, so test results look "
                "too good.",
                "Fly again where coverage is low and add the flight to the map",
                "spn-data reconstruct VIDEO --add",
            )
        else:
            yield VerdictReason(Level.GOOD, text + ".")
        yield from _own_gnss(name, data)


def _own_gnss(name: str, data: ReportData) -> Iterator[VerdictReason]:
    """Check the labels against the sequence's own GNSS fixes, which they do not use."""
    record = data.evaluation_records.get(name)
    gnss = record.counts.get("gnss") if record else None
    if not gnss:
        return
    if gnss.get("far"):
        yield VerdictReason(
            Level.CAUTION,
            f"{gnss['far']} labels of {name} are far from their own GNSS fixes, unlike the others: they show "
            "a place that looks alike, or these fixes are wrong.",
            "Compare these frames with the map frames beside them",
        )
    if not gnss["contradicts"]:
        return
    offset = f"{math.hypot(gnss['offset_e_m'], gnss['offset_n_m']):.1f} m horizontally"
    if gnss["offset_u_m"] is not None:
        offset += f" and {gnss['offset_u_m']:+.1f} m vertically"
    yield VerdictReason(
        Level.CAUTION,
        f"The GNSS of {name}, not used for its labels, deviates from them by {offset}, more than its "
        "noise and the uncertainty of the map explain: the map or a lens may be wrong.",
        "Compare flights and heights, and check the residuals",
    )


def _coverage(data: ReportData, limits: VerdictLimits) -> Iterator[VerdictReason]:
    if data.coverage is None and data.evaluation_sequences:
        yield VerdictReason(
            Level.CAUTION,
            "The coverage of the evaluation sequences by mapping frames is not known.",
            "Measure the coverage",
            "spn-data coverage",
        )
    if data.coverage is not None:
        for name in sorted(data.coverage.strata):
            is_far = name in data.expect_low
            yield from _strata(f"sequence {name}", name, data.coverage, limits, is_far=is_far)
        yield from _stale(data.coverage, "Coverage", "spn-data coverage")
    if data.plan is not None:
        for name in sorted(data.plan.strata):
            yield from _strata("the planned waypoints", name, data.plan, limits, is_far=None)
        command = "spn-data coverage --waypoints FILE.csv"
        yield from _stale(data.plan, "Coverage of the planned waypoints", command)


def _strata(
    what: str, name: str, coverage: CoverageFacts, limits: VerdictLimits, *, is_far: bool | None
) -> Iterator[VerdictReason]:
    counts = coverage.strata[name]
    total = sum(counts.get(stratum, 0) for stratum in STRATA)
    if not total:
        return
    share = counts.get("low", 0) / total
    if share > limits.max_low_share and not is_far:
        again = len(coverage.fly_again)
        declare = f" If it is meant to, declare it: register --name {name} --expect-low."
        yield VerdictReason(
            Level.CAUTION,
            f"{share:.0%} of the views of {what} have no mapping frame nearby: a network has to "
            f"extrapolate there.{'' if is_far is None else declare}",
            f"Fly the {count_of(again, 'place')} listed below and add the flight" if again else "",
            "spn-data reconstruct VIDEO --add",
        )
    else:
        parts = ", ".join(f"{counts.get(s, 0) / total:.0%} {s}" for s in STRATA)
        why = f" {_FAR}" if is_far else ""
        yield VerdictReason(Level.GOOD, f"Coverage of {what} by mapping frames: {parts}.{why}")


def _stale(coverage: CoverageFacts, what: str, command: str) -> Iterator[VerdictReason]:
    if coverage.stale:
        text = f"{what} is out of date: {coverage.stale}."
        yield VerdictReason(Level.CAUTION, text, "Measure the coverage again", command)


def _split(data: ReportData, limits: VerdictLimits) -> Iterator[VerdictReason]:
    if data.model_record is None:
        return
    if data.split is None:
        yield VerdictReason(
            Level.STOP,
            "The frames are not split into training, validation and test, so there is no dataset.h5 yet.",
            "Split the frames",
            "spn-data split",
        )
        return
    counts = data.split.counts()
    train = counts.get(TRAIN, 0)
    text = f"{count_of(train, 'training frame')}, {count_of(counts.get(VALIDATION, 0), 'validation frame')}"
    if train == 0:
        yield VerdictReason(
            Level.STOP,
            "No training frames are left.",
            "Hold out fewer frames",
            "spn-data split --overwrite",
        )
    elif train < limits.min_training_frames:
        yield VerdictReason(
            Level.CAUTION,
            f"{text}: fewer than {limits.min_training_frames} training frames.",
            "Label all frames of the video",
            "spn-data register --all-frames",
        )
    else:
        yield VerdictReason(Level.GOOD, text + ".")
    if data.split.optimistic:
        yield VerdictReason(
            Level.CAUTION,
            "Test and training frames are of the same flight, so test results are optimistic.",
            "Register a flight of another day as an evaluation sequence",
            "spn-data register VIDEO --name NAME",
        )


def _audit(data: ReportData) -> Iterator[VerdictReason]:
    if data.audit is None:
        if data.split is not None:
            yield VerdictReason(
                Level.STOP,
                "The split has not been audited for test frames that leaked into training.",
                "Audit the split",
                "spn-data audit",
            )
        return
    for check in data.audit:
        if check.verdict is audit.AuditVerdict.FAIL:
            yield VerdictReason(
                Level.STOP,
                f"The audit failed ({check.check}): {check.text}.",
                "Split again",
                "spn-data split --overwrite",
            )
        elif check.verdict is audit.AuditVerdict.NOTICE and check.text != OPTIMISTIC:
            yield VerdictReason(Level.CAUTION, f"Audit, {check.check}: {check.text}.")
    if not audit.has_failed(data.audit):
        yield VerdictReason(Level.GOOD, f"The audit passed ({count_of(len(data.audit), 'check')}).")


def count_of(n: int, what: str) -> str:
    """Return a number of things in words."""
    return f"{n:,} {what}{'' if n == 1 else 's'}"
