"""Localization of camera images with a bundle: NumPy, OpenCV and onnxruntime only."""

from __future__ import annotations

from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import cv2
import numpy as np
import onnxruntime

from spn_data.errors import FormatError, GeometryError, InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import SHAPE_TOLERANCE
from spn_data.geometry.image_texture import missing_texture
from spn_data.geometry.pose import Poses
from spn_data.geometry.rendering import PinholeRenderer
from spn_data.geometry.rotations import canonical_quats
from spn_model.landmarks.aids import KnownHeight, KnownVertical
from spn_model.onboard.bundle import (
    FLOAT32,
    INPUT,
    INT8,
    Bundle,
    CellDecoding,
    PoseDecoding,
    read_bundle,
    verified_path,
)
from spn_model.onboard.decoding import decode, with_aids

# Rendering from 1280 to 480 px then takes 2 x 2 samples per pixel, which is four times as fast as 3 x 3.
# Images of simulated flights differ from those of the data set by 0.7 grey levels on average.
SAMPLE_STEP_PX = 1.5
_FATAL = 4  # log level: errors are raised, and onnxruntime need not print them as well


@dataclass(frozen=True, eq=False)
class Located:
    """Pose of one image, or the reason why there is none.

    Attributes
    ----------
    poses : Poses
        One pose in the world; NaN if none was found.
    covariance : ndarray, shape (6, 6)
        Over the centre in the world's unit and a rotation vector v in the camera frame, in radians:
        R_true = exp(v) R.
    reason : str
        Why there is no pose; empty if there is one.
    """

    poses: Poses
    covariance: np.ndarray
    reason: str = ""

    @classmethod
    def failed(cls, reason: str) -> Located:
        """Return a result without a pose."""
        return cls(Poses.unknown(1), np.full((6, 6), np.nan), reason)


class Localizer:
    """A bundle loaded into memory at one precision, for use by one thread at a time.

    `localize` consists of the steps `view`, `run` and `decode`, after a check of the image's texture.

    Parameters
    ----------
    folder : str or path-like
        Folder of the bundle.
    int8 : bool
        Use the 8-bit graph instead of the float32 graph.
    threads : int
        Threads of onnxruntime.

    Attributes
    ----------
    bundle : Bundle
        Description of the bundle.
    camera : Camera
        Pinhole of the graph's input.
    session : onnxruntime.InferenceSession
        The loaded graph.

    Raises
    ------
    InputError
        If the folder is not a bundle, or has no graph of this precision.
    FormatError
        If the bundle is damaged.
    """

    def __init__(self, folder: str | PathLike[str], *, int8: bool = False, threads: int = 1):
        folder = Path(folder)
        self.bundle: Bundle = read_bundle(folder)
        self.camera = self.bundle.camera
        precision = INT8 if int8 else FLOAT32
        if precision not in self.bundle.graphs:
            raise InputError(f"has no {precision} graph", path=folder)
        path = verified_path(self.bundle.graphs[precision])
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        options.log_severity_level = _FATAL
        try:
            self.session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        except (
            Exception
        ) as error:  # onnxruntime has one type per status, without a common base class
            raise FormatError(f"{path}: onnxruntime cannot load it ({error})") from error
        self._check_graph(path)
        self._renderers: dict[tuple[object, ...], PinholeRenderer] = {}

    def localize(
        self,
        image: np.ndarray,
        camera: Camera,
        *,
        rgb: bool = False,
        vertical: KnownVertical | None = None,
        height: KnownHeight | None = None,
    ) -> Located:
        """Estimate the pose of an image.

        Parameters
        ----------
        image : ndarray, shape (H, W, 3)
            Image of the flying camera, uint8, BGR as OpenCV reads it or RGB.
        camera : Camera
            Its camera with distortion; scaled if its size differs but its aspect ratio is the same.
        rgb : bool
            Whether the image is RGB.
        vertical : KnownVertical, optional
            Up in the camera.
        height : KnownHeight, optional
            Height of the camera in the world.

        Returns
        -------
        Located
            Without a pose, and with the reason, if the image has too little texture (`missing_texture`): a
            network returns a pose and an ordinary covariance for a black image too.

        Raises
        ------
        InputError
            If the aspect ratios of image and camera differ, or the camera sees nothing of the network's view.
        """
        seen = self.view(image, camera, rgb=rgb)
        reason = missing_texture(image)
        if reason:
            return Located.failed(reason)
        return self.decode(self.run(seen), vertical=vertical, height=height)

    def view(self, image: np.ndarray, camera: Camera, *, rgb: bool = False) -> np.ndarray:
        """Render an image into the network's own camera.

        Parameters
        ----------
        image : ndarray, shape (H, W, 3)
            Image of the flying camera, uint8.
        camera : Camera
            Its camera.
        rgb : bool
            Whether the image is RGB instead of BGR.

        Returns
        -------
        ndarray, shape (1, h, w, 3)
            uint8 RGB; pixels outside the image are black.

        Raises
        ------
        InputError
            If the image does not have the aspect ratio of the camera.
        ValueError
            For another type or shape of image.
        """
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise ValueError(
                f"expected an image (H, W, 3) of uint8, got {image.shape} of {image.dtype}"
            )
        seen = self.renderer(camera, image.shape[1], image.shape[0]).render(image)
        return (seen if rgb else cv2.cvtColor(seen, cv2.COLOR_BGR2RGB))[None]

    def run(self, images: np.ndarray) -> list[np.ndarray]:
        """Run the network on an image (1, h, w, 3) uint8 RGB.

        Returns the outputs in the order of the bundle's decoding.
        """
        found: list[np.ndarray] = self.session.run(self.bundle.decoding.outputs, {INPUT: images})
        return found

    def decode(
        self,
        outputs: list[np.ndarray],
        matrix: np.ndarray | None = None,
        vertical: KnownVertical | None = None,
        height: KnownHeight | None = None,
    ) -> Located:
        """Convert outputs of the network to a pose in the world.

        Parameters
        ----------
        outputs : list of ndarray
            As `run` returns them.
        matrix : ndarray, shape (3, 3), optional
            Camera matrix K of the image, if it is not that of the bundle's camera.
        vertical : KnownVertical, optional
            Up in the camera.
        height : KnownHeight, optional
            Height of the camera in the world.

        Returns
        -------
        Located
        """
        by, offset = self.bundle.decoding, self.bundle.view.offset
        if height is not None:
            height = replace(height, up_m=height.up_m - offset[2])
        try:
            if isinstance(by, PoseDecoding):
                found = _decode_regression(by, *outputs)
                is_aided = vertical is not None or height is not None
                if is_aided and np.isfinite(found.covariance).all():
                    found = Located(*with_aids(found.poses, found.covariance, vertical, height))
                return replace(found, poses=found.poses.moved_by(offset))
            coordinates, log_scale = outputs
            estimate = decode(
                coordinates[0],
                log_scale[0, 0],
                self.camera.matrix if matrix is None else matrix,
                first_px=by.first_px,
                stride_px=by.stride_px,
                options=by.options,
                vertical=vertical,
                height=height,
            )
        except GeometryError as error:
            return Located.failed(str(error))
        return Located(estimate.poses.moved_by(offset), estimate.covariance)

    def renderer(self, camera: Camera, width: int, height: int) -> PinholeRenderer:
        """Return the cached renderer from images of one size into the network's camera.

        Parameters
        ----------
        camera : Camera
            Camera of the images.
        width, height : int
            Size of the images in pixels.

        Returns
        -------
        PinholeRenderer
            Its `valid` mask gives the pixels of the view that the camera sees.

        Raises
        ------
        InputError
            If the images do not have the aspect ratio of the camera.
        """
        key = (camera.model, camera.width, camera.height, camera.params.tobytes(), width, height)
        if key not in self._renderers:
            if abs(width * camera.height / (height * camera.width) - 1) > SHAPE_TOLERANCE:
                raise InputError(
                    f"the image is {width}x{height}, but the camera is {camera.width}x{camera.height}; "
                    "give the camera of these images"
                )
            made = PinholeRenderer(
                camera.scaled(width, height), self.camera, sample_step_px=SAMPLE_STEP_PX
            )
            if not made.valid.any():
                raise InputError(
                    "the camera sees nothing of the view that the network was trained on; check that the "
                    "camera file belongs to these images"
                )
            self._renderers[key] = made
        return self._renderers[key]

    def _check_graph(self, path: Path) -> None:
        inputs = [(i.name, i.type, i.shape) for i in self.session.get_inputs()]
        shape = [1, self.camera.height, self.camera.width, 3]
        if inputs != [(INPUT, "tensor(uint8)", shape)]:
            raise FormatError(f"{path}: does not match the bundle: its input is {inputs}")
        shapes = {o.name: o.shape for o in self.session.get_outputs() if o.type == "tensor(float)"}
        decoding = self.bundle.decoding
        expected: dict[str, list[int]] = {"offset": [1, 3], "quaternion": [1, 4], "log_std": [1, 6]}
        if isinstance(decoding, CellDecoding):
            columns, rows = (
                int((side - decoding.first_px) // decoding.stride_px) + 1
                for side in (self.camera.width, self.camera.height)
            )
            found = shapes.get("log_scale", [])
            # All cells whose centre is in the image, or without the last row or column.
            if len(found) == 4 and all(isinstance(n, int) for n in found):
                rows, columns = min(rows, found[2]), min(columns, found[3])
            expected = {"coordinates": [1, 3, rows, columns], "log_scale": [1, 1, rows, columns]}
        wrong = {name: shapes.get(name) for name in decoding.outputs}
        if wrong != {name: expected[name] for name in decoding.outputs}:
            raise FormatError(f"{path}: does not match the bundle: its outputs are {shapes}")


def _decode_regression(
    decoding: PoseDecoding, offset: np.ndarray, quaternion: np.ndarray, log_std: np.ndarray
) -> Located:
    """Convert the outputs of a pose regressor to a pose."""
    x, q = offset[0].astype(np.float64), quaternion[0].astype(np.float64)
    length = np.linalg.norm(q)
    if not (np.isfinite(x).all() and np.isfinite(length) and length > 1e-6):
        return Located.failed("the network's output is not a valid pose")
    covariance = np.diag(np.exp(2 * log_std[0].astype(np.float64)))
    return Located(Poses(x[None] + decoding.center, canonical_quats(q[None])), covariance)
