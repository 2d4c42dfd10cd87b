"""Batches on a real Dask cluster: two local workers in an empty folder, without access to the area."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from spn_cli.data import main

import spn_data
from spn_data.area.area import Area
from spn_data.area.names import DATABASE, EVALUATION, MODEL, POSES
from spn_data.colmap.database import MapDatabase
from spn_data.colmap.model import read_scene
from spn_data.errors import InputError
from spn_data.labels.labels import read_labels
from spn_data.matching.features import FeatureOptions, extract_from_bytes
from spn_data.work import cluster
from spn_data.work.answers import check_kind
from spn_data.work.cluster import fingerprint, run_on_cluster

pytest.importorskip("distributed", reason="the extra `cluster` is not installed")

PACKAGE = Path(spn_data.__file__).parent
# Python runs this at start-up: opening, listing or changing anything in a folder is refused.
BLIND = """
import os, sys
folder = os.environ["NOT_TO_BE_READ"]
def refuse(event, arguments):
    if any(isinstance(a, (str, os.PathLike)) and os.fspath(a).startswith(folder) for a in arguments):
        raise PermissionError(f"{event} in the area")
sys.addaudithook(refuse)
"""


class Cluster:
    """Scheduler and workers, stopped at the end of the block."""

    def __init__(self, folder: Path, stack: ExitStack):
        self._folder, self._stack = folder, stack
        with closing(socket.socket()) as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{port}"
        self.workers: list[subprocess.Popen[bytes]] = []
        self._start("dask_scheduler", "--host", "127.0.0.1", "--port", str(port))

    def add_worker(self, package: Path = PACKAGE, blind_to: Path | None = None) -> None:
        """Start a worker with one thread, which loads this program from the folder above `package`."""
        self.workers.append(
            self._start(
                *(
                    "dask_worker",
                    self.address,
                    "--nthreads",
                    "1",
                    "--no-nanny",
                    "--host",
                    "127.0.0.1",
                ),
                package=package,
                blind_to=blind_to,
            )
        )

    def _start(
        self, module: str, *words: str, package: Path = PACKAGE, blind_to: Path | None = None
    ) -> subprocess.Popen[bytes]:
        empty = self._folder / f"empty-{len(self.workers)}-{module}"
        empty.mkdir()
        path = [str(package.parent)]
        environment = dict(os.environ)
        if blind_to is not None:
            hook = self._folder / f"hook-{len(self.workers)}"
            hook.mkdir()
            (hook / "sitecustomize.py").write_text(BLIND)
            path.insert(0, str(hook))
            environment["NOT_TO_BE_READ"] = str(blind_to)
        environment["PYTHONPATH"] = os.pathsep.join(path)
        with (self._folder / f"{empty.name}.log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.{module}", *words, "--no-dashboard"],
                cwd=empty,
                env=environment,
                stderr=log,
            )
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        return process


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Cluster]:
    with ExitStack() as stack:
        yield Cluster(tmp_path, stack)


def triple(x: int) -> int:
    return 3 * x


def test_every_result_arrives_once_though_a_worker_is_killed(started: Cluster) -> None:
    """If a worker is killed after the fifth of forty results, every result still arrives exactly once."""
    started.add_worker()
    started.add_worker()
    results: list[str] = []

    def store(result: str) -> None:
        results.append(result)
        if len(results) == 5:
            started.workers[0].kill()

    # A standard library function, because workers cannot import the tests.
    batches = [(str(k), ("{}", k)) for k in range(40)]
    run_on_cluster(started.address, str.format, iter(batches), store)
    assert sorted(map(int, results)) == list(range(40))


def test_the_error_of_a_call_is_raised_here(started: Cluster) -> None:
    """An error raised in a worker is raised in the calling process."""
    started.add_worker()
    batch = ("a.jpg", ("a.jpg", b"no image", None, FeatureOptions()))
    with pytest.raises(InputError, match=r"a\.jpg: cannot be decoded as an image"):
        run_on_cluster(started.address, extract_from_bytes, [batch], print)


def test_a_wrong_answer_names_worker_and_task(started: Cluster) -> None:
    """An answer that the caller refuses becomes one line with the worker's address and the task."""
    started.add_worker()

    def store(result: object) -> None:
        check_kind(result, bytes)

    with pytest.raises(
        InputError, match=r"worker tcp://127\.0\.0\.1:\d+ answered 'a\.jpg'.*: str instead"
    ):
        run_on_cluster(started.address, str.format, [("a.jpg", ("a",))], store)


def test_a_worker_with_other_code_is_refused(started: Cluster, tmp_path: Path) -> None:
    """A worker whose code differs in one line of one file is refused."""
    other = tmp_path / "other" / "spn_data"
    shutil.copytree(PACKAGE, other)
    with (other / "features.py").open("a") as file:
        file.write("# changed\n")
    started.add_worker(other)
    with pytest.raises(InputError, match=r"has spn_data .*: install the same on both"):
        run_on_cluster(started.address, str.format, [("a", ("a",))], print)


def test_a_worker_without_this_program_is_refused(started: Cluster, tmp_path: Path) -> None:
    """A worker that cannot import this program is refused."""
    empty = tmp_path / "nothing" / "spn_data"
    empty.mkdir(parents=True)
    (empty / "__init__.py").touch()
    started.add_worker(empty)
    with pytest.raises(InputError, match="cannot load this program"):
        run_on_cluster(started.address, str.format, [("a", ("a",))], print)


def test_a_call_is_refused_by_a_worker_that_joined_later_with_another_version() -> None:
    """A worker with another package version refuses the call, whenever it joined."""
    expected = {**fingerprint(), "numpy": "1.0"}
    with pytest.raises(InputError, match=r"has numpy .*, this program 1\.0"):
        cluster.call(expected, str.format, ("a",))
    assert cluster.call(fingerprint(), triple, (4,)) == 12


def test_no_scheduler_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """An unreachable scheduler or an invalid address gives a one-line error."""
    monkeypatch.setattr(cluster, "_CONNECT_S", 0.5)
    with pytest.raises(InputError, match=r"no Dask scheduler at tcp://127\.0\.0\.1:9"):
        run_on_cluster("tcp://127.0.0.1:9", triple, [("a", (1,))], print)
    with pytest.raises(InputError, match="no Dask scheduler at nonsense"):
        run_on_cluster("nonsense://", triple, [("a", (1,))], print)


def test_no_workers_are_one_line(started: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    """A scheduler without workers gives a one-line error."""
    monkeypatch.setattr(cluster, "_WAIT_FOR_WORKERS_S", 0.5)
    with pytest.raises(InputError, match="has no workers"):
        run_on_cluster(started.address, triple, [("a", (1,))], print)


def test_without_dask_the_remedy_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without Dask, the error gives the command that installs it."""
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'squeezeposenet-toolkit\[cluster\]'"):
        run_on_cluster("tcp://127.0.0.1:9", triple, [("a", (1,))], print)


@contextmanager
def killing_one(
    started: Cluster, monkeypatch: pytest.MonkeyPatch, after: int
) -> Iterator[list[str]]:
    """Kill the first worker after a number of stored results, and yield what was stored."""
    stored: list[str] = []

    def counted(method: Callable[..., None]) -> Callable[..., None]:
        def store(self: MapDatabase, *arguments: object) -> None:
            method(self, *arguments)
            stored.append(method.__name__)
            if len(stored) == after:
                started.workers[0].kill()

        return store

    for name in ("write_features", "write_pair"):
        monkeypatch.setattr(MapDatabase, name, counted(getattr(MapDatabase, name)))
    yield stored
    assert started.workers[0].poll() is not None


@pytest.mark.slow
def test_a_cluster_gives_the_labels_that_this_machine_gives(
    started: Cluster, flight2: Path, finished_area: Path, tmp_path: Path
) -> None:
    """A cluster whose workers cannot read the map or frames gives the same labels as one machine."""
    near, far = (Path(shutil.copytree(finished_area, tmp_path / name)) for name in ("near", "far"))
    for _ in range(2):
        started.add_worker(blind_to=far)
    for area, where in ((near, []), (far, ["--cluster", started.address])):
        command = ["register", str(flight2), "--area", str(area), "--rate", "1", *where]
        result = CliRunner().invoke(main, command)
        assert result.exit_code == 0, result.output
    mine, theirs = (Area(area).folder(f"{EVALUATION}/flight2") / POSES for area in (near, far))
    assert mine.read_bytes() == theirs.read_bytes()
    assert sum(read_labels(mine).registered) > 5


@pytest.mark.slow
def test_a_cluster_makes_the_model_that_this_machine_makes(
    started: Cluster,
    flight1: Path,
    finished_area: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The model is identical bit for bit, even if a worker is killed during feature extraction."""
    area = tmp_path / "area"
    for _ in range(2):
        started.add_worker(blind_to=area)
    options = ["--max-features", "800", "--threads", "1", "--fov", "72"]
    remote = ["--cluster", started.address]
    with killing_one(started, monkeypatch, after=4) as stored:
        result = CliRunner().invoke(
            main,
            ["reconstruct", str(flight1), "--area", str(area), *options, *remote],
        )
    assert result.exit_code == 0, result.output
    assert stored.count("write_pair") > 10
    local, far = (Area(folder).folder(MODEL) for folder in (finished_area, area))
    with MapDatabase.open(local / DATABASE) as one, MapDatabase.open(far / DATABASE) as other:
        assert one.ids == other.ids
        assert one.verified_pairs() == other.verified_pairs()
        for name in one.ids:
            mine, theirs = one.read_features(name), other.read_features(name)
            assert np.array_equal(mine.keypoints, theirs.keypoints)
            assert np.array_equal(mine.descriptors, theirs.descriptors)
    mine, theirs = read_scene(local), read_scene(far)
    assert mine.names == theirs.names
    assert np.array_equal(mine.poses.centers, theirs.poses.centers)
