"""`spn-data report --serve`: what it answers, to whom, and the state of work in progress."""

from __future__ import annotations

import http.client
import json
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from spn_cli.serve import LOOPBACK, AreaServer

from spn_data.area.area import Area
from spn_data.area.names import FRAMES, GEO, LOG, MODEL, RUNS
from spn_data.errors import InputError
from spn_data.pipeline.live_state import LiveState
from spn_model.training.training_state import Log


@pytest.fixture(scope="module")
def mapping(finished_area: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An area as it is while frames register and a network trains: a snapshot of the model, and a log."""
    root = Path(shutil.copytree(finished_area, tmp_path_factory.mktemp("serve") / "area"))
    area = Area(root)
    shutil.rmtree(area.folder(GEO))
    area.folder(MODEL).rename(area.partial(MODEL))
    snapshot = area.partial(MODEL) / "mapping-first" / "snapshots" / "1"
    snapshot.mkdir(parents=True)
    for file in area.partial(MODEL).glob("*.bin"):
        shutil.copy(file, snapshot)
    (root / RUNS / "first").mkdir(parents=True)
    log = Log(root / RUNS / "first" / LOG, 0)
    step = {"event": "steps", "stage": "all", "step": 1, "images": 32, "progress": 0.25}
    log.write({**step, "train_s": 30.0, "loss": 4.5, "images_per_s": 2.0})
    judged = {"event": "views", "stage": "all", "train_s": 60.0, "frames": 9, "located": 2}
    log.write({**judged, "median_m": float("inf"), "median_deg": 7.0})
    log.close()
    with (root / RUNS / "first" / LOG).open("a") as file:
        file.write("steps,all,2")  # a row in the making
    return root


@pytest.fixture(scope="module")
def served(mapping: Path) -> Iterator[AreaServer]:
    """The server of that area."""
    with AreaServer(Area(mapping), 0) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def ask(server: AreaServer, path: str, host: str = "") -> tuple[int, bytes]:
    """Return status and content of a request, whose path is sent as it is."""
    connection = http.client.HTTPConnection(LOOPBACK, server.server_port, timeout=10)
    connection.putrequest("GET", path, skip_host=True)
    connection.putheader("Host", host or f"{LOOPBACK}:{server.server_port}")
    connection.endheaders()
    answer = connection.getresponse()
    found = answer.status, answer.read()
    connection.close()
    return found


def test_the_state_tells_registered_frames_and_curves(served: AreaServer, mapping: Path) -> None:
    """Frames of the newest snapshot of the mapping and the rows of log.csv are in the state, without NaN."""
    status, body = ask(served, "/state.json")
    state = json.loads(body, parse_constant=pytest.fail)
    assert status == 200
    assert [one["stage"] for one in state["stages"]] == [FRAMES]
    (working,) = state["working"]
    steps = {step["step"]: (step["done"], step["total"]) for step in working["steps"]}
    chosen = Area(mapping).record(FRAMES).counts["chosen"]
    registered = steps["frames registered by the newest attempt"]
    assert registered == (state["frames"]["registered"], chosen)
    assert 10 < registered[0] == len(state["frames"]["positions"]) <= chosen
    assert steps["images with features"] == (chosen, chosen)
    assert steps["pairs matched"][0] > 10
    (run,) = state["runs"]
    assert (run["loss"], run["stage_done"]) == ([[0.5, 4.5]], 0.25)
    assert run["errors"] == {"views": [[1.0, None, 7.0]]}


def test_positions_are_those_of_the_model(mapping: Path, finished_area: Path) -> None:
    """Distances between the drawn frames are at most those of the model, and their spread is the same."""
    import numpy as np

    from spn_data.colmap.model import read_scene

    frames = LiveState(Area(mapping)).to_json()["frames"]
    centers = read_scene(finished_area / MODEL).poses.centers
    known = centers[np.isfinite(centers).all(axis=1)]
    spread = np.linalg.svd(known - known.mean(axis=0), compute_uv=False)[:2]
    shown = np.linalg.svd(np.array(frames["positions"]), compute_uv=False)
    np.testing.assert_allclose(shown, spread, rtol=1e-3)


@pytest.mark.parametrize(
    "path",
    [
        "/../area.toml",
        "/area.toml",
        "/%2e%2e/area.toml",
        "/state.json/..",
        "/.lock",
    ],
)
def test_no_other_path_is_answered(served: AreaServer, path: str) -> None:
    """Paths of files, also of those that exist, are not found."""
    assert ask(served, path)[0] == 404


def test_only_this_machine_is_answered(served: AreaServer) -> None:
    """The server listens on the loopback interface and refuses requests for another host's name."""
    assert served.server_address[0] == "127.0.0.1"
    assert ask(served, "/", host="evil.example")[0] == 403
    assert ask(served, "/state.json", host=f"evil.example:{served.server_port}")[0] == 403
    status, page = ask(served, "/")
    assert (status, b"state.json" in page) == (200, True)


def test_the_report_is_the_one_of_the_area(served: AreaServer, mapping: Path) -> None:
    """report.html is answered as it is, with a query that tells its time too."""
    status, page = ask(served, "/report.html?changed=1")
    assert (status, page) == (200, (mapping / "report.html").read_bytes())


def test_a_port_in_use_is_refused(served: AreaServer, mapping: Path) -> None:
    """A port that cannot be used is one line that names the option."""
    with pytest.raises(InputError, match=r"port \d+ cannot be used .*choose another by --port"):
        AreaServer(Area(mapping), served.server_port)
