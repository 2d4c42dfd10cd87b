"""Verdict on an area in three parts: its data, its networks, and a flight with them; and the next step."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from spn_data.report.data import ReportData
from spn_data.report.next_step import next_step
from spn_data.report.run_verdict import RunVerdict, judge_run
from spn_data.report.verdict import DataVerdict, Level, VerdictReason, judge_data

DATA, NETWORK, FLIGHT = "Data", "Network", "Flight"
_NO_NETWORK = VerdictReason(Level.UNKNOWN, "Not measured: no network is trained.")
_NO_BUNDLE = VerdictReason(Level.UNKNOWN, "Not measured: no bundle is exported.")


@dataclass(frozen=True)
class AreaVerdict:
    """Verdict on an area.

    Attributes
    ----------
    data : DataVerdict
        Whether the data are ready for training.
    runs : tuple of RunVerdict
        Verdict on each trained network, the newest first.
    next : VerdictReason
        The next step.
    """

    data: DataVerdict
    runs: tuple[RunVerdict, ...]
    next: VerdictReason

    def parts(self, run: str | None = None) -> Iterator[tuple[str, VerdictReason]]:
        """Yield the parts: name, and what is said with its remedy; of one run if it is given, or of all."""
        yield DATA, VerdictReason(self.data.level, f"{self.data.headline}.")
        runs = [one for one in self.runs if run in (None, one.name)]
        yield from ((NETWORK, one.network) for one in runs)
        yield from ((FLIGHT, one.flight) for one in runs)
        if not runs:
            yield NETWORK, _NO_NETWORK
            yield FLIGHT, _NO_BUNDLE


def judge(data: ReportData) -> AreaVerdict:
    """Judge an area: the one verdict that page, commands and model cards show.

    Parameters
    ----------
    data : ReportData

    Returns
    -------
    AreaVerdict
    """
    of_data = judge_data(data)
    runs = tuple(judge_run(state, data.runs, data.expect_low) for state in data.trained)
    has_flights = bool(data.evaluation_sequences)
    step = next_step(of_data, data.trained, runs, has_flights=has_flights, recorded=data.recorded)
    return AreaVerdict(of_data, runs, step)
