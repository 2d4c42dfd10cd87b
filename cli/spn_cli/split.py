"""The command `spn-data split`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from spn_cli import console, options, page
from spn_cli.audit import show_findings

if TYPE_CHECKING:
    from spn_data.pipeline.split_stage import SplitStageOptions
    from spn_data.storage.stage_record import StageRecord

_SHARE = options.Finite(0, 0.9, min_open=True)
_SECONDS = options.Finite(0, 3600)
_METRES = options.Finite(0, 100_000)


@click.command()
@options.area
@options.overwrite
@click.option(
    "--validation",
    type=click.Choice(["time", "space", "height"]),
    default="time",
    show_default=True,
    help="How validation is held out of the mapping flights: blocks in time, a region, or a band of heights.",
)
@click.option(
    "--validation-share",
    type=_SHARE,
    default=0.11,
    show_default=True,
    help="Share of the mapping frames that validate.",
)
@click.option(
    "--test-share",
    type=_SHARE,
    default=0.15,
    show_default=True,
    help="Share that tests, where there is no evaluation sequence.",
)
@click.option(
    "--gap",
    "gap_s",
    type=_SECONDS,
    default=2.0,
    show_default=True,
    help="Seconds between a held-out frame and the nearest training frame of its sequence.",
)
@click.option(
    "--block",
    "block_s",
    type=options.Finite(0, 3600, min_open=True),
    default=5.0,
    show_default=True,
    help="Seconds of a validation block, about (time).",
)
@click.option(
    "--cell",
    "cell_m",
    type=options.Finite(0, 100_000, min_open=True),
    default=4.0,
    show_default=True,
    help="Metres of a cell's edge, of which regions are made (space).",
)
@click.option(
    "--guard-distance",
    "guard_distance_m",
    type=_METRES,
    default=3.0,
    show_default=True,
    help="Metres in plan view from validation to training (space).",
)
@click.option(
    "--guard-height",
    "guard_height_m",
    type=_METRES,
    default=1.0,
    show_default=True,
    help="Metres in height from validation to training (height).",
)
@click.option(
    "--no-tracked",
    "--no-dense",
    "no_tracked",
    is_flag=True,
    help="Leave out video frames that were tracked between mapped ones.",
)
@click.option(
    "--size",
    "width_px",
    type=click.IntRange(32, 16_384),
    metavar="WIDTH",
    help="Width in pixels of images in dataset.h5.  [default: 480; with --native the lens's own]",
)
@click.option(
    "--native",
    is_flag=True,
    help="Undistort each lens into its own view, not all into the one that they share.",
)
@click.option(
    "--cambridge",
    type=click.Choice(["chosen", "all", "none"]),
    default="chosen",
    show_default=True,
    help="Frames in the folder cambridge/, whose images are of full size.",
)
@click.option(
    "--video",
    "video_folder",
    type=click.Path(exists=True, path_type=Path),
    help="Where the videos lie, of which tracked frames are read.  [default: where they were]",
)
@options.seed
def split(area_folder: Path, overwrite: bool, video_folder: Path | None, **chosen: Any) -> None:
    """Divide frames into training, validation and test, and write dataset.h5.

    Each evaluation sequence is a test set of its own name. Without one, a block of a mapping flight is
    held out, and everything says that such a test is optimistic.

    \b
    Example:
        spn-data split --area fields/north
    """
    from spn_data.area.names import AUDIT, SPLIT
    from spn_data.pipeline.area_audit import read_audit
    from spn_data.pipeline.split_stage import split_area

    area = options.open_area(area_folder)
    with area.locked():
        before = area.record(SPLIT) if area.has(SPLIT) else None
        with console.progress() as progress:
            record = split_area(
                area,
                _options(**chosen),
                progress,
                video_folder=video_folder,
                overwrite=overwrite,
            )
        if record == before:
            console.out.print(f"{SPLIT}: unchanged since {record.finished}.")
        _show(record)
        page.refresh(area)
    show_findings(read_audit(area.folder(SPLIT) / AUDIT))


def _options(
    *, native: bool, width_px: int | None, cambridge: str, no_tracked: bool, **chosen: Any
) -> SplitStageOptions:
    from spn_data.pipeline.split_stage import CambridgeFrames, SplitStageOptions
    from spn_data.split.groups import Policy, SplitOptions

    chosen["validation"] = Policy(chosen["validation"])
    return SplitStageOptions(
        split=SplitOptions(tracked=not no_tracked, **chosen),
        native=native,
        width_px=width_px,
        cambridge=CambridgeFrames(cambridge),
    )


def _show(record: StageRecord) -> None:
    from spn_cli import show_labels

    counts = record.counts
    sizes = ", ".join(f"{width}x{height}" for width, height in counts["image_px"])
    console.table(
        f"{record.stage}: what networks train on",
        [
            *((name, f"{n} frames") for name, n in counts["groups"].items()),
            ("left out", f"{counts['left_out']} frames (guards, or no pose)"),
            ("images", f"{sizes} pixels"),
            ("points for training", str(counts["training_points"])),
            show_labels.time_row(record),
        ],
    )
    for note in record.notes:
        if not note.startswith("audit:"):  # told with the other findings
            console.note(note)
