"""Import of a folder in the format of Cambridge Landmarks: lists, images, reconstruction.nvm."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from spn_data.capture.photos import decode_photo
from spn_data.dataset.cambridge import NVM
from spn_data.dataset.hdf5_schema import DatasetFrame, DatasetInfo, Role
from spn_data.dataset.hdf5_writer import DatasetWriter
from spn_data.dataset.image_copies import ImageChecks
from spn_data.errors import GeometryError, InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import position_text
from spn_data.geometry.rendering import PinholeRenderer, RenderingOptions, canonical_camera
from spn_data.inputs.cambridge_frames import LISTS, far_offset, first_name, read_listed_frames
from spn_data.inputs.cambridge_model import OpenedFrames, check_sizes, read_model
from spn_data.storage.fingerprints import content_fingerprint
from spn_data.work.timing import Progress

_NOT_GEOREFERENCED = (
    "the lists are not georeferenced (unknown origin and up direction), so the poses cannot be used for "
    "navigation"
)


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """Options of the import.

    Attributes
    ----------
    width_px : int
        Width of the images in dataset.h5; the height follows.
    units : str
        Unit of the positions in the lists: "m", or "model" if it is unknown.
    keep_outliers : bool
        Whether to keep frames whose position is absurdly far from all others.
    subtract : tuple of float
        Offset to subtract from all positions, such as (563200, 5934700, 300) for UTM coordinates.
    """

    width_px: int = 480
    units: str = "m"
    keep_outliers: bool = False
    subtract: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Imported:
    """Result of an import.

    Attributes
    ----------
    counts : dict of str to int
        Number of frames by group.
    has_images : bool
    with_focal : int
        Number of frames with known intrinsics.
    notes : tuple of str
    """

    counts: dict[str, int]
    has_images: bool
    with_focal: int
    notes: tuple[str, ...]


def import_cambridge(
    folder: Path,
    target: Path,
    options: ImportOptions,
    progress: Progress,
    *,
    overwrite: bool = False,
) -> Imported:
    """Write a data set from dataset_train.txt and, if present, the other lists, images and NVM model.

    Images are resized to the width of the options and undistorted by the NVM model. They are not cropped to
    a common field of view, because VisualSFM estimates one focal length per image.

    Parameters
    ----------
    folder : Path
        Folder with the lists.
    target : Path
        HDF5 file to write.
    options : ImportOptions
    progress : Progress
    overwrite : bool
        Whether `target` may be replaced.

    Returns
    -------
    Imported

    Raises
    ------
    InputError
        If a list, an image or the model is missing or damaged, if list and model disagree on nearly all
        poses, if the model was made of images of another size, if a test image is a copy of a training image,
        or if `target` exists and `overwrite` is false.
    """
    if target.suffix.lower() not in (".h5", ".hdf5") or target.is_dir():
        raise InputError("is not the name of an HDF5 file; it must end in .h5", path=target)
    if target.exists() and not overwrite:
        raise InputError("already exists; use --overwrite to replace it", path=target)
    frames, notes = read_listed_frames(
        folder, keep_outliers=options.keep_outliers, subtract=options.subtract
    )
    notes.insert(0, _NOT_GEOREFERENCED)
    if any(options.subtract):
        notes.append(
            f"{position_text(options.subtract)} was subtracted from all positions: add it to every position"
        )
    offset = far_offset(frames.poses.centers[frames.roles == Role.TRAIN])
    if any(offset):
        notes.append(
            "the positions are far from zero: the file stores them relative to the offset "
            f"{position_text(offset)}, and poses that a network estimates include the offset again"
        )
    model, model_notes = read_model(folder, frames, options.subtract)
    opened, size_notes = check_sizes(folder, frames, model, options.width_px)
    notes += model_notes + size_notes
    has_images = any(file is not None for file in frames.files)
    info = DatasetInfo(
        units=options.units,
        origin=None,
        up_is_known=False,
        camera=None,
        has_images=has_images,
        split={"lists": [name for name in LISTS.values() if (folder / name).is_file()]},
        fingerprints={
            name: content_fingerprint(folder / name)
            for name in (*LISTS.values(), NVM)
            if (folder / name).is_file()
        },
        notes=tuple(notes),
        offset=offset,
    )
    groups = {role.value: role for role in LISTS if (folder / LISTS[role]).is_file()}
    counts = dict.fromkeys(groups, 0)
    with_focal, checks = 0, ImageChecks()
    with DatasetWriter(target, info, groups) as writer:
        for k in range(len(frames.names)):
            progress("images" if has_images else "poses", k, len(frames.names))
            frame = _frame(opened, k, options, checks)
            writer.append(str(frames.roles[k]), frame)
            counts[str(frames.roles[k])] += 1
            with_focal += bool(np.isfinite(frame.intrinsics).all())
        image_notes = _image_notes(checks)
        writer.add_notes(image_notes)
        progress("images" if has_images else "poses", len(frames.names), len(frames.names))
    return Imported(counts, has_images, with_focal, (*notes, *image_notes))


def _image_notes(checks: ImageChecks) -> list[str]:
    """Return notes on images without texture and on images that are the same."""
    notes = []
    if checks.bare:
        notes.append(
            f"{first_name(checks.bare)}: the image is nearly black, white or without texture, so a network "
            "can learn nothing from it (12-bit images in 16-bit files have to be brightened)"
        )
    for pairs, what in (
        (checks.repeated, "has the same pixels as"),
        (checks.lookalikes(), "looks the same as the training image"),
    ):
        if pairs:
            more = f"; {len(pairs) - 1} more such images" if len(pairs) > 1 else ""
            notes.append(f"{pairs[0][0]}: {what} {pairs[0][1]}{more}")
    return notes


def _frame(
    opened: OpenedFrames, k: int, options: ImportOptions, checks: ImageChecks
) -> DatasetFrame:
    frames, model = opened.frames, opened.model
    name, file = frames.names[k], frames.files[k]
    sequence = str(PurePosixPath(name).parent)
    frame = DatasetFrame(
        name=name,
        sequence="" if sequence == "." else sequence,
        time_s=np.nan,
        center=frames.poses.centers[k],
        quat_wxyz=frames.poses.quats_wxyz[k],
        intrinsics=np.full((3, 3), np.nan),
    )
    if file is None:
        return frame
    image = decode_photo(file, upright=bool(opened.upright[k]))
    role = Role(str(frames.roles[k]))
    copied = checks.add(name, role, image)
    if copied:
        raise InputError(
            f"is a copy of {copied}, which is in another list: networks must not be tested on training "
            f"images; remove {name} from {LISTS[role]}",
            path=file,
        )
    height, width = image.shape[:2]
    try:
        camera = None if model is None else model.camera(k, width, height)
    except GeometryError as error:
        raise InputError(
            f"its lens in {NVM} cannot be used: {error}; remove that file to use the images as they are",
            path=file,
        ) from error
    # Any focal length will do to resize an image whose focal length is unknown.
    assumed = Camera.from_horizontal_fov(width, height, 60.0)
    renderer = _renderer(_Key(assumed if camera is None else camera), options.width_px)
    frame = replace(frame, image=cv2.cvtColor(renderer.render(image), cv2.COLOR_BGR2RGB))
    if camera is None or model is None:
        return frame
    ids, pixels, xyz = model.points(k, width, height)
    moved, is_seen = renderer.map_pixels(pixels)
    return replace(
        frame,
        intrinsics=renderer.target.matrix,
        point_ids=ids[is_seen],
        point_pixels=moved[is_seen],
        point_xyz=xyz[is_seen],
    )


class _Key:
    """Hashable camera, compared by value, as the key of cached renderers."""

    def __init__(self, camera: Camera):
        self.camera = camera
        self._values = (camera.model, camera.width, camera.height, camera.params.tobytes())

    def __hash__(self) -> int:
        return hash(self._values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self._values == other._values


@lru_cache(maxsize=4)
def _renderer(key: _Key, width_px: int) -> PinholeRenderer:
    camera = key.camera
    return PinholeRenderer(camera, canonical_camera([camera], RenderingOptions(width_px=width_px)))
