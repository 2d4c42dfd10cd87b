"""Cameras and map points of listed frames, taken from a VisualSFM model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np

from spn_data.dataset.nvm import NvmModel
from spn_data.errors import GeometryError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses, pose_errors

_RADII = 400
_MAX_ERROR_PX = 0.1
# If poses of list and model differ by more, they refer to different worlds, or to different versions of one.
_SAME_POSITION_SHARE = 1e-3  # of the frames' median distance from their middle
_SAME_ROTATION_DEG = 0.1


class NvmFrames:
    """Lookup of N listed frames in an NVM model.

    Images are matched by name, or by path without suffix, because suffixes differ between lists and models of
    Cambridge Landmarks. Points are used only if list and model agree on the pose.

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
        by_name = {name: k for k, name in enumerate(model.names)}
        by_stem = {_stem(name): k for k, name in enumerate(model.names)}
        self._image = np.array(
            [by_name.get(name, by_stem.get(_stem(name), -1)) for name in names], dtype=np.int64
        )
        self.is_known = self._image >= 0
        known = np.flatnonzero(self.is_known)
        self.has_points = np.zeros(len(names), dtype=bool)
        self.has_points[known] = _same_poses(poses[known], model.poses[self._image[known]])
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


def _same_poses(poses: Poses, others: Poses) -> np.ndarray:
    """Return a mask (N,) of poses that agree."""
    if not len(poses):
        return np.zeros(0, dtype=bool)
    distance, angle_deg = pose_errors(others, poses)
    spread = np.median(np.linalg.norm(poses.centers - np.median(poses.centers, axis=0), axis=1))
    same = (distance <= _SAME_POSITION_SHARE * spread + 1e-5) & (angle_deg <= _SAME_ROTATION_DEG)
    return np.asarray(same)


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix(""))
