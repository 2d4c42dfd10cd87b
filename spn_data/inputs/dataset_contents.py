"""Contents of dataset.h5: frames with their group, map points and rendered images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from spn_data.capture.photos import load_mask
from spn_data.coverage.nearest_frame import coverage_strata
from spn_data.dataset.hdf5_schema import DatasetFrame
from spn_data.geometry.camera import Camera
from spn_data.geometry.rendering import (
    PinholeRenderer,
    RenderingOptions,
    canonical_camera,
    undistorted_camera,
)
from spn_data.inputs.area_labels import LabelledArea
from spn_data.labels.labels import LabelObservations, Labels
from spn_data.split.audit import training_points
from spn_data.split.groups import LEFT_OUT, TRAIN, Split


@dataclass(frozen=True, eq=False)
class GroupedFrames:
    """N frames that belong to a group of the split, sorted by sequence and time.

    Attributes
    ----------
    labels : Labels
    group : ndarray, shape (N,), str
    strata : ndarray, shape (N,), str
        Coverage by the chosen training frames; empty for training frames and if the map is not in metres.
    for_training : ndarray, int
        Ids of the map points that training frames may use.
    split : Split
        Split of all frames of the area.
    seen : tuple of LabelObservations
        Observations of the parts of the area that the frames are from. They may be large and are not copied.
    part, row : ndarray, shape (N,), int
        Part of each frame, and its row in that part.
    """

    labels: Labels
    group: np.ndarray
    strata: np.ndarray
    for_training: np.ndarray
    split: Split
    seen: tuple[LabelObservations, ...]
    part: np.ndarray
    row: np.ndarray

    def points_of(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return ids (K,) and pixels (K, 2) of the map points in frame k.

        A training frame has only points that were reconstructed by training frames.
        """
        ids, pixels = self.seen[self.part[k]].of_frame(int(self.row[k]))
        if self.group[k] == TRAIN:
            allowed = np.isin(ids, self.for_training)
            ids, pixels = ids[allowed], pixels[allowed]
        return ids, pixels


def group_frames(labelled: LabelledArea, split: Split) -> GroupedFrames:
    """Collect the frames of an area that are in a group of the split.

    Parameters
    ----------
    labelled : LabelledArea
    split : Split

    Returns
    -------
    GroupedFrames
        Without frames that the split leaves out.
    """
    parts = labelled.parts()
    kept = [np.flatnonzero(split.groups_of(labels.names) != LEFT_OUT) for labels, _ in parts]
    labels = Labels.concatenate([p.select(rows) for (p, _), rows in zip(parts, kept, strict=True)])
    order = np.lexsort((labels.time_s, labels.sequences))
    labels = labels.select(order)
    group = split.groups_of(labels.names)
    strata = np.full(len(labels), "", dtype="<U6")
    if labelled.units == "m":
        others = group != TRAIN
        training = labels.poses[(group == TRAIN) & ~labels.tracked]
        strata[others] = coverage_strata(labels.poses[others], training)
    return GroupedFrames(
        labels,
        group,
        strata,
        training_points(labelled.mapping, labelled.mapping_seen, split),
        split,
        tuple(seen for _, seen in parts),
        np.repeat(np.arange(len(parts)), [len(rows) for rows in kept])[order],
        np.concatenate(kept)[order],
    )


def target_cameras(
    labelled: LabelledArea, labels: Labels, *, native: bool, width_px: int | None
) -> dict[str, Camera]:
    """Return the pinhole camera that images of each lens are rendered with.

    Parameters
    ----------
    labelled : LabelledArea
    labels : Labels
        Frames to render.
    native : bool
        Whether each lens keeps its own field of view. Otherwise, all share one camera, which depends on the
        mapping cameras only, so that an evaluation sequence does not change the training images.
    width_px : int or None
        Image width; None: that of each lens if `native`, else the default of `RenderingOptions`.

    Returns
    -------
    dict of str to Camera
        Target camera by camera key.
    """
    keys = sorted(set(labels.cameras.tolist()))
    if native:
        own = {key: undistorted_camera(labelled.cameras[key]) for key in keys}
        return {key: _resized(camera, width_px) for key, camera in own.items()}
    mapping = labelled.mapping
    mapped = sorted(set(mapping.cameras[mapping.registered].tolist()))
    rendering = RenderingOptions(width_px=width_px or RenderingOptions.width_px)
    shared = canonical_camera([labelled.cameras[key] for key in mapped], rendering)
    return dict.fromkeys(keys, shared)


def _resized(camera: Camera, width_px: int | None) -> Camera:
    if width_px is None:
        return camera
    return camera.scaled(width_px, max(1, round(width_px * camera.height / camera.width)))


class RenderedFrames:
    """Renderer of the frames of dataset.h5, one by one.

    Parameters
    ----------
    labelled : LabelledArea
    frames : GroupedFrames
    targets : dict of str to Camera
        Target pinhole camera of each camera key.
    masks : Path
        Folder of `<sequence>.png`, which may be empty.
    """

    def __init__(
        self, labelled: LabelledArea, frames: GroupedFrames, targets: dict[str, Camera], masks: Path
    ):
        self._cameras, self._points = labelled.cameras, labelled.points
        self._frames = frames
        self._targets = targets
        self._masks = masks
        self._renderers: dict[str, PinholeRenderer] = {}
        self._valid: dict[tuple[str, str], np.ndarray | None] = {}

    def frame(self, row: int, image: np.ndarray) -> DatasetFrame:
        """Return the frame in a row, rendered from its full-size image (H, W, 3) BGR."""
        labels, key = self._frames.labels, str(self._frames.labels.cameras[row])
        renderer = self._renderer(key)
        ids, pixels = self._frames.points_of(row)
        moved, is_seen = renderer.map_pixels(pixels)
        return DatasetFrame(
            name=str(labels.names[row]),
            sequence=str(labels.sequences[row]),
            time_s=float(labels.time_s[row]),
            center=labels.poses.centers[row],
            quat_wxyz=labels.poses.quats_wxyz[row],
            intrinsics=renderer.target.matrix,
            covariance=labels.covariance[row],
            tracked=bool(labels.tracked[row]),
            stratum=str(self._frames.strata[row]),
            image=cv2.cvtColor(renderer.render(image), cv2.COLOR_BGR2RGB),
            valid=self._valid_pixels(str(labels.sequences[row]), key),
            point_ids=ids[is_seen],
            point_pixels=moved[is_seen],
            point_xyz=self._points.xyz[self._points.rows_of(ids[is_seen])],
        )

    def _renderer(self, key: str) -> PinholeRenderer:
        if key not in self._renderers:
            self._renderers[key] = PinholeRenderer(self._cameras[key], self._targets[key])
        return self._renderers[key]

    def _valid_pixels(self, sequence: str, key: str) -> np.ndarray | None:
        """Return (H, W) bool, true inside the source image and its mask; None if all pixels are valid."""
        if (sequence, key) not in self._valid:
            renderer, path = self._renderer(key), self._masks / f"{sequence}.png"
            valid = None if renderer.all_valid else renderer.valid
            if path.exists():
                size = (renderer.camera.width, renderer.camera.height)
                valid = renderer.render_mask(load_mask(path, *size))
            self._valid[sequence, key] = valid
        return self._valid[sequence, key]
