"""Results of registration and tracking, as tables."""

from __future__ import annotations

from typing import Any

from spn_cli import console, output
from spn_data.area.names import EVALUATION, SPLIT, TRACKED
from spn_data.storage.stage_record import StageRecord


def evaluation(record: StageRecord, unit: str) -> None:
    """Print the table of an evaluation sequence; `unit` is "m" or "model units"."""
    c = record.counts
    console.table(
        f"{record.stage}: poses in the frozen map",
        [
            ("registered", f"{_share(c['registered'], c['frames'])} frames"),
            *((f"failed: {kind}", f"{n} frames") for kind, n in c["failed"].items()),
            *(
                [
                    ("lens", f"{c['focal_px']:.1f} px, {c['fov_deg']:.1f} deg wide"),
                    ("map points per frame", f"{c['inliers']:.0f} (median)"),
                    ("residual", f"{c['error_px']:.2f} px (median of RMS)"),
                    (
                        "uncertainty (1 sigma)",
                        f"{_length(c['sigma'], unit)}, {c['sigma_deg']:.3f} deg relative to the map (median)",
                    ),
                ]
                if c["registered"]
                else []
            ),
            time_row(record),
        ],
    )
    notes(record)


def tracked(record: StageRecord) -> None:
    """Print the table of the tracked frames of a sequence."""
    c = record.counts
    console.table(
        f"{record.stage}: tracked frames",
        [
            ("registered", f"{_share(c['registered'], c['frames'])} frames"),
            ("with chosen frames", f"{_share(c['registered_of_all'], c['of_all'])} video frames"),
            *((f"failed: {reason}", f"{n} frames") for reason, n in c["failed"].items()),
            time_row(record),
        ],
    )
    notes(record)


def summary(record: StageRecord) -> str:
    """Return the content of a stage in a few words."""
    c = record.counts
    group = record.stage.partition("/")[0]
    if group in (EVALUATION, TRACKED):
        return f"{_share(c['registered'], c['frames'])} frames"
    assert group == SPLIT, group
    return ", ".join(f"{name} {n}" for name, n in c["groups"].items())


def add_stage(record: StageRecord, **more: Any) -> None:
    """Add a stage to the object of `--json`."""
    known = output.current().figures.setdefault("stages", {})
    known[record.stage] = {
        **more,
        "counts": record.counts,
        "seconds": record.seconds,
        "cpu_seconds": record.cpu_seconds,
        "finished": record.finished,
    }


def notes(record: StageRecord) -> None:
    """Print the notes of a stage."""
    for note in record.notes:
        console.note(note)


def time_row(record: StageRecord) -> tuple[str, str]:
    """Return the row with the time that a stage took."""
    steps = ", ".join(
        f"{name} {console.duration(s)}" for name, s in record.seconds.items() if s >= 1
    )
    total, cpu = sum(record.seconds.values()), sum(record.cpu_seconds.values())
    return (
        "time",
        f"{console.duration(total)} ({cpu:.0f} s of CPU){f': {steps}' if steps else ''}",
    )


def _share(part: int, whole: int) -> str:
    return f"{part} of {whole} ({part / max(whole, 1):.1%})"


def _length(value: Any, unit: str) -> str:
    return f"{100 * value:.1f} cm" if unit == "m" else f"{value:.4g} {unit}"
