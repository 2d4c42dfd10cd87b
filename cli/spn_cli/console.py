"""Terminal output: tables, sentences and notes; progress with the remaining time.

What a command prints goes through here, so that `--quiet` and `--json` hold for all of them. Results go to
standard output, progress to standard error. Without a terminal nothing is wrapped: a record is a line.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as RichProgress
from rich.table import Table
from rich.text import Text

from spn_cli import output
from spn_cli.group import raise_if_stopped
from spn_data.work.timing import Progress

# File names of the user are printed unchanged: brackets in them are not markup, colons not emoji.
out = Console(highlight=False, markup=False, emoji=False)
err = Console(highlight=False, markup=False, emoji=False, stderr=True)
_PLAIN_EVERY_S = 20.0
_SIGN_AFTER_S = 2.0  # without a terminal; what is over sooner needs no line in a log


def say(text: str, *, wrap: bool = True) -> None:
    """Print a sentence of the results; without `wrap`, in one line on a narrow terminal too."""
    if not output.current().is_silent:
        _print(out, text, wrap=wrap)


def step(text: str) -> None:
    """Print a line about the progress."""
    if not output.current().quiet:
        _print(err, text)


def note(text: str) -> None:
    """Print a note, which `--quiet` leaves."""
    asked = output.current()
    asked.notes.append(text)
    if not (asked.quiet and asked.as_json):
        console = err if asked.as_json else out
        _print(console, Text.assemble(("Note:", "yellow"), " ", text))


def _print(console: Console, text: str | Text, *, wrap: bool = True) -> None:
    output.current().has_shown = True
    console.print(text, soft_wrap=not (wrap and console.is_terminal))


def table(title: str, rows: Sequence[tuple[str, ...]], header: tuple[str, ...] = ()) -> None:
    """Print a table of texts; on a terminal, the first column is bold."""
    if output.current().is_silent:
        return
    if not out.is_terminal:
        _plain_table(title, [*([header] if header else []), *rows])
        return
    shown = Table(title=Text(title), title_justify="left", show_header=bool(header), box=None)
    width = len(header or rows[0])
    for k in range(width):
        shown.add_column(
            header[k] if header else "", overflow="fold", style="bold" if k == 0 else ""
        )
    for row in rows:
        shown.add_row(*(Text(cell) for cell in row))
    out.print(shown)
    out.print()


def _plain_table(title: str, rows: Sequence[tuple[str, ...]]) -> None:
    """Print one line for each row, in columns that are as wide as they need to be."""
    lines = [[" ".join(cell.split()) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for line in (
        title,
        *("  ".join(map(str.ljust, row, widths)).rstrip() for row in lines),
        "",
    ):
        _print(out, line)


@contextmanager
def working(what: str) -> Iterator[None]:
    """Show within the block that something is being done whose length is not known."""
    if output.current().quiet:
        yield
    elif err.is_terminal:
        output.current().has_shown = True
        with err.status(Text(f"{what} ...")):
            yield
    else:
        with output.after(_SIGN_AFTER_S, lambda: _print(err, f"{what} ...")):
            yield


@contextmanager
def progress() -> Iterator[Progress]:
    """Show a bar with the remaining time for each step on a terminal, otherwise a line from time to time."""
    if output.current().quiet:
        yield lambda *_: raise_if_stopped()
        return
    if not err.is_terminal:
        yield _PlainProgress()
        return
    columns = (
        TextColumn("{task.description:<12}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    output.current().has_shown = True
    with RichProgress(*columns, console=err, transient=False) as bars:
        tasks: dict[str, object] = {}

        def update(step: str, done: int, total: int) -> None:
            raise_if_stopped()
            if step not in tasks:
                # What an interrupted run had done says nothing about the speed of this one.
                tasks[step] = bars.add_task(step, total=total or None, completed=done)
            bars.update(tasks[step], completed=done, total=total or None)  # type: ignore[arg-type]

        yield update


class _PlainProgress:
    """Progress for logs: a line at the start and end of each step, and every 20 seconds in between."""

    def __init__(self) -> None:
        self._step = ""
        self._started = self._last = 0.0
        self._before = 0  # done by an interrupted run: it says nothing about the speed of this one

    def __call__(self, step: str, done: int, total: int) -> None:
        raise_if_stopped()
        now = time.monotonic()
        if step != self._step:
            self._step, self._started, self._last, self._before = step, now, now, done
        elif not (0 < total <= done) and now - self._last < _PLAIN_EVERY_S:
            return
        self._last = now
        left = ""
        if self._before < done < total and now > self._started:
            seconds = (now - self._started) / (done - self._before) * (total - done)
            left = f", about {duration(seconds)} left"
        _print(err, f"{step}: {done}{f' of {total}' if total else ''}{left}")


def duration(seconds: float) -> str:
    """Format seconds as a rounded number of seconds, minutes or hours."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
