"""Planned waypoints in the report: what was expected with which bundle, from possibly hostile files."""

from __future__ import annotations

import json

import pytest

from spn_data.area.area import Area
from spn_data.inputs.expected_plans import read_expected_plans
from spn_data.report.expected import expected_plans

BUNDLE = {"network": "aa", "landmarks": "bb"}
PLAN = {
    "version": 1,
    "plan": "plan <1>.csv",
    "bundle": BUNDLE,
    "counts": {"yes": 12, "perhaps": 1, "no": 2},
    "lacking": [
        {"name": "3", "expected": "no", "landmarks": 17, "reason": "<b>too few</b>"},
        {"name": "4", "expected": "perhaps", "landmarks": 1700, "reason": "few agree"},
    ],
}


@pytest.fixture
def area(tmp_path):
    """Return an area with a run that has a bundle and a judged plan."""
    run = tmp_path / "runs" / "first"
    (run / "bundle").mkdir(parents=True)
    document = {
        "run": {"checkpoint": "c"},
        "graphs": {"float32": {"sha256": "aa"}},
        "landmarks": {"sha256": "bb"},
    }
    (run / "bundle" / "bundle.json").write_text(json.dumps(document))
    (run / "expected.json").write_text(json.dumps(PLAN))
    return Area(tmp_path)


def test_the_page_says_where_a_fix_is_to_be_expected(area):
    """Counts, the waypoints that lack one with the reason, and how many more; texts are escaped."""
    plans, broken = read_expected_plans(area)
    assert not broken
    shown = expected_plans(plans, broken)
    assert "plan &lt;1&gt;.csv, bundle of first" in shown
    assert "expected at 12 of 15 waypoints, perhaps at 1 more" in shown
    assert "<td>4</td><td>perhaps</td><td>1,700</td><td>few agree</td>" in shown
    assert "&lt;b&gt;too few" in shown
    assert "1 more are not shown" in shown
    assert "earlier bundle" not in shown
    assert expected_plans((), ()) == ""


def test_a_plan_of_another_bundle_is_marked(area):
    """Once the bundle changes or is gone, the page says that the plan was judged by an earlier one."""
    path = area.root / "runs" / "first" / "bundle" / "bundle.json"
    for text in (path.read_text().replace("bb", "cc"), "{"):
        path.write_text(text)
        plans, broken = read_expected_plans(area)
        assert "Judged by an earlier bundle" in expected_plans(plans, broken)


@pytest.mark.parametrize(
    "change",
    [
        {"counts": {"yes": -1, "perhaps": 0, "no": 0}},
        {"counts": {"yes": True, "perhaps": 0, "no": 0}},
        {"lacking": [{"name": 3}]},
        {"plan": None},
        {"version": 2},
    ],
)
def test_a_damaged_file_is_told_and_not_shown(area, change):
    """The page names the file and the remedy instead of showing what it cannot understand."""
    (area.root / "runs" / "first" / "expected.json").write_text(json.dumps({**PLAN, **change}))
    plans, broken = read_expected_plans(area)
    assert not plans
    assert "expected.json" in broken[0]
    assert "run spn-model availability again" in expected_plans(plans, broken)
