"""Kill `spn-data reconstruct` at random times, resume it, and compare with an uninterrupted run.

    python benchmarks/interruption.py SOURCE [--kills 10] [--seed 0] [--json OUT] [-- OPTIONS...]

SOURCE is a folder of flights; OPTIONS are passed to `spn-data reconstruct`, which uses one thread. The times
are drawn uniformly over the uninterrupted run. A kill is a SIGKILL of the main process, or with --victim of a
worker or of the mapping process. Repeated work is the CPU time of the killed and the resumed run together
beyond that of the uninterrupted one, over all processes. Differences are between the poses of the finished
areas, without alignment and after the best similarity.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from spn_data.area.area import Area
from spn_data.area.names import GEO, MODEL
from spn_data.colmap.model import read_scene
from spn_data.geometry.pose import Similarity, pose_errors

_TICKS = os.sysconf("SC_CLK_TCK")
STEPS = ("analysis", "frames", "features", "matching", "mapping", "refinement", "time offset")


@dataclass(frozen=True)
class Difference:
    """Difference of two areas from the same sources; in metres, or in model units without telemetry."""

    same_frames: bool
    largest_as_is_m: float  # largest distance of two centres without alignment
    position_m: float  # largest after the best similarity
    rotation_deg: float


@dataclass(frozen=True)
class Kill:
    """One kill and its effect. repeated_cpu_s : CPU seconds beyond those of the uninterrupted run."""

    after_s: float
    step: str
    victim: str
    repeated_cpu_s: float
    left_behind: int  # processes that outlived the killed one by more than two seconds
    difference: Difference


class Run:
    """A run of `spn-data reconstruct` in its own process group, as under a terminal."""

    def __init__(self, sources: list[Path], area: Path, options: list[str]):
        self.log = area.with_suffix(".log")
        self._from = self.log.stat().st_size if self.log.exists() else 0
        command = [sys.executable, "-c", "from spn_cli.data import main; main()", "reconstruct"]
        with self.log.open("a") as out:
            self.process = subprocess.Popen(
                [*command, *map(str, sources), "--area", str(area), "--threads", "1", *options],
                stdout=out,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    @property
    def output(self) -> str:
        """Output printed by this run so far."""
        return self.log.read_text()[self._from :]

    @property
    def step(self) -> str:
        """Step reported last."""
        lines = [line.split(":")[0] for line in self.output.splitlines()]
        known = [line for line in lines if line.startswith(STEPS) or line[:2] in ("1-", "2-", "3-")]
        return known[-1] if known else "start"

    def wait_for(self, line_start: str, timeout_s: float = 120) -> None:
        """Wait until a line of the output starts with the text; raise RuntimeError if it does not appear."""
        deadline = time.monotonic() + timeout_s
        while not any(line.startswith(line_start) for line in self.output.splitlines()):
            if self.process.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(f"{line_start!r} did not appear:\n{self.output}")
            time.sleep(0.02)

    def family(self) -> list[int]:
        """Return the descendants of the main process."""
        parents = {}
        for stat in Path("/proc").glob("[0-9]*/stat"):
            fields = _stat(stat)
            if fields is not None:
                parents[int(stat.parent.name)] = int(fields[1])
        found, new = [], [self.process.pid]
        while new:
            new = [pid for pid, parent in parents.items() if parent in new]
            found += new
        return found

    def cpu_s(self) -> float:
        """Return the CPU seconds of all its processes so far, including those that have ended."""
        ticks = 0
        for pid in (self.process.pid, *self.family()):
            fields = _stat(Path(f"/proc/{pid}/stat"))
            ticks += sum(map(int, fields[11:15])) if fields is not None else 0
        return ticks / _TICKS

    def finish(self, timeout_s: float = 600) -> float:
        """Wait for the end and return the CPU seconds of all processes; raise RuntimeError on failure."""
        deadline = time.monotonic() + timeout_s
        while True:
            pid, status, used = os.wait4(self.process.pid, os.WNOHANG)
            if pid:
                break
            if time.monotonic() > deadline:
                self.kill()
                raise RuntimeError(f"not finished after {timeout_s:.0f} s:\n{self.output}")
            time.sleep(0.05)
        self.process.returncode = os.waitstatus_to_exitcode(status)
        if self.process.returncode != 0:
            raise RuntimeError(f"ended with exit code {self.process.returncode}:\n{self.output}")
        return used.ru_utime + used.ru_stime

    def kill(self) -> int:
        """Kill the main process only; return how many others outlive it by two seconds."""
        family = self.family()
        self.process.kill()
        self.process.wait()
        return len(outliving(family, 2.0))


def outliving(pids: list[int], wait_s: float) -> list[int]:
    """Return which processes still run after some time; zombies do not count."""
    deadline = time.monotonic() + wait_s
    while True:
        fields = {pid: _stat(Path(f"/proc/{pid}/stat")) for pid in pids}
        alive = [pid for pid, found in fields.items() if found is not None and found[0] != "Z"]
        if not alive or time.monotonic() > deadline:
            return alive
        time.sleep(0.05)


def _stat(path: Path) -> list[str] | None:
    """Read the fields after the name in /proc/PID/stat: state, parent, ...; None if the process is gone."""
    try:
        return path.read_text().rsplit(")", 1)[1].split()
    except OSError:
        return None


def difference(one: Path, other: Path) -> Difference:
    """Compare the poses of two finished areas."""
    stage = GEO if Area(one).has(GEO) else MODEL
    a, b = read_scene(Area(one).folder(stage)), read_scene(Area(other).folder(stage))
    if a.names != b.names:
        return Difference(False, float("nan"), float("nan"), float("nan"))
    as_is = np.linalg.norm(a.poses.centers - b.poses.centers, axis=1).max()
    a_from_b = Similarity.fit(b.poses.centers, a.poses.centers)
    error_m, error_deg = pose_errors(a_from_b.apply_to_poses(b.poses), a.poses)
    return Difference(True, float(as_is), float(error_m.max()), float(error_deg.max()))


def measure(
    sources: list[Path], folder: Path, options: list[str], *, kills: int, seed: int, victim: str
) -> tuple[float, float, list[Kill]]:
    """Return wall and CPU seconds of an uninterrupted run in `folder`, and the cost of each kill."""
    started = time.monotonic()
    cpu_s = Run(sources, folder / "whole", options).finish()
    wall_s = time.monotonic() - started
    rng = random.Random(seed)
    results = []
    for k in range(kills):
        after_s = rng.uniform(0.5, wall_s)
        area = folder / f"killed-{k}"
        run = Run(sources, area, options)
        time.sleep(after_s)
        step, spent_s, left = run.step, run.cpu_s(), 0
        targets = run.family() if victim != "main" else []
        if victim != "main" and targets and run.process.poll() is None:
            os.kill(rng.choice(targets), signal.SIGKILL)
            code = run.process.wait(600)
            spent_s = 0.0 if code == 0 else spent_s
        else:
            left = run.kill()
        resumed_s = Run(sources, area, options).finish()
        repeated_s = spent_s + resumed_s - cpu_s
        found = difference(folder / "whole", area)
        results.append(Kill(after_s, step, victim, repeated_s, left, found))
        print(_row(results[-1]), flush=True)
    return wall_s, cpu_s, results


def _row(kill: Kill) -> str:
    d = kill.difference
    frames = "same frames" if d.same_frames else "OTHER FRAMES"
    return (
        f"{kill.after_s:7.1f} s  {kill.step:<18} repeated {kill.repeated_cpu_s:6.1f} s of CPU  {frames}  "
        f"as is {d.largest_as_is_m:.1e} m  aligned {d.position_m:.1e} m {d.rotation_deg:.1e} deg  "
        f"left behind {kill.left_behind}"
    )


def main() -> None:
    """Run the benchmark."""
    arguments = sys.argv[1:]
    cut = arguments.index("--") if "--" in arguments else len(arguments)
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("source", type=Path, nargs="+")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--victim", choices=["main", "child"], default="main")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--work", type=Path, help="empty folder for the areas [default: temporary]")
    given = parser.parse_args(arguments[:cut])
    with tempfile.TemporaryDirectory() as temporary:
        wall_s, cpu_s, kills = measure(
            given.source,
            given.work or Path(temporary),
            arguments[cut + 1 :],
            kills=given.kills,
            seed=given.seed,
            victim=given.victim,
        )
    print(f"uninterrupted: {wall_s:.1f} s, {cpu_s:.1f} s of CPU")
    if given.json is not None:
        figures = {"wall_s": wall_s, "cpu_s": cpu_s, "kills": [asdict(kill) for kill in kills]}
        given.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
