"""Growth of the cost of a reconstruction with the number of frames, at constant overlap.

    python benchmarks/growth.py FOLDER [--frames 100 300 1000 3000] [--threads 2] [--json OUT]

For each number, a nadir survey is simulated at 45 m over a proportionally larger area: parallel lines 14 m
apart, a frame every 7.5 m, 12 houses per hectare, 960x540 pixels. Flights and frames are kept in FOLDER and
reused by the next run; 3,000 frames take minutes to render and half an hour to reconstruct on two cores.
Costs are measured as in `reconstruct.py`, including child processes.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from contestants import OURS
from reconstruct import STAGES, errors_against_truth, machine, run
from rich.console import Console
from rich.table import Table

from spn_data.area.area import Area
from spn_data.area.names import FRAMES, FRAMES_TABLE
from spn_data.capture.frames import read_frames
from spn_data.pipeline.frames_stage import FramesOptions, choose_frames, plan
from spn_data.simulate.flight import simulate_paths
from spn_data.simulate.presets import MappingPaths, SimulateOptions, preset
from spn_data.simulate.produce import simulate

VERSION = 1  # of the JSON
_STEP_M = 7.5  # between frames; the flight speed is 5 m/s
_SPEED_M_S = 5.0


def survey(frames: int) -> SimulateOptions:
    """Return options of a flight with about the given number of frames."""
    options = replace(
        preset("demo"),
        mapping_paths=MappingPaths.NADIR,
        only=("mapping",),
        fps=_SPEED_M_S / _STEP_M,
        texels_per_m=12.0,  # images have 15 pixels per metre
        houses_per_hectare=12.0,
        blur_share=0.0,  # there are no sharp frames nearby to use instead
    )
    low, high = 0.5, 200.0  # area factors
    for _ in range(20):
        middle = (low * high) ** 0.5
        (path,) = simulate_paths(replace(options, area_factor=middle)).values()
        low, high = (middle, high) if len(path.time_s) < frames else (low, middle)
    return replace(options, area_factor=high)


def area_with_frames(folder: Path, frames: int, console: Console) -> tuple[Area, Path]:
    """Return an area with its first stage and the flight; create both if they do not exist yet."""
    flights, area = folder / f"flights-{frames}", Area(folder / f"area-{frames}")
    if not flights.exists():
        with console.status(f"{frames} frames: rendering") as status:
            simulate(
                flights,
                survey(frames),
                lambda done, total: status.update(f"rendering {done} of {total}"),
            )
    if not area.has(FRAMES):
        with console.status(f"{frames} frames: choosing"):
            options = FramesOptions()
            found = plan([flights / "mapping"], options, tested=area)
            choose_frames(area, found, options, lambda *_: None)
    return area, flights


def measure(area: Area, flights: Path, threads: int) -> dict[str, Any]:
    """Measure one reconstruction with our default options."""
    frames = read_frames(area.folder(FRAMES) / FRAMES_TABLE)
    chosen = frames.select(frames.chosen)
    for name in chosen.names.tolist():  # warm the page cache
        (area.folder(FRAMES) / name).read_bytes()
    with tempfile.TemporaryDirectory(prefix="growth-") as work:
        folder = area.folder(FRAMES).parent.resolve()
        figures, scene = run(OURS, folder, Path(work) / OURS, threads, 0)
    if scene is not None:
        figures["errors"] = errors_against_truth(scene, chosen, flights)
    return {"frames": len(chosen), **figures}


def show(rows: list[dict[str, Any]], console: Console) -> None:
    """Print the cost per frame, which shows what grows faster than their number."""
    table = Table(title="CPU seconds per frame", title_justify="left", box=None)
    for column in ("frames", "registered", *STAGES, "all", "wall s", "MB", "median cm", "p95 cm"):
        table.add_column(column, justify="right")
    for row in rows:
        n, cpu = row["frames"], row["cpu_s"]
        errors = row.get("errors", {})
        table.add_row(
            str(n),
            str(row.get("registered", row["failure"])),
            *(f"{cpu[stage] / n:.3f}" if stage in cpu else "" for stage in STAGES),
            f"{cpu['total'] / n:.3f}",
            f"{row['wall_s']['total'] / n:.3f}",
            "" if row["peak_memory_mb"] is None else f"{row['peak_memory_mb']:.0f}",
            *(
                f"{100 * errors[key]:.2f}" if key in errors else ""
                for key in ("position_median_m", "position_p95_m")
            ),
        )
    console.print(table)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, nargs="+", default=[100, 300, 1000, 3000])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    console = Console(width=None if sys.stdout.isatty() else 120)
    arguments.folder.mkdir(parents=True, exist_ok=True)
    figures: dict[str, Any] = {"version": VERSION, "machine": machine(), "rows": []}
    for frames in arguments.frames:
        made = area_with_frames(arguments.folder, frames, console)
        figures["rows"].append(measure(*made, arguments.threads))
        if arguments.json:  # after each: the last takes longest
            arguments.json.write_text(json.dumps(figures, indent=1) + "\n")
        show(figures["rows"], console)


if __name__ == "__main__":
    main()
