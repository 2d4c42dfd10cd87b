"""The next step for the state of an area."""

from __future__ import annotations

from pathlib import Path

import pytest

from spn_data.report.network_state import NetworkState
from spn_data.report.next_step import command_for, next_step
from spn_data.report.verdict import AreaVerdict, Level, VerdictReason

RESERVATION = VerdictReason(
    Level.CAUTION, "Coverage is low.", "Fly again", "spn-data reconstruct VIDEO --add"
)
OBSTACLE = VerdictReason(Level.STOP, "There is no split.", "Split the frames", "spn-data split")


def judged(*findings: VerdictReason) -> AreaVerdict:
    """Return a verdict with these findings."""
    return AreaVerdict(findings[0].level, "", findings)


def trained(
    *, evaluated: bool = False, exported: bool = False, bundle: bool = False
) -> NetworkState:
    """Return a trained network."""
    return NetworkState(
        "first try", "runs/first try/bundle", evaluated, bundle or exported, exported
    )


@pytest.mark.parametrize(
    ("runs", "command"),
    [
        ([], "spn-model train --area a"),
        ([trained()], "spn-model export --run 'first try' --area a"),
        ([trained(exported=True)], "spn-model evaluate --run 'first try' --area a"),
        (
            [trained(evaluated=True, bundle=True)],
            "spn-model export --run 'first try' --overwrite --area a",
        ),
        (
            [trained(evaluated=True, exported=True)],
            "spn-onboard fly 'a/runs/first try/bundle' VIDEO --camera CAMERA.json --to fixes.jsonl",
        ),
    ],
)
def test_the_step_after_each_command_is_the_next_one(
    runs: list[NetworkState], command: str
) -> None:
    """After the split follow training, export, evaluation and flight, also where there are reservations."""
    step = next_step(judged(RESERVATION), runs)
    assert command_for(step.command, Path("a")) == command


def test_what_stands_in_the_way_of_training_comes_first() -> None:
    """A reason not to train precedes the steps of a network that was trained before."""
    assert next_step(judged(OBSTACLE, RESERVATION), [trained()]) is OBSTACLE


def test_commands_are_written_for_the_folder_in_which_they_are_typed() -> None:
    """In the area itself a command needs no option; elsewhere the path is quoted as a shell demands."""
    flown = next_step(judged(RESERVATION), [trained(evaluated=True, exported=True)]).command
    assert command_for(OBSTACLE.command, Path(".")) == "spn-data split"
    assert command_for(OBSTACLE.command, Path("my area")) == "spn-data split --area 'my area'"
    assert command_for(flown, Path(".")).startswith("spn-onboard fly 'runs/first try/bundle' ")
    assert command_for(flown, Path("my area")).startswith(
        "spn-onboard fly 'my area/runs/first try/bundle' "
    )
    assert command_for("", Path("my area")) == ""
