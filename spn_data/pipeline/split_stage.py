"""Stage 5-split: frames split into groups, as dataset.h5 and in the format of Cambridge Landmarks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.area.area import Area, StageWork
from spn_data.area.names import AUDIT, CAMBRIDGE, DATASET, FRAMES, MASKS, SPLIT, SPLIT_FILE
from spn_data.dataset.hdf5_schema import DatasetInfo, Role
from spn_data.dataset.hdf5_writer import DatasetWriter
from spn_data.errors import GeometryError
from spn_data.geometry.camera import Camera
from spn_data.inputs.area_labels import LabelledArea, read_labelled_area
from spn_data.inputs.cambridge_contents import CambridgeFolder
from spn_data.inputs.dataset_contents import (
    GroupedFrames,
    RenderedFrames,
    group_frames,
    target_cameras,
)
from spn_data.inputs.frame_images import frame_images
from spn_data.pipeline.area_audit import audit_folder, write_audit
from spn_data.split.audit import AuditFinding, AuditVerdict
from spn_data.split.groups import LEFT_OUT, OPTIMISTIC, TRAIN, VALIDATION, Split, SplitOptions
from spn_data.split.holdout import make_split
from spn_data.split.split_file import write_split
from spn_data.storage.stage_record import StageRecord
from spn_data.work.timing import Progress, Stopwatch


class CambridgeFrames(StrEnum):
    """Frames to write to cambridge/, where images have full size."""

    CHOSEN = "chosen"
    ALL = "all"
    NONE = "none"


@dataclass(frozen=True, kw_only=True)
class SplitStageOptions:
    """Options of the split and of the images in the data set.

    Attributes
    ----------
    split : SplitOptions
    native : bool
        Whether images of each lens are undistorted to its own field of view, instead of a common one.
    width_px : int or None
        Width of images in dataset.h5. None: 480, or that of the lens if `native`.
    cambridge : CambridgeFrames
        Frames to write to cambridge/.
    """

    split: SplitOptions = field(default_factory=SplitOptions)
    native: bool = False
    width_px: int | None = None
    cambridge: CambridgeFrames = CambridgeFrames.CHOSEN


def split_area(
    area: Area,
    options: SplitStageOptions,
    progress: Progress,
    *,
    video_folder: Path | None = None,
    overwrite: bool = False,
) -> StageRecord:
    """Split the frames of an area, write the data set for training, and audit it.

    Parameters
    ----------
    area : Area
    options : SplitStageOptions
    progress : Progress
    video_folder : Path or None
        Where to look first for the videos of tracked frames.
    overwrite : bool
        Whether a split with other options may be replaced.

    Returns
    -------
    StageRecord

    Raises
    ------
    GeometryError
        If a group would be empty.
    StageError
        If a stage is missing or stale, or a video is not found.
    """
    work = area.begin(SPLIT, asdict(options), {}, overwrite=overwrite)
    if isinstance(work, StageRecord):
        return work
    try:
        return _split(area, work, options, video_folder, progress)
    except GeometryError:
        work.discard()  # nothing in it could be reused
        raise


def _split(
    area: Area,
    work: StageWork,
    options: SplitStageOptions,
    video_folder: Path | None,
    progress: Progress,
) -> StageRecord:
    stopwatch = Stopwatch()
    with stopwatch.step("divide"):
        labelled = read_labelled_area(area)
        split = make_split(
            labelled.mapping,
            labelled.tracked,
            labelled.evaluation,
            options.split,
            metric=labelled.units == "m",
        )
        write_split(work.path / SPLIT_FILE, split)
        frames = group_frames(labelled, split)
    with stopwatch.step("images"):
        targets = target_cameras(
            labelled, frames.labels, native=options.native, width_px=options.width_px
        )
        rendered = RenderedFrames(labelled, frames, targets, area.folder(FRAMES) / MASKS)
        images = frame_images(area, frames.labels, video_folder=video_folder)
        info = _info(
            area, labelled, split, None if options.native else next(iter(targets.values()))
        )
        _write_files(
            work.path, labelled, frames, rendered, images, info, options.cambridge, progress
        )
    with stopwatch.step("audit"):
        findings = audit_folder(area, labelled, work.path)
        write_audit(work.path / AUDIT, findings)
    return work.finish(
        counts={
            "groups": split.counts(),
            "left_out": int((split.group == LEFT_OUT).sum()),
            "optimistic": split.optimistic,
            "training_points": len(frames.for_training),
            "image_px": _sizes(targets),
            "audit": {v.value: sum(f.verdict is v for f in findings) for v in AuditVerdict},
        },
        seconds=stopwatch.seconds,
        cpu_seconds=stopwatch.cpu_seconds,
        notes=(*_notes(split), *_failures(findings)),
    )


def _write_files(
    folder: Path,
    labelled: LabelledArea,
    frames: GroupedFrames,
    rendered: RenderedFrames,
    images: Iterator[tuple[int, np.ndarray]],
    info: DatasetInfo,
    which: CambridgeFrames,
    progress: Progress,
) -> None:
    """Write dataset.h5 and cambridge/ in one pass over the images, without keeping them in memory."""
    labels = frames.labels
    listed = np.full(len(labels), which is not CambridgeFrames.NONE)
    if which is CambridgeFrames.CHOSEN:
        listed = ~labels.tracked
    cambridge = CambridgeFolder(folder / CAMBRIDGE, labelled.cameras)
    roles = {name: _role(name) for name in frames.split.groups()}
    with DatasetWriter(folder / DATASET, info, roles) as writer:
        for done, (row, image) in enumerate(images):
            progress("images", done, len(labels))
            writer.append(str(frames.group[row]), rendered.frame(row, image))
            if listed[row]:
                cambridge.add_image(str(labels.names[row]), str(labels.cameras[row]), image)
        progress("images", len(labels), len(labels))
    if listed.any():
        cambridge.finish(frames, np.flatnonzero(listed), labelled.points)


def _info(area: Area, labelled: LabelledArea, split: Split, camera: Camera | None) -> DatasetInfo:
    return DatasetInfo(
        units=labelled.units,
        origin=labelled.origin,
        up_is_known=labelled.units == "m",
        camera=camera,
        optimistic=split.optimistic,
        split=asdict(split.options),
        fingerprints=area.upstream_of(SPLIT),
        notes=_notes(split),
    )


def _notes(split: Split) -> tuple[str, ...]:
    return (*((OPTIMISTIC,) if split.optimistic else ()), *split.notes)


def _role(group: str) -> Role:
    return {TRAIN: Role.TRAIN, VALIDATION: Role.VALIDATION}.get(group, Role.TEST)


def _sizes(targets: dict[str, Camera]) -> list[Any]:
    return sorted({(camera.width, camera.height) for camera in targets.values()})


def _failures(findings: tuple[AuditFinding, ...]) -> list[str]:
    return [f"audit: {f.check}: {f.text}" for f in findings if f.verdict is AuditVerdict.FAIL]
