"""Landmark map: points of the map with their descriptors, in a file that NumPy reads."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.errors import FormatError
from spn_data.geometry.json_values import bounded, parse_json
from spn_data.matching.features import FeatureOptions
from spn_data.matching.putative import unit_descriptors

VERSION = 1
DESCRIPTOR_BYTES = 128
_MAX_FILE_BYTES = 200_000_000
_MAX_ROWS = 2_000_000
_MM = 1e-3  # factors of covariances are stored in millimetres, which float16 resolves
# Kind and shape of each array of the file; None for a side that may have any length.
_ARRAYS: dict[str, tuple[str, tuple[int | None, ...]]] = {
    "facts": ("u1", (None,)),
    "middle": ("f8", (3,)),
    "xyz": ("f4", (None, 3)),
    "sigma_mm": ("f2", (None, 6)),
    "descriptors": ("u1", (None, DESCRIPTOR_BYTES)),
    "landmark": ("i4", (None,)),
    "directions": ("i1", (None, 3)),
    "sizes_m": ("f2", (None,)),
    "distances_m": ("f2", (None,)),
    "basis": ("f4", (DESCRIPTOR_BYTES, None)),
}


@dataclass(frozen=True, kw_only=True)
class LandmarkFacts:
    """What a landmark map is bound to, and how its features are detected.

    Attributes
    ----------
    features : FeatureOptions
        Options with which features are detected on board, as for the descriptors of the map.
    noise_px : float
        Standard deviation of a measurement along one axis, at the width that features are detected at.
    map_hash : str
        Hash of the map that the landmarks are from.
    network : str
        SHA-256 of the float32 graph of the bundle.
    """

    features: FeatureOptions
    noise_px: float
    map_hash: str
    network: str

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "version": VERSION,
            "max_features": self.features.max_features,
            "max_image_size_px": self.features.max_image_size_px,
            "contrast_threshold": self.features.contrast_threshold,
            "edge_threshold": self.features.edge_threshold,
            "noise_px": self.noise_px,
            "map_hash": self.map_hash,
            "network": self.network,
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> LandmarkFacts:
        """Parse the result of `to_json`; raise KeyError, TypeError or ValueError if invalid."""
        if value["version"] != VERSION:
            raise ValueError(f"its version is {value['version']!r}, this program reads {VERSION}")
        return cls(
            features=FeatureOptions(
                max_features=int(bounded(value["max_features"], 16, 20_000)),
                max_image_size_px=int(bounded(value["max_image_size_px"], 64, 4096)),
                contrast_threshold=bounded(value["contrast_threshold"], 1e-4, 1),
                edge_threshold=bounded(value["edge_threshold"], 1, 1000),
            ),
            noise_px=bounded(value["noise_px"], 0.01, 100),
            map_hash=str(value["map_hash"]),
            network=str(value["network"]),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class LandmarkMap:
    """L landmarks with D descriptors, each of the views from one direction.

    Attributes
    ----------
    facts : LandmarkFacts
    xyz : ndarray, shape (L, 3)
        Positions relative to the offset of the bundle's view, metres.
    covariance : ndarray, shape (L, 3, 3)
        Of the positions, relative to the map.
    descriptors : ndarray of uint8, shape (D, 128)
        RootSIFT.
    landmark : ndarray, shape (D,)
        Row of the landmark that a descriptor describes.
    directions : ndarray, shape (D, 3)
        Unit vectors from the landmark towards the camera that saw it.
    sizes_m : ndarray, shape (D,)
        Scale of the keypoint on the scene.
    distances_m : ndarray, shape (D,)
        From that camera.
    basis : ndarray, shape (128, B)
        Orthonormal directions to which descriptors are reduced for the comparison with all landmarks.
    """

    facts: LandmarkFacts
    xyz: np.ndarray
    covariance: np.ndarray
    descriptors: np.ndarray
    landmark: np.ndarray
    directions: np.ndarray
    sizes_m: np.ndarray
    distances_m: np.ndarray
    basis: np.ndarray

    def __len__(self) -> int:
        return len(self.xyz)

    @cached_property
    def units(self) -> np.ndarray:
        """Descriptors of length one, (D, 128) float32."""
        return unit_descriptors(self.descriptors)

    @cached_property
    def reduced(self) -> np.ndarray:
        """Mean descriptors in the reduced space, and their squared lengths in the last row, (B + 1, L)."""
        first = np.searchsorted(self.landmark, np.arange(len(self)))
        means = _unit(np.add.reduceat(self.units, first)) @ self.basis
        return np.vstack([means.T, (means**2).sum(axis=1)])

    def save(self, path: Path) -> None:
        """Write the map to a file. Values are rounded as the file stores them."""
        middle = np.round(self.xyz.mean(axis=0)) if len(self.xyz) else np.zeros(3)
        factor = np.linalg.cholesky(self.covariance) / _MM
        rows, columns = np.tril_indices(3)
        text = json.dumps(self.facts.to_json(), allow_nan=False).encode()
        arrays = {
            "facts": np.frombuffer(text, np.uint8),
            "middle": middle,
            "xyz": self.xyz - middle,
            "sigma_mm": np.clip(factor[:, rows, columns], -6e4, 6e4),
            "descriptors": self.descriptors,
            "landmark": self.landmark,
            "directions": np.rint(127 * self.directions),
            "sizes_m": self.sizes_m,
            "distances_m": np.minimum(self.distances_m, 6e4),
            "basis": self.basis,
        }
        with path.open("wb") as handle:
            stored = {n: np.asarray(a).astype(_ARRAYS[n][0]) for n, a in arrays.items()}
            np.savez_compressed(handle, allow_pickle=False, **stored)

    @classmethod
    def load(cls, path: Path) -> LandmarkMap:
        """Read a map.

        Raises
        ------
        FormatError
            If the file is damaged, too large, or of another version.
        """
        try:
            with zipfile.ZipFile(path) as archive:
                if sum(entry.file_size for entry in archive.infolist()) > _MAX_FILE_BYTES:
                    raise ValueError("it is too large")
            with np.load(path, allow_pickle=False) as opened:
                arrays = {name: opened[name] for name in _ARRAYS}
            return cls._from_arrays(arrays)
        except FileNotFoundError as error:
            raise FormatError(
                f"{path}: does not exist; copy the whole bundle folder again"
            ) from error
        except Exception as error:  # what damaged archives raise: zipfile, zlib, struct, NumPy
            raise FormatError(f"{path}: is damaged ({error}); copy the bundle again") from error

    @classmethod
    def _from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> LandmarkMap:
        for name, (kind, shape) in _ARRAYS.items():
            array = arrays[name]
            fits = array.ndim == len(shape) and all(
                want in (None, have) for want, have in zip(shape, array.shape, strict=True)
            )
            if array.dtype != np.dtype(kind) or not fits or array.size > 128 * _MAX_ROWS:
                raise ValueError(f"its array {name} is {array.dtype} {array.shape}")
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise ValueError(f"its array {name} has values that are not finite")
        count, described = len(arrays["xyz"]), len(arrays["descriptors"])
        sides = {
            **{"sigma_mm": count, "landmark": described, "directions": described},
            **{"sizes_m": described, "distances_m": described},
        }
        if any(len(arrays[name]) != side for name, side in sides.items()):
            raise ValueError("its arrays do not belong together")
        landmark = arrays["landmark"].astype(np.int64)
        if not count or not np.array_equal(np.unique(landmark), np.arange(count)):
            raise ValueError("its landmarks and descriptors do not belong together")
        if (np.diff(landmark) < 0).any():
            raise ValueError("its descriptors are not in the order of its landmarks")
        factor = np.zeros((count, 3, 3))
        rows, columns = np.tril_indices(3)
        factor[:, rows, columns] = arrays["sigma_mm"].astype(np.float64) * _MM
        middle = arrays["middle"]
        return cls(
            facts=LandmarkFacts.from_json(parse_json(arrays["facts"].tobytes().decode())),
            xyz=arrays["xyz"].astype(np.float64) + middle,
            covariance=factor @ factor.transpose(0, 2, 1),
            descriptors=arrays["descriptors"],
            landmark=landmark,
            directions=_unit(arrays["directions"]),
            sizes_m=arrays["sizes_m"].astype(np.float32),
            distances_m=arrays["distances_m"].astype(np.float32),
            basis=arrays["basis"],
        )


def _unit(vectors: np.ndarray) -> np.ndarray:
    floats = vectors.astype(np.float32)
    found: np.ndarray = floats / np.maximum(np.linalg.norm(floats, axis=1, keepdims=True), 1e-12)
    return found
