"""A campaign: inputs of all targets in turn, and a table of what went wrong."""

from __future__ import annotations

import json
import os
import random
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import monotonic

import cv2

from fuzz.limits import Reader, limited, wait_for
from fuzz.targets import BY_NAME, TARGETS, Target
from spn_data.errors import SpnError

FINE = ("ok", "refused")


class Campaign:
    """Inputs made from seeds; failing ones are kept with what they caused.

    Parameters
    ----------
    folder : Path
        Folder that holds `seeds`, and gets `failures` and temporary files.
    seed : int
        Campaigns with other seeds have other inputs.
    """

    def __init__(self, folder: Path, seed: int):
        self.folder, self.seed = folder, seed
        self.seeds = {t.name: t.files(folder / "seeds") for t in TARGETS}
        self._copies: dict[Path, Path] = {}

    def make(self, target: Target, number: int) -> tuple[Path, bytes]:
        """Return the seed file and the bytes of an input; equal arguments give equal bytes.

        Numbers below zero are the seeds themselves, from -1.
        """
        if number < 0:
            origin = self.seeds[target.name][-number - 1]
            return origin, origin.read_bytes()
        rng = random.Random(f"{self.seed}/{target.name}/{number}")
        origin = rng.choice(self.seeds[target.name])
        return origin, target.mutate(origin.read_bytes(), rng)

    def serve(self, name: str, number: int) -> tuple[str, str]:
        """Make and read one input, in a child process."""
        cv2.setNumThreads(1)
        target = BY_NAME[name]
        origin, data = self.make(target, number)
        path = self._place(target, origin)
        kept = path.read_bytes() if path.exists() else None
        path.unlink(missing_ok=True)
        path.write_bytes(data)
        try:
            return limited(lambda: target.read(path), SpnError)
        finally:
            path.unlink(missing_ok=True)
            if kept is not None:
                path.write_bytes(kept)

    def _place(self, target: Target, origin: Path) -> Path:
        """Return where an input is written: among copies of the other files of its folder."""
        scratch = self.folder / "scratch" / str(os.getpid())
        root = self.folder / "seeds"
        inner = origin.relative_to(root)
        if not target.above:
            scratch.mkdir(parents=True, exist_ok=True)
            return scratch / inner.name
        top = root / inner.parts[0] if target.above > 1 else origin.parent
        if top not in self._copies:
            self._copies[top] = scratch / f"{len(self._copies)}-{top.name}"
            shutil.copytree(top, self._copies[top])
        return self._copies[top] / origin.relative_to(top)

    def run(self, jobs: Iterator[tuple[str, int]], workers: int) -> dict[str, Counter[str]]:
        """Read all inputs; return the number of each verdict by target."""
        found: dict[str, Counter[str]] = {t.name: Counter() for t in TARGETS}
        readers = [Reader(self.serve) for _ in range(workers)]
        try:
            busy = [r for r in readers if _give(r, jobs)]
            while busy:
                ready = wait_for(busy)
                for reader in busy:
                    if reader not in ready and not reader.is_overdue():
                        continue
                    assert reader.job is not None
                    name, number = reader.job
                    verdict, text = reader.take() if reader in ready else reader.kill()
                    found[name][verdict] += 1
                    if verdict not in FINE:
                        self._keep(name, number, verdict, text)
                    reader.job = None
                    _give(reader, jobs)
                busy = [r for r in busy if r.job is not None]
        finally:
            for reader in readers:
                reader.close()
            shutil.rmtree(self.folder / "scratch", ignore_errors=True)
        return found

    def _keep(self, name: str, number: int, verdict: str, text: str) -> None:
        origin, data = self.make(BY_NAME[name], number)
        folder = (
            self.folder / "failures" / f"{verdict}-{name.replace(' ', '-')}-{self.seed}-{number}"
        )
        folder.mkdir(parents=True, exist_ok=True)
        (folder / origin.name).write_bytes(data)
        (folder / "why.txt").write_text(text or verdict, encoding="utf-8")
        job = {"target": name, "seed": self.seed, "number": number, "origin": str(origin)}
        (folder / "input.json").write_text(json.dumps(job, indent=1))


def jobs_of(
    campaign: Campaign, inputs: int, names: Sequence[str] = ()
) -> Iterator[tuple[str, int]]:
    """Yield targets in turn, those with seeds only, until there are as many inputs as wanted."""
    targets = [t.name for t in TARGETS if campaign.seeds[t.name] and (not names or t.name in names)]
    for k in range(inputs):
        yield targets[k % len(targets)], k // len(targets)


def until(jobs: Iterator[tuple[str, int]], seconds: float) -> Iterator[tuple[str, int]]:
    """Yield jobs until the time is over."""
    end = monotonic() + seconds
    for job in jobs:
        if monotonic() > end:
            return
        yield job


def _give(reader: Reader, jobs: Iterator[tuple[str, int]]) -> bool:
    job = next(jobs, None)
    if job is not None:
        reader.give(*job)
    return job is not None


def table(found: dict[str, Counter[str]]) -> str:
    """Return the figures as text, a line for each target."""
    kinds = ("ok", "refused", "traceback", "timeout", "memory", "crash", "lines")
    lines = [f"{'target':<20}{'inputs':>8}" + "".join(f"{kind:>10}" for kind in kinds)]
    for name, of in (*found.items(), ("all", sum(found.values(), Counter()))):
        lines.append(f"{name:<20}{of.total():>8}" + "".join(f"{of[kind]:>10}" for kind in kinds))
    return "\n".join(lines)
