"""Updates of report.html by commands that change its content."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from spn_cli import console
from spn_data.area.area import Area
from spn_data.area.names import FRAMES, REPORT
from spn_data.errors import InUseError, SpnError

if TYPE_CHECKING:
    from spn_data.report.verdict import AreaVerdict


def refresh(area: Area) -> None:
    """Write report.html; if that fails, only show a note, because the results of the command are complete."""
    from spn_data.pipeline.area_report import write_report

    try:
        path, verdict = write_report(area)
    except SpnError as error:
        console.note(f"{REPORT} could not be written: {error}")
        return
    show_verdict(path, verdict)


def refresh_if_free(area: Area) -> None:
    """Write report.html, unless the area has no frames or is in use by another command."""
    if not area.has(FRAMES):
        return
    try:
        with area.locked():
            refresh(area)
    except InUseError:
        console.note(
            f"{REPORT} was not updated because the area is in use; run spn-data report later."
        )


def show_verdict(path: Path, verdict: AreaVerdict) -> None:
    """Print the verdict and the next step."""
    console.out.print(f"{verdict.headline}: see {path}.")
    if step := verdict.next_step:
        console.out.print(
            f"Next: {step.do}{': ' if step.do and step.command else ''}{step.command}"
        )
