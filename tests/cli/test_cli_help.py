"""Command help and documentation are complete, and every documented command line parses."""

from __future__ import annotations

import inspect
import re
import shlex
from importlib.metadata import version
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from spn_cli import options
from spn_cli.data import main
from spn_cli.model import main as model_main

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
COMMANDS = sorted(main.commands)
OF_EVERY_COMMAND = {"--verbose", "--quiet", "--json"}
GEO_PARAMETERS = set(inspect.signature(options.geo_options).parameters)


def model_commands(group: click.Group = model_main) -> dict[str, click.Command]:
    """Return the commands of spn-model and its groups by name."""
    found: dict[str, click.Command] = {}
    for name, command in group.commands.items():
        found[name] = command
        if isinstance(command, click.Group):
            found |= {f"{name} {inner}": c for inner, c in model_commands(command).items()}
    return found


def command_for(words: list[str], program: click.Group = main) -> click.Command:
    """Resolve and parse the words after a program's name without running it; raise click's usage errors."""
    while words and words[0] in ("-v", "--verbose"):
        words = words[1:]
    if words in (["--help"], ["--version"]):
        return program
    group = click.Context(program, info_name="spn")
    name, command, rest = program.resolve_command(group, list(words))
    assert command is not None
    if isinstance(command, click.Group) and rest:
        return command_for(rest, command)
    context = command.make_context(name, rest, parent=group)
    if set(context.params) >= GEO_PARAMETERS:
        options.geo_options(**{name: context.params[name] for name in GEO_PARAMETERS})
    return command


def command_lines(text: str, program: str = "spn-data") -> list[tuple[str, bool]]:
    """Return command lines in fenced blocks (with True) and inline code (with False), without the program."""
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    fenced = "\n".join(block for language, block in blocks if language in ("", "sh"))
    found = re.findall(rf"^(?:\S*/)?{program}( .*)$", fenced, re.MULTILINE)
    outside = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    inline = re.findall(rf"`{program}( [^`\n]+)`", outside)
    return [(line.strip(), True) for line in found] + [(line.strip(), False) for line in inline]


def test_the_commands_are_those_of_this_version():
    """spn-data has exactly these commands; a change here also needs a change of the README."""
    assert COMMANDS == [
        "audit",
        "check-points",
        "coverage",
        "export",
        "georegister",
        "import",
        "reconstruct",
        "register",
        "report",
        "simulate",
        "split",
        "status",
        "telemetry",
    ]


def test_help_lists_the_commands_in_the_order_of_work():
    """`spn-data --help` lists the commands in the order of the workflow."""
    shown = CliRunner().invoke(main, ["--help"])
    assert shown.exit_code == 0
    listed = re.findall(r"^  (\w+) {2,}\S", shown.output.split("Commands:")[1], re.MULTILINE)
    assert listed == [
        "reconstruct",
        "georegister",
        "register",
        "coverage",
        "split",
        "audit",
        "import",
        "export",
        "report",
        "telemetry",
        "status",
        "simulate",
    ]


@pytest.mark.parametrize("group", [main, model_main])
def test_version_is_that_of_the_package(group):
    """--version prints the installed version."""
    shown = CliRunner().invoke(group, ["--version"])
    assert shown.exit_code == 0
    assert version("squeezeposenet-toolkit") in shown.output


@pytest.mark.parametrize("name", COMMANDS)
def test_help_ends_with_examples_that_parse(name):
    """Every command's help has examples, and click accepts them."""
    text = main.commands[name].help
    assert text is not None
    examples = re.findall(r"^\s+spn-data (.+)$", text.split("Example:")[1], re.MULTILINE)
    assert examples
    for example in examples:
        assert command_for(shlex.split(example)) is main.commands[name]


@pytest.mark.parametrize("name", sorted(model_commands()))
def test_help_of_the_model_commands_is_whole(name):
    """Help of an spn-model command has a summary and valid examples, and the docs show the command."""
    command = model_commands()[name]
    text = command.help or ""
    first = text.split("\n\n")[0]
    assert first.endswith(".")
    assert len(first) < 120
    examples = re.findall(r"^\s+spn-model (.+)$", text.split("Example:")[1], re.MULTILINE)
    assert command in [command_for(shlex.split(example), model_main) for example in examples]
    pages = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert any(line.startswith(name) for line, _ in command_lines(pages, "spn-model"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_model_commands_in_the_docs_parse(page):
    """click accepts every spn-model command in README and docs.

    In lines with placeholders (`\u2026`, `A|B`, capitals), only the command and its options are checked.
    """
    known = model_commands()
    for line, whole in command_lines(page.read_text(encoding="utf-8"), "spn-model"):
        if re.search(r"[\u2026|]|\b[A-Z]{2,}\b|\bN\b", line):
            command = next(c for n, c in known.items() if line.split()[0] == n)
            nested = command.commands.values() if isinstance(command, click.Group) else ()
            flags = {flag for c in (command, *nested) for p in c.params for flag in p.opts}
            assert {word for word in line.split() if word.startswith("-")} <= flags, line
            continue
        try:
            command_for(shlex.split(line), model_main)
        except click.MissingParameter:
            assert not whole, f"{page.name}: {line}"
        except click.UsageError as error:
            pytest.fail(f"{page.name}: spn-model {line}: {error.format_message()}")


@pytest.mark.parametrize(
    "command",
    [*main.commands.values(), *model_commands().values()],
    ids=[*main.commands, *model_commands()],
)
def test_every_option_has_help(command):
    """Every option has a help text."""
    for parameter in command.params:
        if isinstance(parameter, click.Option):
            assert parameter.help, parameter.name
            assert len(parameter.help) > 8, parameter.name


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_fits_a_sentence(name):
    """The first line of every command's help is one sentence."""
    first = (main.commands[name].help or "").split("\n\n")[0]
    assert first.endswith(".")
    assert len(first) < 120


@pytest.mark.parametrize(
    "words",
    [
        ["reconstruct", "video", "--area", "a", "--no-such-option"],
        ["reconstruct", "--area", "a"],
        ["reconstruct", "video", "--fov", "300"],
        ["reconstruct", "video", "--fov", "flight=wide"],
        ["georegister", "--takeoff-alt", "112.4"],
        ["no-such-command"],
    ],
)
def test_the_check_itself_refuses_what_click_refuses(words):
    """Parsing alone rejects an invalid command line, so the checks of the docs can fail."""
    with pytest.raises(click.UsageError):
        command_for(words)


def test_a_wrong_option_exits_with_2():
    """Usage errors exit with code 2."""
    assert CliRunner().invoke(main, ["reconstruct", "video", "--frames", "1"]).exit_code == 2


def test_an_error_of_the_users_data_is_one_line_and_exits_with_1(tmp_path):
    """An empty folder is reported in one line that names it, with exit code 1."""
    folder = tmp_path / "empty"
    folder.mkdir()
    ran = CliRunner().invoke(main, ["reconstruct", str(folder), "--area", str(tmp_path / "area")])
    assert ran.exit_code == 1
    assert ran.output.splitlines() == [
        f"Error: {folder}: contains no video or photo; the folder is empty"
    ]


def test_command_lines_are_found():
    """`command_lines` finds fenced and inline commands and ignores prose."""
    text = "Use `spn-data status` or\n```sh\n.venv/bin/spn-data --help\n```\nspn-data is a name.\n"
    assert command_lines(text) == [("--help", True), ("status", False)]
    assert sum(len(command_lines(page.read_text(encoding="utf-8"))) for page in PAGES) > 10


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_in_the_docs_parse(page):
    """click accepts every spn-data command in README and docs, with its options and values.

    In lines with placeholders (`\u2026`, `A|B`, capitals), only the command and its options are checked.
    """
    for line, whole in command_lines(page.read_text(encoding="utf-8")):
        words = shlex.split(line)
        if re.search(r"[\u2026|]|\b[A-Z]{2,}\b|\bN\b", line):
            names = [word for word in words if re.fullmatch(r"[a-z]+", word)]
            command = main.commands[names[0]] if names else main
            known = {flag for p in (*main.params, *command.params) for flag in p.opts}
            assert {word for word in words if word.startswith("-")} <= known, f"{page.name}: {line}"
        else:
            try:
                command_for(words)
            except click.MissingParameter:
                assert not whole, f"{page.name}: {line}"
            except click.UsageError as error:
                pytest.fail(f"{page.name}: spn-data {line}: {error.format_message()}")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_is_in_the_readme(name):
    """The README shows every command; `simulate` is in docs/simulator.md."""
    page = "docs/simulator.md" if name == "simulate" else "README.md"
    lines = command_lines((ROOT / page).read_text(encoding="utf-8"))
    assert any(name in line.split() for line, _ in lines)


@pytest.mark.parametrize("name", ["reconstruct", "georegister"])
def test_every_option_is_documented(name):
    """docs/reconstruct.md lists every option with the default shown in the help."""
    text = (ROOT / "docs" / "reconstruct.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(--[a-z-]+)` \|([^|]*)\|", text, re.MULTILINE))
    for parameter in main.commands[name].params:
        if not isinstance(parameter, click.Option) or parameter.opts[-1] in OF_EVERY_COMMAND:
            continue
        flag = parameter.opts[-1]
        assert flag in rows
        if parameter.show_default is True:
            shown = rows[flag].strip("` ")
            if isinstance(parameter.default, tuple):
                assert tuple(float(value) for value in shown.split()) == parameter.default, flag
            elif isinstance(parameter.default, int | float):
                assert float(shown) == parameter.default, flag
            else:
                assert shown == parameter.default, flag


def test_no_option_is_documented_that_is_not_there():
    """docs/reconstruct.md lists no option that `reconstruct` lacks."""
    text = (ROOT / "docs" / "reconstruct.md").read_text(encoding="utf-8")
    rows = set(re.findall(r"^\| `(--[a-z-]+)` ", text, re.MULTILINE))
    known = {f for p in main.commands["reconstruct"].params for f in p.opts if f[:2] == "--"}
    assert rows == known - OF_EVERY_COMMAND


def test_every_option_of_simulate_is_documented():
    """docs/simulator.md names every option of `simulate`."""
    text = (ROOT / "docs" / "simulator.md").read_text(encoding="utf-8")
    missing = [
        parameter.opts[-1]
        for parameter in main.commands["simulate"].params
        if isinstance(parameter, click.Option) and f"`{parameter.opts[-1]}" not in text
    ]
    assert set(missing) <= OF_EVERY_COMMAND


@pytest.mark.parametrize(
    "command", [main, model_main, *main.commands.values(), *model_commands().values()]
)
def test_every_command_takes_the_options_of_every_command(command):
    """-v, --quiet and --json are options of both programs and of each command, and are documented."""
    assert {p.opts[-1] for p in command.params} >= OF_EVERY_COMMAND
    text = (ROOT / "docs" / "command-line.md").read_text(encoding="utf-8")
    assert all(f"`{flag}`" in text for flag in OF_EVERY_COMMAND)
