"""The command `spn-data register`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from spn_cli import completion, options

if TYPE_CHECKING:
    from spn_cli.show import Live
    from spn_data.area.area import Area
    from spn_data.storage.stage_record import StageRecord


@click.command()
@click.argument("video", required=False, type=click.Path(path_type=Path))
@options.area
@click.option(
    "--name",
    shell_complete=completion.sequences,
    help="Name of the sequence.  [default: that of the video]",
)
@click.option(
    "--all-frames",
    is_flag=True,
    help="Also label tracked frames: of VIDEO; without VIDEO, of --name or of all sequences.",
)
@click.option(
    "--rate",
    "rate_hz",
    type=options.Finite(0.01, 1000),
    default=2.0,
    show_default=True,
    help="Frames per second to use, regardless of content.",
)
@click.option(
    "--fov",
    "fov_deg",
    type=options.FieldOfView(),
    help="Horizontal field of view in degrees, as initial value.",
)
@click.option(
    "--camera",
    "camera_file",
    type=click.Path(exists=True, dir_okay=False),
    help="Calibrated camera (JSON: model, width, height, params) as initial value.",
)
@click.option("--fixed-lens", is_flag=True, help="Keep the intrinsics of --camera fixed.")
@click.option(
    "--map-frames",
    type=click.IntRange(1, 1000),
    default=12,
    show_default=True,
    help="Number of most similar map frames to match each frame with.",
)
@click.option(
    "--any-telemetry",
    is_flag=True,
    help="Use telemetry even if its length, time or time zone does not match its images.",
)
@click.option(
    "--time-offset",
    "time_offset_s",
    type=options.Finite(-4e8, 4e8),
    help="Seconds to add to telemetry times.  [default: estimated]",
)
@click.option(
    "--video",
    "video_folder",
    type=click.Path(path_type=Path, exists=True),
    help="File or folder with the videos for --all-frames, if moved.  [default: original location]",
)
@click.option(
    "--expect-low/--no-expect-low",
    default=None,
    help="Declare that the flight is meant to be far from the map: low coverage and few fixes on it are no "
    "reservations. Without VIDEO, of the sequence --name.",
)
@options.threads
@options.cluster
@options.seed
@options.overwrite
def register(video: Path | None, area_folder: Path, **chosen: Any) -> None:
    """Register the frames of another flight in the frozen map.

    VIDEO is a file, or a folder with one sequence. The map does not change; a frame whose pose is not
    reliable fails with a reason.

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
    expect_low: bool | None,
    video_folder: Path | None,
    threads: int | None,
    overwrite: bool,
    **chosen: Any,
) -> None:
    """Register a video, track the frames between registered ones, or both."""
    import os

    from spn_cli import page, show
    from spn_data.area.names import EVALUATION, GEO
    from spn_data.pipeline.evaluation_stage import declare_far
    from spn_data.pipeline.tracking_stage import sequences_with_video, track_sequence

    if video is None and not all_frames and expect_low is None:
        raise click.UsageError("give a VIDEO to register, or --all-frames")
    if video is None and expect_low is not None and name is None:
        raise click.UsageError("--expect-low without VIDEO needs --name")
    if chosen["fixed_lens"] and chosen["camera_file"] is None:
        raise click.UsageError("--fixed-lens needs --camera")
    workers = threads or os.cpu_count() or 1
    area = options.open_area(area_folder)
    with area.locked():
        with show.Live("m" if area.has(GEO) else "model units") as live:
            names = [name] if name else None
            before = {s: area.record(s) for s in area.stages()}
            if video is not None:
                record = _register(
                    area, video, name, live, workers=workers, overwrite=overwrite, **chosen
                )
                live.made(record, before)
                names = [record.stage.removeprefix(f"{EVALUATION}/")]
            if expect_low is not None and names:
                declare_far(area, names[0], is_far=expect_low)
            if all_frames:
                for sequence in names or sequences_with_video(area):
                    tracked = track_sequence(
                        area,
                        sequence,
                        live.progress,
                        workers=workers,
                        video=video_folder or video,
                        overwrite=overwrite,
                    )
                    live.made(tracked, before)
        page.refresh(area)


def _register(
    area: Area,
    video: Path,
    name: str | None,
    live: Live,
    *,
    rate_hz: float,
    fov_deg: float | None,
    camera_file: str | None,
    fixed_lens: bool,
    map_frames: int,
    any_telemetry: bool,
    time_offset_s: float | None,
    workers: int,
    cluster: str,
    seed: int,
    overwrite: bool,
) -> StageRecord:
    from spn_data.pipeline.evaluation_stage import RegisterStageOptions
    from spn_data.pipeline.evaluation_stage import register as stage
    from spn_data.registration.register_options import RegisterOptions
    from spn_data.work.cluster import dispatch_to

    wanted = RegisterStageOptions(
        register=RegisterOptions(
            rate_hz=rate_hz, map_frames=map_frames, hold_lens=fixed_lens, seed=seed
        ),
        fov_deg=fov_deg,
        camera_file=camera_file,
        any_telemetry=any_telemetry,
        time_offset_s=time_offset_s,
    )
    with dispatch_to(cluster, workers) as dispatch:
        return stage(
            area, video, name, wanted, live.progress, dispatch=dispatch, overwrite=overwrite
        )
