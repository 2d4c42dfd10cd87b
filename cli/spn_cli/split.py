"""The command `spn-data split`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from spn_cli import console, options, page
from spn_cli.audit import fail_if_failed, show_findings

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
    help="How validation frames are held out: blocks in time, a region, or a band of heights.",
)
@click.option(
    "--validation-share",
    type=_SHARE,
    default=0.11,
    show_default=True,
    help="Share of the mapping frames used for validation.",
)
@click.option(
    "--test-share",
    type=_SHARE,
    default=0.15,
    show_default=True,
    help="Share of the mapping frames used as test set if there is no evaluation sequence.",
)
@click.option(
    "--gap",
    "gap_s",
    type=_SECONDS,
    default=2.0,
    show_default=True,
    help="Minimum time in seconds between a held-out frame and the training frames of its sequence.",
)
@click.option(
    "--block",
    "block_s",
    type=options.Finite(0, 3600, min_open=True),
    default=5.0,
    show_default=True,
    help="Approximate length of a validation block in seconds (time).",
)
@click.option(
    "--cell",
    "cell_m",
    type=options.Finite(0, 100_000, min_open=True),
    default=4.0,
    show_default=True,
    help="Edge length in metres of the cells that make up regions (space).",
)
@click.option(
    "--guard-distance",
    "guard_distance_m",
    type=_METRES,
    default=3.0,
    show_default=True,
    help="Horizontal distance in metres between validation and training (space).",
)
@click.option(
    "--guard-height",
    "guard_height_m",
    type=_METRES,
    default=1.0,
    show_default=True,
    help="Height difference in metres between validation and training (height).",
)
@click.option(
    "--no-tracked",
    "--no-dense",
    "no_tracked",
    is_flag=True,
    help="Leave out tracked frames.",
)
@click.option(
    "--size",
    "width_px",
    type=click.IntRange(32, 16_384),
    metavar="WIDTH",
    help="Image width in dataset.h5 in pixels.  [default: 480; with --native that of the lens]",
)
@click.option(
    "--native",
    is_flag=True,
    help="Undistort each lens into its own pinhole view instead of rendering all into a common one.",
)
@click.option(
    "--cambridge",
    type=click.Choice(["chosen", "all", "none"]),
    default="chosen",
    show_default=True,
    help="Frames in the folder cambridge/, which has images of full size; all includes tracked frames.",
)
@click.option(
    "--video",
    "video_folder",
    type=click.Path(exists=True, path_type=Path),
    help="File or folder with the videos, from which tracked frames are read.  [default: original location]",
)
@options.seed
def split(area_folder: Path, overwrite: bool, video_folder: Path | None, **chosen: Any) -> None:
    """Split frames into training, validation and test sets, and write dataset.h5.

    Each evaluation sequence becomes a test set of that name. Without one, a block of a mapping flight is held
    out; such a test is optimistic, which all results state.

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
            console.say(f"{SPLIT}: unchanged since {record.finished}.")
        _show(record)
        findings = read_audit(area.folder(SPLIT) / AUDIT)
        show_findings(findings)
        for note in record.notes:
            if not note.startswith("audit:"):  # printed with the other findings
                console.note(note)
        page.refresh(area)
    fail_if_failed(findings)


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
        f"{record.stage}: data set",
        [
            *((name, f"{n} frames") for name, n in counts["groups"].items()),
            ("left out", f"{counts['left_out']} frames (guard zones, or no pose)"),
            ("images", f"{sizes} pixels"),
            ("points for training", str(counts["training_points"])),
            show_labels.time_row(record),
        ],
    )
    show_labels.add_stage(record)
