"""Simulated flights on disk are reproducible, complete or absent, and consistent."""

from __future__ import annotations

import json
import re
import signal
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest

from spn_data.errors import FormatError, InputError, InUseError, StageError
from spn_data.simulate import (
    MappingPaths,
    SimulateOptions,
    preset,
    read_truth,
    simulate,
    simulate_paths,
    simulate_telemetry,
)
from spn_data.simulate.produce import _RenderPool

# Three frames of each flight at 160 x 90, with coarse textures: quick to paint and render.
TINY = replace(
    preset("standard", seed=11),
    width=160,
    height=90,
    fps=2.0,
    length_factor=0.03,
    texels_per_m=16.0,
    blur_share=0.4,
)


def tree(folder: Path) -> dict[str, bytes]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def decoded(path: Path) -> tuple[list[float], np.ndarray]:
    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
        pixels = np.stack([frame.to_ndarray(format="rgb24") for frame in frames])
        return [float(frame.time) for frame in frames], pixels


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("simulated") / "flights"
    simulate(out, TINY, workers=1)
    return out


def test_folder_holds_videos_telemetry_and_truth_and_nothing_else(flights: Path) -> None:
    """The folder has the documented tree, and no partial folder remains."""
    assert list(tree(flights)) == [
        "evaluation/low.SRT",
        "evaluation/low.mp4",
        "evaluation/medium.SRT",
        "evaluation/medium.mp4",
        "mapping/flight1.SRT",
        "mapping/flight1.mp4",
        "mapping/flight2.SRT",
        "mapping/flight2.mp4",
        *(f"truth/{name}" for name in (
            "flight1.csv", "flight1_camera.json", "flight2.csv", "flight2_camera.json", "low.csv",
            "low_camera.json", "medium.csv", "medium_camera.json", "options.json", "origin.json",
        )),
    ]  # fmt: skip
    assert [path.name for path in flights.parent.iterdir()] == ["flights"]


def test_truth_is_that_of_the_paths_and_its_times_are_the_videos(flights: Path) -> None:
    """Truth read back equals the exact path to a micrometre, and times equal the video container's."""
    for name, path in simulate_paths(TINY).items():
        truth = read_truth(flights / "truth", name)
        np.testing.assert_allclose(truth.poses.centers, path.poses.centers, rtol=0, atol=1e-8)
        np.testing.assert_allclose(
            truth.poses.quats_wxyz, path.poses.quats_wxyz, rtol=0, atol=1e-11
        )
        np.testing.assert_array_equal(truth.blurred, path.blurred)
        assert truth.camera.model == "RADIAL"
        np.testing.assert_array_equal(truth.camera.params, path.camera.params)
        assert truth.origin == TINY.origin
        times, pixels = decoded(flights / path.role / f"{name}.mp4")
        np.testing.assert_allclose(times, truth.time_s, rtol=0, atol=1e-6)
        assert pixels.shape[1:] == (90, 160, 3)
        assert 60 < pixels.mean() < 190
        assert pixels.std() > 20


def test_srt_says_what_the_telemetry_says_to_its_last_digit(flights: Path) -> None:
    """Each record is within half a unit of its last decimal of truth plus error model."""
    number = r"(-?\d+\.\d+)"
    pattern = re.compile(
        rf"\[latitude: {number}\] \[longitude: {number}\] \[rel_alt: {number} abs_alt: {number}\] "
        rf"\[gb_yaw: {number} gb_pitch: {number} gb_roll: {number}\]"
    )
    path = simulate_paths(TINY)["flight1"]
    expected = simulate_telemetry(path, TINY)
    text = (flights / "mapping" / "flight1.SRT").read_text(encoding="utf-8")
    said = np.array([[float(value) for value in match] for match in pattern.findall(text)])
    assert len(said) == len(path.time_s)
    np.testing.assert_allclose(said[:, :2], expected.lat_lon_deg, rtol=0, atol=0.51e-6)
    np.testing.assert_allclose(said[:, 2], expected.rel_alt_m, rtol=0, atol=0.51e-3)
    np.testing.assert_allclose(said[:, 3], expected.abs_alt_m, rtol=0, atol=0.51e-3)
    turn = (said[:, 4:] - expected.gimbal_deg + 180.0) % 360.0 - 180.0
    assert np.abs(turn).max() < 0.051
    cues = re.findall(r"(\d\d):(\d\d):(\d\d),(\d{3}) -->", text)
    starts = [int(h) * 3600 + int(m) * 60 + int(s) + int(ms) / 1000 for h, m, s, ms in cues]
    np.testing.assert_allclose(starts, path.time_s, rtol=0, atol=0.0006)


def test_same_options_give_the_same_bytes_whatever_renders_them(
    flights: Path, tmp_path: Path
) -> None:
    """Two processes write the same bytes as one, also for one flight alone; another seed differs."""
    only = replace(TINY, only=("flight2",))
    simulate(tmp_path / "two", only, workers=2)
    two, one = tree(tmp_path / "two"), tree(flights)
    assert {name for name in two if "low" in name or "medium" in name or "flight1" in name} == set()
    for name in ("mapping/flight2.mp4", "mapping/flight2.SRT", "truth/flight2.csv"):
        assert two[name] == one[name]
    simulate(tmp_path / "other", replace(only, seed=12), workers=1)
    other = tree(tmp_path / "other")
    for name in ("mapping/flight2.mp4", "mapping/flight2.SRT", "truth/flight2.csv"):
        assert other[name] != one[name]


@pytest.mark.parametrize(
    "change",
    [
        {"readout_s": 0.02},
        {"mapping_paths": MappingPaths.NADIR},
        {"mapping_paths": MappingPaths.STRAIGHT, "area_factor": 2.0},
        {"gimbal_angles": False, "time_offset_s": 1.0},
    ],
)
def test_options_lead_to_complete_flights(change: dict[str, object], tmp_path: Path) -> None:
    """Flights with rolling shutter, other paths, other areas and plain telemetry are all rendered."""
    options = replace(TINY, only=("mapping",), **change)  # type: ignore[arg-type]
    simulate(tmp_path / "out", options, workers=1)
    for name in simulate_paths(options):
        times, _ = decoded(tmp_path / "out" / "mapping" / f"{name}.mp4")
        assert len(times) == len(read_truth(tmp_path / "out" / "truth", name).time_s) > 0
        text = (tmp_path / "out" / "mapping" / f"{name}.SRT").read_text(encoding="utf-8")
        assert ("gb_yaw" in text) == options.gimbal_angles


def test_existing_folder_is_refused_and_a_stopped_run_leaves_nothing(tmp_path: Path) -> None:
    """An existing folder is refused unchanged, and an interrupted run leaves no folder, even partial."""
    (tmp_path / "there").mkdir()
    with pytest.raises(StageError, match="there already exists; choose another folder"):
        simulate(tmp_path / "there", TINY, workers=1)

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(tmp_path / "stopped", replace(TINY, only=("low",)), stop, workers=1)
    assert [path.name for path in tmp_path.iterdir()] == ["there"]


def blocked_signals(_: object) -> set[signal.Signals]:
    return set(signal.pthread_sigmask(signal.SIG_BLOCK, ()))


def test_ctrl_c_does_not_reach_processes_that_render(tmp_path: Path) -> None:
    """Ctrl-C is blocked from the start of a rendering process: it may come while its modules load."""
    with _RenderPool(TINY, tmp_path, 2) as pool:
        (blocked,) = pool.map(blocked_signals, [()])
    assert signal.SIGINT in blocked
    assert signal.SIGINT not in blocked_signals(None)


def test_what_a_killed_run_left_is_replaced_and_a_second_run_is_refused(tmp_path: Path) -> None:
    """Files of a run that was killed do not stay; two runs at once do not write into one folder."""
    left = tmp_path / ".out.partial"
    (left / "mapping").mkdir(parents=True)
    (left / "mapping" / "flight9.mp4").write_bytes(b"left")
    options = replace(TINY, only=("low",))

    def start_another(done: int, total: int) -> None:
        with pytest.raises(InUseError, match="in use by another spn-data simulate"):
            simulate(tmp_path / "out", options, workers=1)

    simulate(tmp_path / "out", options, start_another, workers=1)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert {path.split("/")[0] for path in tree(tmp_path / "out")} == {"evaluation", "truth"}


def test_progress_counts_every_frame(tmp_path: Path) -> None:
    """Progress goes from 1 to the number of frames of all requested flights."""
    seen: list[tuple[int, int]] = []
    options = replace(TINY, only=("evaluation",))
    simulate(tmp_path / "out", options, lambda *counts: seen.append(counts), workers=1)
    total = sum(len(path.time_s) for path in simulate_paths(options).values())
    assert seen == [(i + 1, total) for i in range(total)]


def test_impossible_options_are_refused_in_one_line() -> None:
    """Odd image sizes, no frames, shares beyond one and offsets of minutes give a one-line error."""
    for change, message in (
        ({"width": 161}, "image size 161 x 90: H.264 needs even numbers"),
        ({"fps": 0.0}, "fps, area factor and length factor must be above zero"),
        ({"blur_share": 1.5}, "blur share 1.5 is outside 0 to 1"),
        ({"time_offset_s": -9.0}, "time offset -9.0 s is outside -5 to 5 s"),
        ({"area_factor": 17.0, "texels_per_m": 50.0}, "area factor 17.0 exceeds 16 at 50 texels"),
    ):
        with pytest.raises(InputError, match=re.escape(message)):
            replace(TINY, **change)  # type: ignore[arg-type]


def test_damaged_or_newer_truth_is_refused(flights: Path, tmp_path: Path) -> None:
    """A missing flight, other columns, a garbage row and a newer version each give one clear line."""
    truth = tmp_path / "truth"
    truth.mkdir()
    for name, content in tree(flights / "truth").items():
        (truth / name).write_bytes(content)
    with pytest.raises(InputError, match="no ground truth for flight 'nowhere'"):
        read_truth(truth, "nowhere")
    (truth / "low.csv").write_text("a,b\n1,2\n", encoding="utf-8")
    with pytest.raises(FormatError, match=r"low\.csv: not a ground-truth file"):
        read_truth(truth, "low")
    (truth / "medium.csv").write_text(
        (truth / "medium.csv").read_text() + "x,y\n", encoding="utf-8"
    )
    with pytest.raises(FormatError, match=r"medium\.csv: not a ground-truth file"):
        read_truth(truth, "medium")
    camera = json.loads((truth / "flight1_camera.json").read_text())
    (truth / "flight1_camera.json").write_text(json.dumps({**camera, "version": 2}))
    with pytest.raises(FormatError, match="made by a newer version"):
        read_truth(truth, "flight1")


def test_options_written_are_those_used(flights: Path) -> None:
    """options.json holds every field of SimulateOptions."""
    written = json.loads((flights / "truth" / "options.json").read_text())
    assert set(written) == {*SimulateOptions.__dataclass_fields__, "version"}
    assert (written["seed"], written["width"], written["gnss"]["burst_m"]) == (11, 160, 12.0)
