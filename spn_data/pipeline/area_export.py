"""Export of an area's labels in other programs' formats."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.area.area import Area
from spn_data.errors import GeometryError, StageError
from spn_data.exports.colmap_export import IMAGE_FOLDER as COLMAP_IMAGES
from spn_data.exports.colmap_export import write_colmap
from spn_data.exports.exported_frames import ExportedFrames
from spn_data.exports.geojson import write_geojson
from spn_data.exports.kapture import IMAGE_FOLDER as KAPTURE_IMAGES
from spn_data.exports.kapture import write_kapture
from spn_data.exports.kml import write_kml
from spn_data.exports.nerfstudio import IMAGE_FOLDER as NERFSTUDIO_IMAGES
from spn_data.exports.nerfstudio import write_nerfstudio
from spn_data.exports.nvm_export import write_nvm_export
from spn_data.exports.tum import write_tum
from spn_data.inputs.area_labels import LabelledArea, map_folder, merge_labels, read_labelled_area
from spn_data.inputs.frame_images import image_path
from spn_data.pipeline.area_orthophoto import NoOrthophotoError, write_orthophoto
from spn_data.storage.files import replace_folder
from spn_data.storage.json_files import VERSION, write_json

RECORD = "export.json"


class Format(StrEnum):
    """Export formats; ALL writes one folder for each format that the area allows."""

    TUM = "tum"
    NERFSTUDIO = "nerfstudio"
    KAPTURE = "kapture"
    GEOJSON = "geojson"
    KML = "kml"
    COLMAP_TEXT = "colmap-text"
    COLMAP = "colmap"
    NVM = "nvm"
    GEOTIFF = "geotiff"
    ALL = "all"


# Formats that list images, with the subfolder in which they are expected.
_IMAGES = {
    Format.NERFSTUDIO: NERFSTUDIO_IMAGES,
    Format.KAPTURE: KAPTURE_IMAGES,
    Format.COLMAP_TEXT: COLMAP_IMAGES,
    Format.COLMAP: COLMAP_IMAGES,
}
_NEED_ORIGIN = (Format.GEOJSON, Format.KML, Format.GEOTIFF)
_WITH_MAP = (Format.COLMAP_TEXT, Format.COLMAP)  # contain the whole map, whatever is selected
_WITH_TRACKED = (Format.TUM, Format.GEOJSON, Format.KML)


@dataclass(frozen=True, kw_only=True)
class LabelExportOptions:
    """Options of an export.

    Attributes
    ----------
    sequences : tuple of str
        Sequences to export; empty for all. COLMAP models always contain all mapping frames.
    all_frames : bool
        Whether to include tracked frames, in formats that do not list images.
    images : bool
        Whether to copy the images that a format lists.
    """

    sequences: tuple[str, ...] = ()
    all_frames: bool = False
    images: bool = True


@dataclass(frozen=True, kw_only=True)
class ExportedLabels:
    """Result of an export.

    Attributes
    ----------
    units : str
        "m" or "model".
    frames : dict of str to int
        Number of frames by sequence.
    formats : tuple of str
        Formats that were written.
    left_out : dict of str to str
        Formats that were left out, with the reason.
    notes : tuple of str
        What to know about what was written.
    """

    units: str
    frames: dict[str, int]
    formats: tuple[str, ...]
    left_out: dict[str, str]
    notes: tuple[str, ...] = ()


def export(
    area: Area,
    format_name: Format,
    target: Path,
    options: LabelExportOptions,
    *,
    overwrite: bool = False,
) -> ExportedLabels:
    """Write the registered frames to a folder, atomically.

    Parameters
    ----------
    area : Area
    format_name : Format
    target : Path
    options : LabelExportOptions
    overwrite : bool
        Whether an earlier export in `target` may be replaced.

    Returns
    -------
    ExportedLabels

    Raises
    ------
    StageError
        If `target` contains something else, no frame has a pose, a sequence is unknown, or the format needs
        a georegistered map but the area has none.
    """
    target = Path(os.path.abspath(target))
    check_target(area, target, overwrite=overwrite)
    labelled = read_labelled_area(area)
    wanted = [f for f in Format if f != Format.ALL] if format_name == Format.ALL else [format_name]
    left_out: dict[str, str] = {}
    notes: tuple[str, ...] = ()
    if format_name == Format.ALL and labelled.origin is None:
        left_out = {f.value: "it needs a georegistered map" for f in _NEED_ORIGIN}
        wanted = [f for f in wanted if f not in _NEED_ORIGIN]
    if options.all_frames and format_name != Format.ALL and format_name not in _WITH_TRACKED:
        raise StageError(
            f"{format_name.value} lists images, but frames added by --all-frames exist only in their "
            f"video; use --all-frames with {', '.join(f.value for f in _WITH_TRACKED)}"
        )
    partial = target.with_name(f".{target.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        counts: dict[str, int] = {}
        for one in wanted:
            folder = partial / one.value if format_name == Format.ALL else partial
            tracked = options.all_frames and one in _WITH_TRACKED
            frames = select_frames(
                labelled, options.sequences, tracked=tracked, whole_map=one in _WITH_MAP
            )
            counts = {name: len(rows) for name, rows in frames.sequences()}
            try:
                notes += _write(area, one, folder, frames, images=options.images)
            except (NoOrthophotoError, GeometryError) as error:
                # An area may be without ground, which the other formats do not need.
                if format_name != Format.ALL or one != Format.GEOTIFF:
                    raise
                shutil.rmtree(folder)
                left_out[one.value] = f"cannot be made: {error}"
        if format_name == Format.ALL:
            write_json(partial / RECORD, {"version": VERSION, "format": Format.ALL.value})
        replace_folder(partial, target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return ExportedLabels(
        units=labelled.units,
        frames=counts,
        formats=tuple(f.value for f in wanted if f.value not in left_out),
        left_out=left_out,
        notes=notes,
    )


def check_target(area: Area, target: Path, *, overwrite: bool) -> None:
    """Raise StageError unless the folder is empty, or an earlier export that may be replaced."""
    inside = target.resolve()
    if inside == area.root.resolve() or any(
        area.folder(stage.partition("/")[0]).resolve() in (inside, *inside.parents)
        for stage in area.stages()
    ):
        raise StageError(f"{target} is part of the area; choose another folder with --to")
    if target.is_symlink() or (target.exists() and not target.is_dir()):
        raise StageError(f"{target} is not a folder; choose another with --to")
    if not target.exists() or not any(target.iterdir()):
        return
    if not (target / RECORD).is_file():
        raise StageError(f"{target} contains other files; choose another folder with --to")
    if not overwrite:
        raise StageError(f"{target} already contains an export; use --overwrite to replace it")


def select_frames(
    labelled: LabelledArea,
    sequences: Sequence[str],
    *,
    tracked: bool = False,
    whole_map: bool = False,
) -> ExportedFrames:
    """Select frames with a pose, sorted by sequence and time.

    Parameters
    ----------
    labelled : LabelledArea
    sequences : sequence of str
        Sequences to include; empty for all.
    tracked : bool
        Whether to include tracked frames.
    whole_map : bool
        Whether to include all mapping frames, also those of other sequences.

    Returns
    -------
    ExportedFrames

    Raises
    ------
    StageError
        If a sequence is unknown, or no frame has a pose.
    """
    known = sorted({s for labels, _ in labelled.parts() for s in labels.sequences.tolist()})
    for name in sequences:
        if name not in known:
            raise StageError(f"there is no sequence {name!r}; the area has: {', '.join(known)}")
    kept = []
    for labels, seen in labelled.parts():
        mask = labels.registered & (tracked | ~labels.tracked)
        if sequences:
            in_map = whole_map & ~np.isin(labels.sequences, list(labelled.evaluation))
            mask &= in_map | np.isin(labels.sequences, list(sequences))
        rows = np.flatnonzero(mask)
        kept.append((labels.select(rows), seen.select(rows)))
    labels, seen = merge_labels(kept)
    if len(labels) == 0:
        raise StageError("no frame of " + (", ".join(sequences) or "the area") + " has a pose")
    return ExportedFrames(
        units=labelled.units,
        origin=labelled.origin,
        labels=labels,
        is_evaluation=np.isin(labels.sequences, list(labelled.evaluation)),
        seen=seen,
        points=labelled.points,
        cameras=labelled.cameras,
    )


def _write(
    area: Area, one: Format, folder: Path, frames: ExportedFrames, *, images: bool
) -> tuple[str, ...]:
    """Write one format to a new folder, and return what to know about it."""
    folder.mkdir(parents=True)
    writers: dict[Format, Callable[[Path, ExportedFrames], None]] = {
        Format.TUM: write_tum,
        Format.NERFSTUDIO: write_nerfstudio,
        Format.KAPTURE: write_kapture,
        Format.GEOJSON: write_geojson,
        Format.KML: write_kml,
        Format.NVM: write_nvm_export,
    }
    more: dict[str, Any] = {}
    notes: tuple[str, ...] = ()
    if one in writers:
        writers[one](folder, frames)
    elif one == Format.GEOTIFF:
        orthophoto = write_orthophoto(area, folder, frames)
        more, notes = {"orthophoto": orthophoto.plain()}, orthophoto.notes()
    else:
        write_colmap(folder, frames, map_folder(area), text=one == Format.COLMAP_TEXT)
    if images and one in _IMAGES:
        _copy_images(area, folder / _IMAGES[one], frames)
    write_json(folder / RECORD, {"version": VERSION, **_record(area, one, frames), **more})
    return notes


def _copy_images(area: Area, folder: Path, frames: ExportedFrames) -> None:
    for name, sequence in zip(
        frames.labels.names.tolist(), frames.labels.sequences.tolist(), strict=True
    ):
        (folder / sequence).mkdir(parents=True, exist_ok=True)
        shutil.copyfile(image_path(area, name, sequence), folder / name)


def _record(area: Area, one: Format, frames: ExportedFrames) -> dict[str, Any]:
    """Return a description of the export, for facts that the format itself cannot express."""
    origin = frames.origin
    return {
        "format": one.value,
        "units": frames.units,
        "origin": None if origin is None else origin.plain(),
        "sequences": {
            name: {
                "frames": len(rows),
                "role": "evaluation" if frames.is_evaluation[rows[0]] else "mapping",
            }
            for name, rows in frames.sequences()
        },
        "made_of": {stage: area.record(stage).fingerprint() for stage in area.stages()},
    }
