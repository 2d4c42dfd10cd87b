"""The network section of the report: errors of networks and baselines, from possibly hostile files."""

from __future__ import annotations

import base64
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from spn_cli.data import main as data_main
from spn_cli.model import main

from spn_data.area.area import Area
from spn_data.inputs.network_runs import read_runs, trained_runs
from spn_data.report.html import render
from spn_data.storage.fingerprints import content_fingerprint
from tests.spn_data.report.test_report_browser import CHROMIUM, visit
from tests.worlds.judged_world import write_judged, write_network
from tests.worlds.report_data import area as made_up_area

pytestmark = pytest.mark.usefixtures("tiny_kind")

IMAGE = re.compile(r'<img alt="([^"]*)" width="(\d+)" src="data:image/svg\+xml;base64,([\w+/=]+)">')
ALERT = "<script>document.title='hacked';console.log('hacked')</script>"
HOSTILE_SVG = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 100 50" onload="console.log(\'hacked\')">'
    f'{ALERT}<image href="https://example.org/x.png" width="9" height="9"/>'
    '<foreignObject width="9" height="9"><body xmlns="http://www.w3.org/1999/xhtml">'
    '<img src="x" onerror="console.log(\'hacked\')"/></body></foreignObject></svg>'
)


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Area with two networks, evaluated together; tests must not change it."""
    root = tmp_path_factory.mktemp("networks") / "area"
    dataset = write_judged(root / "5-split" / "dataset.h5")
    for seed, name in enumerate(("first", "second")):
        (root / "runs" / name).mkdir(parents=True)
        write_network(root / "runs" / name / "checkpoint.safetensors", dataset, seed=seed)
    words = ["--area", str(root), "--run", "first", "--run", "second", "--device", "cpu"]
    ran = CliRunner().invoke(main, ["evaluate", str(dataset), *words, "--threads", "1"])
    assert ran.exit_code == 0, ran.output
    return root


@pytest.fixture
def root(evaluated: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(evaluated, tmp_path / "area"))


def page(root: Path) -> str:
    """Return the page of an area with these networks."""
    runs, broken = read_runs(Area(root))
    html = render(replace(made_up_area(), runs=runs, broken_runs=broken))
    (section,) = re.findall(r'<section id="networks">.*?</section>', html, re.DOTALL)
    assert html.count("<script") == 2
    return section


def rewrite(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table))


def test_networks_stand_beside_what_needs_none(root):
    """Each group has one table with both networks, all baselines, and the figures of metrics.json."""
    shown = page(root)
    for group, frames in (("low", 4), ("medium", 7)):
        assert f"<h3>{group}: {frames} test frames</h3>" in shown
    table = shown[shown.index("<h3>medium") : shown.index("<h3>validation")]
    order = ["<b>first</b>", "<b>second</b>", "mean training", "retrieval, GeM", "retrieval, VLAD"]
    places = [table.index(f"<td>{words}") for words in [*order, "nearest training pose"]]
    assert places == sorted(places)
    assert table.count("(the better)") == 1
    assert "SqueezePoseNet, in the paper*" in table
    metrics = json.loads((root / "runs" / "first" / "metrics.json").read_text())
    one = metrics["groups"]["medium"]["first"]
    told = f"{one['position']['median']:.2f} m, {one['rotation_deg']['median']:.1f}&deg;"
    assert table.count(told) == 1


FIXES = {
    "flights": {
        "low": {
            method: {
                **{"images": 1200, "usable": 1199, "compared": 1000, "misleading": 0},
                **{"error_m": off, "error_deg": 0.04, "largest_m": 0.1, "nees": 0.9},
                **{"misleading_at_most": 0.003, "protected": None, "longest_outage_s": 0.4},
            }
            for method, off in (("coarse", 12.3), ("track", 0.0123), ("track, attitude", 0.0456))
        }
    },
    "attitudes": ["Attitude on low: to < 1 deg."],
    "reason": "",
    "bundle": {},
}


def test_fixes_stand_beside_coarse_poses(root):
    """Coarse poses of metres and fixes of centimetres have rows of their own; without any, it is said."""
    assert page(root).count("its fixes were not measured (") == 2  # there is no bundle
    rewrite(root / "runs" / "first" / "metrics.json", lambda t: t.update(fixes=FIXES))
    shown = page(root)
    part = shown[shown.index("<h3>first: fixes of its bundle") :].split("</table>")[0]
    assert "<td>coarse</td><td>1,199 of 1,200</td><td>12.30 m, 0.04&deg;</td>" in part
    assert "<td>track</td><td>1,199 of 1,200</td><td>1.2 cm, 0.04&deg;</td>" in part
    assert "<td>track, attitude</td><td>1,199 of 1,200</td><td>4.6 cm, 0.04&deg;</td>" in part
    assert "Attitude on low: to &lt; 1 deg.</p>" in shown
    assert "<td>0 (&le; 0.3 %)</td><td>0.90</td><td>&ndash;</td><td>0.4 s</td>" in part


def test_fixes_are_those_of_the_bundle_that_they_were_measured_with(root):
    """Another network, other landmarks or a damaged file: what is exported was not measured."""
    folder = root / "runs" / "first"
    bundle = folder / "bundle"

    def state() -> tuple[bool, bool, bool]:
        runs, _ = read_runs(Area(root))
        found = {one.name: one for one in trained_runs(Area(root), runs)}["first"]
        assert found.is_evaluated
        return found.has_bundle, found.is_exported, found.is_measured

    assert state() == (False, False, False)
    bundle.mkdir()
    document = {
        "run": {"checkpoint": content_fingerprint(folder / "checkpoint.safetensors")},
        "graphs": {"float32": {"sha256": "n"}},
        "landmarks": {"sha256": "l"},
    }
    same = {"network": "n", "landmarks": "l"}
    for made, measured, expected in (
        (document, same, (True, True, True)),
        (document, {"network": "n", "landmarks": "other"}, (True, True, False)),
        (document, {}, (True, True, False)),
        (
            {**document, "run": {"checkpoint": "other"}},
            {"network": "n", "landmarks": "l"},
            (True, False, True),
        ),
        ([], {"network": "n", "landmarks": "l"}, (True, False, False)),
    ):
        (bundle / "bundle.json").write_text(json.dumps(made))
        fixes = {**FIXES, "bundle": measured}
        rewrite(folder / "metrics.json", lambda t, fixes=fixes: t.update(fixes=fixes))
        assert state() == expected


def test_a_short_training_is_called_short(root):
    """A training on only forty images is marked as short."""
    shown = page(root)
    assert "Short training: first (40 images), second (40 images)." in shown
    table = shown[shown.index('class="trained"') : shown.index("</table>")]
    (first, _) = re.findall(r"<tr><td>(.*?)</td></tr>", table)
    titles = re.findall(r"<th>(.*?)</th>", table)
    told = dict(zip(titles, first.split("</td><td>"), strict=True))
    assert told["training time"] == told["best after"] == "0.1 min"
    assert told["images seen"] == "40"
    assert told["time per pose"].endswith(" ms")


def test_figures_are_images_and_nothing_else(root):
    """Each figure is an <img> with the exact bytes of its file, and no SVG is inlined."""
    shown = page(root)
    images = IMAGE.findall(shown)
    assert shown.count("<img") == len(images) == shown.count("src=")
    assert "<svg" not in shown
    folder = root / "runs" / "compared" / "figures"
    files = {path.read_bytes() for path in (root / "runs").glob("*/figures/*.svg")}
    assert {base64.b64decode(content) for _, _, content in images} == files
    first = base64.b64decode(images[0][2])
    assert first == (folder / "low-trajectories.svg").read_bytes()
    assert images[0][:2] == ("low: trajectories", "1000")


def test_what_was_judged_on_other_frames_is_told(root):
    """After another split or further training, the page marks the old evaluation as outdated."""
    write_judged(root / "5-split" / "dataset.h5", {"train": 9, "medium": 4})
    assert "earlier dataset than the current one: first, second." in page(root)
    write_network(root / "runs/first/checkpoint.safetensors", root / "5-split/dataset.h5", seed=7)
    shown = page(root)
    assert "first: trained further since its evaluation" in shown
    assert "compared: trained further since its evaluation" in shown
    assert "second: trained further since its evaluation" not in shown
    assert "Figures of <b>second</b>" in shown
    assert "Figures of <b>first</b>" not in shown


def _nested(table: dict[str, Any]) -> None:
    table["facts"]["runs"]["first"]["training"] = json.loads("[" * 90 + "]" * 90)


DAMAGE: dict[str, Callable[[dict[str, Any]], object]] = {
    "another version": lambda t: t.update(version=2),
    "no groups": lambda t: t.pop("groups"),
    "groups that are none": lambda t: t.update(groups=[1, 2]),
    "text for a number": lambda t: t["groups"]["medium"]["first"]["position"].update(median="1"),
    "a number that is none": lambda t: t["groups"]["medium"]["first"].update(frames=float("nan")),
    "a number for text": lambda t: t["facts"].update(dataset=7),
    "a name that leads out": lambda t: t["facts"]["runs"].update(
        {"../../x": t["facts"]["runs"]["first"]}
    ),
    "fixes without flights": lambda t: t.update(fixes={"reason": ""}),
    "a count of fixes that is text": lambda t: t.update(
        fixes={
            **FIXES,
            "flights": {"low": {"track": {**FIXES["flights"]["low"]["track"], "usable": "1"}}},
        }
    ),
    "nested lists": _nested,
}


@pytest.mark.parametrize("what", DAMAGE)
def test_a_damaged_metrics_json_is_told_and_the_rest_shown(root, what):
    """An unreadable run is named with a remedy, and the page still shows the other run."""
    rewrite(root / "runs" / "first" / "metrics.json", DAMAGE[what])
    shown = page(root)
    assert "metrics.json: cannot be shown" in shown
    assert "run spn-model evaluate again" in shown
    assert "<b>second</b>" in shown


@pytest.mark.parametrize("content", ["", "{", "[" * 100_000, '{"version": 1e999}', "\x00"])
def test_what_is_no_json_is_told(root, content):
    """Empty, truncated and deeply nested files give one line instead of a crash."""
    (root / "runs" / "first" / "metrics.json").write_text(content)
    assert "metrics.json: cannot be shown" in page(root)


def test_numbers_that_are_none_are_not_shown_as_numbers(root):
    """NaN and infinity, which some JSON files contain, are shown as unknown, like null."""

    def change(table: dict[str, Any]) -> None:
        table["groups"]["medium"]["first"]["position"].update(median=float("nan"), p95=float("inf"))

    rewrite(root / "runs" / "first" / "metrics.json", change)
    table = page(root).split("<h3>medium")[1].split("</table>")[0]
    (row,) = re.findall(r"<tr><td><b>first</b>.*?</tr>", table)
    assert row.count("<td>&ndash;</td>") == 2
    assert not re.search(r"\b(nan|inf)\b", row)


def test_runs_with_other_columns_share_a_table(root):
    """Runs with different limits or axes share a table, with empty cells for missing columns."""

    def change(table: dict[str, Any]) -> None:
        one = table["groups"]["medium"]["second"]
        one["within"], one["axes"] = one["within"][1:] * 4, []

    rewrite(root / "runs" / "second" / "metrics.json", change)
    table = page(root).split("<h3>medium")[1].split("</table>")[0]
    (row,) = re.findall(r"<tr><td><b>second</b>.*?</tr>", table)
    assert row.count("<td>") == table.count("<th>")
    assert row.count("<td>&ndash;</td>") == 2


def test_no_text_of_metrics_becomes_markup(root):
    """Markup in method, group, kind and note names is shown as plain text."""

    def change(table: dict[str, Any]) -> None:
        table["groups"][ALERT] = table["groups"].pop("medium")
        table["facts"]["roles"][ALERT] = ALERT
        table["groups"]["low"][ALERT] = table["groups"]["low"]["first"]
        table["groups"]["low"]["first"]["axes"][2]["axis"] = ALERT
        table["facts"]["runs"]["first"]["kind"] = ALERT
        table["facts"]["notes"] = [ALERT]
        table["units"] = ALERT
        for row in table["paper"]["table_1"]:
            row.update(network=ALERT, sequence=ALERT)

    rewrite(root / "runs" / "first" / "metrics.json", change)
    shown = page(root)
    assert "<script" not in shown
    assert shown.count("&lt;script&gt;") >= 7


def test_figures_that_are_none_of_ours_are_left_out(root):
    """Links, foreign files and oversized figures are counted but not shown."""
    folder = root / "runs" / "first" / "figures"
    before = len(IMAGE.findall(page(root)))
    (root / "secret.svg").write_text('<svg viewBox="0 0 9 9"></svg>')
    (folder / "link.svg").symlink_to(root / "secret.svg")
    (folder / "page.svg").write_text("<html><svg viewBox='0 0 9 9'>")
    (folder / "large.svg").write_bytes(b'<svg viewBox="0 0 9 9">' + b" " * 3_000_001)
    shown = page(root)
    assert "3 figures are omitted: too large or not readable as SVG." in shown
    assert len(IMAGE.findall(shown)) == before


def test_status_lists_runs(root):
    """`spn-data status` lists the networks and marks those not evaluated yet."""
    area = root
    (area / ".1-frames.partial").mkdir()
    (area / "runs" / "second" / "metrics.json").unlink()
    (area / "runs" / "begun").mkdir()
    shutil.rmtree(area / "5-split")
    env = {"COLUMNS": "200"}
    shown = CliRunner().invoke(data_main, ["status", "--area", str(area)], env=env).output
    lines = {line.split()[0]: line for line in shown.splitlines() if "runs/" in line}
    assert "complete" in lines["runs/first"]
    assert "evaluated" in lines["runs/first"]
    assert "not evaluated: spn-model evaluate --run second" in lines["runs/second"]
    assert "unfinished" in lines["runs/begun"]
    assert "side by side" in lines["runs/compared"]


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine (Debian: chromium)")
def test_a_hostile_figure_runs_nothing_in_a_browser(root, tmp_path):
    """A hostile SVG is drawn as an image: its scripts, handlers and links do nothing.

    The console stays empty.
    """
    figures = root / "runs" / "compared" / "figures"
    shutil.rmtree(figures)
    figures.mkdir()
    (figures / "low-trajectories.svg").write_text(HOSTILE_SVG)
    runs, broken = read_runs(Area(root))
    seen = visit(
        tmp_path,
        render(replace(made_up_area(), runs=runs, broken_runs=broken)),
        """
        const images = [...document.querySelectorAll("#networks img")];
        found.title = document.title;
        found.shown = images.filter(image => image.complete && image.naturalWidth > 0).length;
        found.all = images.length;
        found.inside = images.every(image => image.src.startsWith("data:"));
        found.first = atob(images[0].src.split(",")[1]).includes("hacked");
        found.wide = document.documentElement.scrollWidth <= window.innerWidth;
        """,
        when_loaded=True,
    )
    assert seen.found["first"]
    assert seen.console == []
    assert seen.found["title"] == "north"
    assert seen.found["inside"]
    assert seen.found["wide"]
    assert seen.found["shown"] == seen.found["all"] > 10
