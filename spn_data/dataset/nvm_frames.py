"""Cameras and map points of listed frames, taken from a VisualSFM model."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np

from spn_data.dataset.nvm import NvmModel
from spn_data.dataset.pose_agreement import same_poses
from spn_data.errors import GeometryError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses

_RADII = 400
_MAX_ERROR_PX = 0.1


class NvmFrames:
    """Lookup of N listed frames in an NVM model.

    Images are matched by name, or by path without suffix, because suffixes differ between lists and models of
    Cambridge Landmarks, or by the ending of the path, if that is unique in both. Points are used only if list
    and model agree on the pose.

    Parameters
    ----------
    model : NvmModel
        The model.
    names : sequence of str
        Names of the N frames.
    poses : Poses
        Poses of the frames in the list.
    is_training : ndarray of bool, shape (N,)
        Which frames are training frames.

    Attributes
    ----------
    is_known : ndarray of bool, shape (N,)
        Whether the model contains the image.
    has_points : ndarray of bool, shape (N,)
        Whether the model contains the image at the same pose.
    """

    def __init__(
        self, model: NvmModel, names: Sequence[str], poses: Poses, is_training: np.ndarray
    ):
        self._model, self._is_training = model, is_training
        self._image = match_names(names, model.names)
        self.is_known = self._image >= 0
        known = np.flatnonzero(self.is_known)
        self.has_points = np.zeros(len(names), dtype=bool)
        self.has_points[known] = same_poses(poses[known], model.poses[self._image[known]])
        self._by_image = np.argsort(model.image_idx, kind="stable")
        self._first = np.searchsorted(
            model.image_idx[self._by_image], np.arange(len(model.names) + 1)
        )
        trains = np.zeros(len(model.names), dtype=bool)
        trains[self._image[self.has_points & is_training]] = True
        # A point can be measured twice in an image.
        pairs = np.unique(
            np.stack([model.point_idx, model.image_idx])[:, trains[model.image_idx]], axis=1
        )
        self._training_frames = np.bincount(pairs[0], minlength=len(model.xyz))

    def focal_px(self, k: int) -> float:
        """Return the focal length of frame k, which is in the model."""
        return float(self._model.focal_px[self._image[k]])

    def model_poses(self, rows: np.ndarray) -> Poses:
        """Return the model's poses of frames that are in it."""
        return self._model.poses[self._image[rows]]

    def offsets(self, k: int) -> np.ndarray:
        """Return all measurements in frame k as pixels from the image centre, (M, 2)."""
        image = int(self._image[k])
        if image < 0:
            return np.zeros((0, 2))
        rows = self._by_image[self._first[image] : self._first[image + 1]]
        return np.asarray(self._model.offsets_px[rows])

    def camera(self, k: int, width: int, height: int) -> Camera | None:
        """Return the camera of frame k for the given image size; None if the frame is not in the model."""
        image = int(self._image[k])
        if image < 0:
            return None
        focal, distortion = self._model.focal_px[image], self._model.distortion[image]
        return camera_from_visualsfm(float(focal), float(distortion), width, height)

    def points(self, k: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return ids, pixels in the full-size image, and positions of the points seen by frame k.

        Ids are indices of the model's points. For a training frame, only points that at least one other
        training frame sees are returned.
        """
        if not self.has_points[k]:
            return np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 3))
        image = int(self._image[k])
        rows = self._by_image[self._first[image] : self._first[image + 1]]
        if self._is_training[k]:
            rows = rows[self._training_frames[self._model.point_idx[rows]] >= 2]
        ids = self._model.point_idx[rows]
        pixels = self._model.offsets_px[rows] + np.array([width / 2, height / 2])
        return ids, pixels, self._model.xyz[ids]


def camera_from_visualsfm(focal_px: float, distortion: float, width: int, height: int) -> Camera:
    """Convert VisualSFM intrinsics to a COLMAP camera with the principal point at the image centre.

    distortion : VisualSFM's r, which maps from the image to the undistorted ray:
    ray = (1 + r * |m|^2) * m with m = offset from the centre / focal_px. COLMAP's models map in the opposite
    direction. The result is SIMPLE_PINHOLE without distortion, otherwise RADIAL with k1, k2 fitted over the
    image. Raises GeometryError if the fit is worse than 0.1 px, or the distortion folds within the image.
    """
    center = (width / 2, height / 2)
    if not (np.isfinite([focal_px, distortion]).all() and focal_px > 0):
        raise GeometryError(
            f"focal length {focal_px:g} px and distortion {distortion:g} are not a valid camera"
        )
    if distortion == 0:
        return Camera("SIMPLE_PINHOLE", width, height, np.array([focal_px, *center]))
    measured = np.linspace(0, np.hypot(*center) / focal_px, _RADII)[1:]
    ray = measured * (1 + distortion * measured**2)
    if np.any(1 + 3 * distortion * measured**2 <= 0.05):
        raise GeometryError(f"a distortion of {distortion:g} folds the image onto itself")
    terms = np.stack([ray**3, ray**5], axis=1)
    k1, k2 = np.linalg.lstsq(terms, measured - ray, rcond=None)[0]
    error_px = focal_px * np.abs(ray + terms @ [k1, k2] - measured).max()
    if error_px > _MAX_ERROR_PX:
        raise GeometryError(
            f"a distortion of {distortion:g} is too strong: k1 and k2 leave {error_px:.2f} px"
        )
    return Camera("RADIAL", width, height, np.array([focal_px, *center, k1, k2]))


def match_names(names: Sequence[str], model_names: Sequence[str]) -> np.ndarray:
    """Find listed images in a model.

    Parameters
    ----------
    names : sequence of str
        N names of a list.
    model_names : sequence of str
        Names of the model's images; a backslash separates folders as "/" does, and VisualSFM's double
        quotation mark represents a space.

    Returns
    -------
    ndarray of int, shape (N,)
        Index in the model, -1 if there is none: the same name, otherwise the same path without suffix,
        otherwise a path without suffix of which one is the ending of the other. No image of the model is
        given to two names, and none is chosen if several match.
    """
    plain = [name.replace("\\", "/").replace('"', " ") for name in model_names]
    found = np.full(len(names), -1, dtype=np.int64)
    for listed, given in (
        (list(names), plain),
        ([_stem(name) for name in names], [_stem(name) for name in plain]),
    ):
        by_name = _rows_by(given)
        rows_of = _rows_by(listed)
        taken = set(found.tolist())
        for k, name in enumerate(listed):
            rows = [row for row in by_name.get(name, []) if row not in taken]
            if found[k] < 0 and len(rows) == 1 and len(rows_of[name]) == 1:
                found[k] = rows[0]
    _match_endings(found, [_stem(name) for name in names], [_stem(name) for name in plain])
    return found


def _match_endings(found: np.ndarray, stems: list[str], model_stems: list[str]) -> None:
    """Give names without an image those of the model whose path is the only one with the same ending."""
    taken = set(found.tolist())
    free = [row for row in range(len(model_stems)) if row not in taken]
    missing = [k for k in range(len(stems)) if found[k] < 0]
    by_end = _rows_by([PurePosixPath(model_stems[row]).name for row in free])
    candidates: dict[int, list[int]] = {}
    for k in missing:
        rows = [free[i] for i in by_end.get(PurePosixPath(stems[k]).name, [])]
        candidates[k] = [row for row in rows if _is_ending(stems[k], model_stems[row])]
    wanted: dict[int, int] = defaultdict(int)
    for rows in candidates.values():
        for row in rows:
            wanted[row] += 1
    for k, rows in candidates.items():
        if len(rows) == 1 and wanted[rows[0]] == 1:
            found[k] = rows[0]


def _is_ending(one: str, other: str) -> bool:
    short, long = sorted((f"/{one.strip('/')}", f"/{other.strip('/')}"), key=len)
    return long.endswith(short)


def _rows_by(names: list[str]) -> dict[str, list[int]]:
    rows: dict[str, list[int]] = defaultdict(list)
    for k, name in enumerate(names):
        rows[name].append(k)
    return rows


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix("")) if PurePosixPath(name).name else name
