"""Log messages of the libraries are shown with `-v` only."""

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
    """Run one step of a stage like the pipeline, and log like a module of spn_model."""
    with Stopwatch().step("features"):
        click.echo("result")
    logging.getLogger("spn_model.training").info("on cpu")


@pytest.mark.parametrize("program", [main, model_main])
def test_verbose_shows_what_the_libraries_log(
    program: click.Group, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`-v` logs to standard error with module names; the next command without it logs nothing."""
    monkeypatch.setitem(program.commands, "work", work)
    loud = CliRunner().invoke(program, ["-v", "work"])
    assert loud.stdout == "result\n"
    lines = [line.partition(" ")[2] for line in loud.stderr.splitlines()]
    assert lines[0] == "spn_data.work.timing: features: started"
    assert lines[1].startswith("spn_data.work.timing: features: ended after 0.")
    assert lines[2] == "spn_model.training: on cpu"
    quiet = CliRunner().invoke(program, ["work"])
    assert (quiet.stdout, quiet.stderr) == ("result\n", "")
