"""The area's page, kept up to date by every command that changes what it shows."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from spn_cli import console
from spn_data.area.area import Area
from spn_data.area.names import FRAMES
from spn_data.errors import InUseError, SpnError

if TYPE_CHECKING:
    from spn_data.report.verdict import AreaVerdict


def refresh(area: Area) -> None:
    """Write report.html. What a command has made stands, whatever becomes of the page."""
    from spn_data.pipeline.area_report import write_report

    try:
        path, verdict = write_report(area)
    except SpnError as error:
        console.note(f"report.html could not be written: {error}")
        return
    tell(path, verdict)


def refresh_if_free(area: Area) -> None:
    """As `refresh`, of an area that may be in use by another command, or hold nothing but networks."""
    if not area.has(FRAMES):
        return
    try:
        with area.locked():
            refresh(area)
    except InUseError:
        console.note(
            "report.html is as before: the area is in use; spn-data report writes it anew."
        )


def tell(path: Path, verdict: AreaVerdict) -> None:
    """The verdict, and what to do next."""
    console.out.print(f"{verdict.headline}: see {path}.")
    if step := verdict.next_step:
        console.out.print(
            f"Next: {step.do}{': ' if step.do and step.command else ''}{step.command}"
        )
