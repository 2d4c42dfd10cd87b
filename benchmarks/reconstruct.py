"""Compare our reconstruction with pycolmap's pipeline: same frames, cameras, threads and machine.

    python benchmarks/reconstruct.py AREA [--flights FLIGHTS] [--threads 2] [--only ours|pycolmap]
                                     [--seed 0] [--work DIR] [--json OUT]

AREA needs its stage 1-frames and is only read. FLIGHTS is the output of `spn-data simulate`: with it, both
are compared with the exact ground truth after the best similarity. Costs cover everything after the choice of
frames, including child processes. The baseline is `run_pycolmap` in `contestants.py`.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from contestants import OURS, PYCOLMAP, RESULT, Job, Result
from process import Usage, run_measured
from rich.console import Console
from rich.table import Table
from truth import error_figures, true_of_scene

from spn_data.area.area import Area
from spn_data.area.names import FRAMES
from spn_data.capture.frames import Frames, read_frames
from spn_data.colmap.model import Scene, load_native, scene_of
from spn_data.errors import GeometryError, SpnError, StageError
from spn_data.geometry.pose import Poses, Similarity, pose_errors
from spn_data.storage.stage_record import versions

VERSION = 1  # of the JSON
STAGES = ("features", "pairs", "matching", "mapping", "refinement", "covariance")


def run(
    who: str, area: Path, work: Path, threads: int, seed: int
) -> tuple[dict[str, Any], Scene | None]:
    """Run one contestant; return its figures and its reconstruction."""
    work.mkdir()
    job = work.with_suffix(".json")
    job.write_text(
        json.dumps(asdict(Job(area=str(area), work=str(work), threads=threads, seed=seed)))
    )
    script = str(Path(__file__).with_name("contestants.py"))
    log = work.with_suffix(".log")
    usage = run_measured([sys.executable, script, who, str(job)], threads=threads, log=log)
    result = _read_result(work, usage, log)
    figures: dict[str, Any] = {
        "failure": result.failure,
        "wall_s": _by_stage(result.seconds, usage.wall_s),
        "cpu_s": _by_stage(result.cpu_seconds, usage.cpu_s),
        "peak_memory_mb": usage.peak_memory_mb,
        "notes": list(result.notes),
    }
    if result.model is None:
        return figures, None
    native = load_native(Path(result.model))
    scene = scene_of(native)
    figures |= {
        "registered": len(scene.names),
        "points": len(scene.points),
        "observations": int(scene.track_lengths.sum()),
        "mean_error_px": float(native.compute_mean_reprojection_error()),
    }
    return figures, scene


def _read_result(work: Path, usage: Usage, log: Path) -> Result:
    if usage.exit_code != 0:
        code = usage.exit_code
        how = f"killed by signal {-code}" if code < 0 else f"ended with code {code}"
        tail = "\n".join(log.read_text(errors="replace").splitlines()[-8:])
        return Result(model=None, failure=f"{how}: {tail}")
    return Result(**json.loads((work / RESULT).read_text(encoding="utf-8")))


def _by_stage(seconds: dict[str, float], total: float) -> dict[str, float]:
    """Return the seconds of the stages, of everything else (starting, reading, diagnosis), and in total."""
    return {**seconds, "other": total - sum(seconds.values()), "total": total}


def errors_against_truth(scene: Scene, chosen: Frames, flights: Path) -> dict[str, Any]:
    """Return the figures of `error_figures` after the best similarity, or why there are none."""
    true = true_of_scene(scene, chosen, flights)
    try:
        world_from_model = Similarity.fit(scene.poses.centers, true.centers)
    except GeometryError as error:
        return {"failure": str(error)}
    return {
        "frames": len(true),
        **error_figures(world_from_model.apply_to_poses(scene.poses), true),
    }


def difference(ours: Scene, theirs: Scene) -> dict[str, Any]:
    """Compare two scenes after the best similarity, over their common images.

    Positions are relative to the diagonal of the bounding box of the cameras, since neither scene is metric.
    """
    a, b = common_poses(ours, theirs)
    try:
        theirs_from_ours = Similarity.fit(a.centers, b.centers)
    except GeometryError as error:
        return {"frames": len(a), "failure": str(error)}
    off, off_deg = pose_errors(theirs_from_ours.apply_to_poses(a), b)
    share = off / np.linalg.norm(np.ptp(b.centers, axis=0))
    return {
        "frames": len(a),
        "position_median_share": float(np.median(share)),
        "position_p95_share": float(np.quantile(share, 0.95)),
        "rotation_median_deg": float(np.median(off_deg)),
        "rotation_p95_deg": float(np.quantile(off_deg, 0.95)),
    }


def common_poses(a: Scene, b: Scene) -> tuple[Poses, Poses]:
    """Return the poses of the common images in the same order."""
    row_a = {name: k for k, name in enumerate(a.names)}
    row_b = {name: k for k, name in enumerate(b.names)}
    both = [name for name in a.names if name in row_b]
    return (
        a.poses[np.array([row_a[n] for n in both], dtype=np.int64)],
        b.poses[np.array([row_b[n] for n in both], dtype=np.int64)],
    )


def only(scene: Scene, names: set[str]) -> Scene:
    """Restrict a scene to the poses of some images."""
    keep = np.array([name in names for name in scene.names], dtype=bool)
    return replace(
        scene,
        names=tuple(name for name in scene.names if name in names),
        poses=scene.poses[keep],
        camera_ids=scene.camera_ids[keep],
    )


def machine() -> dict[str, Any]:
    """Describe the machine and the versions in use."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": models[0] if models else platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "load_before": round(os.getloadavg()[0], 2),
        "system": platform.platform(),
        "versions": versions(),
    }


def compare(
    area: Path, flights: Path | None, work: Path, *, who: Iterable[str], threads: int, seed: int
) -> dict[str, Any]:
    """Run the contestants `who` one after the other in `work` and return all figures."""
    folder = Area(area).folder(FRAMES)
    if not folder.is_dir():
        raise StageError(f"{folder} is missing; run spn-data reconstruct first")
    frames = read_frames(folder / "frames.csv")
    chosen = frames.select(frames.chosen)
    for name in chosen.names.tolist():  # warm the page cache for both
        (folder / name).read_bytes()
    figures: dict[str, Any] = {
        "version": VERSION,
        "machine": machine(),
        "area": str(area),
        "frames": len(chosen),
        "cameras": len(np.unique(chosen.cameras)),
        "threads": threads,
        "seed": seed,
    }
    scenes: dict[str, Scene] = {}
    for one in who:
        figures[one], scene = run(one, area.resolve(), work / one, threads, seed)
        if scene is not None:
            scenes[one] = scene
            if flights is not None:
                figures[one]["errors"] = errors_against_truth(scene, chosen, flights)
    if len(scenes) == 2:  # times of an early failure are not comparable
        figures["baseline_over_ours"] = {
            unit: figures[PYCOLMAP][unit]["total"] / figures[OURS][unit]["total"]
            for unit in ("wall_s", "cpu_s")
        }
        figures["difference"] = difference(scenes[OURS], scenes[PYCOLMAP])
        ours, theirs = scenes[OURS], scenes[PYCOLMAP]
        if flights is not None and ours.names != theirs.names:
            # Leaving out difficult frames would make a result look better than it is.
            for name, mine, other in ((OURS, ours, theirs), (PYCOLMAP, theirs, ours)):
                figures[name]["errors_of_common"] = errors_against_truth(
                    only(mine, set(other.names)), chosen, flights
                )
    return figures


def show(figures: dict[str, Any], console: Console) -> None:
    """Print the tables of seconds and results, followed by notes and differences."""
    who = [name for name in (OURS, PYCOLMAP) if name in figures]
    on = figures["machine"]
    used = on["versions"]
    console.print(
        f"{figures['frames']} frames of {figures['area']}, {figures['cameras']} camera(s), "
        f"{figures['threads']} threads on {on['cpu']} with {on['cores']} cores "
        f"(load {on['load_before']} before)\n"
        + ", ".join(f"{name} {number}" for name, number in used.items()),
        highlight=False,
    )
    seconds = Table(title="Seconds", title_justify="left", box=None)
    seconds.add_column("")
    for name in who:
        seconds.add_column(f"{name} wall", justify="right")
        seconds.add_column("CPU", justify="right")
    for stage in (*STAGES, "other", "total"):
        cells = [figures[name][unit].get(stage) for name in who for unit in ("wall_s", "cpu_s")]
        if any(cell is not None for cell in cells):
            seconds.add_row(stage, *("" if c is None else f"{c:.1f}" for c in cells))
    console.print(seconds)
    results = Table(title="Results", title_justify="left", box=None)
    for column in ("", *who):
        results.add_column(column, justify="right" if column else "left")
    for label, cells in _result_rows([figures[name] for name in who]):
        if any(cells):
            results.add_row(label, *cells)
    console.print(results)
    for name in who:
        for note in figures[name]["notes"]:
            console.print(f"{name}: {note}", highlight=False)
        if figures[name]["failure"]:
            console.print(f"{name} failed: {figures[name]['failure']}", markup=False)
    if "difference" in figures:
        _show_difference(figures["difference"], console)
    if "baseline_over_ours" in figures:
        ratio = figures["baseline_over_ours"]
        console.print(f"pycolmap / ours: CPU {ratio['cpu_s']:.2f}, wall {ratio['wall_s']:.2f}")


def _result_rows(of: list[dict[str, Any]]) -> list[tuple[str, list[str]]]:
    def row(label: str, pattern: str, *keys: str, factor: float = 1.0) -> tuple[str, list[str]]:
        cells = []
        for value in of:
            found: Any = value
            for key in keys:
                found = None if found is None else found.get(key)
            cells.append("" if found is None else pattern.format(found * factor))
        return label, cells

    rows = [
        row("registered frames", "{:.0f}", "registered"),
        row("points", "{:.0f}", "points"),
        row("observations", "{:.0f}", "observations"),
        row("mean reprojection error", "{:.3f} px", "mean_error_px"),
        row("peak memory", "{:.0f} MB", "peak_memory_mb"),
    ]
    for key, note in (("errors", ""), ("errors_of_common", ", frames of both")):
        rows += [
            row(f"position median{note}", "{:.2f} cm", key, "position_median_m", factor=100),
            row(f"position p95{note}", "{:.2f} cm", key, "position_p95_m", factor=100),
            row(f"rotation median{note}", "{:.4f} deg", key, "rotation_median_deg"),
        ]
    return rows


def _show_difference(of: dict[str, Any], console: Console) -> None:
    if "failure" in of:
        console.print(f"between the two, {of['frames']} frames: {of['failure']}")
        return
    console.print(
        f"between the two, {of['frames']} frames: position median {of['position_median_share']:.3%}, "
        f"p95 {of['position_p95_share']:.3%} of the cameras' extent; "
        f"rotation median {of['rotation_median_deg']:.4f} deg",
        highlight=False,
    )


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("area", type=Path)
    parser.add_argument(
        "--flights", type=Path, help="output of spn-data simulate, with the ground truth"
    )
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--only", choices=(OURS, PYCOLMAP))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, help="new folder for databases, models and logs")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    who = (OURS, PYCOLMAP) if arguments.only is None else (arguments.only,)
    with ExitStack() as stack:
        if arguments.work is None:
            work = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="benchmark-")))
        else:
            work = arguments.work.resolve()
            if work.exists():
                parser.error(f"--work {work} already exists; choose a new folder")
            work.mkdir(parents=True)
        try:
            figures = compare(
                arguments.area,
                arguments.flights,
                work,
                who=who,
                threads=arguments.threads,
                seed=arguments.seed,
            )
        except SpnError as error:
            parser.exit(1, f"Error: {error}\n")
    show(figures, Console())
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
