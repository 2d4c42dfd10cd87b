"""`spn-data register`: labels of evaluation sequences, and of the frames between."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from spn_cli import options


@click.command()
@click.argument("video", required=False, type=click.Path(path_type=Path))
@options.area
@click.option("--name", help="Of the sequence.  [default: the video's own]")
@click.option(
    "--all-frames",
    is_flag=True,
    help="Label the frames between, too: of this video; without VIDEO, of --name or of all sequences.",
)
@click.option(
    "--rate",
    "rate_hz",
    type=options.Finite(0.01, 1000),
    default=2.0,
    show_default=True,
    help="Frames taken a second, whatever they show.",
)
@click.option(
    "--fov", "fov_deg", type=options.Finite(5, 170), help="Horizontal field of view in degrees."
)
@click.option(
    "--camera",
    "camera_file",
    type=click.Path(exists=True, dir_okay=False),
    help="Calibrated camera (JSON: model, width, height, params) to start from.",
)
@click.option("--fixed-lens", is_flag=True, help="Keep the lens of --camera as it is.")
@click.option(
    "--map-frames",
    type=click.IntRange(1, 1000),
    default=12,
    show_default=True,
    help="Most similar map frames that a frame is matched with.",
)
@click.option(
    "--any-telemetry", is_flag=True, help="Use telemetry whose length does not fit its video."
)
@click.option(
    "--video",
    "video_folder",
    type=click.Path(path_type=Path, exists=True),
    help="Where videos lie now, for --all-frames.  [default: where they were]",
)
@options.threads
@options.cluster
@options.seed
@options.overwrite
def register(video: Path | None, area_folder: Path, **chosen: Any) -> None:
    """Give the frames of another flight poses in the frozen map.

    VIDEO is a file, or a folder with one sequence. The map does not change; a frame whose pose cannot be
    trusted fails with a reason.

    \b
    Example:
        spn-data register second-day.mp4 --name medium --area fields/north
    """
    run(video, area_folder, **chosen)


def run(
    video: Path | None,
    area_folder: Path,
    *,
    name: str | None,
    all_frames: bool,
    rate_hz: float,
    fov_deg: float | None,
    camera_file: str | None,
    fixed_lens: bool,
    map_frames: int,
    any_telemetry: bool,
    video_folder: Path | None,
    threads: int | None,
    cluster: str,
    seed: int,
    overwrite: bool,
) -> None:
    import os

    from spn_cli import page, show
    from spn_data.area.names import EVALUATION, GEO
    from spn_data.pipeline.evaluation_stage import RegisterStageOptions
    from spn_data.pipeline.evaluation_stage import register as stage
    from spn_data.pipeline.tracking_stage import sequences_with_video, track_sequence
    from spn_data.registration.register_options import RegisterOptions
    from spn_data.work.cluster import dispatch_to

    if video is None and not all_frames:
        raise click.UsageError("name a VIDEO to register, or give --all-frames")
    if fixed_lens and camera_file is None:
        raise click.UsageError("--fixed-lens keeps the lens of --camera: name one")
    workers = threads or os.cpu_count() or 1
    area = options.open_area(area_folder)
    unit = "m" if area.has(GEO) else "units of the model"
    with area.locked():
        with show.Live(unit) as live:
            names = [name] if name else None
            before = {s: area.record(s) for s in area.stages()}
            if video is not None:
                wanted = RegisterStageOptions(
                    register=RegisterOptions(
                        rate_hz=rate_hz, map_frames=map_frames, hold_lens=fixed_lens, seed=seed
                    ),
                    fov_deg=fov_deg,
                    camera_file=camera_file,
                    any_telemetry=any_telemetry,
                )
                with dispatch_to(cluster, workers) as dispatch:
                    record = stage(
                        area,
                        video,
                        name,
                        wanted,
                        live.progress,
                        dispatch=dispatch,
                        overwrite=overwrite,
                    )
                live.made(record, before)
                names = [record.stage.removeprefix(f"{EVALUATION}/")]
            if all_frames:
                for sequence in names or sequences_with_video(area):
                    between = track_sequence(
                        area,
                        sequence,
                        live.progress,
                        workers=workers,
                        video=video_folder or video,
                        overwrite=overwrite,
                    )
                    live.made(between, before)
        page.refresh(area)
