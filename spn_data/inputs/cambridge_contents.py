"""The folder cambridge/ of a split: a data set that programs for Cambridge Landmarks can read."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from spn_data.dataset.cambridge import NVM, TEST_LIST, TRAIN_LIST, VALIDATION_LIST, write_cambridge
from spn_data.dataset.nvm import build_nvm_model, write_nvm
from spn_data.geometry.camera import Camera
from spn_data.geometry.rendering import PinholeRenderer, undistorted_camera
from spn_data.inputs.dataset_contents import GroupedFrames
from spn_data.labels.map_points import MapPoints
from spn_data.split.audit import MIN_TRAINING_VIEWS
from spn_data.split.groups import TRAIN, VALIDATION
from spn_data.storage.files import write_atomically

_LISTS = {TRAIN: TRAIN_LIST, VALIDATION: VALIDATION_LIST}


def list_file(group: str) -> str:
    """Return the list file of a group; evaluation sequences or the held-out test block share one."""
    return _LISTS.get(group, TEST_LIST)


def image_name(frame: str) -> str:
    """Return the name of a frame's image in the lists."""
    return frame.removesuffix(".jpg") + ".png"


class CambridgeFolder:
    """Writer of the folder: images are added one by one, lists and model at the end.

    Images are written in full size, undistorted and with a centred principal point, because the format has
    no parameters for either.

    Parameters
    ----------
    folder : Path
    cameras : dict of str to Camera
        Camera of each key, of the full-size images.
    """

    def __init__(self, folder: Path, cameras: dict[str, Camera]):
        self._folder = folder
        self._cameras = cameras
        self._renderers: dict[str, PinholeRenderer] = {}

    def add_image(self, frame: str, key: str, image: np.ndarray) -> None:
        """Write a frame's image (H, W, 3) BGR, unless an interrupted run already wrote it."""
        path = self._folder / image_name(frame)
        if path.exists():
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        ok, data = cv2.imencode(".png", self._renderer(key).render(image))
        if not ok:
            raise ValueError(f"{frame} cannot be encoded as PNG")
        write_atomically(path, data.tobytes())

    def finish(self, frames: GroupedFrames, rows: np.ndarray, points: MapPoints) -> None:
        """Write the lists, each sorted by sequence and time, and the model.

        Parameters
        ----------
        frames : GroupedFrames
        rows : ndarray, shape (K,), int
            Rows of the frames whose images were added.
        points : MapPoints
        """
        names = [image_name(name) for name in frames.labels.names.tolist()]
        files = np.array([list_file(name) for name in frames.group.tolist()])
        for file in (*_LISTS.values(), TEST_LIST):
            mine = rows[files[rows] == file]
            write_cambridge(
                self._folder / file, [names[k] for k in mine], frames.labels.poses[mine]
            )
        self._write_model(frames, rows, [names[k] for k in rows], points)

    def _write_model(
        self, frames: GroupedFrames, rows: np.ndarray, names: list[str], points: MapPoints
    ) -> None:
        """Write all images, for their focal lengths, but only measurements of training frames.

        The measurements of a held-out frame would reveal its pose.
        """
        images, ids, offsets, focal_px = [], [], [], []
        for image, row in enumerate(rows.tolist()):
            renderer = self._renderer(str(frames.labels.cameras[row]))
            target = renderer.target
            focal_px.append(target.focal_px[0])
            if frames.group[row] != TRAIN:
                continue
            own_ids, pixels = frames.points_of(row)
            moved, is_seen = renderer.map_pixels(pixels)
            images.append(np.full(int(is_seen.sum()), image))
            ids.append(own_ids[is_seen])
            offsets.append(moved[is_seen] - [target.width / 2, target.height / 2])
        known, number, views = np.unique(
            np.concatenate(ids), return_inverse=True, return_counts=True
        )
        kept = views[number] >= MIN_TRAINING_VIEWS
        model = build_nvm_model(
            tuple(names),
            frames.labels.poses[rows],
            np.array(focal_px),
            (points.xyz, points.colors),
            (
                points.rows_of(known)[number][kept],
                np.concatenate(images)[kept],
                np.concatenate(offsets)[kept],
            ),
        )
        write_nvm(self._folder / NVM, model)

    def _renderer(self, key: str) -> PinholeRenderer:
        if key not in self._renderers:
            camera = self._cameras[key]
            self._renderers[key] = PinholeRenderer(camera, undistorted_camera(camera))
        return self._renderers[key]
