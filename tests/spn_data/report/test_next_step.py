"""The next step for the state of an area."""

from __future__ import annotations

from pathlib import Path

import pytest

from spn_data.report.network_state import NetworkState, RecordedFlight
from spn_data.report.next_step import command_for, next_step
from spn_data.report.run_verdict import RunVerdict
from spn_data.report.verdict import DataVerdict, Level, VerdictReason

RESERVATION = VerdictReason(
    Level.CAUTION, "Coverage is low.", "Fly again", "spn-data reconstruct VIDEO --add"
)
OBSTACLE = VerdictReason(Level.STOP, "There is no split.", "Split the frames", "spn-data split")


POOR = VerdictReason(Level.STOP, "Poor.", "Train longer", "spn-model train --run 'first try'")
FINE = VerdictReason(Level.GOOD, "Fine.")


def judged(*findings: VerdictReason) -> DataVerdict:
    """Return a verdict on data with these findings."""
    return DataVerdict(findings[0].level, "", findings)


def following(
    findings: list[VerdictReason],
    runs: list[NetworkState],
    *,
    network: VerdictReason = FINE,
    flight: VerdictReason = FINE,
    has_flights: bool = True,
) -> VerdictReason:
    """Return the next step after findings, with the same verdict on each run."""
    verdicts = [RunVerdict(run.name, network, flight) for run in runs]
    return next_step(judged(*findings), runs, verdicts, has_flights=has_flights)


def trained(**state: bool) -> NetworkState:
    """Return a trained network, in the state after those of its steps that are given."""
    return NetworkState("first try", "runs/first try/bundle", **state)


EXPORTED = {"has_bundle": True, "is_exported": True, "has_landmarks": True}
DONE = {**EXPORTED, "is_evaluated": True, "is_measured": True}


@pytest.mark.parametrize(
    ("runs", "command"),
    [
        ([], "spn-model train --area a"),
        ([trained()], "spn-model export --run 'first try' --area a"),
        ([trained(**EXPORTED)], "spn-model evaluate --run 'first try' --area a"),
        (
            [trained(is_evaluated=True, has_bundle=True)],
            "spn-model export --run 'first try' --overwrite --area a",
        ),
        (  # evaluated before the export: its fixes are unknown
            [trained(**EXPORTED, is_evaluated=True)],
            "spn-model evaluate --run 'first try' --area a",
        ),
        (
            [trained(**DONE)],
            "spn-onboard fly 'a/runs/first try/bundle' VIDEO --camera CAMERA.json --to fixes.jsonl",
        ),
        (
            [trained(**{**DONE, "has_landmarks": False, "is_measured": False})],
            "spn-onboard 'a/runs/first try/bundle' VIDEO --camera CAMERA.json",
        ),
    ],
)
def test_the_step_after_each_command_is_the_next_one(
    runs: list[NetworkState], command: str
) -> None:
    """After the split follow training, export, evaluation and flight, also where there are reservations."""
    step = following([RESERVATION], runs)
    assert command_for(step.command, Path("a")) == command


def test_what_stands_in_the_way_of_training_comes_first() -> None:
    """A reason not to train precedes the steps of a network that was trained before."""
    assert following([OBSTACLE, RESERVATION], [trained()]) is OBSTACLE


def test_nobody_is_sent_to_fly_on_what_is_not_to_be_flown() -> None:
    """Bad fixes have their remedy instead of a flight; a bad network matters where there are no fixes."""
    assert following([RESERVATION], [trained(**DONE)], flight=POOR) is POOR
    assert "spn-onboard fly" in following([RESERVATION], [trained(**DONE)], network=POOR).command
    coarse = trained(has_bundle=True, is_exported=True, is_evaluated=True)
    assert following([RESERVATION], [coarse], network=POOR) is POOR


def test_the_bundle_is_tried_on_a_flight_that_the_area_knows() -> None:
    """The command names the video and the camera of an evaluation flight, so that it can be pasted."""
    flight = RecordedFlight("/data/my flight.mp4", "4-eval/medium/camera.json")
    run = trained(**DONE)
    verdicts = [RunVerdict(run.name, FINE, FINE)]
    step = next_step(judged(RESERVATION), [run], verdicts, recorded=flight)
    assert command_for(step.command, Path("a")) == (
        "spn-onboard fly 'a/runs/first try/bundle' '/data/my flight.mp4' --camera "
        "a/4-eval/medium/camera.json --to fixes.jsonl"
    )


def test_without_an_evaluation_flight_one_has_to_be_registered() -> None:
    """The evaluation of fixes needs a flight, so that the same command is not proposed for ever."""
    step = following([RESERVATION], [trained(**EXPORTED, is_evaluated=True)], has_flights=False)
    assert step.command == "spn-data register VIDEO --name NAME"


def test_commands_are_written_for_the_folder_in_which_they_are_typed() -> None:
    """In the area itself a command needs no option; elsewhere the path is quoted as a shell demands."""
    flown = following([RESERVATION], [trained(**DONE)]).command
    assert command_for(OBSTACLE.command, Path(".")) == "spn-data split"
    assert command_for(OBSTACLE.command, Path("my area")) == "spn-data split --area 'my area'"
    assert command_for(flown, Path(".")).startswith("spn-onboard fly 'runs/first try/bundle' ")
    assert command_for(flown, Path("my area")).startswith(
        "spn-onboard fly 'my area/runs/first try/bundle' "
    )
    assert command_for("", Path("my area")) == ""
