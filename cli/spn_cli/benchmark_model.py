"""`spn-model benchmark`: what a bundle costs on this machine."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from spn_cli import console, options
from spn_data.area.names import DATASET

if TYPE_CHECKING:
    from spn_model.export.bundle_benchmark import BundleCost

_STEPS = ("preprocessing", "graph", "decoding", "total")


@click.command()
@click.argument("bundle", required=False, type=click.Path(path_type=Path))
@options.area
@click.option("--run", "name", help="Trained network whose bundle is timed, instead of BUNDLE.")
@click.option(
    "--frame",
    "frames",
    type=click.Path(path_type=Path),
    multiple=True,
    help="Image of the flying camera; may be repeated.  [default: the data set's, as of 1280x720]",
)
@click.option(
    "--camera",
    "camera_file",
    type=click.Path(path_type=Path),
    help="The flying camera (JSON: model, width, height, params), with --frame.",
)
@click.option(
    "--poses",
    type=click.IntRange(1, 100_000),
    default=100,
    show_default=True,
    help="How many are timed, of each graph.",
)
@click.option(
    "--threads", type=click.IntRange(1, 256), default=1, show_default=True, help="Of the network."
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of tables.")
def benchmark(bundle: Path | None, area_folder: Path, **chosen: Any) -> None:
    """Time the program on board: each step of a pose, file sizes, and the memory of its process.

    \b
    Example:
        spn-model benchmark --area fields/north --run first
        spn-model benchmark bundle/ --frame frame.jpg --camera cam.json
    """
    run(bundle, area_folder, **chosen)


def run(
    bundle: Path | None,
    area_folder: Path,
    *,
    name: str | None,
    frames: tuple[Path, ...],
    camera_file: Path | None,
    poses: int,
    threads: int,
    as_json: bool,
) -> None:
    from spn_data.area import names as names_of
    from spn_model.export.bundle_benchmark import BenchmarkOptions, render_flight_frames
    from spn_model.export.bundle_benchmark import benchmark as work

    if (bundle is None) == (name is None):
        raise click.UsageError("give BUNDLE or --run")
    if bool(frames) != (camera_file is not None):
        raise click.UsageError("--frame and --camera go together: a frame's camera must be known")
    area = options.open_area(area_folder)
    folder = bundle if name is None else area.run_folder(name) / names_of.BUNDLE
    assert folder is not None
    wanted = BenchmarkOptions(poses=poses, threads=threads)
    with tempfile.TemporaryDirectory(prefix="spn-benchmark-") as scratch:
        images, camera = list(frames), camera_file
        if camera is None:
            source = area.folder(names_of.SPLIT) / DATASET
            images, camera = render_flight_frames(folder, source, Path(scratch), wanted.frames)
        found = work(folder, images, camera, wanted)
    if as_json:
        plain = {one.precision: {"file_mb": one.bytes / 1e6, **one.found} for one in found}
        click.echo(json.dumps(plain, indent=1, sort_keys=True))
        return
    _show(found)


def _show(found: tuple[BundleCost, ...]) -> None:
    first = found[0].found
    width, height = first["frame"]
    rows = []
    for one in found:
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
    console.out.print(
        "of bare: processor's time of our call of onnxruntime against its own on the same tensor. "
        "memory: greatest of the program's process."
    )
