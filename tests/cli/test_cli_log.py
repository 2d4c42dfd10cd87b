"""Log messages of the libraries: shown by `-v`, and nothing of them without it."""

from __future__ import annotations

import logging

import click
import pytest
from click.testing import CliRunner
from spn_cli.data import main
from spn_cli.model import main as model_main

from spn_data.work.timing import Stopwatch


@click.command()
def work() -> None:
    """Take one step of a stage, as the pipeline does, and log as a module of spn_model does."""
    with Stopwatch().step("features"):
        click.echo("result")
    logging.getLogger("spn_model.training").info("on cpu")


@pytest.mark.parametrize("program", [main, model_main])
def test_verbose_shows_what_the_libraries_log(
    program: click.Group, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On standard error, with the module's name; the next command without `-v` is silent again."""
    monkeypatch.setitem(program.commands, "work", work)
    loud = CliRunner().invoke(program, ["-v", "work"])
    assert loud.stdout == "result\n"
    lines = [line.partition(" ")[2] for line in loud.stderr.splitlines()]
    assert lines[0] == "spn_data.work.timing: features: started"
    assert lines[1].startswith("spn_data.work.timing: features: ended after 0.")
    assert lines[2] == "spn_model.training: on cpu"
    quiet = CliRunner().invoke(program, ["work"])
    assert (quiet.stdout, quiet.stderr) == ("result\n", "")
