"""Bundle: a folder with an exported network and everything needed to convert its outputs to poses; no torch.

docs/export.md specifies the format, also for programs in other languages.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.errors import FormatError, InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_from_json
from spn_data.geometry.json_values import bounded, parse_file
from spn_model.onboard.attitude import GimbalMounting
from spn_model.onboard.decoding import DecodingOptions
from spn_model.onboard.graph_check import check_self_contained
from spn_model.onboard.view import View

FORMAT = "squeezeposenet-bundle"
VERSION = 1
OFFSET_VERSION = 2  # of a view with an offset, so that programs that know none refuse it
DOCUMENT, CARD = "bundle.json", "MODEL_CARD.md"
FLOAT32, INT8 = "float32", "int8"
LANDMARKS = "landmarks.npz"
GRAPHS = {FLOAT32: "model.onnx", INT8: "model-int8.onnx"}
INPUT = "image"  # of a graph: (1, h, w, 3) uint8 RGB
CONVENTIONS = (
    "World: East, North, Up in metres about the origin if units is 'm' and origin is not null. A pose is "
    "the camera centre in the world and a unit quaternion, scalar first, w >= 0, that turns world axes into "
    "camera axes (x right, y down, z forward): x_cam = R(q) (x_world - center). Covariance: 6x6 over "
    "(centre; rotation vector v in the camera frame, radians), R_true = exp(v) R, relative to the map. "
    "Pixels: x right, y down, the centre of the upper-left pixel is (0.5, 0.5); camera "
    "parameters in COLMAP's order."
)
OFFSET_CONVENTION = " Add the view's offset, in float64, to the centre that the decoding gives."
_MAX_DOCUMENT_BYTES = 1_000_000
# Raised when values of a damaged bundle.json are used.
_DAMAGE = (ValueError, KeyError, TypeError, AttributeError, OverflowError)
_MAX_SIDE_PX = 8192
_MAX_GRAPH_BYTES = 2 * 10**9  # ONNX files cannot be larger
# Bounds of decoding options that cost time or memory. P3P needs three points and a fourth to disambiguate.
_LIMITS = {"cells": (4, 100_000), "ransac_iterations": (1, 100_000), "min_inliers": (4, 100_000)}
_SIZES = (0, 1e9)


@dataclass(frozen=True, kw_only=True)
class CellDecoding:
    """Decoding of scene coordinates by PnP, see `decoding.decode`.

    The outputs are `coordinates` (1, 3, h, w), relative to the view's offset, and `log_scale` (1, 1, h, w).

    Attributes
    ----------
    first_px : float
        Centre of the first cell along both axes, in pixels.
    stride_px : float
        Distance between cells, in pixels.
    options : DecodingOptions
        Options of the decoding.
    """

    kind = "scene-coordinates"
    outputs = ("coordinates", "log_scale")
    first_px: float
    stride_px: float
    options: DecodingOptions = field(default_factory=DecodingOptions)

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {"kind": self.kind, **asdict(self)}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> CellDecoding:
        """Parse the result of `to_json`; raise KeyError, TypeError or ValueError if invalid."""
        given = value["options"]
        options: dict[str, Any] = {}
        for own in fields(DecodingOptions):
            low, high = _LIMITS.get(own.name, _SIZES)
            number = bounded(given[own.name], low, high)
            options[own.name] = int(number) if isinstance(own.default, int) else number
        return cls(
            first_px=bounded(value["first_px"], 0, 1000),
            stride_px=bounded(value["stride_px"], 1, 1000),
            options=DecodingOptions(**options),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseDecoding:
    """Decoding of a directly regressed pose.

    The outputs are `offset` (1, 3) from the centre in the world's unit, `quaternion` (1, 4) of any length,
    and `log_std` (1, 6), logarithms of standard deviations along the axes of the covariance.

    Attributes
    ----------
    center : ndarray, shape (3,)
        Point that these offsets refer to, itself relative to the view's offset.
    """

    kind = "regression"
    outputs = ("offset", "quaternion", "log_std")
    center: np.ndarray

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {"kind": self.kind, "center": [float(v) for v in self.center]}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> PoseDecoding:
        """Parse the result of `to_json`; raise KeyError, TypeError or ValueError if invalid."""
        center = value["center"]
        if not isinstance(center, list) or len(center) != 3:
            raise ValueError(f"its centre is {center!r}")
        return cls(center=np.array([bounded(v, -1e9, 1e9) for v in center]))


Decoding = CellDecoding | PoseDecoding
_DECODINGS: dict[str, type[CellDecoding] | type[PoseDecoding]] = {
    kind.kind: kind for kind in (CellDecoding, PoseDecoding)
}


@dataclass(frozen=True, eq=False, kw_only=True)
class BundleFile:
    """File of a bundle: a graph, or the landmarks."""

    path: Path
    bytes: int
    sha256: str


@dataclass(frozen=True, eq=False, kw_only=True)
class Bundle:
    """Content of bundle.json.

    Attributes
    ----------
    folder : Path
        Folder of the bundle.
    view : View
        View that the network was trained on; its camera is known.
    camera : Camera
        Pinhole of the graph's input: that of the view, or a smaller one.
    decoding : Decoding
        How outputs are converted to a pose.
    graphs : mapping of str to BundleFile
        By precision.
    landmarks : BundleFile or None
        None in a bundle without landmarks.
    gimbal : GimbalMounting or None
        None if the mapping flights recorded no angles.
    document : mapping
        The whole file, including facts for people.
    """

    folder: Path
    view: View
    camera: Camera
    decoding: Decoding
    graphs: Mapping[str, BundleFile]
    landmarks: BundleFile | None
    gimbal: GimbalMounting | None
    document: Mapping[str, Any]


def read_bundle(folder: Path) -> Bundle:
    """Read the description of a bundle.

    Parameters
    ----------
    folder : Path
        Folder of the bundle.

    Returns
    -------
    Bundle
        Its graph files are not checked yet, see `verified_path`.

    Raises
    ------
    InputError
        If the folder is not a bundle.
    FormatError
        If bundle.json is damaged or of another version.
    """
    path = folder / DOCUMENT
    if not path.is_file():
        raise InputError(f"is not a bundle: it has no {DOCUMENT}", path=folder)
    try:
        document = parse_file(path, max_bytes=_MAX_DOCUMENT_BYTES)
        if not isinstance(document, dict) or document.get("format") != FORMAT:
            raise ValueError(f"its format is not {FORMAT}")
        version = int(document["version"])
    except (*_DAMAGE, OSError) as error:
        raise FormatError(f"{path}: is not a valid bundle description ({error})") from error
    if version not in (VERSION, OFFSET_VERSION):
        raise FormatError(
            f"{path}: has format {version}, but this program reads {VERSION} and {OFFSET_VERSION}; "
            "export the run again, or update the program"
        )
    try:
        camera = camera_from_json(document["input"])
        if camera.opencv_distortion.any() or max(camera.width, camera.height) > _MAX_SIDE_PX:
            raise ValueError("its input is not a pinhole, or too large")
        return Bundle(
            folder=folder,
            view=View.from_json(document["view"], has_offset=version == OFFSET_VERSION),
            camera=camera,
            decoding=_decoding(document["decoding"]),
            graphs={p: _graph(folder, p, entry) for p, entry in dict(document["graphs"]).items()},
            landmarks=_landmarks(folder, document.get("landmarks")),
            gimbal=_gimbal(document.get("gimbal")),
            document=document,
        )
    except _DAMAGE as error:
        raise FormatError(f"{path}: is damaged ({error!r})") from error


def verified_path(graph: BundleFile) -> Path:
    """Return the path of a graph after checking it against bundle.json.

    Parameters
    ----------
    graph : BundleFile
        Entry of `Bundle.graphs`.

    Returns
    -------
    Path

    Raises
    ------
    FormatError
        If the file is missing, is a link, has another size or hash, or keeps weights in another file.
    """
    path = _verified(graph)
    try:
        check_self_contained(path)
    except ValueError as error:
        raise FormatError(f"{path}: cannot be used: {error}; export the run again") from error
    return path


def verified_landmarks(bundle: Bundle) -> Path:
    """Return the path of the landmarks of a bundle after checking it against bundle.json.

    Parameters
    ----------
    bundle : Bundle

    Returns
    -------
    Path

    Raises
    ------
    InputError
        If the bundle has no landmarks.
    FormatError
        If the file is missing, is a link, or has another size or hash.
    """
    if bundle.landmarks is None:
        raise InputError(
            "has no landmarks, which a fix needs: export the run again with --map-mb 10",
            path=bundle.folder,
        )
    return _verified(bundle.landmarks)


def _verified(file: BundleFile) -> Path:
    path = file.path
    if path.is_symlink() or not path.is_file():
        raise FormatError(f"{path}: is not a regular file; copy the whole bundle folder again")
    size = path.stat().st_size
    if size != file.bytes:
        raise FormatError(
            f"{path}: has {size} bytes, but {DOCUMENT} says {file.bytes}; copy it again"
        )
    if sha256_of(path) != file.sha256:
        raise FormatError(f"{path}: its SHA-256 differs from {DOCUMENT}; copy it again")
    return path


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal."""
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def _decoding(value: Mapping[str, Any]) -> Decoding:
    if value["kind"] not in _DECODINGS:
        raise ValueError(f"its decoding {value['kind']!r} is not one of {', '.join(_DECODINGS)}")
    return _DECODINGS[value["kind"]].from_json(value)


def _graph(folder: Path, precision: str, entry: Mapping[str, Any]) -> BundleFile:
    # The name in the file is only compared, never used as a path.
    if GRAPHS.get(precision) != entry["file"]:
        raise ValueError(f"its {precision} graph is {entry['file']!r}")
    digest = str(entry["sha256"])
    return BundleFile(
        path=folder / GRAPHS[precision],
        bytes=int(bounded(entry["bytes"], 1, _MAX_GRAPH_BYTES)),
        sha256=digest,
    )


def _gimbal(entry: Mapping[str, Any] | None) -> GimbalMounting | None:
    return None if entry is None else GimbalMounting.from_json(entry)


def _landmarks(folder: Path, entry: Mapping[str, Any] | None) -> BundleFile | None:
    if entry is None:
        return None
    if entry["file"] != LANDMARKS:
        raise ValueError(f"its landmarks are {entry['file']!r}")
    return BundleFile(
        path=folder / LANDMARKS,
        bytes=int(bounded(entry["bytes"], 1, _MAX_GRAPH_BYTES)),
        sha256=str(entry["sha256"]),
    )
