"""Terminal output: progress with remaining time, tables, and errors in one line."""

from __future__ import annotations

import errno
import logging
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import click
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

from spn_cli.entry import STOPPED
from spn_data.errors import SpnError
from spn_data.work.timing import Progress

# File names of the user are printed unchanged: brackets in them are not markup, colons not emoji.
out = Console(highlight=False, markup=False, emoji=False)
_PLAIN_EVERY_S = 20.0
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_DISK = (*_FULL, errno.EIO, errno.EROFS)
_KEPT = ". Completed work is kept: free some space and run the same command to resume"


class Group(click.Group):
    """Group that lists commands in order of definition and reports errors in one line with exit code 1."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands in order of definition."""
        return list(self.commands)

    def invoke(self, ctx: click.Context) -> object:
        """Run a command; turn errors into click's, Ctrl-C into exit code 130, and SIGTERM into 143."""
        if ctx.params.get("verbose"):
            ctx.with_resource(_log_on_stderr())
        try:
            with _interruptible():
                return super().invoke(ctx)
        except SpnError as error:
            if ctx.params.get("verbose"):
                raise
            is_full = isinstance(error.__cause__, OSError) and error.__cause__.errno in _FULL
            raise click.ClickException(f"{error}{_KEPT if is_full else ''}") from error
        except KeyboardInterrupt:
            click.echo(f"\n{STOPPED}", err=True)
            ctx.exit(128 + _stopped_by)
        except OSError as error:
            # Without a file name it is a bug, unless the disk refused a write.
            if ctx.params.get("verbose") or (error.filename is None and error.errno not in _DISK):
                raise
            # When a copy fills the disk, the second name is the file that could not be written.
            name = error.filename2 if error.errno in _DISK and error.filename2 else error.filename
            where = "" if name is None else f"{os.fsdecode(name)}: "
            raise click.ClickException(
                f"{where}{error.strerror}{_KEPT if error.errno in _FULL else ''}"
            ) from error


class _EchoHandler(logging.Handler):
    """Print log messages on standard error, above progress bars."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print one message."""
        click.echo(self.format(record), err=True)


@contextmanager
def _log_on_stderr() -> Iterator[None]:
    """Print what the libraries log within the block."""
    handler = _EchoHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s", "%H:%M:%S"))
    loggers = [logging.getLogger(name) for name in ("spn_data", "spn_model")]
    for logger in loggers:
        logger.addHandler(handler)
        logger.setLevel(logging.DEBUG)
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeHandler(handler)
            logger.setLevel(logging.NOTSET)


_stop_wanted = False
_stopped_by = int(signal.SIGINT)


@contextmanager
def _interruptible() -> Iterator[None]:
    """Remember Ctrl-C within the block: Python drops the exception in callbacks of native libraries.

    SIGTERM is treated as Ctrl-C.
    """
    global _stop_wanted, _stopped_by
    _stop_wanted, _stopped_by = False, int(signal.SIGINT)

    def stop(*_: object) -> None:
        global _stop_wanted
        _stop_wanted = True
        raise KeyboardInterrupt

    def terminate(*_: object) -> None:
        global _stopped_by
        _stopped_by = int(signal.SIGTERM)
        # Whoever handles or defers Ctrl-C at this moment does the same for SIGTERM.
        signal.raise_signal(signal.SIGINT)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, stop), signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before[0])
        signal.signal(signal.SIGTERM, before[1])


def _raise_if_stopped() -> None:
    if _stop_wanted:
        raise KeyboardInterrupt


@contextmanager
def progress() -> Iterator[Progress]:
    """Show a bar with the remaining time for each step on a terminal, otherwise a line from time to time."""
    if not out.is_terminal:
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
    with RichProgress(*columns, console=out, transient=False) as bars:
        tasks: dict[str, object] = {}

        def update(step: str, done: int, total: int) -> None:
            _raise_if_stopped()
            if step not in tasks:
                tasks[step] = bars.add_task(step, total=total or None)
            bars.update(tasks[step], completed=done, total=total or None)  # type: ignore[arg-type]

        yield update


class _PlainProgress:
    """Progress for logs: a line at the start and end of each step, and every 20 seconds in between."""

    def __init__(self) -> None:
        self._step = ""
        self._started = self._last = 0.0

    def __call__(self, step: str, done: int, total: int) -> None:
        _raise_if_stopped()
        now = time.monotonic()
        if step != self._step:
            self._step, self._started, self._last = step, now, now
        elif not (0 < total <= done) and now - self._last < _PLAIN_EVERY_S:
            return
        self._last = now
        left = ""
        if 0 < done < total and now > self._started:
            left = f", about {(now - self._started) / done * (total - done):.0f} s left"
        out.print(f"{step}: {done}{f' of {total}' if total else ''}{left}")


def table(title: str, rows: Sequence[tuple[str, ...]], header: tuple[str, ...] = ()) -> None:
    """Print a table of texts; the first column is bold."""
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


def note(text: str) -> None:
    """Print a note."""
    out.print(Text.assemble(("Note:", "yellow"), " ", text))


def duration(seconds: float) -> str:
    """Format seconds as a rounded number of seconds, minutes or hours."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
