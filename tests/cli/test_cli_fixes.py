"""`spn-model evaluate` and `availability` with the bundle of a run, on a registered flight."""

from __future__ import annotations

import csv
import json
import re
import shlex
import shutil
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner
from spn_cli.data import main as data_main
from spn_cli.model import main as model_main

from spn_model.onboard.__main__ import main as onboard_main

pytestmark = pytest.mark.slow

TRAIN = ["--images", "32", "--validations", "1", "--threads", "1", "--device", "cpu"]


def run(command, *words: object):
    return CliRunner().invoke(command, [str(word) for word in words], env={"COLUMNS": "250"})


def paste(output: str, begins: str, *less: str) -> str:
    """Run the command of the line "Next", which begins so, with further options; return what it printed."""
    last = [line for line in output.splitlines() if line.startswith("Next: ")][-1]
    command = re.fullmatch(r"Next: [^:]*: (spn-.*)", last)
    assert command is not None, last
    assert command[1].startswith(begins), last
    program, *words = shlex.split(command[1])
    if program == "spn-onboard":
        assert onboard_main([*words, *less]) == 0
        return ""
    result = run({"spn-data": data_main, "spn-model": model_main}[program], *words, *less)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture(scope="module")
def area(finished_area: Path, flight2: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The area with the second flight registered, a network of a few steps, and its bundle."""
    area = tmp_path_factory.mktemp("fixes") / "area"
    shutil.copytree(finished_area, area)
    before = torch.get_num_threads()
    options = ("--name", "medium", "--rate", 1, "--all-frames", "--any-telemetry", "--threads", 1)
    result = run(
        data_main, "register", flight2 / "flight2.mp4", *options, "--expect-low", "--area", area
    )
    assert result.exit_code == 0, result.output
    assert 'expect_low = [\n    "medium",\n]' in (area / "area.toml").read_text()
    # From here on, what is typed is what the line before it says, with less work.
    following = paste(result.output, "spn-data split")
    following = paste(following, "spn-model train", *TRAIN)
    paste(following, "spn-model export", "--map-mb", "2", "--calibration-images", "2")
    torch.set_num_threads(before)
    return area


def test_what_a_user_sees_of_fixes_before_a_flight(area):
    """Evaluation measures the bundle's fixes; they agree with views rendered where the frames were taken."""
    folder = area / "runs" / "default"
    card = folder / "bundle" / "MODEL_CARD.md"
    assert "not to be flown yet" in card.read_text()
    assert (
        "- Flight: The fixes of default are not measured: it was not evaluated" in card.read_text()
    )
    early = run(model_main, "availability", "--run", "default", "--area", area)
    assert early.exit_code == 1
    assert "fixes.csv: does not exist; run spn-model evaluate --run default first" in early.output
    words = ["--run", "default", "--area", area, "--threads", 1, "--training-images", 4]
    shown = run(model_main, "evaluate", *words, "--fixes", "--no-baselines")
    assert shown.exit_code == 0, shown.output
    fixes = json.loads((folder / "metrics.json").read_text())["fixes"]
    found = fixes["flights"]["medium"]
    ways = ["coarse", "search", "track"]
    # The flight has too few frames for the bundle to know its gimbal.
    assert sorted(found) == sorted([*ways, *(f"{way}, simulated attitude" for way in ways)])
    assert found["search, simulated attitude"]["usable"] == found["search"]["usable"]
    assert "simulated, that of the labels" in " ".join(shown.output.split())
    assert found["track"]["images"] > found["search"]["images"] > 5
    assert found["search"]["usable"] > 0.6 * found["search"]["images"]
    assert found["search"]["error_m"] < 0.1
    assert found["search"]["misleading"] == found["track"]["misleading"] == 0
    assert found["track"]["longest_outage_s"] < 5
    with (folder / "fixes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    times = [float(row["time_s"]) for row in rows if row["method"] == "track"]
    assert times == sorted(times)
    assert len(rows) == sum(one["images"] for one in found.values())
    assert all(row["reason"] for row in rows if row["usable"] == "0")
    assert (folder / "figures" / "medium-protection.svg").is_file()
    assert "| medium | search |" in card.read_text()
    assert "default: fixes of its bundle" in (area / "report.html").read_text()
    verdict = [
        line for line in shown.output.splitlines() if line.startswith(("Network: ", "Flight: "))
    ]
    assert verdict[0].startswith(
        "Network: default is not measured: there is no evaluation flight near"
    )
    assert "have a usable fix (track), 0 of" in verdict[1]
    assert "They come from landmarks; the pose of the network led to" in verdict[1]
    assert f"- {verdict[1]}" in card.read_text()
    table = area.parent / "expected.csv"
    again = run(model_main, "availability", "--run", "default", "--area", area, "--to", table)
    assert again.exit_code == 0, again.output
    assert "not known here: light, seasons" in again.output
    with table.open(newline="") as file:
        expected = {row["name"]: row for row in csv.DictReader(file)}
    usable = {row["name"]: row["usable"] for row in rows if row["method"] == "search"}
    assert expected.keys() == usable.keys()
    said = {"yes": "1", "no": "0"}
    agree = sum(
        said.get(expected[name]["expected"], usable[name]) == usable[name] for name in usable
    )
    assert agree > 0.6 * len(usable)


def test_a_plan_is_judged(area, tmp_path):
    """A waypoint within the flight may have a fix; one far outside has none, with the reason."""
    poses = (area / "4-eval" / "medium" / "poses.csv").read_text().splitlines()
    inside = next(row for row in csv.DictReader(poses) if row["status"] == "registered")
    x, y, z = (inside[axis] for axis in "xyz")
    plan = tmp_path / "plan.csv"
    plan.write_text(f"x,y,z,heading_deg,pitch_deg\n{x},{y},{z},0,-90\n5000,5000,90,0,-30\n")
    words = ["availability", "--run", "default", "--area", area, "--waypoints", plan]
    shown = run(model_main, *words)
    assert shown.exit_code == 0, shown.output
    assert "of 2 waypoints" in shown.output
    assert "the training images show 0% of this view" in shown.output
    page = (area / "report.html").read_text()
    assert "plan.csv, bundle of default" in page
    assert "of 2 waypoints" in page


def test_a_bundle_of_an_earlier_network_is_refused(area, tmp_path):
    """With --fixes it is an error, without it a sentence in the verdict, and fixes.csv is gone."""
    other = Path(shutil.copytree(area, tmp_path / "area"))
    path = other / "runs" / "default" / "bundle" / "bundle.json"
    document = json.loads(path.read_text())
    document["run"]["checkpoint"] = "0"
    path.write_text(json.dumps(document))
    words = [
        "evaluate",
        "--run",
        "default",
        "--area",
        other,
        "--threads",
        1,
        "--training-images",
        4,
    ]
    refused = run(model_main, *words, "--no-baselines", "--fixes")
    assert refused.exit_code == 1
    assert "the bundle is of an earlier network of this run" in refused.output
    shown = run(model_main, *words, "--no-baselines")
    assert shown.exit_code == 0, shown.output
    assert (
        "The fixes of default are not measured: the bundle is damaged or of an earlier"
        in shown.output
    )
    assert not (other / "runs" / "default" / "fixes.csv").exists()


def test_the_next_lines_lead_from_a_registered_flight_to_a_replayed_one(
    area, tmp_path, monkeypatch
):
    """The lines of `status` are pasted where the user is: evaluation, then a flight with the bundle."""
    monkeypatch.chdir(tmp_path)
    (area / "runs" / "default" / "metrics.json").unlink(missing_ok=True)
    shown = run(data_main, "status", "--area", area)
    less = ("--threads", "1", "--training-images", "4", "--no-baselines")
    paste(paste(shown.output, "spn-model evaluate", *less), "spn-onboard fly")
    assert len((tmp_path / "fixes.jsonl").read_text().splitlines()) > 10
