"""The next step for the state of an area: what stands in the way, then train, export, evaluate and fly."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from spn_data.report.network_state import NetworkState, RecordedFlight
from spn_data.report.run_verdict import RunVerdict
from spn_data.report.verdict import DataVerdict, Level, VerdictReason

_IN_AREA = "AREA/"  # in commands: the folder of the area


def next_step(
    data: DataVerdict,
    trained: Sequence[NetworkState],
    judged: Sequence[RunVerdict],
    *,
    has_flights: bool = True,
    recorded: RecordedFlight | None = None,
) -> VerdictReason:
    """Return the next step.

    Parameters
    ----------
    data : DataVerdict
    trained : sequence of NetworkState
        Trained networks, the newest first.
    judged : sequence of RunVerdict
        Verdict on each of them.
    has_flights : bool
        Whether the area has an evaluation sequence, without which no fixes can be measured.
    recorded : RecordedFlight, optional
        A flight to try the bundle on.

    Returns
    -------
    VerdictReason
        The first finding that has to be dealt with before training, otherwise the step that follows in the
        life of the newest network. Reservations stop nobody and keep their own remedies.
    """
    for finding in data.findings:
        if finding.level is Level.STOP and (finding.do or finding.command):
            return finding
    if not trained:
        return VerdictReason(Level.GOOD, "", "Train a network", "spn-model train")
    run, verdict = trained[0], judged[0]
    name = shlex.quote(run.name)
    if not run.is_exported:
        do = f"Export the network {run.name} with its landmarks"
        again = " --overwrite" if run.has_bundle else ""
        return VerdictReason(Level.GOOD, "", do, f"spn-model export --run {name}{again}")
    if run.has_landmarks and not run.is_measured and not has_flights:
        do = f"Register a flight of another day, on which the fixes of {run.name} can be measured"
        return VerdictReason(Level.GOOD, "", do, "spn-data register VIDEO --name NAME")
    if not run.is_evaluated or (run.has_landmarks and not run.is_measured):
        do = f"Evaluate the network {run.name} and its bundle on flights that it was not trained on"
        return VerdictReason(Level.GOOD, "", do, f"spn-model evaluate --run {name}")
    poor = verdict.flight if run.has_landmarks else verdict.network
    if poor.level is Level.STOP and poor.do:
        return poor
    flight = ["VIDEO", "--camera", "CAMERA.json"]
    if recorded is not None:
        flight = [recorded.video, "--camera", f"{_IN_AREA}{recorded.camera}"]
    words = shlex.join([f"{_IN_AREA}{run.bundle}", *flight])
    if not run.has_landmarks:
        do = f"Estimate coarse poses of a recorded flight with the bundle of {run.name}"
        return VerdictReason(Level.GOOD, "", do, f"spn-onboard {words}")
    do = f"Fly a recorded flight with the bundle of {run.name}"
    return VerdictReason(Level.GOOD, "", do, f"spn-onboard fly {words} --to fixes.jsonl")


def command_for(command: str, area: Path) -> str:
    """Return a command that can be typed where the path `area` leads to the area; "." needs no option."""
    if command.startswith("spn-onboard"):  # has no option for an area
        words = (
            str(area / word.removeprefix(_IN_AREA)) if word.startswith(_IN_AREA) else word
            for word in shlex.split(command)
        )
        return shlex.join(words)
    takes_area = command.startswith("spn-") and area != Path(".")
    return f"{command} --area {shlex.quote(str(area))}" if takes_area else command
