"""Updates of report.html by commands that change its content."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from spn_cli import console
from spn_data.area.area import Area
from spn_data.area.names import FRAMES, REPORT
from spn_data.errors import InUseError, SpnError

if TYPE_CHECKING:
    from spn_data.report.verdict import AreaVerdict, VerdictReason


def refresh(area: Area) -> None:
    """Write report.html; if that fails, only show a note, because the results of the command are complete."""
    from spn_data.pipeline.area_report import write_report

    try:
        path, verdict, step = write_report(area)
    except SpnError as error:
        console.note(f"{REPORT} could not be written: {error}")
        return
    show_verdict(verdict, path)
    show_next(step, area)


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


def open_in_browser(path: Path) -> None:
    """Open a page in the default browser; say so if none can be started."""
    import webbrowser

    if not webbrowser.open(path.resolve().as_uri()):
        console.note(f"no browser could be started; open {path.resolve()} in one")


def show_judgement(area: Area) -> None:
    """Print the verdict and the next step of an area with frames; say why if they are not known."""
    from spn_data.pipeline.area_report import judge_area

    if not area.has(FRAMES):
        return
    try:
        verdict, step = judge_area(area)
    except SpnError as error:
        console.note(f"there is no verdict: {error}")
        return
    show_verdict(verdict)
    show_next(step, area)


def show_verdict(verdict: AreaVerdict, path: Path | None = None) -> None:
    """Print the verdict, and the page with its reasons if it was written."""
    console.out.print(f"{verdict.headline}{f': see {path}' if path else ''}.")


def show_next(step: VerdictReason, area: Area) -> None:
    """Print the next step: one line that can be typed in the current folder."""
    from spn_data.report.next_step import command_for

    root, here = area.root.resolve(), Path.cwd()
    where = root.relative_to(here) if root.is_relative_to(here) else root
    command = command_for(step.command, where)
    words = f"Next: {step.do}{': ' if step.do and command else ''}{command}"
    console.out.print(words, soft_wrap=True)
