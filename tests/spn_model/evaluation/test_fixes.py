"""Figures of fixes on evaluation flights, and what they mean for a flight."""

from __future__ import annotations

import csv
import math
from dataclasses import replace

import numpy as np
import pytest

from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotations_from_angles
from spn_model.evaluation.fix_figures import stanford_diagrams
from spn_model.evaluation.fix_files import RunFixes, fix_rows, write_fixes
from spn_model.evaluation.fixes import (
    COARSE,
    SEARCH,
    TRACK,
    FlightFixes,
    JudgedImage,
    fix_error,
    largest_share,
)
from spn_model.evaluation.flight_attitude import FlightAttitude
from spn_model.export.model_card import card_with_metrics, card_with_verdict
from spn_model.integrity.fix import Fix, FixSource, FixState

SIGMA = np.array([0.01, 0.01, 0.02, 1e-3, 1e-3, 1e-3])


def poses(center, heading_deg=30.0) -> Poses:
    """Return one pose."""
    return Poses.from_rotations(
        np.array([center], float), rotations_from_angles(np.array([[heading_deg, -20.0, 0.0]]))
    )


TRUTH = poses([10.0, 20.0, 30.0])


def fix(off_m=(0.0, 0.0, 0.0), turn_deg=0.0, level_m=(0.6, 0.6)) -> Fix:
    """Return a fix that is off by a shift and a heading."""
    pose = poses(np.array([10.0, 20.0, 30.0]) + off_m, 30.0 + turn_deg)
    return Fix(
        time_us=1,
        center=pose.centers[0],
        quat_wxyz=pose.quats_wxyz[0],
        covariance=np.diag(SIGMA**2),
        horizontal_protection_m=level_m[0],
        vertical_protection_m=level_m[1],
        state=FixState.TRACK,
        source=FixSource.NETWORK,
        quality=90,
        processing_s=0.1,
    )


def images(*fixes: Fix | None) -> tuple[JudgedImage, ...]:
    """Return judged images; None is an image without a fix."""
    return tuple(
        JudgedImage(
            name=f"low/{k}.jpg", time_s=0.5 * k, is_usable=False, state="search", reason="dark"
        )
        if one is None
        else JudgedImage(
            name=f"low/{k}.jpg",
            time_s=0.5 * k,
            is_usable=True,
            state="track",
            source="network",
            protection_m=(one.horizontal_protection_m, one.vertical_protection_m),
            error=fix_error(one, TRUTH),
        )
        for k, one in enumerate(fixes)
    )


@pytest.mark.parametrize(
    ("given", "misleading", "protected"),
    [
        ({"off_m": (0.1, 0.0, 0.1)}, False, True),
        ({"off_m": (0.36, 0.36, 0.0), "level_m": (2.0, 2.0)}, True, True),
        ({"turn_deg": 2.2}, True, True),
        ({"off_m": (0.08, 0.08, 0.0), "level_m": (0.1, 0.6)}, True, False),
        ({"off_m": (0.0, 0.0, -0.2), "level_m": (0.6, 0.1)}, True, False),
    ],
)
def test_what_is_off_by_more_than_a_limit_is_misleading(given, misleading, protected):
    """Half a metre, 2 degrees and either protection level are limits of their own."""
    found = fix_error(fix(**given), TRUTH)
    assert (found.is_misleading, found.is_protected) == (misleading, protected)


def test_errors_are_compared_with_covariances():
    """One standard deviation along each axis of the position is half of what 6 axes would give."""
    found = fix_error(fix(off_m=SIGMA[:3]), TRUTH)
    assert found.nees == pytest.approx(3 / 6)
    assert found.error_m == pytest.approx(np.linalg.norm(SIGMA[:3]))
    assert found.horizontal_m == pytest.approx(0.01 * 2**0.5)
    assert found.vertical_m == pytest.approx(0.02)


def test_the_bound_of_a_share_is_exact():
    """None of 300 is below 1 %, as 3/n says; other counts are those of Clopper and Pearson."""
    assert largest_share(0, 300) == pytest.approx(3 / 300, rel=0.01)
    assert largest_share(1, 10) == pytest.approx(0.3942, abs=1e-4)
    assert largest_share(0, 0) == largest_share(4, 4) == 1.0


def test_a_flight_is_summarized():
    """Medians and shares are of usable fixes with a label; usable counts all of them."""
    unlabelled = replace(images(fix())[0], error=None, time_s=2.0)
    judged = (
        *images(fix(off_m=(0.02, 0, 0)), fix(off_m=(0.04, 0, 0)), None, fix(turn_deg=5)),
        unlabelled,
    )
    one = FlightFixes(flight="low", method=TRACK, images=judged).summary()
    assert (one.images, one.usable, one.compared, one.misleading) == (5, 4, 3, 1)
    assert one.error_m == pytest.approx(0.02)
    assert one.largest_m == pytest.approx(0.04)
    assert one.protected == 1.0
    assert one.longest_outage_s == 1.0  # around the third of them
    empty = FlightFixes(flight="low", method=SEARCH, images=images(None)).summary()
    assert (empty.usable, empty.misleading_at_most) == (0, 1.0)
    assert math.isnan(empty.error_m)


GOOD = FlightFixes(flight="low", method=SEARCH, images=images(fix(off_m=(0.02, 0, 0)), None, fix()))


def attitude(*, is_simulated: bool) -> FlightAttitude:
    """Return an attitude whose sentence says what kind it is."""
    text = "Simulated." if is_simulated else "Recorded."
    return FlightAttitude(verticals=(None,) * 3, is_simulated=is_simulated, text=text)


def test_rows_with_an_attitude_stand_apart():
    """Recorded and simulated attitudes have rows of their own; the diagram leaves them out."""
    aided = replace(GOOD, attitude=attitude(is_simulated=False))
    other = replace(aided, attitude=attitude(is_simulated=True))
    document = RunFixes(flights=(GOOD, aided, other)).to_json()
    rows = ["search", "search, attitude", "search, simulated attitude"]
    assert list(document["flights"]["low"]) == rows
    assert [row[1] for row in fix_rows(document["flights"])] == rows
    assert document["attitudes"] == ["Recorded.", "Simulated."]
    assert stanford_diagrams([GOOD, aided]) == stanford_diagrams([GOOD])


def test_every_image_has_a_row_and_each_fix_a_dot(tmp_path):
    """fixes.csv has the reason of an image without a fix; the diagram shows fixes, not coarse poses."""
    coarse = replace(GOOD, method=COARSE)
    write_fixes(tmp_path / "fixes.csv", [coarse, GOOD])
    with (tmp_path / "fixes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["method"] for row in rows] == ["coarse"] * 3 + ["search"] * 3
    assert rows[4]["reason"] == "dark"
    assert rows[4]["error"] == rows[4]["misleading"] == ""
    assert rows[3]["error"] == "0.0200"
    assert rows[3]["protection_horizontal"] == "0.6000"
    drawings = stanford_diagrams([coarse, GOOD])
    assert list(drawings) == ["low-protection"]
    assert drawings["low-protection"].count("<circle") == 2 * 2 + 1  # two panels, and the legend
    assert "0 misleading" in drawings["low-protection"]


def test_the_card_of_a_bundle_gets_the_fixes_of_a_later_evaluation():
    """Sections on errors and fixes are replaced, the others stay; a card without sections is unchanged."""
    fixes = RunFixes(flights=(GOOD, replace(GOOD, attitude=attitude(is_simulated=True))))
    document = fixes.to_json()
    metrics = {"units": "m", "groups": {}, "fixes": document}
    card = "# first\n\n## Errors\n\nold\n\n## Fixes\n\nold\n\n## Limits\n\nnone\n"
    made = card_with_metrics(card, metrics, run="first", trained_on=())
    assert "old" not in made
    assert made.startswith("# first\n\n## Errors\n\nMeasured by")
    assert made.endswith("\n\n## Limits\n\nnone\n")
    assert "| low | search | 2 of 3 | 1.0 cm, 0.00 deg | 0 (<= 77.6 %) |" in made
    assert "| low | search, simulated attitude | 2 of 3 |" in made
    assert "\n\nSimulated.\n\n" in made
    assert len(fix_rows(document["flights"])) == 2
    assert card_with_metrics("# other\n", metrics, run="first", trained_on=()) == "# other\n"


def test_the_card_of_a_bundle_gets_the_verdict_until_the_next_evaluation():
    """The verdict is a section of its own, also in an older card; new errors make it unknown again."""
    card = "# first\n\n## Errors\n\nold\n\n## Fixes\n\nold\n\n## Limits\n\nnone\n"
    made = card_with_verdict(card, [("Data", "Ready to train."), ("Flight", "Do not\n\n## fly.")])
    verdict = (
        "## Verdict\n\n- Data: Ready to train.\n- Flight: Do not ## fly.\n\n## Errors\n\nold\n\n"
    )
    assert f"# first\n\n{verdict}## Fixes" in made
    metrics = {"units": "m", "groups": {}, "fixes": RunFixes(flights=(GOOD,)).to_json()}
    later = card_with_metrics(made, metrics, run="first", trained_on=())
    assert "## Verdict\n\nNot judged yet: run `spn-model evaluate`" in later
