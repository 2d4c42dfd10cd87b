"""Poses of a flying camera's images by a bundle: NumPy, OpenCV and onnxruntime alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import onnxruntime

from spn_data.errors import FormatError, GeometryError, InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses, canonical_quats
from spn_data.geometry.rendering import PinholeRenderer
from spn_model.onboard.bundle import (
    FLOAT32,
    INPUT,
    INT8,
    Bundle,
    CellDecoding,
    PoseDecoding,
    read_bundle,
    verified,
)
from spn_model.onboard.decoding import decode

# From 1280 to 480 px 2 x 2 samples a pixel then suffice, which are taken four times as fast as 3 x 3;
# images of simulated flights differ from those of the data set by 0.7 grey levels in the mean.
SAMPLE_STEP_PX = 1.5
_SHAPE_TOLERANCE = 0.005  # of the aspect, between a camera file and the images
_FATAL = 4  # what goes wrong is raised: onnxruntime prints it as well, in colour


@dataclass(frozen=True, eq=False)
class Located:
    """Of one image: poses (1), NaN where none was found; covariance (6, 6) over the centre in the world's
    unit and a rotation vector v in the camera frame, R_true = exp(v) R; reason : empty where there is a pose.
    """

    poses: Poses
    covariance: np.ndarray
    reason: str = ""

    @classmethod
    def nowhere(cls, reason: str) -> Located:
        return cls(Poses.unknown(1), np.full((6, 6), np.nan), reason)


class Localizer:
    """A bundle in memory, at one precision. One thread may use it at a time.

    The steps of `localize` are its methods `view`, `run` and `decode`. Raises InputError or FormatError where
    the bundle cannot be used, and InputError for int8 where it holds no such graph.
    """

    def __init__(self, folder: Path, *, int8: bool = False, threads: int = 1):
        self.bundle: Bundle = read_bundle(folder)
        self.camera = self.bundle.camera
        precision = INT8 if int8 else FLOAT32
        if precision not in self.bundle.graphs:
            raise InputError(f"holds no {precision} graph", path=folder)
        path = verified(self.bundle.graphs[precision])
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        options.log_severity_level = _FATAL
        try:
            self.session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime has a type for each status, none in common
            raise FormatError(f"{path}: onnxruntime cannot load it ({error})") from error
        self._check_graph(path)
        self._renderers: dict[tuple[object, ...], PinholeRenderer] = {}

    def localize(self, image: np.ndarray, camera: Camera, *, rgb: bool = False) -> Located:
        """Of a flying camera's image (H, W, 3) uint8: BGR as OpenCV reads it, or RGB.

        camera : of that image, with its distortion; where it is of another size and the same shape it is
        scaled. Raises InputError where it is of another shape, or does not see what the network knows.
        """
        return self.decode(self.run(self.view(image, camera, rgb=rgb)))

    def view(self, image: np.ndarray, camera: Camera, *, rgb: bool = False) -> np.ndarray:
        """(1, h, w, 3) uint8 RGB: what the network's own camera would have seen there; black beside it."""
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise ValueError(f"an image of {image.shape}, {image.dtype}")
        seen = self.renderer(camera, image.shape[1], image.shape[0]).render(image)
        return (seen if rgb else cv2.cvtColor(seen, cv2.COLOR_BGR2RGB))[None]

    def run(self, images: np.ndarray) -> list[np.ndarray]:
        """Outputs of the network, as the bundle's decoding names them, of an image (1, h, w, 3) uint8 RGB."""
        found: list[np.ndarray] = self.session.run(self.bundle.decoding.outputs, {INPUT: images})
        return found

    def decode(self, outputs: list[np.ndarray], matrix: np.ndarray | None = None) -> Located:
        """The pose that outputs tell; matrix : K (3, 3) of the image, where not the bundle's camera's."""
        if isinstance(self.bundle.decoding, PoseDecoding):
            return _read_out(self.bundle.decoding, *outputs)
        by = self.bundle.decoding
        coordinates, log_scale = outputs
        try:
            found = decode(
                coordinates[0],
                log_scale[0, 0],
                self.camera.matrix if matrix is None else matrix,
                first_px=by.first_px,
                stride_px=by.stride_px,
                options=by.options,
            )
        except GeometryError as error:
            return Located.nowhere(str(error))
        return Located(found.poses, found.covariance)

    def renderer(self, camera: Camera, width: int, height: int) -> PinholeRenderer:
        """From images of that size into the network's camera; made at first use, then kept.

        Its `valid` tells which pixels of the view the camera sees. Raises InputError as `localize` does.
        """
        key = (camera.model, camera.width, camera.height, camera.params.tobytes(), width, height)
        if key not in self._renderers:
            if abs(width * camera.height / (height * camera.width) - 1) > _SHAPE_TOLERANCE:
                raise InputError(
                    f"the image is {width}x{height}, the camera is of {camera.width}x{camera.height}: "
                    "give the camera of these images"
                )
            made = PinholeRenderer(
                camera.scaled(width, height), self.camera, sample_step_px=SAMPLE_STEP_PX
            )
            if not made.valid.any():
                raise InputError(
                    "the camera sees nothing of the view that the network was trained on: is it another "
                    "camera's file?"
                )
            self._renderers[key] = made
        return self._renderers[key]

    def _check_graph(self, path: Path) -> None:
        inputs = [(i.name, i.type, i.shape) for i in self.session.get_inputs()]
        shape = [1, self.camera.height, self.camera.width, 3]
        if inputs != [(INPUT, "tensor(uint8)", shape)]:
            raise FormatError(f"{path}: is no graph of this bundle: its input is {inputs}")
        shapes = {o.name: o.shape for o in self.session.get_outputs() if o.type == "tensor(float)"}
        decoding = self.bundle.decoding
        expected: dict[str, list[int]] = {"offset": [1, 3], "quaternion": [1, 4], "log_std": [1, 6]}
        if isinstance(decoding, CellDecoding):
            columns, rows = (
                int((side - decoding.first_px) // decoding.stride_px) + 1
                for side in (self.camera.width, self.camera.height)
            )
            found = shapes.get("log_scale", [])
            # As many cells as lie in the image, or the last ones less.
            if len(found) == 4 and all(isinstance(n, int) for n in found):
                rows, columns = min(rows, found[2]), min(columns, found[3])
            expected = {"coordinates": [1, 3, rows, columns], "log_scale": [1, 1, rows, columns]}
        wrong = {name: shapes.get(name) for name in decoding.outputs}
        if wrong != {name: expected[name] for name in decoding.outputs}:
            raise FormatError(f"{path}: is no graph of this bundle: its outputs are {shapes}")


def _read_out(
    decoding: PoseDecoding, offset: np.ndarray, quaternion: np.ndarray, log_std: np.ndarray
) -> Located:
    """A pose regressor's answer."""
    x, q = offset[0].astype(np.float64), quaternion[0].astype(np.float64)
    length = np.linalg.norm(q)
    if not (np.isfinite(x).all() and np.isfinite(length) and length > 1e-6):
        return Located.nowhere("the network's answer is no pose")
    covariance = np.diag(np.exp(2 * log_std[0].astype(np.float64)))
    return Located(Poses(x[None] + decoding.center, canonical_quats(q[None])), covariance)
