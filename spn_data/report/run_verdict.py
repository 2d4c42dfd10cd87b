"""Verdict on a trained network: its poses against baselines, and the fixes of its bundle."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from spn_data.report.fix_facts import BundleFixes, FixFigures
from spn_data.report.network_state import NetworkState
from spn_data.report.run_facts import MethodErrors, RunFacts
from spn_data.report.verdict import Level, VerdictReason, count_of

# A training with fewer images is called short: two cores process several times as many in 30 minutes.
SHORT_IMAGES = 30_000
LEAST_USABLE = 0.5  # share of usable fixes below which a flight is not to be flown on them
MAX_MISLEADING = 0.05  # upper bound of their share above which too few images were compared
_LONG_MINUTES = 30
# What half an hour of the default recipe processes on two cores with bfloat16; others need longer for it.
_LONG_IMAGES = 345_000
_LONG_DRAWS = 280_000  # for `--images`: batches of small images show more than they draw
_SCENE_COORDINATES = "scene-coordinates"
_COARSE, _SEARCH, _TRACK = "coarse", "search", "track"
_MEAN = "mean"  # first word of the baseline


@dataclass(frozen=True)
class RunVerdict:
    """Verdict on a trained network.

    Attributes
    ----------
    name : str
        Name of its run.
    network : VerdictReason
        Its poses alone, compared with the mean training pose and with retrieval.
    flight : VerdictReason
        Availability of the fixes of its bundle, and misleading ones.
    """

    name: str
    network: VerdictReason
    flight: VerdictReason


def judge_run(
    state: NetworkState, runs: Sequence[RunFacts], expect_low: Collection[str]
) -> RunVerdict:
    """Judge a trained network by what was measured; what was not measured is said to be so.

    Parameters
    ----------
    state : NetworkState
    runs : sequence of RunFacts
        Evaluated runs.
    expect_low : collection of str
        Flights that are declared to be far from the map: few fixes there do not speak against a flight.

    Returns
    -------
    RunVerdict
    """
    facts = next((run for run in runs if run.name == state.name), None)
    return RunVerdict(
        state.name, _network(state, facts, expect_low), _flight(state, facts, expect_low)
    )


def _unknown(text: str) -> VerdictReason:
    return VerdictReason(Level.UNKNOWN, text)


def _network(
    state: NetworkState, facts: RunFacts | None, expect_low: Collection[str]
) -> VerdictReason:
    name = state.name
    if facts is None or not state.is_evaluated:
        why = "not evaluated"
        if facts is not None:
            why = "trained further since its evaluation"
            if not facts.is_outdated:
                why = "evaluated on another data set than the present one of the area"
        return _unknown(f"{name} is not measured: {why}.")
    groups = {
        flight: methods
        for flight, (role, methods) in facts.groups.items()
        if role == "test" and name in methods and methods[name].frames
    }
    judged = {flight: methods for flight, methods in groups.items() if flight not in expect_low}
    if not judged:
        far = " near the map" if groups else ""
        return _unknown(f"{name} is not measured: there is no evaluation flight{far}.")
    unit = "m" if facts.units == "m" else "units"
    worse = _Worse(name, facts, judged)
    medians = "; ".join(
        f"{flight} {_median(methods[name], unit)}" for flight, methods in judged.items()
    )
    if not worse.compared:
        return _unknown(f"{name} is not compared with baselines (medians: {medians}).")
    n, declared = len(worse.compared), _declared(groups, expect_low)
    found = (
        ("the most similar training image (retrieval)", worse.retrieval),
        ("the mean training pose", worse.mean),
    )
    said = [
        f"than {what} on {len(flights)} of {count_of(n, 'flight')}"
        for what, flights in found
        if flights
    ]
    if not said:
        text = f"{name} is better than retrieval on {n} of {count_of(n, 'flight')} (medians: {medians})."
        return VerdictReason(Level.GOOD, text + declared)
    is_everywhere = n in (len(worse.retrieval), len(worse.mean))
    where = "" if is_everywhere else f" where {', '.join(worse.retrieval or worse.mean)} is"
    text = (
        f"{name} is worse {' and '.join(said)} (medians: {medians}): do not fly on its poses alone"
    )
    level = Level.STOP if is_everywhere else Level.CAUTION
    return VerdictReason(level, f"{text}{where}.{declared}", *_longer(state, facts))


class _Worse:
    """Flights on which the poses of a network are worse than those of what needs no network."""

    def __init__(
        self, name: str, facts: RunFacts, judged: dict[str, dict[str, MethodErrors]]
    ) -> None:
        self.compared: list[str] = []
        self.retrieval: list[str] = []
        self.mean: list[str] = []
        for flight, methods in judged.items():
            own, retrieval = methods[name], methods.get(facts.retrieval.get(flight, ""))
            mean = next((of for method, of in methods.items() if method.startswith(_MEAN)), None)
            if retrieval is None:
                continue
            self.compared.append(flight)
            if _is_worse(own, retrieval):
                self.retrieval.append(flight)
            if mean is not None and _is_worse(own, mean):
                self.mean.append(flight)


def _is_worse(own: MethodErrors, other: MethodErrors) -> bool:
    """Return whether the median position error is larger; without one, half of the frames have no pose."""
    mine, its = own.position[0], other.position[0]
    return its is not None and (mine is None or mine > its)


def _median(errors: MethodErrors, unit: str) -> str:
    position, rotation = errors.position[0], errors.rotation_deg[0]
    if position is None or rotation is None:
        return f"none, as {errors.located:,} of {errors.frames:,} frames have a pose"
    return f"{position:.2f} {unit}, {rotation:.1f} deg"


def _longer(state: NetworkState, facts: RunFacts) -> tuple[str, str]:
    """Return what to do about a network that is too inaccurate."""
    network = facts.networks.get(state.name)
    if network is None or network.images is None or network.minutes is None:
        return "", ""
    shown = f"it has seen {network.images:,} images in {network.minutes:.1f} min"
    if network.images >= SHORT_IMAGES:
        return f"Train longer or by another recipe ({shown}), and map what the flights see", ""
    minutes = max(_LONG_MINUTES, round(4 * network.minutes))
    budget = f"--minutes {minutes}"
    if network.kind == _SCENE_COORDINATES and network.images:
        hours = _LONG_IMAGES * network.minutes / network.images / 60
        shown += f"; {_LONG_IMAGES:,} take about {hours:.1f} h at this rate"
        budget = f"--images {_LONG_DRAWS}"
    # Under another name: this one may have a bundle whose fixes are good.
    recipe = f" --recipe {shlex.quote(state.recipe)}" if state.recipe else ""
    return (
        f"Train longer ({shown})",
        f"spn-model train --run {shlex.quote(f'{state.name}-longer')}{recipe} {budget}",
    )


def _flight(
    state: NetworkState, facts: RunFacts | None, expect_low: Collection[str]
) -> VerdictReason:
    fixes = facts.fixes if facts is not None else BundleFixes()
    missing = _not_measured(state, fixes)
    published = [row for row in fixes.rows if not row.method.startswith(_COARSE)]
    rows = {row.flight: row for row in published if row.method == _SEARCH}
    rows |= {row.flight: row for row in published if row.method == _TRACK}
    if missing or not rows:
        return _unknown(
            f"The fixes of {state.name} are not measured: {missing or 'no flight could be'}. Do not fly on "
            "them."
        )
    counted = _counted(rows.values())
    said = _said(rows, expect_low, fixes)
    misleading = [
        f"{row.misleading:,} of {row.compared:,} ({row.method} on {row.flight})"
        for row in published
        if row.misleading
    ]
    near = [row for flight, row in rows.items() if flight not in expect_low]
    few = [row.flight for row in near if row.usable < LEAST_USABLE * row.images]
    bound = _bound(rows.values())
    if misleading:
        text = f"Do not fly on the fixes of {state.name}: misleading are {', '.join(misleading)}; {counted}."
        do = f"See which they are (column misleading of runs/{state.name}/fixes.csv), and map there again"
        return VerdictReason(Level.STOP, f"{text}{said}", do, "spn-data reconstruct VIDEO --add")
    if few:
        text = f"Do not fly on the fixes of {state.name} where {', '.join(few)} is: {counted}."
        do = "Find the places that the map lacks, and map them"
        return VerdictReason(Level.STOP, f"{text}{said}", do, "spn-data coverage")
    if not near:
        text = f"The fixes of {state.name} are measured only far from the map: {counted}."
        return VerdictReason(Level.CAUTION, f"{text}{said}")
    if bound > MAX_MISLEADING:
        text = (
            f"The fixes of {state.name} are measured on few images: {counted}, so up to {bound:.0%} may be "
            "misleading."
        )
        do = "Register a longer evaluation flight, label all its frames, and evaluate again"
        return VerdictReason(Level.CAUTION, f"{text}{said}", do)
    return VerdictReason(Level.GOOD, f"The fixes of {state.name} may be flown on: {counted}.{said}")


def _not_measured(state: NetworkState, fixes: BundleFixes) -> str:
    """Return why the fixes of the present bundle are not known; empty if they are."""
    if not state.has_bundle:
        return "no bundle is exported"
    if not state.is_exported:
        return "the bundle is damaged or of an earlier network"
    if not state.has_landmarks:
        return "the bundle has no landmarks, so it gives coarse poses only"
    if not state.is_evaluated:
        return "it was not evaluated on the present data set since it was trained"
    if not state.is_measured:
        return fixes.reason or "it was evaluated with another bundle"
    return ""


def _bound(rows: Collection[FixFigures]) -> float:
    """Return the largest upper bound of the share of misleading fixes on a flight."""
    return max(row.misleading_at_most if row.compared else 1.0 for row in rows)


def _counted(rows: Collection[FixFigures]) -> str:
    """Return how many images have a usable fix and how many of the fixes are misleading."""
    images, usable = sum(row.images for row in rows), sum(row.usable for row in rows)
    compared, misleading = sum(row.compared for row in rows), sum(row.misleading for row in rows)
    methods = " and ".join(sorted({row.method for row in rows}))
    return (
        f"{usable:,} of {images:,} images have a usable fix ({methods}), {misleading:,} of {compared:,} "
        f"compared fixes are misleading (at most {_bound(rows):.1%} of a flight, with 95 % confidence)"
    )


def _said(rows: dict[str, FixFigures], expect_low: Collection[str], fixes: BundleFixes) -> str:
    """Return where the fixes come from, and which flights are declared to be far from the map."""
    alone = [row for row in fixes.rows if row.method == _SEARCH]
    text = " Whether the network led to them is not measured."
    if alone and all(row.from_network is not None for row in alone):
        started = sum(row.from_network or 0 for row in alone)
        usable = sum(row.usable for row in alone)
        text = (
            " They come from landmarks; the pose of the network led to "
            f"{started:,} of {usable:,} (search)."
        )
    return text + _declared(rows, expect_low)


def _declared(flights: Collection[str], expect_low: Collection[str]) -> str:
    far = [flight for flight in flights if flight in expect_low]
    return f" Declared far from the map: {', '.join(far)}." if far else ""
