"""Run each command under limits of the machine and under signals, rerun it, and print a table.

    python -m faults.limits [--only NAME ...] [--limit NAME ...] [--jobs 2] [--work build/kill]

Needs Linux, a C compiler, and `unshare` with the right to mount (root, or user namespaces). Each command runs
as a process of its own, in a copy of the state in which it starts:

- disk full: a file system in memory that has room for 0 and for 60 % of what the command adds;
- read-only: its folder is mounted read-only;
- files: `ulimit -n 64`; memory: `ulimit -v`, 2.5 GB and 0.6 GB;
- tmp full, tmp read-only: TMPDIR, /tmp and /var/tmp are a full or a read-only file system;
- SIGTERM at 10 and 60 %, Ctrl-C for all its processes at 40 and 85 % of the time of an undisturbed run.

In the table: "as usual" if it ended with 0 and the files of an undisturbed run; its exit code if it ended
with one line, lost nothing, left no process, and the rerun made the files of an undisturbed run; "!"
otherwise, with a line below the table that says what was wrong.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from spn_cli.entry import STOPPED

from faults.commands import ALL, Command, state
from faults.contents import contents
from faults.kill import LIMIT_S, Undisturbed, adopt_orphans, counter, different, lost, prepare, run

_ROOT = Path(__file__).resolve().parents[1]
_PAGE = 4096
_STOP_S = 5.0  # time to end after a signal, on a machine with as many tasks as cores
_BY_TORCH = "+torchinductor_root"  # torch makes it where temporary files go: here, if nowhere else
# The page is only noted to be missing: the results of the command are complete.
_REPORT, _NO_REPORT = "~area/report.html", "Note: report.html could not be written"
# OpenBLAS ends a process for which it finds no memory itself.
_REASONS = ("Error", "OpenBLAS error: Memory allocation still failed")
_NATIVE = re.compile(
    r"Traceback|Fatal Python error|terminate called|\*\*\* |Aborted|Segmentation|core dumped"
    r"|Exception ignored|Warning: |^  File \"",
    re.MULTILINE,
)
# "trained" is spn-model train with a network that can be exported.
ROWS = (
    *(
        "reconstruct",
        "reconstruct --add",
        "register",
        "split",
        "audit",
        "coverage",
        "export nerfstudio",
    ),
    *(
        "import",
        "simulate",
        "report",
        "trained",
        "evaluate",
        "model export",
        "predict",
        "benchmark",
    ),
)


@dataclass(frozen=True)
class Limit:
    """A limit or a signal.

    Attributes
    ----------
    name : str
        Column of the table.
    setup : str
        Shell commands that set it, with the variables WORK (folder of the command), START, TMP and SIZE.
    room : float or None
        Share of what the command adds for which there is room.
    sent : signal or None
        Signal to send.
    after : float
        Share of the time of an undisturbed run after which it is sent.
    """

    name: str
    setup: str = ""
    room: float | None = None
    sent: signal.Signals | None = None
    after: float = 0.0

    @property
    def code(self) -> int:
        """Exit code other than 0 that is right."""
        return 1 if self.sent is None else 128 + self.sent


_SMALL = 'mount -t tmpfs -o size="$SIZE" none "$WORK"; cp -a "$START/." "$WORK"'
_READ_ONLY = 'mount --bind "$WORK" "$WORK"; mount -o remount,bind,ro "$WORK"'
_TMP = 'mount -t tmpfs -o size=4k none "$TMP"; head -c 4096 /dev/zero > "$TMP/full"'
_TMP_READ_ONLY = 'mount --bind "$TMP" "$TMP"; mount -o remount,bind,ro "$TMP"'
_EVERY_TMP = 'mount --bind "$TMP" /tmp; mount --bind "$TMP" /var/tmp; export TMPDIR=/tmp'
LIMITS = (
    *(Limit("disk full", _SMALL, room=share) for share in (0.0, 0.6)),
    Limit("read-only", _READ_ONLY),
    Limit("files", "ulimit -n 64"),
    Limit("2.5 GB", "ulimit -v 2500000"),
    Limit("0.6 GB", "ulimit -v 600000"),
    Limit("tmp full", f"{_TMP}; {_EVERY_TMP}"),
    Limit("tmp read-only", f"{_TMP_READ_ONLY}; {_EVERY_TMP}"),
    *(Limit("SIGTERM", sent=signal.SIGTERM, after=share) for share in (0.1, 0.6)),
    *(Limit("Ctrl-C", sent=signal.SIGINT, after=share) for share in (0.4, 0.85)),
)


@dataclass(frozen=True)
class Ended:
    """How a command ended under a limit. line : what it said last; wrong : empty if nothing was."""

    command: str
    limit: str
    code: int
    line: str
    wrong: tuple[str, ...]
    stop_s: float = 0.0

    @property
    def cell(self) -> str:
        """Text of the table."""
        return "!" if self.wrong else "as usual" if self.code <= 0 else str(self.code)


def _started(command: Command, limit: Limit, own: Path, start: Path, size: int) -> subprocess.Popen:
    """Start a command under a limit; its output goes to own/output."""
    program, *words = command.words
    module = {"spn-data": "data", "spn-model": "model"}[program]
    python = [sys.executable, "-c", f"from spn_cli.entry import {module}; {module}()", *words]
    begin = [f"set -e; {limit.setup}", 'cd "$WORK"']
    # A file system in memory ends with its last process: what it holds is copied out.
    keep = 'set +e; "$@"; code=$?; cp -a "$WORK/." "$KEPT"; exit $code'
    script = "\n".join([*begin, 'exec "$@"' if limit.room is None else keep])
    mounting = ["unshare", "--mount", *(() if os.geteuid() == 0 else ("--map-root-user",))]
    environment = {
        **os.environ,
        **{"WORK": str(own / "work"), "START": str(start), "TMP": str(own / "tmp")},
        **{"SIZE": str(size), "KEPT": str(own / "kept")},
        "PYTHONPATH": os.pathsep.join([str(_ROOT), str(_ROOT / "cli")]),
    }
    environment.pop("LD_PRELOAD", None)
    with (own / "output").open("w") as output:
        return subprocess.Popen(
            [*mounting, "sh", "-c", script, "sh", *python],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )


def _end_of(process: subprocess.Popen, limit: Limit, usual_s: float) -> tuple[int, float, int]:
    """Wait for a process, after its signal; return exit code, seconds to the end, and processes left."""
    began = time.monotonic()
    stop_s = 0.0
    if limit.sent is not None:
        try:
            process.wait(limit.after * usual_s)
        except subprocess.TimeoutExpired:
            began = time.monotonic()
            if limit.sent == signal.SIGINT:
                os.killpg(process.pid, limit.sent)
            else:
                process.send_signal(limit.sent)
    try:
        code = process.wait(LIMIT_S)
        stop_s = time.monotonic() - began
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        code = process.wait()
    return code, stop_s, _orphans(5.0)


def _orphans(seconds: float) -> int:
    """Return 1 if a descendant still runs after some seconds; all are waited for."""
    began = time.monotonic()
    while True:
        try:
            ended, _ = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return int(time.monotonic() - began > seconds)
        if not ended:
            time.sleep(0.02)
        if time.monotonic() - began > LIMIT_S:
            raise SystemExit("a process that a command left behind does not end")


def undisturbed(command: Command, folder: Path) -> tuple[Undisturbed, float]:
    """Run a command without limits; return its result and its seconds."""
    start = state(command.start, folder / "states", run)
    own = _fresh(folder / "limits" / "whole" / command.name.replace(" ", "_"), start)
    began = time.monotonic()
    code = _started(command, Limit("none"), own, start, 0).wait()
    took = time.monotonic() - began
    if code:
        raise SystemExit(f"{command.name}: ended with {code}: {(own / 'output').read_text()}")
    work = own / "work"
    return Undisturbed(start, contents(start), work, contents(work), 0), took


def _fresh(own: Path, start: Path) -> Path:
    shutil.rmtree(own, ignore_errors=True)
    shutil.copytree(start, own / "work", symlinks=True)
    (own / "tmp").mkdir()
    (own / "kept").mkdir()
    return own


def _pages(folder: Path) -> int:
    """Return the bytes that the files of a folder take in memory."""
    sizes = [path.lstat().st_size for path in folder.rglob("*") if path.is_file()]
    return sum(-(-size // _PAGE) * _PAGE for size in sizes)


def tried(
    command: Command, whole: Undisturbed, usual_s: float, folder: Path, limit: Limit
) -> Ended:
    """Run a command under a limit and judge how it ended, what it left and what a rerun makes of it."""
    own = _fresh(folder / "limits" / f"worker-{os.getpid()}", whole.start)
    before, after = _pages(whole.start), _pages(whole.whole)
    size = before + 16 * _PAGE + int(max(after - before, 0) * (limit.room or 0))
    process = _started(command, limit, own, whole.start, size)
    code, stop_s, orphans = _end_of(process, limit, usual_s)
    work = own / ("work" if limit.room is None else "kept")
    output = (own / "output").read_text(errors="replace")
    lines = [line for line in output.splitlines() if line.strip()]
    wrong = [*_wrong_output(output, lines, code, limit), *lost(command, whole.before, work)]
    load = max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
    if code and limit.sent is not None and stop_s > _STOP_S * load:
        wrong.append(f"ended {stop_s:.0f} s after the signal")
    if orphans:
        wrong.append("a process went on")
    if limit.room is not None:
        shutil.rmtree(own / "work")
        work = work.rename(own / "work")
    if not wrong and code <= 0:
        accepted = [_BY_TORCH, *([_REPORT] if _NO_REPORT in output else [])]
        wrong += [found for found in different(command, whole, work) if found not in accepted]
    elif code:
        again = run(command, work, output=own / "again")
        wrong += [f"rerun: {found}" for found in lost(command, whole.before, work)]
        if again:
            told = (own / "again").read_text().strip().splitlines()[-1:]
            wrong.append(f"the rerun ended with {again}: {told}")
        else:
            wrong += [f"rerun: {found}" for found in different(command, whole, work)]
    line = lines[-1] if lines else ""
    return Ended(command.name, limit.name, code, line, tuple(wrong), round(stop_s, 1))


def _wrong_output(output: str, lines: list[str], code: int, limit: Limit) -> list[str]:
    """Return what is wrong with exit code and output."""
    wrong = []
    # After its last line a process can only end by the signal itself.
    if code not in (0, limit.code, -(limit.sent or 0)):
        wrong.append(f"exit code {code}")
    if _NATIVE.search(output):
        wrong.append("a stack trace")
    said = [line for line in lines if line.startswith(_REASONS) or line == STOPPED]
    if code > 0 and (len(said) != 1 or lines[-1] != said[0]):
        wrong.append(f"{len(said)} lines that say why, the last is {lines[-1:]}")
    return wrong


def table(found: list[Ended]) -> str:
    """Return the results as a Markdown table, and what was wrong."""
    columns = list(dict.fromkeys(one.limit for one in found))
    rows = [f"| command | {' | '.join(columns)} |", f"|---|{'---|' * len(columns)}"]
    for name in dict.fromkeys(one.command for one in found):
        cells = []
        for column in columns:
            each = [one.cell for one in found if (one.command, one.limit) == (name, column)]
            cells.append(", ".join(dict.fromkeys(each)))
        rows.append(f"| {name} | {' | '.join(cells)} |")
    wrong = [one for one in found if one.wrong]
    rows += [f"\n! {one.command}, {one.limit}: {'; '.join(one.wrong[:6])}" for one in wrong]
    return "\n".join(rows)


def campaign(names: list[str], limits: list[Limit], folder: Path, jobs: int) -> list[Ended]:
    """Run the named commands under limits; print each result when it is known."""
    prepare({"spn-data", "spn-model"})
    found: list[Ended] = []
    context = multiprocessing.get_context("fork")
    for name in names:
        whole, usual_s = undisturbed(ALL[name], folder)
        with ProcessPoolExecutor(jobs, mp_context=context, initializer=adopt_orphans) as pool:
            for one in pool.map(partial(tried, ALL[name], whole, usual_s, folder), limits):
                print(f"{one.command}, {one.limit}: {one.cell} ({one.stop_s} s) {one.line}")
                for what in one.wrong[:6]:
                    print(f"  ! {what}")
                sys.stdout.flush()
                found.append(one)
    return found


def main() -> None:
    """Run the campaign and print the table; exit with 1 if anything was wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    known = list(dict.fromkeys(limit.name for limit in LIMITS))
    parser.add_argument("--only", nargs="*", choices=[*ALL], default=[*ROWS])
    parser.add_argument("--limit", nargs="*", choices=known, default=known)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--work", type=Path, default=_ROOT / "build" / "kill")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    folder = given.work.resolve()
    if folder.is_relative_to("/tmp") or folder.is_relative_to("/var/tmp"):
        parser.error("--work cannot be below /tmp, which is replaced")
    library = str(counter(folder))
    if os.environ.get("LD_PRELOAD") != library:
        # As many threads in a process of its own as in one that is forked: sums depend on them.
        environment = {**os.environ, "LD_PRELOAD": library, "OMP_NUM_THREADS": "1"}
        os.execve(
            sys.executable, [sys.executable, "-m", "faults.limits", *sys.argv[1:]], environment
        )
    limits = [limit for limit in LIMITS if limit.name in given.limit]
    found = campaign(given.only, limits, folder, given.jobs)
    print(table(found))
    if given.json is not None:
        given.json.write_text(json.dumps([asdict(one) for one in found], indent=1) + "\n")
    sys.exit(any(one.wrong for one in found))


if __name__ == "__main__":
    main()
