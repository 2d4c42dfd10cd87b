"""The command `spn-model benchmark`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from spn_cli import completion, console, options, output
from spn_data.area.names import DATASET, SPLIT

if TYPE_CHECKING:
    from spn_model.export.bundle_benchmark import BundleCost

_STEPS = ("preprocessing", "graph", "decoding", "total")


@click.command()
@click.argument("bundle", required=False, type=click.Path(path_type=Path))
@options.area
@click.option(
    "--run",
    "name",
    shell_complete=completion.runs,
    help="Run whose bundle is benchmarked, instead of BUNDLE.",
)
@click.option(
    "--frame",
    "frames",
    type=click.Path(path_type=Path),
    multiple=True,
    help="Image of the flying camera; may be repeated.  [default: rendered from the data set at 1280x720]",
)
@click.option(
    "--camera",
    "camera_file",
    type=click.Path(path_type=Path),
    help="Camera of --frame (JSON: model, width, height, params).",
)
@click.option(
    "--poses",
    type=click.IntRange(1, 100_000),
    default=100,
    show_default=True,
    help="Number of poses to time with each graph.",
)
@click.option(
    "--threads",
    type=click.IntRange(1, 256),
    default=1,
    show_default=True,
    help="Number of threads of the network.",
)
def benchmark(
    bundle: Path | None,
    area_folder: Path,
    *,
    name: str | None,
    frames: tuple[Path, ...],
    camera_file: Path | None,
    poses: int,
    threads: int,
) -> None:
    """Measure latency of each step, file size and memory of the onboard program on this machine.

    \b
    Example:
        spn-model benchmark --area fields/north --run first
        spn-model benchmark bundle/ --frame frame.jpg --camera cam.json
    """
    from spn_model.export.bundle_benchmark import (
        BenchmarkOptions,
        benchmark_on_dataset,
    )
    from spn_model.export.bundle_benchmark import (
        benchmark as benchmark_on_frames,
    )
    from spn_model.runs.run_files import RunFiles

    if (bundle is None) == (name is None):
        raise click.UsageError("give either BUNDLE or --run")
    if bool(frames) != (camera_file is not None):
        raise click.UsageError("--frame and --camera go together: a frame needs its camera")
    area = options.open_area(area_folder)
    folder = bundle if name is None else RunFiles(area.run_folder(name)).bundle
    assert folder is not None
    wanted = BenchmarkOptions(poses=poses, threads=threads)
    with console.working(f"Timing {poses} poses with each graph"):
        if camera_file is None:
            costs = benchmark_on_dataset(folder, area.folder(SPLIT) / DATASET, wanted)
        else:
            costs = benchmark_on_frames(folder, frames, camera_file, wanted)
    graphs = {one.precision: {"file_mb": one.bytes / 1e6, **one.found} for one in costs}
    output.figures(graphs=graphs)
    _show(costs)


def _show(costs: tuple[BundleCost, ...]) -> None:
    first = costs[0].found
    width, height = first["frame"]
    rows = []
    for one in costs:
        spent, memory = one.found["milliseconds"], one.found["memory_mb"]
        rows.append(
            (
                one.precision,
                *(f"{spent[name]['p50']:.1f} / {spent[name]['p95']:.1f} ms" for name in _STEPS),
                f"{one.found['overhead']:.3f}",
                f"{one.bytes / 1e6:.2f} MB",
                "" if memory is None else f"{memory:.0f} MB",
                f"{100 * one.found['located']:.0f} %",
            )
        )
    console.table(
        f"A pose from a frame of {width}x{height}, {first['threads']} thread"
        f"{'' if first['threads'] == 1 else 's'}, p50 / p95 of {first['poses']}",
        rows,
        ("graph", *_STEPS, "of bare", "file", "memory", "with a pose"),
    )
    console.say(
        "of bare: CPU time of our onnxruntime call relative to a bare call on the same tensor. "
        "memory: peak of the onboard process."
    )
