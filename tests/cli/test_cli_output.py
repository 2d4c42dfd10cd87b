"""What commands print: one record a line, `--json`, `--quiet`, `-v`, progress, and completion."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path

import click
import numpy as np
import pytest
from click.shell_completion import ShellComplete
from click.testing import CliRunner
from spn_cli import console, group, output
from spn_cli.data import main
from spn_cli.group import Group
from spn_cli.model import main as model_main

from spn_data.errors import InputError
from spn_model.export.model_card import percent_text

LONG = "word " * 40


@click.group(cls=Group)
def program() -> None:
    """Stand for spn-data."""


@program.command()
@click.option("--fail", is_flag=True, help="End with an error.")
def work(fail: bool) -> None:
    """Print what commands print: progress, a table, a sentence, figures and a note."""
    with console.progress() as progress:
        progress("features", 1, 2)
    console.table(
        "Found", [("first", LONG, "end"), ("second", "", "end")], ("name", "what", "last")
    )
    output.figures(errors_m=np.array([1.5, math.nan]), worst_m=math.inf, frames=np.int64(3))
    console.say(f"A sentence of {LONG}.")
    console.note("look here")
    if fail:
        raise InputError("is bad", path=Path("file.csv"))


def test_without_a_terminal_a_record_is_a_line() -> None:
    """A table that is wider than 80 columns has one line for each row, in columns, without wrapping."""
    shown = CliRunner().invoke(program, ["work"])
    lines = shown.stdout.splitlines()
    assert lines[0] == "Found"
    assert lines[1].split() == ["name", "what", "last"]
    assert lines[2].startswith("first   word word")
    assert lines[2].endswith("word  end")
    assert lines[2].index("end") == lines[3].index("end") == lines[1].index("last")
    assert lines[5:] == [f"A sentence of {LONG}.", "Note: look here"]
    assert shown.stderr == "features: 1 of 2\n"


@program.command()
def slow() -> None:
    """Show nothing for a while."""
    time.sleep(0.3)


def test_a_command_that_shows_nothing_says_that_it_works(monkeypatch: pytest.MonkeyPatch) -> None:
    """After some seconds without output there is a line on standard error, unless --quiet is given."""
    monkeypatch.setattr(group, "_SIGN_AFTER_S", 0.05)
    sign = "slow: reading and checking its input ...\n"
    assert CliRunner().invoke(program, ["slow"]).stderr == sign
    assert CliRunner().invoke(program, ["slow", "--quiet"]).stderr == ""
    monkeypatch.setattr(group, "_SIGN_AFTER_S", 5.0)
    assert CliRunner().invoke(program, ["slow"]).stderr == ""


def test_what_is_not_finite_is_a_word() -> None:
    """A change by percent that is not defined is no number."""
    assert [percent_text(value) for value in (math.nan, 1.25)] == ["not known", "+1.2 %"]


@pytest.mark.parametrize("words", [["--json", "work"], ["work", "--json"]])
def test_json_is_one_object_and_all_else_is_on_standard_error(words: list[str]) -> None:
    """Before or after the command, --json prints one object without NaN; notes are in it and on stderr."""
    shown = CliRunner().invoke(program, words)
    assert json.loads(shown.stdout, parse_constant=pytest.fail) == {
        "command": "program work",
        "errors_m": [1.5, None],
        "worst_m": None,
        "frames": 3,
        "notes": ["look here"],
    }
    assert shown.stderr.splitlines() == ["features: 1 of 2", "Note: look here"]


def test_json_of_a_command_that_fails_holds_the_error() -> None:
    """With --json an error is one line on stderr and `error` in the object; the exit code is 1."""
    shown = CliRunner().invoke(program, ["work", "--fail", "--json"])
    assert shown.exit_code == 1
    assert json.loads(shown.stdout)["error"] == "file.csv: is bad"
    assert shown.stderr.splitlines()[-1] == "Error: file.csv: is bad"


def test_quiet_leaves_notes_and_errors() -> None:
    """--quiet prints neither tables nor progress, before or after the command; the next one prints again."""
    for words in (["-q", "work"], ["work", "--quiet"]):
        shown = CliRunner().invoke(program, words)
        assert (shown.stdout, shown.stderr) == ("Note: look here\n", "")
    shown = CliRunner().invoke(program, ["-q", "work", "--fail"])
    assert shown.stderr == "Error: file.csv: is bad\n"
    assert "Found" in CliRunner().invoke(program, ["work"]).stdout


def test_verbose_is_accepted_after_the_command() -> None:
    """`-v` after the command raises the error itself, as it does before it."""
    for words in (["-v", "work", "--fail"], ["work", "--fail", "-v"]):
        assert isinstance(CliRunner().invoke(program, words).exception, InputError)


def test_progress_of_a_resumed_step_tells_the_time_of_this_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What an interrupted run had done does not shorten the time that is left."""
    now = [0.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: now[0])
    with console.progress() as progress:
        progress("features", 90, 100)
        now[0] = 30.0
        progress("features", 95, 100)
    assert capsys.readouterr().err.splitlines()[-1] == "features: 95 of 100, about 30 s left"


def test_real_commands_print_json(flight1: Path, tmp_path: Path) -> None:
    """Telemetry of a flight and the list of weights are valid objects with counts."""
    words = ["telemetry", str(flight1 / "flight1.SRT"), "--to", str(tmp_path / "t.csv"), "--json"]
    found = json.loads(CliRunner().invoke(main, words).stdout)
    assert found["command"].endswith(" telemetry")
    assert found["records"] >= found["with_position"] > 10
    listed = json.loads(CliRunner().invoke(model_main, ["weights", "--json"]).stdout)
    assert all(one["size_bytes"] > 0 for one in listed["weights"])
    missing = CliRunner().invoke(main, ["status", "--json", "--area", str(tmp_path)])
    assert "is not an area" in json.loads(missing.stdout)["error"]


def test_status_of_an_area(finished_area: Path) -> None:
    """`status --json` holds the counts of each stage with their units, and the next step."""
    shown = CliRunner().invoke(main, ["status", "--area", str(finished_area), "--json"])
    found = json.loads(shown.stdout, parse_constant=pytest.fail)
    assert found["stages"]["1-frames"]["counts"]["chosen"] > 10
    assert found["stages"]["2-model"]["counts"]["mean_error_px"] < 2
    assert found["next"]["command"].startswith("spn-data ")
    plain = CliRunner().invoke(main, ["status", "--area", str(finished_area)]).stdout
    assert next(line for line in plain.splitlines() if line.startswith("2-model")).count("frames")


@pytest.mark.parametrize(
    ("program", "words", "begun", "expected"),
    [
        (main, ["status", "--area"], "", ["fields/north", "fields/south"]),
        (main, ["status", "--area"], "fields/n", ["fields/north"]),
        (main, ["export", "tum", "--area", "fields/north", "--sequence"], "", ["flight1", "low"]),
        (main, ["register", "--area", "fields/north", "--name"], "l", ["low"]),
        (model_main, ["evaluate", "--area", "fields/north", "--run"], "", ["first", "second"]),
        (model_main, ["train", "--recipe"], "squ", ["squeezeposenet"]),
    ],
)
def test_names_are_completed(
    program: click.Group,
    words: list[str],
    begun: str,
    expected: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Areas, sequences and runs are completed from folders, recipes from the package."""
    for folder in (
        *("north/1-frames/flight1", "north/1-frames/masks", "north/4-eval/low"),
        *(
            "north/runs/first",
            "north/runs/second",
            "north/runs/compared",
            "south/1-frames",
            "notes",
        ),
    ):
        (tmp_path / "fields" / folder).mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    found = ShellComplete(program, {}, "spn", "_SPN_COMPLETE").get_completions(words, begun)
    assert [one.value for one in found] == expected
