"""Selection of landmarks for a bundle from the map of an area: from training frames, everywhere."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from spn_data.errors import InputError
from spn_data.inputs.landmark_source import LandmarkSource
from spn_data.matching.putative import unit_descriptors
from spn_model.landmarks.landmark_map import LandmarkFacts, LandmarkMap

_MIN_FRAMES = 3  # training frames that see a landmark
_VIEWS = 4  # descriptors of a landmark
_NEW_VIEW = (
    0.8  # difference of views that needs another descriptor; 30 degrees or a factor of two are 1
)
_SIGMA_PX = 0.5  # of a measurement in a mapping frame, for the covariance of a landmark
_FLOOR_M = 1e-3
_CELLS = (10, 6)  # of a frame, in each of which landmarks are wanted
_BYTES = 12 + 12, 128 + 4 + 3 + 2 + 2  # of a landmark and of a descriptor
_BASIS = 32
_OTHER_BYTES = 30_000  # of the file


@dataclass(frozen=True, eq=False, kw_only=True)
class _Seen:
    """Measurements of map points in training frames; arrays of M rows."""

    point: np.ndarray
    units: np.ndarray
    directions: np.ndarray  # from the point to the camera
    distances: np.ndarray
    sizes: np.ndarray  # scale of the keypoint on the scene
    focal_px: np.ndarray
    cells: np.ndarray


def select_landmarks(
    source: LandmarkSource,
    training: Collection[str],
    offset: np.ndarray,
    facts: LandmarkFacts,
    *,
    max_bytes: int,
) -> tuple[LandmarkMap, int]:
    """Choose landmarks that cover all training frames evenly, and describe them from different directions.

    Parameters
    ----------
    source : LandmarkSource
    training : collection of str
        Names of the training frames; no measurement in another frame enters the map.
    offset : ndarray, shape (3,)
        Of the world of the network, subtracted from positions.
    facts : LandmarkFacts
    max_bytes : int
        Largest size of the file.

    Returns
    -------
    LandmarkMap
    int
        Number of training frames that it was made from.

    Raises
    ------
    InputError
        If the map has no training frame, or not even one landmark fits.
    """
    is_training = np.array([name in training for name in source.names])
    if not is_training.any():
        raise InputError("none of the frames of the map is a training frame of the data set")
    seen = _seen(source, np.flatnonzero(is_training[source.frame]))
    count = np.bincount(seen.point, minlength=len(source.xyz))
    covariance = _covariances(seen, len(source.xyz))
    chosen, rows = _within(seen, _order(seen, count, covariance), max_bytes - _OTHER_BYTES)
    found = LandmarkMap(
        facts=facts,
        xyz=source.xyz[chosen] - offset,
        covariance=covariance[chosen],
        basis=_basis(rows["descriptors"]),
        **rows,
    )
    return found, int(is_training.sum())


def _seen(source: LandmarkSource, rows: np.ndarray) -> _Seen:
    frame, point = source.frame[rows], source.point[rows]
    towards = source.poses.centers[frame] - source.xyz[point]
    far = np.linalg.norm(towards, axis=1)
    depth = -np.einsum("ni,ni->n", source.poses.rotations[frame][:, 2], towards)
    cell = np.floor(source.pixels[rows] / source.sizes[frame] * _CELLS).astype(np.int64)
    cell = np.clip(cell, 0, np.array(_CELLS) - 1)
    return _Seen(
        point=point,
        units=unit_descriptors(source.descriptors[rows]),
        directions=towards / np.maximum(far, 1e-9)[:, None],
        distances=far,
        sizes=source.scales[rows] * depth / source.focal_px[frame],
        focal_px=source.focal_px[frame],
        cells=(frame * _CELLS[1] + cell[:, 1]) * _CELLS[0] + cell[:, 0],
    )


def _covariances(seen: _Seen, count: int) -> np.ndarray:
    """Return covariances (P, 3, 3) of the points by triangulation from their measurements."""
    across = np.eye(3) - seen.directions[:, :, None] * seen.directions[:, None, :]
    weight = (seen.focal_px / (_SIGMA_PX * seen.distances)) ** 2
    information = np.zeros((count, 3, 3))
    np.add.at(information, seen.point, weight[:, None, None] * across)
    information += np.eye(3) * 1e-2  # at most 10 m, for points that are not used
    return np.linalg.inv(information) + np.eye(3) * _FLOOR_M**2


def _order(seen: _Seen, count: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return points in the order in which they are wanted.

    Each cell of each training frame asks for its first landmark before any gets its second, and so on. In a
    cell, points that many frames see well come first.
    """
    usable = count[seen.point] >= _MIN_FRAMES
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    merit = np.minimum(count, 12) / 12 - np.minimum(
        sigma / np.median(sigma[count >= _MIN_FRAMES]), 5
    )
    rows = np.flatnonzero(usable)
    rows = rows[np.lexsort((-merit[seen.point[rows]], seen.cells[rows]))]
    _, first, size = np.unique(seen.cells[rows], return_index=True, return_counts=True)
    turn = np.arange(len(rows)) - np.repeat(first, size)
    rows = rows[np.lexsort((-merit[seen.point[rows]], turn))]
    _, earliest = np.unique(seen.point[rows], return_index=True)
    found: np.ndarray = seen.point[rows[np.sort(earliest)]]
    return found


def _within(seen: _Seen, rank: np.ndarray, room: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return as many of the first points as fit, ascending, and their descriptors."""
    order = np.argsort(seen.point, kind="stable")
    starts = np.searchsorted(seen.point[order], np.arange(seen.point.max() + 2))
    chosen, described, used = [], {}, 0
    for point in rank.tolist():
        rows = order[starts[point] : starts[point + 1]]
        views = _views(seen, rows)
        used += _BYTES[0] + len(views) * _BYTES[1]
        if used > room:
            break
        chosen.append(point)
        described[point] = views
    if not chosen:
        raise InputError("no landmark fits into a map of this size; raise --map-mb")
    points = np.sort(np.array(chosen))
    groups = [group for point in points.tolist() for group in described[point]]
    rows, size = np.concatenate(groups), np.array([len(group) for group in groups])
    starts = np.cumsum(size) - size
    directions = np.add.reduceat(seen.directions[rows], starts)
    units = np.add.reduceat(seen.units[rows], starts)
    units /= np.linalg.norm(units, axis=1, keepdims=True)
    return points, {
        "descriptors": np.clip(np.rint(512 * units), 0, 255).astype(np.uint8),
        "landmark": np.repeat(np.arange(len(points)), [len(described[p]) for p in points.tolist()]),
        "directions": directions / np.linalg.norm(directions, axis=1, keepdims=True),
        "sizes_m": np.add.reduceat(seen.sizes[rows], starts) / size,
        "distances_m": np.add.reduceat(seen.distances[rows], starts) / size,
    }


def _views(seen: _Seen, rows: np.ndarray) -> list[np.ndarray]:
    """Group the measurements of one point by view: those seen alike share a descriptor."""
    cosine = np.clip(seen.directions[rows] @ seen.directions[rows].T, -1, 1)
    logs = np.log2(seen.distances[rows])
    unlike = np.rad2deg(np.arccos(cosine)) / 30 + np.abs(logs[:, None] - logs[None])
    middles = [int(unlike.sum(axis=1).argmin())]
    while len(middles) < min(_VIEWS, len(rows)):
        nearest = unlike[:, middles].min(axis=1)
        if nearest.max() < _NEW_VIEW:
            break
        middles.append(int(nearest.argmax()))
    member = unlike[:, middles].argmin(axis=1)
    return [rows[member == k] for k in range(len(middles))]


def _basis(descriptors: np.ndarray) -> np.ndarray:
    """Return the directions (128, B) in which the descriptors are largest."""
    units = unit_descriptors(descriptors)
    _, vectors = np.linalg.eigh((units.T @ units).astype(np.float64))
    return np.ascontiguousarray(vectors[:, ::-1][:, :_BASIS], np.float32)
