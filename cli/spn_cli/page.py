"""Updates of report.html by commands that change its content."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from spn_cli import console, output
from spn_data.area.area import Area
from spn_data.area.names import FRAMES, REPORT
from spn_data.errors import InUseError, SpnError

if TYPE_CHECKING:
    from spn_data.report.area_verdict import AreaVerdict
    from spn_data.report.verdict import VerdictReason


def refresh(area: Area) -> AreaVerdict | None:
    """Write report.html and show the verdict; if that fails, only a note: the results are complete."""
    from spn_data.pipeline.area_report import write_report

    try:
        with console.working(f"Writing {REPORT}"):
            path, verdict = write_report(area)
    except SpnError as error:
        console.note(f"{REPORT} could not be written: {error}")
        return None
    show_verdict(verdict, area, path)
    return verdict


def refresh_if_free(area: Area) -> AreaVerdict | None:
    """Write report.html, unless the area has no frames or is in use by another command."""
    if not area.has(FRAMES):
        return None
    try:
        with area.locked():
            return refresh(area)
    except InUseError:
        console.note(
            f"{REPORT} was not updated because the area is in use; run spn-data report later."
        )
    return None


def complete_cards(verdict: AreaVerdict | None, folders: Mapping[str, Path]) -> None:
    """Write the verdict into the model cards of bundles, by run; without one they say so themselves."""
    from spn_model.onboard.bundle import CARD
    from spn_model.runs.run_export import write_verdict

    if verdict is None:
        return
    for run, folder in folders.items():
        if (folder / CARD).is_file():
            try:
                write_verdict(
                    folder, ((name, _sentence(said)) for name, said in verdict.parts(run))
                )
            except SpnError as error:
                console.note(f"the model card of {run} was not completed: {error}")


def open_in_browser(address: str) -> None:
    """Open a page in the default browser; say so if none can be started."""
    import webbrowser

    if not webbrowser.open(address):
        console.note(f"no browser could be started; open {address} in one")


def show_judgement(area: Area) -> None:
    """Print the verdict and the next step of an area with frames; say why if they are not known."""
    from spn_data.pipeline.area_report import judge_area

    if not area.has(FRAMES):
        return
    try:
        with console.working("Judging the area"):
            verdict = judge_area(area)
    except SpnError as error:
        console.note(f"there is no verdict: {error}")
        return
    show_verdict(verdict, area)


def show_verdict(verdict: AreaVerdict, area: Area, path: Path | None = None) -> None:
    """Print the verdict, the page with its reasons if it was written, and the next step."""
    from spn_data.report.area_verdict import DATA

    output.figures(verdict={name: _sentence(said, area) for name, said in verdict.parts()})
    if path is not None:
        output.figures(report=path)
    for name, said in verdict.parts():
        text = _sentence(said, area)
        if path is not None and name == DATA:
            text = f"{text.removesuffix('.')}: see {path}."
        console.say(f"{name}: {text}", wrap=False)
    show_next(verdict.next, area)


def _sentence(said: VerdictReason, area: Area | None = None) -> str:
    """Return a part of the verdict with its remedy, as a command that can be typed in the current folder."""
    command = _command(said.command, area) if area and said.command else said.command
    do = f" {said.do}{f': {command}' if command else ''}." if said.do else ""
    return f"{said.text}{do}"


def show_next(step: VerdictReason, area: Area) -> None:
    """Print the next step: one line that can be typed in the current folder."""
    command = _command(step.command, area)
    words = f"Next: {step.do}{': ' if step.do and command else ''}{command}"
    output.figures(next={"do": step.do, "command": command})
    console.say(words, wrap=False)


def _command(command: str, area: Area) -> str:
    from spn_data.report.next_step import command_for

    root, here = area.root.resolve(), Path.cwd()
    return command_for(command, root.relative_to(here) if root.is_relative_to(here) else root)
