"""What dataset.h5 is given of an area: frames in a group, their points, their rendered images."""

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
class GivenFrames:
    """N frames that are in a group, sorted by sequence and time.

    group : (N,) str; strata : (N,) str, by the chosen training frames; empty for training frames and where
    there are no metres. for_training : ids of the points that training frames are given.
    split : of all frames. seen : of the parts of the area that the frames are from, which may be large and
    are not copied; part, row : (N,) where each frame is in them.
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
        """(ids (K,), pixels (K, 2)) that frame k is given; in training those that training frames made."""
        ids, pixels = self.seen[self.part[k]].of_frame(int(self.row[k]))
        if self.group[k] == TRAIN:
            given = np.isin(ids, self.for_training)
            ids, pixels = ids[given], pixels[given]
        return ids, pixels


def given_frames(labelled: LabelledArea, split: Split) -> GivenFrames:
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
    return GivenFrames(
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
    """The pinhole that the images of each lens are rendered into, by camera key.

    One for all, fixed by the mapping cameras alone, so that an evaluation sequence changes nothing in what
    is trained on; or each lens's own.
    """
    keys = sorted(set(labels.cameras.tolist()))
    if native:
        own = {key: undistorted_camera(labelled.cameras[key]) for key in keys}
        return {key: _of_width(camera, width_px) for key, camera in own.items()}
    mapping = labelled.mapping
    mapped = sorted(set(mapping.cameras[mapping.registered].tolist()))
    rendering = RenderingOptions(width_px=width_px or RenderingOptions.width_px)
    one = canonical_camera([labelled.cameras[key] for key in mapped], rendering)
    return dict.fromkeys(keys, one)


def _of_width(camera: Camera, width_px: int | None) -> Camera:
    if width_px is None:
        return camera
    return camera.scaled(width_px, max(1, round(width_px * camera.height / camera.width)))


class RenderedFrames:
    """Frames as dataset.h5 takes them, one by one.

    targets : the pinhole of each lens, by camera key; masks : folder of `<sequence>.png`, which may be empty.
    """

    def __init__(
        self, labelled: LabelledArea, frames: GivenFrames, targets: dict[str, Camera], masks: Path
    ):
        self._cameras, self._points = labelled.cameras, labelled.points
        self._frames = frames
        self._targets = targets
        self._masks = masks
        self._renderers: dict[str, PinholeRenderer] = {}
        self._valid: dict[tuple[str, str], np.ndarray | None] = {}

    def frame(self, row: int, image: np.ndarray) -> DatasetFrame:
        """A frame, from its full-size image (H, W, 3) BGR."""
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
        """(H, W) bool: inside the lens's image, and not masked out; None where all pixels are."""
        if (sequence, key) not in self._valid:
            renderer, path = self._renderer(key), self._masks / f"{sequence}.png"
            valid = None if renderer.all_valid else renderer.valid
            if path.exists():
                size = (renderer.camera.width, renderer.camera.height)
                valid = renderer.render_mask(load_mask(path, *size))
            self._valid[sequence, key] = valid
        return self._valid[sequence, key]
