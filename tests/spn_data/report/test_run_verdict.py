"""The verdict on networks and on the fixes of their bundles."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from spn_data.report.area_verdict import judge
from spn_data.report.fix_facts import BundleFixes, FixFigures
from spn_data.report.html import render
from spn_data.report.network_state import NetworkState
from spn_data.report.run_facts import MethodErrors, NetworkFacts, RunFacts
from spn_data.report.run_verdict import RunVerdict, judge_run
from spn_data.report.verdict import Level
from tests.worlds.report_data import area

DONE = NetworkState(
    "first",
    "runs/first/bundle",
    recipe="paper",
    is_evaluated=True,
    has_bundle=True,
    is_exported=True,
    has_landmarks=True,
    is_measured=True,
)


def errors(median: float | None, degrees: float | None = 3.0) -> MethodErrors:
    """Return errors of 100 frames; without a median, a third of them has a pose."""
    located = 33 if median is None else 100
    return MethodErrors(100, located, (median, 9.0, 9.0), (degrees, 9.0, 9.0), (), (), None)


def fixes(flight: str = "medium", method: str = "track", **changes: Any) -> FixFigures:
    """Return the fixes of a flight: 149 of 150 images, none misleading."""
    made = FixFigures(flight, method, 150, 149, 149, 0.01, 0.04, 0, 0.02, 0.9, 1.0, 0.2, 3)
    return replace(made, **changes)


def run(
    *medians: tuple[float | None, float | None, float | None],
    rows: tuple[FixFigures, ...] = (),
    **changes: Any,
) -> RunFacts:
    """Return an evaluated run: medians of network, mean pose and retrieval on `medium`, then on `low`."""
    groups = {
        flight: (
            "test",
            {"first": errors(own), "mean training pose": errors(mean), "GeM": errors(retrieval)},
        )
        for flight, (own, mean, retrieval) in zip(("medium", "low"), medians, strict=False)
    }
    made = RunFacts(
        name="first",
        units="m",
        dataset="d",
        is_current=True,
        is_outdated=False,
        networks={"first": NetworkFacts("kind", "c", 9, 9, 4779, 3.0, 3.0, 9.0)},
        groups=groups,
        retrieval={"medium": "GeM", "low": "GeM"},
        published=(),
        notes=(),
        figures=(),
        fixes=BundleFixes(rows=rows),
    )
    return replace(made, **changes)


BAD = run((None, 14.0, 3.6), (19.0, 18.0, 18.3))
GOOD = run((0.8, 14.0, 3.6), (0.9, 18.0, 18.3))


@pytest.mark.parametrize(
    ("facts", "level", "words"),
    [
        (
            BAD,
            Level.STOP,
            "first is worse than the most similar training image (retrieval) on 2 of 2 flights and than the "
            "mean training pose on 2 of 2 flights (medians: medium none, as 33 of 100 frames have a pose; "
            "low 19.00 m, 3.0 deg): do not fly on its poses alone.",
        ),
        (
            GOOD,
            Level.GOOD,
            "first is better than retrieval on 2 of 2 flights (medians: medium 0.80 m",
        ),
        (
            run((4.0, 14.0, 3.6), (0.9, 18.0, 18.3)),
            Level.CAUTION,
            "on 1 of 2 flights (medians: medium 4.00 m, 3.0 deg; low 0.90 m, 3.0 deg): do not fly on its "
            "poses alone where medium is.",
        ),
        (replace(GOOD, retrieval={}), Level.UNKNOWN, "first is not compared with baselines"),
        (run(), Level.UNKNOWN, "first is not measured: there is no evaluation flight."),
    ],
)
def test_a_network_is_measured_against_what_needs_none(
    facts: RunFacts, level: Level, words: str
) -> None:
    """It is compared with retrieval and with the mean pose on each flight, and what is missing is said."""
    found = judge_run(DONE, [facts], ()).network
    assert found.level is level
    assert words in found.text


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "not evaluated"),
        ({"is_outdated": True}, "trained further since its evaluation"),
        ({"is_current": False}, "evaluated on another data set than the present one of the area"),
    ],
)
def test_figures_of_something_else_are_no_verdict(changes: dict[str, Any], words: str) -> None:
    """A network that was not measured as it is, on the present data, has neither verdict nor fixes."""
    state = replace(DONE, is_evaluated=False)
    found = judge_run(state, [replace(GOOD, **changes)] if changes else [], ())
    assert (found.network.level, found.flight.level) == (Level.UNKNOWN, Level.UNKNOWN)
    assert found.network.text == f"first is not measured: {words}."


def test_a_short_training_is_to_be_continued_and_a_long_one_not() -> None:
    """The command trains the same recipe for longer; after many images no such command is proposed."""
    found = judge_run(DONE, [BAD], ()).network
    assert found.do == "Train longer (it has seen 4,779 images in 3.0 min)"
    assert found.command == "spn-model train --run first-longer --recipe paper --minutes 30"
    scene = NetworkFacts("scene-coordinates", "c", 9, 9, 4_600, 2.0, 2.0, 9.0)
    found = judge_run(DONE, [replace(BAD, networks={"first": scene})], ()).network
    assert found.do.endswith("seen 4,600 images in 2.0 min; 345,000 take about 2.5 h at this rate)")
    assert found.command == "spn-model train --run first-longer --recipe paper --images 280000"
    long = NetworkFacts("kind", "c", 9, 9, 90_000, 40.0, 40.0, 9.0)
    assert judge_run(DONE, [replace(BAD, networks={"first": long})], ()).network.command == ""


def on(*rows: FixFigures, expect_low: tuple[str, ...] = ()) -> RunVerdict:
    """Return the verdict on these fixes."""
    return judge_run(DONE, [replace(GOOD, fixes=BundleFixes(rows=rows))], expect_low)


SEARCHED = fixes(method="search", images=60, usable=58, compared=58, misleading_at_most=0.06)
FEW = fixes("low", usable=40, compared=40, misleading_at_most=0.03)


@pytest.mark.parametrize(
    ("rows", "level", "words"),
    [
        (
            (SEARCHED, fixes(), fixes(method="coarse", misleading=149)),
            Level.GOOD,
            "may be flown on: 149 of 150 images have a usable fix (track), 0 of 149 compared fixes are "
            "misleading (at most 2.0% of a flight, with 95 % confidence). They come from landmarks; "
            "the pose of the network led to 3 of 58 (search).",
        ),
        ((SEARCHED,), Level.CAUTION, "so up to 6% may be misleading"),
        (
            (replace(SEARCHED, misleading=1), fixes()),
            Level.STOP,
            "Do not fly on the fixes of first: misleading are 1 of 58 (search on medium); 149 of 150",
        ),
        ((fixes(), FEW), Level.STOP, "Do not fly on the fixes of first where low is: 189 of 300"),
        (
            (replace(SEARCHED, from_network=None), fixes()),
            Level.GOOD,
            "Whether the network led to them is not measured.",
        ),
        ((), Level.UNKNOWN, "are not measured: no flight could be. Do not fly on them."),
    ],
)
def test_a_flight_is_judged_by_available_and_misleading_fixes(
    rows: tuple[FixFigures, ...], level: Level, words: str
) -> None:
    """Coarse poses do not count; any misleading fix, few fixes and few images are named."""
    found = on(*rows).flight
    assert found.level is level
    assert words in found.text


def test_few_fixes_far_from_the_map_are_expected_and_misleading_ones_are_not() -> None:
    """A declared flight may have few fixes and poor coarse poses, but no misleading ones."""
    found = on(fixes(), FEW, expect_low=("low",)).flight
    assert (found.level, found.text.endswith("Declared far from the map: low.")) == (
        Level.GOOD,
        True,
    )
    assert on(fixes(), replace(FEW, misleading=1), expect_low=("low",)).flight.level is Level.STOP
    assert on(FEW, expect_low=("low",)).flight.level is Level.CAUTION
    poor = run((0.8, 14.0, 3.6), (19.0, 18.0, 18.3))
    assert judge_run(DONE, [poor], ()).network.level is Level.CAUTION
    assert judge_run(DONE, [poor], {"low"}).network.level is Level.GOOD


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"has_bundle": False}, "no bundle is exported"),
        ({"is_exported": False}, "the bundle is damaged or of an earlier network"),
        ({"has_landmarks": False}, "has no landmarks, so it gives coarse poses only"),
        ({"is_measured": False}, "it was evaluated with another bundle"),
    ],
)
def test_fixes_of_another_bundle_are_not_those_that_fly(
    changes: dict[str, Any], words: str
) -> None:
    """Good fixes count only where they were measured with the present bundle of the present network."""
    facts = replace(GOOD, fixes=BundleFixes(rows=(fixes(),)))
    found = judge_run(replace(DONE, **changes), [facts], ()).flight
    assert found.level is Level.UNKNOWN
    assert words in found.text


def test_the_verdict_of_an_area_has_three_parts_and_is_on_top_of_the_page() -> None:
    """Data, network and flight follow each other; the page shows the same sentences before anything else."""
    bare = dict(judge(area()).parts())
    assert list(bare) == ["Data", "Network", "Flight"]
    assert bare["Network"].text == "Not measured: no network is trained."
    facts = replace(BAD, fixes=BundleFixes(rows=(SEARCHED, fixes())))
    data = replace(area(), runs=(facts,), trained=(DONE,))
    judged = judge(data)
    assert [said.level for _, said in judged.parts()] == [Level.GOOD, Level.STOP, Level.GOOD]
    assert judged.next.command.startswith("spn-onboard fly")
    html = render(data, judged)
    places = [html.index(said.text) for _, said in judged.parts()]
    assert places == sorted(places)
    assert places[-1] < html.index("Next:") < html.index("chosen frames have a pose")
