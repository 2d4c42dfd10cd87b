"""Options of every command, before or after its name: `-v`, `--quiet` and `--json`."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

import click

from spn_cli import output


def add_common(command: click.Command) -> None:
    """Let a command, and the commands in it, take the options of every command."""
    known = {option.name for option in command.params}
    command.params += [option for option in _options() if option.name not in known]
    if isinstance(command, click.Group):
        for inner in command.commands.values():
            add_common(inner)


def _options() -> list[click.Option]:
    flags = (
        (("-v", "--verbose"), "Show details, log messages and tracebacks."),
        (("-q", "--quiet"), "Print only notes and errors."),
        (
            ("--json", "as_json"),
            "Print the results as one JSON object, and all else on standard error.",
        ),
    )
    return [
        click.Option(words, is_flag=True, expose_value=False, callback=_ask, help=text)
        for words, text in flags
    ]


def _ask(context: click.Context, option: click.Parameter, given: bool) -> None:
    """Note an option where it was given, before or after the name of the command."""
    now = output.current()
    assert option.name is not None
    if not given or getattr(now, option.name):
        return
    setattr(now, option.name, True)
    if option.name == "verbose":
        context.find_root().with_resource(_log_on_stderr())


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
