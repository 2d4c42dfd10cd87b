"""The report shows and judges the contents of an area, and escapes all of its text."""

from __future__ import annotations

import json
import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from spn_data.report.data import CoverageFacts, FrameTable, ReportData, StageFacts
from spn_data.report.html import render
from spn_data.report.pack import pack, script_json
from spn_data.report.residual_map import residual_map, round_down
from spn_data.report.scene import display_of, thin_points
from spn_data.report.thinning import thin_frames
from spn_data.report.verdict import Level, VerdictLimits, judge_data
from spn_data.split import audit
from tests.worlds.report_data import area, flight, points, record, unpack

ROOT = Path(__file__).resolve().parents[3]


def given(html: str) -> dict:
    """Return the data passed to the script of the page."""
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', html)
    return json.loads(text)


def with_counts(data: ReportData, **counts: object) -> ReportData:
    assert data.model_record is not None
    changed = replace(data.model_record, counts={**data.model_record.counts, **counts})
    return replace(data, model_record=changed)


def test_an_area_with_everything_is_ready():
    """The complete synthetic area is judged ready at the top of the page, without adverse findings."""
    found = judge_data(area())
    assert [f for f in found.findings if f.level is not Level.GOOD] == []
    assert found.headline == "Ready to train"
    html = render(area())
    assert html.index("Ready to train") < html.index("chosen frames have a pose")


def optimistic(data: ReportData) -> ReportData:
    assert data.split is not None
    return replace(data, split=replace(data.split, optimistic=True))


def nothing_to_train_on(data: ReportData) -> ReportData:
    assert data.split is not None
    return replace(data, split=replace(data.split, group=np.full(190, "validation")))


def unsure_of_heading(data: ReportData) -> ReportData:
    assert data.geo is not None
    stated = replace(data.geo.uncertainty, heading_deg=3.5)
    return replace(data, geo=replace(data.geo, uncertainty=stated))


def worse_on_unseen_fixes(data: ReportData) -> ReportData:
    assert data.geo is not None
    held_out = replace(data.geo.held_out_blocks, horizontal_rmse_m=0.9)
    return replace(data, geo=replace(data.geo, held_out_blocks=held_out))


def of_evaluation(failed: int) -> FrameTable:
    return FrameTable.concatenate(
        [
            flight("flight1", 150, radius_m=30, height_m=10),
            flight("medium", 40, radius_m=25, height_m=14, failed=failed),
        ]
    )


def audited(verdict_: audit.AuditVerdict) -> tuple[audit.AuditFinding, ...]:
    return (audit.AuditFinding("guard gap", verdict_, "frames lie within 2 s", ("a is near b",)),)


STALE = (StageFacts(record("3-geo"), "2-model was redone since", "spn-data georegister"),)
LOW = CoverageFacts({"medium": {"high": 20, "medium": 5, "low": 15, "failed": 0}}, (), "")
RULES = {
    "no model": (lambda d: replace(d, model_record=None), Level.STOP, "There is no model"),
    "stale": (lambda d: replace(d, stages=STALE), Level.STOP, "3-geo is out of date: 2-model was"),
    "map has holes": (lambda d: with_counts(d, registered=140), Level.CAUTION, "140 of 150"),
    "map is contradicted": (
        lambda d: with_counts(d, contradicted=True),
        Level.STOP,
        "parts of it lie at wrong places",
    ),
    "map is a ruin": (lambda d: with_counts(d, registered=118), Level.STOP, "118 of 150"),
    "blur": (
        lambda d: with_counts(d, mean_error_px=1.2),
        Level.CAUTION,
        "1.20 px, more than 1 px; likely causes",
    ),
    "rolling shutter": (
        lambda d: with_counts(d, shutter=[{"sequence": "flight1", "rolls": True}]),
        Level.CAUTION,
        "Rolling shutter affects flight1",
    ),
    "no metres": (lambda d: replace(d, geo=None, units="model"), Level.CAUTION, "not metres"),
    "heading": (unsure_of_heading, Level.CAUTION, "uncertain: heading 3.5 deg"),
    "few fixes": (worse_on_unseen_fixes, Level.CAUTION, "is 0.90 m for held-out GNSS fixes"),
    "evaluation fails": (
        lambda d: replace(d, frames=of_evaluation(40)),
        Level.STOP,
        "0 of 40 frames have a pose (0%). It shows another place",
    ),
    "evaluation says little": (
        lambda d: replace(d, frames=of_evaluation(21)),
        Level.CAUTION,
        "a test on so few frames is hardly meaningful",
    ),
    "evaluation has holes": (
        lambda d: replace(d, frames=of_evaluation(5)),
        Level.CAUTION,
        "35 of 40 frames have a pose (88%). Frames without",
    ),
    "coverage unknown": (lambda d: replace(d, coverage=None), Level.CAUTION, "is not known"),
    "coverage stale": (
        lambda d: replace(d, coverage=replace(d.coverage, stale="4-eval/medium was redone since")),
        Level.CAUTION,
        "Coverage is out of date: 4-eval/medium",
    ),
    "coverage low": (
        lambda d: replace(d, coverage=LOW),
        Level.CAUTION,
        "38% of the views of sequence medium have no mapping frame nearby",
    ),
    "no split": (lambda d: replace(d, split=None, audit=None), Level.STOP, "are not split"),
    "nothing to train on": (nothing_to_train_on, Level.STOP, "No training frames are left"),
    "optimistic": (optimistic, Level.CAUTION, "so test results are optimistic"),
    "not audited": (lambda d: replace(d, audit=None), Level.STOP, "has not been audited"),
    "audit failed": (
        lambda d: replace(d, audit=audited(audit.AuditVerdict.FAIL)),
        Level.STOP,
        "The audit failed (guard gap): frames lie within 2 s.",
    ),
    "audit notices": (
        lambda d: replace(d, audit=audited(audit.AuditVerdict.NOTICE)),
        Level.CAUTION,
        "Audit, guard gap: frames lie",
    ),
    "plan": (
        lambda d: replace(d, plan=CoverageFacts({"waypoints": {"high": 1, "low": 3}}, (), "")),
        Level.CAUTION,
        "75% of the views of the planned waypoints have no mapping frame nearby",
    ),
    "plan stale": (
        lambda d: replace(d, plan=CoverageFacts({"waypoints": {"high": 1}}, (), "", "x is gone")),
        Level.CAUTION,
        "Coverage of the planned waypoints is out of date: x is gone.",
    ),
    "own GNSS": (
        lambda d: replace(
            d,
            evaluation_records={
                "medium": record(
                    "4-eval/medium",
                    gnss={
                        "offset_e_m": 3.0,
                        "offset_n_m": -6.0,
                        "offset_u_m": 0.5,
                        "scatter_h_m": 0.4,
                        "contradicts": True,
                    },
                )
            },
        ),
        Level.CAUTION,
        "GNSS of medium, not used for its labels, deviates from them by 6.7 m horizontally and +0.5 m",
    ),
    "far from own GNSS": (
        lambda d: replace(
            d,
            evaluation_records={
                "medium": record("4-eval/medium", gnss={"far": 7, "contradicts": False})
            },
        ),
        Level.CAUTION,
        "7 labels of medium are far from their own GNSS fixes, unlike the others",
    ),
}


@pytest.mark.parametrize("name", RULES)
def test_each_rule_of_the_verdict(name):
    """Each single defect gives one finding of its weight, which decides the verdict and comes first."""
    change, level, text = RULES[name]
    found = judge_data(change(area()))
    bad = [f for f in found.findings if f.level is not Level.GOOD]
    assert len(bad) == 1
    assert found.findings[0].level is found.level is level
    assert text in found.findings[0].text


def test_a_flight_declared_far_from_the_map_is_no_reservation():
    """Few poses and low coverage of a declared flight are said with the declaration, and reserve nothing."""
    poor = replace(area(), frames=of_evaluation(21), coverage=LOW)
    assert judge_data(poor).headline == "Ready to train, with 2 reservations"
    found = judge_data(replace(poor, expect_low=frozenset({"medium"})))
    assert found.headline == "Ready to train"
    said = [f.text for f in found.findings if "declared to be far" in f.text]
    assert len(said) == 2
    assert "19 of 40 frames have a pose" in said[0]
    assert "38% low" in said[1]


@pytest.mark.parametrize(
    ("failed", "declared", "words"),
    [
        (40, "medium", "0 of 40 frames have a pose (0%); nothing can be tested on it"),
        (2, "lo", "low coverage of lo, which is no evaluation sequence"),
    ],
)
def test_a_declaration_that_hides_everything_or_nothing_is_a_reservation(failed, declared, words):
    """A declared flight without a pose tests nothing, and a declared name without a flight does nothing."""
    data = replace(area(), frames=of_evaluation(failed), expect_low=frozenset({declared}))
    found = judge_data(data)
    assert found.headline == "Ready to train, with 1 reservation"
    assert words in found.findings[0].text


def test_few_training_frames_are_a_reservation():
    """93 training frames are fewer than 100 and give a reservation; 143 give none."""
    found = judge_data(area(cameras=100))
    assert found.headline == "Ready to train, with 1 reservation"
    assert "93 training frames" in found.findings[0].text
    assert judge_data(area(cameras=150)).level is Level.GOOD


def test_limits_of_the_verdict_are_documented():
    """docs/report.md has a row for each limit with its default."""
    text = (ROOT / "docs" / "report.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(\w+)` \| ([\d.]+) \|", text, re.MULTILINE))
    limits = VerdictLimits()
    assert {name: float(value) for name, value in rows.items()} == {
        f.name: getattr(limits, f.name) for f in fields(limits)
    }


def test_options_are_documented_with_their_defaults():
    """docs/report.md has a row for each option of `spn-data report`, and no others."""
    from spn_cli.report import report

    text = (ROOT / "docs" / "report.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(--[a-z-]+)` \| ([^|]+) \|", text, re.MULTILINE))
    own = [p for p in report.params if p.expose_value]
    assert sorted(rows) == sorted(p.opts[0] for p in own)
    for parameter in own:
        if type(parameter.default) is int:
            assert int(rows[parameter.opts[0]]) == parameter.default


def test_the_page_loads_nothing():
    """The page is self-contained: it has no address, file or import to load."""
    html = render(area())
    assert html.isascii()
    assert re.findall(r"https?://|@import|\burl\(|<link(?! rel=\"icon\" href=\"data:)", html) == []
    assert re.findall(r"\bsrc=|<iframe|fetch\(|XMLHttpRequest", html) == []
    assert "default-src 'none'" in html


HOSTILE = '</script><img src=x onerror="alert(1)">&amp;\'\u2028\udcff<!--'


def test_no_text_of_the_area_becomes_markup():
    """Markup in paths, notes, reasons and sequence names is shown as plain text."""
    data = area()
    assert data.split is not None
    frames = data.frames
    hostile = replace(
        data,
        title=HOSTILE,
        path=HOSTILE,
        stages=tuple(
            StageFacts(
                replace(
                    stage.record,
                    stage=HOSTILE,
                    options={HOSTILE: {HOSTILE: HOSTILE}},
                    inputs={HOSTILE: HOSTILE},
                    notes=(HOSTILE,),
                    versions={HOSTILE: HOSTILE},
                    seconds={HOSTILE: 1.0},
                    finished=HOSTILE,
                ),
                HOSTILE,
                HOSTILE,
            )
            for stage in data.stages
        ),
        frames=replace(
            frames,
            names=np.array([HOSTILE + str(k) for k in range(len(frames))]),
            sequences=np.full(len(frames), HOSTILE),
            cameras=np.full(len(frames), HOSTILE),
            reason=np.full(len(frames), HOSTILE),
            stratum=np.full(len(frames), HOSTILE),
            group=np.full(len(frames), HOSTILE),
        ),
        coverage=CoverageFacts({HOSTILE: {HOSTILE: 3}}, (), HOSTILE),
        split=replace(data.split, group=np.full(190, HOSTILE), notes=(HOSTILE,)),
        audit=(audit.AuditFinding(HOSTILE, audit.AuditVerdict.FAIL, HOSTILE, (HOSTILE,)),),
    )
    html = render(hostile)
    assert "<img" not in html
    assert html.count("</script>") == render(data).count("</script>") == 2
    assert given(html)["frames"]["name"][0] == HOSTILE + "0"
    assert html.count("&lt;img") > 20


def test_each_section_is_there_with_its_figures():
    """Each section shows its figures.

    The sections are registered frames, uncertainty, residuals, strata, places to fly again, audit and
    versions.
    """
    html = render(area())
    for text in (
        "150 of 150",
        "0.92 m",
        "38 of 40",
        "high 75% (30)",
        "49.0000180, 8.4000137",
        "failed: ambiguous",
        "<b>guard gap</b>: kept",
        "A note of 3-geo.",
        "fit.heights",
        "2.4",
        "origin 49.000000, 8.400000, height 115.00 m (ellipsoid)",
    ):
        assert text in html, text


def test_an_area_without_metres_says_so_everywhere():
    """Without georegistration the page claims neither metres nor north."""
    data = replace(area(), geo=None, units="model")
    html = render(data)
    assert html.count("units: model") == 2
    assert "north is unknown" in html
    assert "GNSS residuals" not in html
    assert "model units position, 1 sigma" in html


def test_an_area_with_frames_only_is_shown():
    """Before reconstruction, the page shows the frames and the next step."""
    data = area()
    nowhere = np.full((150, 3), np.nan)
    frames = data.frames.select(~data.frames.evaluation)
    frames = replace(
        frames,
        status=np.full(150, "chosen"),
        poses=replace(frames.poses, centers=nowhere, quats_wxyz=np.full((150, 4), np.nan)),
    )
    data = replace(
        data,
        stages=data.stages[:1],
        model_record=None,
        geo=None,
        units="model",
        points=None,
        frames=frames,
        coverage=None,
        split=None,
        audit=None,
    )
    html = render(data)
    assert "Not ready to train: 1 thing to do first" in html
    assert given(html)["points"] is None


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("f4", np.array([1.5, -2.0, np.nan])),
        ("i2", np.array([-32768, 32767])),
        ("i4", np.array([2**31 - 1, -5])),
        ("u1", np.array([0, 255])),
    ],
)
def test_arrays_are_packed_without_loss(kind, values):
    """Packed arrays decode to the values put in."""
    np.testing.assert_array_equal(unpack(pack(values, kind)), values)


def test_positions_of_points_are_exact_to_their_step():
    """Point coordinates are within half a step of their values: millimetres over 80 m."""
    data = area(map_points=500)
    packed = given(render(data))
    display = display_of(data.frames, data.points, has_up=True)
    found = unpack(packed["points"]["xyz"]).reshape(-1, 3) * packed["points"]["step"]
    assert packed["points"]["step"] < 0.004
    np.testing.assert_allclose(
        found, display.apply(data.points.xyz), atol=0.51 * packed["points"]["step"]
    )


def test_points_are_thinned_and_the_page_says_so():
    """The page has no more points than requested and none far beyond the map, and says so."""
    data = area(map_points=4000)
    far = data.points.xyz.copy()
    far[0] = [1e6, 0, 0]
    data = replace(data, points=replace(data.points, xyz=far))
    display = display_of(data.frames, data.points, has_up=True)
    rows, left_out = thin_points(data.points, display, 1000)
    assert (len(rows), left_out, 0 in rows) == (1000, 1, False)
    assert "1,000 of 4,000 points are shown" in render(data, max_points=1000)


def test_frames_are_thinned_but_for_those_that_matter():
    """If there are too many frames, candidates are dropped first; failed and chosen ones all stay."""
    base = flight("flight1", 400, radius_m=30, height_m=10, failed=50)
    status = np.where(np.arange(400) < 200, "skipped", base.status)
    frames = replace(base, status=status, tracked=np.arange(400) >= 300)
    kept, left_out = thin_frames(frames, 250)
    assert left_out == {"candidates that were not chosen": 150}
    kept, left_out = thin_frames(frames, 170)
    assert left_out == {
        "candidates that were not chosen": 200,
        "tracked frames with a pose": 30,
    }
    assert (kept.status == "failed").sum() == 50
    assert (~kept.tracked).sum() == 100
    assert thin_frames(frames, 400)[1] == {}


def test_up_is_guessed_from_the_cameras_without_metres():
    """Without georegistration, the cameras' up direction is drawn upwards even in a tilted model."""
    frames = flight("flight1", 60, radius_m=30, height_m=10)
    turned = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    poses = frames.poses.from_rotations(
        frames.poses.centers @ turned.T, frames.poses.rotations @ turned.T
    )
    sideways = replace(frames, poses=poses)
    cloud = points(500)
    display = display_of(sideways, replace(cloud, xyz=cloud.xyz @ turned.T), has_up=False)
    np.testing.assert_allclose(display.rotation @ turned @ [0, 0, 1], [0, 0, 1], atol=1e-6)
    assert np.linalg.det(display.rotation) == pytest.approx(1.0)


def test_residuals_are_drawn_true_to_scale():
    """A residual of 1 m east, drawn 5 times larger, is as long as 5 m on the scale bar."""
    frames = flight("flight1", 60, radius_m=30, height_m=10)
    frames = replace(
        frames, gnss_m=np.tile([1.0, 0, 0.2], (60, 1)), gnss_outlier=np.zeros(60, bool)
    )
    svg = residual_map(frames)
    factor = float(re.findall(r"([\d.]+) times longer", svg)[0])
    m = float(re.findall(r">([\d.]+) m</text>", svg)[0])
    bar = float(re.findall(r'class="bar"><path d="M[\d. ]+h([\d.]+)', svg)[0])
    x0, y0, x1, y1 = map(
        float,
        re.findall(
            r'class="fix" data-frame="[^"]*"><title>[^<]*</title>'
            r'<path d="M([\d.]+) ([\d.]+)L([\d.]+) ([\d.]+)',
            svg,
        )[0],
    )
    assert factor > 1
    assert x1 - x0 == pytest.approx(factor * bar / m, abs=0.2)
    assert y1 == y0


def test_one_outlier_does_not_fill_the_map_of_residuals():
    """A fix 500 m off is clipped and marked, and the other residuals keep their scale."""
    frames = flight("flight1", 60, radius_m=30, height_m=10)
    residuals = frames.gnss_m.copy()
    residuals[7] = [500.0, 0, 0]
    usual, with_outlier = residual_map(frames), residual_map(replace(frames, gnss_m=residuals))
    assert "are truncated" in with_outlier
    assert "are truncated" not in usual
    times = re.findall(r"([\d.]+) times longer", usual + with_outlier)
    assert times[0] == times[1]
    assert 'class="outlier"' in with_outlier


def test_flights_without_fixes_have_no_map_of_residuals():
    """Without GNSS fixes, no map of residuals is drawn."""
    frames = flight("medium", 60, radius_m=30, height_m=10)
    assert residual_map(frames) == ""


@pytest.mark.parametrize(("value", "rounded"), [(0.99, 0.5), (1.0, 1.0), (4.99, 2.0), (73.0, 50.0)])
def test_round_figures_for_bars(value, rounded):
    """Scale bars are 1, 2 or 5 times a power of ten."""
    assert round_down(value) == pytest.approx(rounded)


def test_numbers_that_json_lacks_are_refused():
    """NaN is refused in the page's JSON because browsers cannot parse it."""
    with pytest.raises(ValueError):
        script_json({"x": float("nan")})
