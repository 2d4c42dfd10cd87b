"""Frames of a folder in the format of Cambridge Landmarks: lists, image files, and poses that are none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os.path import isfile
from pathlib import Path

import numpy as np

from spn_data.dataset.cambridge import (
    TEST_LIST,
    TRAIN_LIST,
    VALIDATION_LIST,
    CambridgeList,
    find_anomalies,
    position_outliers,
    read_cambridge,
)
from spn_data.dataset.hdf5_schema import Role
from spn_data.errors import InputError
from spn_data.geometry.pose import Poses
from spn_data.media.photo_file import PHOTO_SUFFIXES

LISTS = {
    Role.TRAIN: TRAIN_LIST,
    Role.VALIDATION: VALIDATION_LIST,
    Role.TEST: TEST_LIST,
}
# A DNG is another image than its JPEG: its lens is not corrected.
_SUFFIXES = [each for s in PHOTO_SUFFIXES if s != ".dng" for each in (s, s.upper())]
# Networks compute in float32: a coordinate has 24 bits.
_COARSE_SHARE = 1e-4  # of the frames' median distance from their middle, at least of one unit
_FAR_TIMES = 5.0


@dataclass(frozen=True, eq=False)
class ListedFrames:
    """N frames of all lists.

    Attributes
    ----------
    names : tuple of str
        Their names.
    roles : ndarray of str, shape (N,)
        Their roles.
    poses : Poses
        Their poses.
    files : tuple of Path or None
        Their image files, None if missing.
    """

    names: tuple[str, ...]
    roles: np.ndarray
    poses: Poses
    files: tuple[Path | None, ...]

    def select(self, index: np.ndarray) -> ListedFrames:
        """Return some of the frames, by their rows."""
        return ListedFrames(
            tuple(self.names[k] for k in index),
            self.roles[index],
            self.poses[index],
            tuple(self.files[k] for k in index),
        )


def read_listed_frames(
    folder: Path, *, keep_outliers: bool, subtract: tuple[float, float, float] = (0, 0, 0)
) -> tuple[ListedFrames, list[str]]:
    """Read the frames of all lists of a folder.

    Parameters
    ----------
    folder : Path
        Folder with `dataset_train.txt` and perhaps the other lists.
    keep_outliers : bool
        Whether to keep frames whose position is absurdly far from all others.
    subtract : tuple of float
        Offset to subtract from all positions.

    Returns
    -------
    frames : ListedFrames
        Frames with a pose and, if any image exists, with an image.
    notes : list of str
        One sentence on each anomaly.

    Raises
    ------
    InputError
        If a list is missing or damaged, an image is in two lists, or there is no training frame.
    """
    if not folder.is_dir():
        raise InputError("is not a folder", path=folder)
    lists = {
        role: _shifted(read_cambridge(folder / name), subtract)
        for role, name in LISTS.items()
        if role is Role.TRAIN or (folder / name).is_file()
    }
    notes = []
    if Role.TEST not in lists:
        notes.append(f"no {LISTS[Role.TEST]}: there are no frames to evaluate on")
    _check_unique(folder, lists)
    lists, failed = _without_failed(lists, -np.asarray(subtract, dtype=np.float64))
    notes += failed
    kept = []
    for role, found in lists.items():
        notes += [f"{LISTS[role]}: {sentence}" for sentence in find_anomalies(found)]
        far = position_outliers(found.poses.centers)
        if far.any() and not keep_outliers:
            names = [name for name, is_far in zip(found.names, far, strict=True) if is_far]
            notes.append(
                f"{first_name(names)}: left out because of its position; use --keep-outliers to keep it"
            )
        kept.append(_frames(folder, found, role, far & (not keep_outliers)))
    frames = ListedFrames(
        tuple(name for part in kept for name in part.names),
        np.concatenate([part.roles for part in kept]),
        Poses.concatenate(part.poses for part in kept),
        tuple(file for part in kept for file in part.files),
    )
    trained = frames.roles == Role.TRAIN
    if not trained.any():
        raise InputError("contains no training frame", path=folder / LISTS[Role.TRAIN])
    notes += _same_place(frames.poses[np.flatnonzero(trained)])
    return _without_missing_images(frames, notes), notes


def first_name(names: Sequence[str]) -> str:
    """Return the first name and the number of further ones."""
    return names[0] + (f" and {len(names) - 1} more" if len(names) > 1 else "")


def _shifted(listed: CambridgeList, subtract: tuple[float, float, float]) -> CambridgeList:
    poses = Poses(listed.poses.centers - np.array(subtract), listed.poses.quats_wxyz)
    return CambridgeList(listed.names, poses, listed.quats_as_read, listed.header)


def _check_unique(folder: Path, lists: dict[Role, CambridgeList]) -> None:
    listed: dict[str, str] = {}
    for role, found in lists.items():
        for name in found.names:
            if name in listed:
                raise InputError(f"{name} is also in {listed[name]}", path=folder / LISTS[role])
            listed[name] = LISTS[role]


def _without_failed(
    lists: dict[Role, CambridgeList], zero: np.ndarray
) -> tuple[dict[Role, CambridgeList], list[str]]:
    """Leave out frames exactly at the zero of the lists, where programs put frames that they failed on.

    One frame alone at zero may be the first of its world. It is kept, unless it is far from all others.
    """
    centers = np.concatenate([found.poses.centers for found in lists.values()])
    names = [name for found in lists.values() for name in found.names]
    at_zero = (centers == zero).all(axis=1)
    if not at_zero.any() or at_zero.all():
        return lists, []
    first = first_name([names[k] for k in np.flatnonzero(at_zero)])
    if at_zero.sum() == 1 and not _is_far(centers[at_zero][0], centers[~at_zero]):
        return lists, [
            f"{first}: its position is 0 0 0; it is kept, as other frames are near, but check that its pose "
            "did not fail"
        ]
    kept = {
        role: found.select(np.flatnonzero(~(found.poses.centers == zero).all(axis=1)))
        for role, found in lists.items()
    }
    return kept, [f"{first}: left out because the position is exactly 0 0 0, as of a failed frame"]


def _is_far(center: np.ndarray, others: np.ndarray) -> bool:
    """Return whether a centre is far from all others, compared with the usual step from one to the next."""
    steps = np.linalg.norm(np.diff(others, axis=0), axis=1)
    usual = float(np.median(steps)) if len(steps) else 0.0
    return bool(np.linalg.norm(others - center, axis=1).min() > _FAR_TIMES * usual)


def far_offset(centers: np.ndarray) -> tuple[float, float, float]:
    """Return an offset for positions that float32 resolves too coarsely (UTM, Earth-centred); else zeros."""
    middle = np.median(centers, axis=0)
    spread = float(np.median(np.linalg.norm(centers - middle, axis=1)))
    step = float(np.spacing(np.float32(np.abs(middle).max())))
    if step > _COARSE_SHARE * max(spread, 1.0):
        digits = -int(np.floor(np.log10(max(spread, 1.0))))
        x, y, z = np.round(middle, digits).tolist()
        return x, y, z
    return 0.0, 0.0, 0.0


def _same_place(poses: Poses) -> list[str]:
    """Return a note if all frames are at one place."""
    if len(poses) < 2 or np.ptp(poses.centers, axis=0).max() > 0:
        return []
    what = "poses" if np.ptp(poses.quats_wxyz, axis=0).max() == 0 else "positions"
    return [
        f"{LISTS[Role.TRAIN]}: all {len(poses)} {what} are equal, so a network cannot learn a position from "
        "them; check the columns of the list"
    ]


def _frames(folder: Path, found: CambridgeList, role: Role, dropped: np.ndarray) -> ListedFrames:
    files = tuple(_image_file(folder, name) for name in found.names)
    roles = np.full(len(found), role.value)
    return ListedFrames(found.names, roles, found.poses, files).select(np.flatnonzero(~dropped))


def _image_file(folder: Path, name: str) -> Path | None:
    """Return the listed image file, or the same image converted to another format; None if missing."""
    path = folder / name
    candidates = [path, *(path.with_suffix(suffix) for suffix in _SUFFIXES)]
    return next((candidate for candidate in candidates if isfile(candidate)), None)


def _without_missing_images(frames: ListedFrames, notes: list[str]) -> ListedFrames:
    exists = np.array([file is not None for file in frames.files], dtype=bool)
    if not exists.any():
        notes.append(
            "none of the listed images exists: the data set has only poses and cannot be used for training"
        )
        return frames
    if not exists.all():
        missing = [name for name, found in zip(frames.names, exists, strict=True) if not found]
        notes.append(f"{first_name(missing)}: left out because the image is missing")
    return frames.select(np.flatnonzero(exists))
