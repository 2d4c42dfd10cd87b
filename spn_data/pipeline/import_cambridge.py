"""Import of a folder in the format of Cambridge Landmarks: lists, images, reconstruction.nvm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from spn_data.capture.photos import decode_photo
from spn_data.dataset.cambridge import (
    NVM,
    TEST_LIST,
    TRAIN_LIST,
    VALIDATION_LIST,
    CambridgeList,
    find_anomalies,
    position_outliers,
    read_cambridge,
)
from spn_data.dataset.hdf5_schema import DatasetFrame, DatasetInfo, Role
from spn_data.dataset.hdf5_writer import DatasetWriter
from spn_data.dataset.nvm import read_nvm
from spn_data.dataset.nvm_frames import NvmFrames
from spn_data.errors import GeometryError, InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.geometry.rendering import PinholeRenderer, RenderingOptions, canonical_camera
from spn_data.storage.fingerprints import content_fingerprint
from spn_data.work.timing import Progress

LISTS = {
    Role.TRAIN: TRAIN_LIST,
    Role.VALIDATION: VALIDATION_LIST,
    Role.TEST: TEST_LIST,
}
_NOT_GEOREFERENCED = (
    "the lists are not georeferenced (unknown origin and up direction), so the poses cannot be used for "
    "navigation"
)
_SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")


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
    """

    width_px: int = 480
    units: str = "m"
    keep_outliers: bool = False


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


@dataclass(frozen=True, eq=False)
class _Frames:
    """N frames of all lists: names, (N,) roles, poses, image files (None if missing)."""

    names: tuple[str, ...]
    roles: np.ndarray
    poses: Poses
    files: tuple[Path | None, ...]

    def select(self, index: np.ndarray) -> _Frames:
        return _Frames(
            tuple(self.names[k] for k in index),
            self.roles[index],
            self.poses[index],
            tuple(self.files[k] for k in index),
        )


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
        If a list is missing or damaged, or `target` exists and `overwrite` is false.
    """
    if target.suffix.lower() not in (".h5", ".hdf5") or target.is_dir():
        raise InputError("is not the name of an HDF5 file; it must end in .h5", path=target)
    if target.exists() and not overwrite:
        raise InputError("already exists; use --overwrite to replace it", path=target)
    frames, notes = _read_lists(folder, options)
    if not (frames.roles == Role.TRAIN).any():
        raise InputError("contains no training frame", path=folder / LISTS[Role.TRAIN])
    model = None
    if (folder / NVM).is_file():
        is_training = frames.roles == Role.TRAIN
        model = NvmFrames(read_nvm(folder / NVM), frames.names, frames.poses, is_training)
        notes += _model_notes(frames, model)
    else:
        notes.append(f"no {NVM}: focal lengths are unknown and there are no map points")
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
    )
    groups = {role.value: role for role in LISTS if (folder / LISTS[role]).is_file()}
    counts = dict.fromkeys(groups, 0)
    with_focal = 0
    with DatasetWriter(target, info, groups) as writer:
        for k in range(len(frames.names)):
            progress("images" if has_images else "poses", k, len(frames.names))
            frame = _frame(frames, k, model, options)
            writer.append(str(frames.roles[k]), frame)
            counts[str(frames.roles[k])] += 1
            with_focal += bool(np.isfinite(frame.intrinsics).all())
        progress("images" if has_images else "poses", len(frames.names), len(frames.names))
    return Imported(counts, has_images, with_focal, tuple(notes))


def _read_lists(folder: Path, options: ImportOptions) -> tuple[_Frames, list[str]]:
    """Read the frames of all lists; return them with notes on anomalies."""
    if not folder.is_dir():
        raise InputError("is not a folder", path=folder)
    lists = {
        role: read_cambridge(folder / name)
        for role, name in LISTS.items()
        if role is Role.TRAIN or (folder / name).is_file()
    }
    notes = [_NOT_GEOREFERENCED]
    if Role.TEST not in lists:
        notes.append(f"no {LISTS[Role.TEST]}: there are no frames to evaluate on")
    listed: dict[str, str] = {}
    kept = []
    for role, found in lists.items():
        for name in found.names:
            if name in listed:
                raise InputError(f"{name} is also in {listed[name]}", path=folder / LISTS[role])
            listed[name] = LISTS[role]
        notes += [f"{LISTS[role]}: {sentence}" for sentence in find_anomalies(found)]
        far = position_outliers(found.poses.centers)
        if far.any() and not options.keep_outliers:
            names = [name for name, is_far in zip(found.names, far, strict=True) if is_far]
            notes.append(
                f"{_first_name(names)}: left out because of its position; use --keep-outliers to keep it"
            )
        kept.append(_frames(folder, found, role, far & (not options.keep_outliers)))
    frames = _Frames(
        tuple(name for part in kept for name in part.names),
        np.concatenate([part.roles for part in kept]),
        Poses.concatenate(part.poses for part in kept),
        tuple(file for part in kept for file in part.files),
    )
    return _without_missing_images(frames, notes), notes


def _frames(folder: Path, found: CambridgeList, role: Role, dropped: np.ndarray) -> _Frames:
    files = tuple(_image_file(folder, name) for name in found.names)
    roles = np.full(len(found), role.value)
    return _Frames(found.names, roles, found.poses, files).select(np.flatnonzero(~dropped))


def _image_file(folder: Path, name: str) -> Path | None:
    """Return the listed image file, or the same image converted to another format; None if missing."""
    path = folder / name
    candidates = [path, *(path.with_suffix(suffix) for suffix in _SUFFIXES)]
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def _without_missing_images(frames: _Frames, notes: list[str]) -> _Frames:
    exists = np.array([file is not None for file in frames.files], dtype=bool)
    if not exists.any():
        notes.append(
            "none of the listed images exists: the data set has only poses and cannot be used for training"
        )
        return frames
    if not exists.all():
        missing = [name for name, found in zip(frames.names, exists, strict=True) if not found]
        notes.append(f"{_first_name(missing)}: left out because the image is missing")
    return frames.select(np.flatnonzero(exists))


def _model_notes(frames: _Frames, model: NvmFrames) -> list[str]:
    notes = []
    for rows, what in (
        (~model.is_known, f"not in {NVM}, so the focal length is unknown"),
        (
            model.is_known & ~model.has_points,
            f"the pose in {NVM} is different, so its map points are left out",
        ),
    ):
        if rows.any():
            notes.append(f"{_first_name([frames.names[k] for k in np.flatnonzero(rows)])}: {what}")
    return notes


def _frame(
    frames: _Frames, k: int, model: NvmFrames | None, options: ImportOptions
) -> DatasetFrame:
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
    image = decode_photo(file)
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


def _first_name(names: Sequence[str]) -> str:
    """Return the first name and the number of further ones."""
    return names[0] + (f" and {len(names) - 1} more" if len(names) > 1 else "")
