"""Kill each command at the k-th change of the file system, run it again, and compare with an undisturbed run.

    python -m faults.kill [--kills 30] [--only NAME ...] [--jobs 2] [--work build/kill]

Needs Linux and a C compiler. A change is a file that is created, written to, renamed or removed below the
folder of the test, by Python or by a native library: `changes.c`, loaded by LD_PRELOAD, counts them and
kills the process just before change k. Work that belongs to worker processes is done in the process itself,
so that it is killed at each change too; COLMAP's mapper is a child process and ends with it. All k are
tried if there are at most `--kills`, otherwise as many, evenly spaced.

Counted per command: null: files that differ between two undisturbed runs | kills | lost: something of the
user's, or a finished stage that the command does not make, is changed or missing after the kill or the
rerun | different: the rerun fails, or its files differ from those of an undisturbed run (times excepted;
poses after mapping may differ by 1 cm).
"""

from __future__ import annotations

import argparse
import ctypes
import importlib
import json
import multiprocessing
import os
import pkgutil
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from faults.commands import COMMANDS, Command, state
from faults.contents import contents, differences

_HERE = Path(__file__).resolve().parent
_PR_SET_CHILD_SUBREAPER = 36
LIMIT_S = 1800  # of a command, also on a busy machine


@dataclass(frozen=True)
class Kill:
    """One kill and what it did."""

    command: str
    at: int
    lost: tuple[str, ...]
    different: tuple[str, ...]
    output: str = ""


def counter(work: Path) -> Path:
    """Compile the library that counts changes; return its path."""
    library = work / "changes.so"
    source = _HERE / "changes.c"
    if not library.exists() or library.stat().st_mtime < source.stat().st_mtime:
        work.mkdir(parents=True, exist_ok=True)
        compiler = os.environ.get("CC", "cc")
        subprocess.run(
            [compiler, "-O1", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True
        )
    return library


def prepare(programs: set[str]) -> None:
    """Import what commands of these programs need, so that a forked process starts at once."""
    import cv2
    import spn_cli

    import spn_data
    import spn_model
    from spn_data.simulate import produce
    from spn_data.work.parallel import WorkerPool

    def run_here(_: WorkerPool, function: Any, batches: Any, on_result: Any) -> None:
        for _label, arguments in batches:
            on_result(function(*arguments))

    packages = [spn_cli, spn_data, *([spn_model] if "spn-model" in programs else [])]
    for package in packages:
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.endswith((".__main__", ".cluster")):
                importlib.import_module(module.name)
    WorkerPool.run = run_here  # type: ignore[method-assign]
    in_processes = produce._RenderPool
    produce._RenderPool = lambda options, folder, _: in_processes(options, folder, 1)  # type: ignore
    cv2.setNumThreads(1)
    adopt_orphans()
    if spn_model in packages:
        import torch

        from tests.worlds.training_world import register_tiny

        torch.set_num_threads(1)
        register_tiny()


def run(command: Command, work: Path, at: int = -1, output: Path | None = None) -> int:
    """Run a command in a folder in a forked process; return its exit code, or -signal.

    `at`: the change at which it is killed; 0: only count them, into the file `count` next to the folder.
    """
    pid = os.fork()
    if pid == 0:
        code = 70
        try:
            code = _inside(command, work, at, output or work.parent / "output")
        finally:
            os._exit(code)
    return _reaped(pid)


def _reaped(pid: int) -> int:
    """Wait for a process and all its descendants; return the exit code of the first."""
    found, deadline = None, time.monotonic() + LIMIT_S
    while True:
        try:
            ended, status = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            assert found is not None
            return found
        if ended == pid:
            found = os.waitstatus_to_exitcode(status)
        elif ended == 0:
            if found is None and time.monotonic() > deadline:
                os.kill(pid, signal.SIGKILL)
            time.sleep(0.005)


def _inside(command: Command, work: Path, at: int, output: Path) -> int:
    """Run a command in this process; return its exit code."""
    os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)
    os.environ.pop("LD_PRELOAD", None)
    file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(file, stream)
    os.close(file)
    sys.stdout = os.fdopen(1, "w", buffering=1, closefd=False)
    sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)
    from spn_cli import console, data, model

    console.out.file = sys.stdout
    program, *words = command.words
    os.chdir(work)
    main = {"spn-data": data.main, "spn-model": model.main}[program]
    library = ctypes.CDLL(None)
    if at >= 0:
        library.faults_arm(os.fsencode(work), ctypes.c_long(at))
    code = 0
    try:
        main(words, prog_name=program)
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 1
    except BaseException:
        import traceback

        traceback.print_exc()
        code = 71
    if at == 0:
        library.faults_count.restype = ctypes.c_long
        (work.parent / "count").write_text(str(library.faults_count()))
    return code


@dataclass(frozen=True)
class Undisturbed:
    """An undisturbed run: folders and contents before and after it, and its number of changes."""

    start: Path
    before: dict[str, str]
    whole: Path
    after: dict[str, str]
    changes: int


def undisturbed(command: Command, folder: Path) -> Undisturbed:
    """Run a command as a whole, in folder/whole."""
    states = folder / "states"
    start = state(command.start, states, run)
    own = folder / "whole" / command.name.replace(" ", "_")
    shutil.rmtree(own, ignore_errors=True)
    shutil.copytree(start, own / "work")
    code = run(command, own / "work", 0)
    if code:
        raise SystemExit(f"{command.name}: ended with {code}: {(own / 'output').read_text()}")
    changes = int((own / "count").read_text())
    work = own / "work"
    return Undisturbed(start, contents(start), work, contents(work), changes)


def same_again(command: Command, whole: Undisturbed, folder: Path) -> Kill:
    """Compare two undisturbed runs: what differs between them, no kill has changed."""
    work = folder / "again" / "work"
    shutil.rmtree(work.parent, ignore_errors=True)
    shutil.copytree(whole.start, work)
    code = run(command, work)
    changed = different(command, whole, work) if code == 0 else [f"exit code {code}"]
    return Kill(command.name, 0, tuple(lost(command, whole.before, work)), tuple(changed))


def kill_once(command: Command, whole: Undisturbed, folder: Path, at: int) -> Kill | None:
    """Kill a command at one change and run it again; None if it ended before the kill."""
    own = folder / f"worker-{os.getpid()}"
    work = own / "work"
    shutil.rmtree(own, ignore_errors=True)
    shutil.copytree(whole.start, work)
    code = run(command, work, at)
    if code == 0:
        return None
    if code != -signal.SIGKILL:
        return Kill(command.name, at, (), (f"exit code {code} instead of a kill",))
    gone = lost(command, whole.before, work)
    code = run(command, work, output=own / "again")
    gone += lost(command, whole.before, work)
    changed = [f"exit code {code}"] if code else different(command, whole, work)
    output = (own / "again").read_text()[-600:] if gone or changed else ""
    return Kill(command.name, at, tuple(dict.fromkeys(gone)), tuple(changed), output)


def lost(command: Command, before: dict[str, str], work: Path) -> list[str]:
    """Return what was changed or removed outside what the command may write."""
    from spn_data.area.area import Area

    if (work / "area").is_dir():  # every command begins so; it completes renames
        Area(work / "area")
    now = contents(work, skip=partial(_is_written, command=command))
    kept = {name: digest for name, digest in before.items() if not _is_written(name, command)}
    found = [name for name, digest in kept.items() if now.get(name) != digest]
    # A finished stage or run is there, old or new, at any moment.
    tops = {name for name, digest in before.items() if digest == "folder" and _is_stage(name)}
    return found + [f"{name} is gone" for name in sorted(tops) if not (work / name).is_dir()]


def _is_written(name: str, command: Command) -> bool:
    return any(name == part or name.startswith(f"{part}/") for part in command.writes)


def _is_stage(name: str) -> bool:
    parts = name.split("/")
    return (
        parts[0] == "area"
        and len(parts) in (2, 3)
        and not parts[-1].startswith(".")
        and (len(parts) == 2 or parts[1] in ("4-eval", "4-tracked"))
    )


def different(command: Command, whole: Undisturbed, work: Path) -> list[str]:
    """Return in what the result differs from that of an undisturbed run."""
    found = differences(whole.after, contents(work))
    if not command.is_mapped or not found:
        return found
    from benchmarks.interruption import difference

    near = difference(whole.whole / "area", work / "area")
    if not near.same_frames or near.position_m > 0.01 or near.rotation_deg > 0.05:
        return [*found, f"poses differ by {near.position_m:.3g} m, {near.rotation_deg:.2g} deg"]
    return [name for name in found if name[0] != "~" or name.startswith("~area/1-frames/")]


def evenly(changes: int, kills: int) -> list[int]:
    """Return numbers of changes from 1 to `changes`: all, or as many as wanted, evenly spaced."""
    if changes <= kills or kills < 2:
        return list(range(1, min(changes, kills) + 1))
    return sorted({1 + round(k * (changes - 1) / (kills - 1)) for k in range(kills)})


def campaign(names: list[str], folder: Path, kills: int, jobs: int) -> list[Kill]:
    """Kill the named commands and print a row for each."""
    prepare({COMMANDS[name].words[0] for name in names})
    found: list[Kill] = []
    print(
        f"{'command':<28}{'changes':>8}{'null':>6}{'kills':>7}{'lost':>6}{'different':>11}{'s':>7}"
    )
    for name in names:
        began = time.monotonic()
        command = COMMANDS[name]
        whole = undisturbed(command, folder)
        null = same_again(command, whole, folder)
        ks = evenly(whole.changes, kills)
        context = multiprocessing.get_context("fork")
        with ProcessPoolExecutor(jobs, mp_context=context, initializer=adopt_orphans) as pool:
            tried = list(pool.map(partial(kill_once, command, whole, folder), ks))
        done = [kill for kill in tried if kill is not None]
        gone, changed = totals(done)
        took = time.monotonic() - began
        print(
            f"{name:<28}{whole.changes:>8}{len(null.different):>6}{len(done):>7}{gone:>6}{changed:>11}"
            f"{took:>7.0f}",
            flush=True,
        )
        found += done
        done = [null, *done]
        for kill in done:
            if kill.lost or kill.different:
                print(f"  at {kill.at}: lost {kill.lost[:6]} different {kill.different[:6]}")
                print(f"    {kill.output.strip().splitlines()[-1:]}", flush=True)
    return found


def totals(kills: list[Kill]) -> tuple[int, int]:
    """Return the number of kills after which something was lost, and of those with a different result."""
    return sum(bool(kill.lost) for kill in kills), sum(bool(kill.different) for kill in kills)


def adopt_orphans() -> None:
    """Become the parent of orphaned descendants, so that they can be waited for."""
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def main() -> None:
    """Run the campaign; exit with 1 if anything was lost or differs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=30, help="largest number of kills per command")
    parser.add_argument("--only", nargs="*", choices=[*COMMANDS], default=[*COMMANDS])
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--work", type=Path, default=Path("build/kill"))
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    folder = given.work.resolve()
    library = str(counter(folder))
    if os.environ.get("LD_PRELOAD") != library:
        environment = {**os.environ, "LD_PRELOAD": library, "OMP_NUM_THREADS": "1"}
        os.execve(sys.executable, [sys.executable, "-m", "faults.kill", *sys.argv[1:]], environment)
    kills = campaign(given.only, folder, given.kills, given.jobs)
    gone, changed = totals(kills)
    print(f"{len(kills)} kills: {gone} lost, {changed} different")
    if given.json is not None:
        given.json.write_text(json.dumps([asdict(kill) for kill in kills], indent=1) + "\n")
    sys.exit(bool(gone or changed))


if __name__ == "__main__":
    main()
