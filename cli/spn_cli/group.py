"""Groups of commands: errors in one line, Ctrl-C and SIGTERM, and the output of `--json`."""

from __future__ import annotations

import errno
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import click

from spn_cli import output
from spn_cli.common_options import add_common
from spn_cli.entry import STOPPED
from spn_data.errors import SpnError

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_DISK = (*_FULL, errno.EIO, errno.EROFS)
_SIGN_AFTER_S = 3.0
_KEPT = ". Completed work is kept: free some space and run the same command to resume"


class Group(click.Group):
    """Group that lists commands in order of definition and reports errors in one line with exit code 1."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        add_common(self)

    def add_command(self, cmd: click.Command, name: str | None = None) -> None:
        """Add a command, which takes the options of every command."""
        add_common(cmd)
        super().add_command(cmd, name)

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands in order of definition."""
        return list(self.commands)

    def invoke(self, ctx: click.Context) -> object:
        """Run a command; print its results as JSON if that was asked for, also where it failed."""
        try:
            result = self._reporting(ctx)
        except click.UsageError:
            raise
        except (click.ClickException, SpnError) as error:
            output.figures(error=str(error))
            _print_json(ctx)
            raise
        except click.exceptions.Exit as ended:
            if ended.exit_code:
                _print_json(ctx)
            raise
        _print_json(ctx)
        return result

    def _reporting(self, ctx: click.Context) -> object:
        """Run a command; turn errors into click's, Ctrl-C into exit code 130, and SIGTERM into 143."""
        try:
            with _interruptible(), _first_sign(ctx):
                return super().invoke(ctx)
        except SpnError as error:
            if output.current().verbose:
                raise
            is_full = isinstance(error.__cause__, OSError) and error.__cause__.errno in _FULL
            raise click.ClickException(f"{error}{_KEPT if is_full else ''}") from error
        except KeyboardInterrupt:
            click.echo(f"\n{STOPPED}", err=True)
            output.figures(error=STOPPED)
            ctx.exit(128 + _stopped_by)
        except OSError as error:
            # Without a file name it is a bug, unless the disk refused a write.
            if output.current().verbose or (error.filename is None and error.errno not in _DISK):
                raise
            # When a copy fills the disk, the second name is the file that could not be written.
            name = error.filename2 if error.errno in _DISK and error.filename2 else error.filename
            where = "" if name is None else f"{os.fsdecode(name)}: "
            raise click.ClickException(
                f"{where}{error.strerror}{_KEPT if error.errno in _FULL else ''}"
            ) from error


@contextmanager
def _first_sign(ctx: click.Context) -> Iterator[None]:
    """Say that a command is at work if it has shown nothing after some seconds."""
    asked = output.current()

    def show() -> None:
        if not (asked.has_shown or asked.quiet):
            click.echo(f"{ctx.invoked_subcommand}: reading and checking its input ...", err=True)

    with output.after(_SIGN_AFTER_S, show):
        yield


def _print_json(ctx: click.Context) -> None:
    if output.current().as_json:
        click.echo(output.current().to_json(f"{ctx.command_path} {ctx.invoked_subcommand}"))


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


def raise_if_stopped() -> None:
    """Raise KeyboardInterrupt if Ctrl-C was pressed since the command began."""
    if _stop_wanted:
        raise KeyboardInterrupt
