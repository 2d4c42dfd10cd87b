"""A bundle: a folder that holds a network for the drone and all that makes poses of its output; no torch.

The format is told in docs/export.md, for programs in other languages too.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.errors import FormatError, InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_from_json
from spn_model.onboard.decoding import DecodingOptions
from spn_model.onboard.view import View

FORMAT = "squeezeposenet-bundle"
VERSION = 1
DOCUMENT, CARD = "bundle.json", "MODEL_CARD.md"
FLOAT32, INT8 = "float32", "int8"
GRAPHS = {FLOAT32: "model.onnx", INT8: "model-int8.onnx"}
INPUT = "image"  # of a graph: (1, h, w, 3) uint8 RGB
CONVENTIONS = (
    "World: East, North, Up in metres about the origin where units is 'm' and origin is not null. A pose is "
    "the camera centre in the world and a unit quaternion, scalar first, w >= 0, that turns world axes into "
    "camera axes (x right, y down, z forward): x_cam = R(q) (x_world - center). Covariance: 6x6 over "
    "(centre; rotation vector v in the camera frame, radians), R_true = exp(v) R, relative to the map. "
    "Pixels: x right, y down, the centre of the upper-left pixel is (0.5, 0.5); camera "
    "parameters in COLMAP's order."
)
_MAX_DOCUMENT_BYTES = 1_000_000
# What values of other kinds than those written raise where they are used.
_DAMAGE = (ValueError, KeyError, TypeError, AttributeError, OverflowError)
_MAX_SIDE_PX = 8192
_MAX_GRAPH_BYTES = 2 * 10**9  # no ONNX file is larger
# Of decoding's options: what costs time or memory; a pose needs three points, and a fourth to choose.
_LIMITS = {"cells": (4, 100_000), "ransac_iterations": (1, 100_000), "min_inliers": (4, 100_000)}
_SIZES = (0, 1e9)


@dataclass(frozen=True, kw_only=True)
class CellDecoding:
    """Of outputs `coordinates` (1, 3, h, w) in the world and `log_scale` (1, 1, h, w): `decoding.decode`."""

    kind = "scene-coordinates"
    outputs = ("coordinates", "log_scale")
    first_px: float
    stride_px: float
    options: DecodingOptions = field(default_factory=DecodingOptions)

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {"kind": self.kind, **asdict(self)}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> CellDecoding:
        """Raises KeyError, TypeError or ValueError where it is not what `to_json` gives."""
        given = value["options"]
        options: dict[str, Any] = {}
        for own in fields(DecodingOptions):
            low, high = _LIMITS.get(own.name, _SIZES)
            number = _number(given[own.name], low, high)
            options[own.name] = int(number) if isinstance(own.default, int) else number
        return cls(
            first_px=_number(value["first_px"], 0, 1000),
            stride_px=_number(value["stride_px"], 1, 1000),
            options=DecodingOptions(**options),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseDecoding:
    """Of outputs `offset` (1, 3) from the centre in the world's unit, `quaternion` (1, 4) of any length, and
    `log_std` (1, 6), logarithms of standard deviations along the axes of the covariance; center : (3,)."""

    kind = "regression"
    outputs = ("offset", "quaternion", "log_std")
    center: np.ndarray

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {"kind": self.kind, "center": [float(v) for v in self.center]}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> PoseDecoding:
        """Raises KeyError, TypeError or ValueError where it is not what `to_json` gives."""
        center = value["center"]
        if not isinstance(center, list) or len(center) != 3:
            raise ValueError(f"a centre of {center!r}")
        return cls(center=np.array([_number(v, -1e9, 1e9) for v in center]))


Decoding = CellDecoding | PoseDecoding
_DECODINGS: dict[str, type[CellDecoding] | type[PoseDecoding]] = {
    kind.kind: kind for kind in (CellDecoding, PoseDecoding)
}


@dataclass(frozen=True, eq=False, kw_only=True)
class GraphFile:
    """An ONNX file of a bundle."""

    path: Path
    bytes: int
    sha256: str


@dataclass(frozen=True, eq=False, kw_only=True)
class Bundle:
    """What bundle.json says. view : of the images that the network was trained on, whose camera is known;
    camera : the pinhole of the graph's input, the view's or a smaller one; graphs : by precision; document :
    all of the file, with facts for people."""

    folder: Path
    view: View
    camera: Camera
    decoding: Decoding
    graphs: Mapping[str, GraphFile]
    document: Mapping[str, Any]


def read_bundle(folder: Path) -> Bundle:
    """Raises InputError where there is no bundle, FormatError where it is damaged or of a newer version."""
    path = folder / DOCUMENT
    if not path.is_file():
        raise InputError(f"is no bundle: it holds no {DOCUMENT}", path=folder)
    try:
        if path.stat().st_size > _MAX_DOCUMENT_BYTES:
            raise ValueError(f"it is larger than {_MAX_DOCUMENT_BYTES // 1_000_000} MB")
        document = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(document, dict) or document.get("format") != FORMAT:
            raise ValueError(f"its format is not {FORMAT}")
        version = int(document["version"])
    except (*_DAMAGE, OSError, RecursionError) as error:
        raise FormatError(f"{path}: is no description of a bundle ({error})") from error
    if version != VERSION:
        raise FormatError(
            f"{path}: is of format {version}, this program reads {VERSION}; export the run anew, or update "
            "the program"
        )
    try:
        camera = camera_from_json(document["input"])
        if camera.opencv_distortion.any() or max(camera.width, camera.height) > _MAX_SIDE_PX:
            raise ValueError("its input is no pinhole, or too large")
        return Bundle(
            folder=folder,
            view=View.from_json(document["view"]),
            camera=camera,
            decoding=_decoding(document["decoding"]),
            graphs={p: _graph(folder, p, entry) for p, entry in dict(document["graphs"]).items()},
            document=document,
        )
    except _DAMAGE as error:
        raise FormatError(f"{path}: is damaged ({error!r})") from error


def verified(graph: GraphFile) -> Path:
    """The path of a graph whose content is the one that bundle.json was written for.

    Raises FormatError where it is missing, a link, or of another size or hash.
    """
    path = graph.path
    if path.is_symlink() or not path.is_file():
        raise FormatError(f"{path}: is no file of the bundle; copy the whole folder")
    size = path.stat().st_size
    if size != graph.bytes:
        raise FormatError(
            f"{path}: has {size} bytes, the bundle was made with {graph.bytes}; copy it again"
        )
    if sha256_of(path) != graph.sha256:
        raise FormatError(f"{path}: is not the file that the bundle was made with; copy it again")
    return path


def sha256_of(path: Path) -> str:
    """Hexadecimal."""
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def _decoding(value: Mapping[str, Any]) -> Decoding:
    if value["kind"] not in _DECODINGS:
        raise ValueError(f"its decoding {value['kind']!r} is none of {', '.join(_DECODINGS)}")
    return _DECODINGS[value["kind"]].from_json(value)


def _graph(folder: Path, precision: str, entry: Mapping[str, Any]) -> GraphFile:
    # A name in the file is compared, never used as a path.
    if GRAPHS.get(precision) != entry["file"]:
        raise ValueError(f"its {precision} graph is {entry['file']!r}")
    digest = str(entry["sha256"])
    return GraphFile(
        path=folder / GRAPHS[precision],
        bytes=int(_number(entry["bytes"], 1, _MAX_GRAPH_BYTES)),
        sha256=digest,
    )


def _number(value: Any, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r} is no number")
    if not (math.isfinite(value) and low <= value <= high):
        raise ValueError(f"{value!r} lies outside {low} to {high}")
    return float(value)
