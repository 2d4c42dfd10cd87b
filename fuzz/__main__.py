"""Fuzz every reader: python -m fuzz [--inputs N] [--seconds S] [--target NAME]... or --replay FILE.

Failing inputs are kept in build/fuzz/failures, each with input.json, which --replay takes.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1] / "build" / "fuzz"


def main() -> int:
    """Run a campaign and return 1 if anything but a result or a one-line refusal was found."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=12_000)
    parser.add_argument("--seconds", type=float, default=900.0, help="stop after this time")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--target", action="append", default=[])
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=FOLDER, help="of seeds and failures")
    parser.add_argument(
        "--replay", type=Path, help="input.json of a failing input: read it here, unlimited"
    )
    given = parser.parse_args()
    # In a process of its own: what it computes would leave threads, which forks do not survive.
    subprocess.run([sys.executable, "-m", "fuzz.seeds", given.folder / "seeds"], check=True)
    from fuzz.campaign import FINE, Campaign, jobs_of, table, until

    if given.replay:
        job = json.loads(given.replay.read_text())
        verdict, text = Campaign(given.folder, job["seed"]).serve(job["target"], job["number"])
        print(verdict, text, sep="\n")
        return verdict not in FINE
    campaign = Campaign(given.folder, given.seed)
    jobs = until(jobs_of(campaign, given.inputs, given.target), given.seconds)
    found = campaign.run(jobs, given.workers)
    print(table(found))
    missing = [name for name, files in campaign.seeds.items() if not files]
    if missing:
        print(f"Without seeds on this machine: {', '.join(missing)}")
    return any(of[kind] for of in found.values() for kind in of if kind not in FINE)


if __name__ == "__main__":
    sys.exit(main())
