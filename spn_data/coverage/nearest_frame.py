"""How mapping frames cover other poses: the nearest frame, strata, the best nearest-neighbour answer."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from scipy.spatial.distance import cdist

from spn_data.coverage.view_share import ViewShareOptions
from spn_data.errors import GeometryError
from spn_data.geometry.pose import Poses, pose_errors

_PAIRS_AT_ONCE = 2_000_000  # of queries and mapping frames: bounds the memory


class Stratum(StrEnum):
    """How well mapping frames cover a pose."""

    HIGH = "high"
    MEDIUM = "medium"
    LOW = "low"


_BY_LEVEL = np.array([Stratum.HIGH.value, Stratum.MEDIUM.value, Stratum.LOW.value])


@dataclass(frozen=True, kw_only=True)
class CoverageOptions:
    """Where strata end, and how two poses are compared. Lengths in the world's unit."""

    high_m: float = 2.0  # a mapping frame as near as this,
    high_deg: float = 15.0  # and as alike in direction: high
    medium_m: float = 5.0
    medium_deg: float = 40.0
    deg_per_m: float = 10.0  # this many degrees count as much as a metre
    view: ViewShareOptions = field(default_factory=ViewShareOptions)

    def __post_init__(self) -> None:
        if not (0 < self.high_m <= self.medium_m and 0 < self.high_deg <= self.medium_deg):
            raise ValueError("thresholds of high coverage are above 0 and within those of medium")

    def limits(self, stratum: Stratum) -> tuple[float, float]:
        """(m, degrees) within which a mapping frame must lie for HIGH or MEDIUM."""
        return {
            Stratum.HIGH: (self.high_m, self.high_deg),
            Stratum.MEDIUM: (self.medium_m, self.medium_deg),
        }[stratum]


@dataclass(frozen=True, eq=False)
class Nearest:
    """What lies nearest to N queries among M mapping frames. Lengths in the world's unit.

    stratum : (N,) str, the best that any mapping frame gives.
    frame : (N,) int, the mapping frame that is meant by "nearest": of those that give that stratum, the
    one with the smallest distance + angle / deg_per_m; distance, angle_deg : (N,) to it; height : (N,)
    of the query above it.
    answer_distance, answer_angle_deg : (N,) errors of the best answer that looking up one mapping frame
    can give: the smallest distance + angle / deg_per_m of all. Differs from the nearest only where
    another frame, worse in sum, is within the limits of a better stratum.
    """

    stratum: np.ndarray
    frame: np.ndarray
    distance: np.ndarray
    angle_deg: np.ndarray
    height: np.ndarray
    answer_distance: np.ndarray
    answer_angle_deg: np.ndarray

    def __len__(self) -> int:
        return len(self.stratum)


def nearest_frames(
    queries: Poses, mapping: Poses, options: CoverageOptions | None = None
) -> Nearest:
    """The mapping frames nearest to N queries; every pair is looked at. All poses are finite.

    Angles are those of the whole rotation between two cameras, roll included: the error that an answer
    would have. Raises GeometryError where there is no mapping frame.
    """
    options = options or CoverageOptions()
    if len(mapping) == 0:
        raise GeometryError("there is no mapping frame with a pose: nothing covers anything")
    n, step = len(queries), max(1, _PAIRS_AT_ONCE // len(mapping))
    frame, answer = np.zeros(n, np.int64), np.zeros(n, np.int64)
    level = np.zeros(n, np.int64)
    for first in range(0, n, step):
        part = slice(first, first + step)
        distance, angle = distances_and_angles(queries[part], mapping)
        cost = distance + angle / options.deg_per_m
        answer[part] = cost.argmin(axis=1)
        levels = _levels(distance, angle, options)
        level[part] = levels.min(axis=1)
        frame[part] = np.where(levels == level[part, None], cost, np.inf).argmin(axis=1)
    distance, angle_deg = pose_errors(queries, mapping[frame])
    answer_distance, answer_angle_deg = pose_errors(queries, mapping[answer])
    return Nearest(
        stratum=_BY_LEVEL[level],
        frame=frame,
        distance=distance,
        angle_deg=angle_deg,
        height=queries.centers[:, 2] - mapping.centers[frame, 2],
        answer_distance=answer_distance,
        answer_angle_deg=answer_angle_deg,
    )


def distances_and_angles(a: Poses, b: Poses) -> tuple[np.ndarray, np.ndarray]:
    """(N, M) between every two of N and M poses; angles in degrees, exact to 1e-5."""
    cosine = np.minimum(np.abs(a.quats_wxyz @ b.quats_wxyz.T), 1.0)
    return cdist(a.centers, b.centers), np.rad2deg(2 * np.arccos(cosine))


def strata_of(queries: Poses, mapping: Poses, options: CoverageOptions | None = None) -> np.ndarray:
    """Stratum (N,) str of each query by M mapping frames; "" for a query without a pose (NaN).

    Mapping frames without a pose are left out. Raises GeometryError where none is left.
    """
    known = np.isfinite(queries.centers).all(axis=1)
    found = nearest_frames(
        queries[known], mapping[np.isfinite(mapping.centers).all(axis=1)], options
    )
    strata = np.full(len(queries), "", dtype=_BY_LEVEL.dtype)
    strata[known] = found.stratum
    return strata


def above_range(heights: np.ndarray, mapping_heights: np.ndarray) -> np.ndarray:
    """(N,) by how much heights lie above the highest mapping frame; negative: below the lowest; 0 between."""
    low, high = mapping_heights.min(), mapping_heights.max()
    return np.maximum(heights - high, 0.0) + np.minimum(heights - low, 0.0)


def _levels(distance: np.ndarray, angle_deg: np.ndarray, options: CoverageOptions) -> np.ndarray:
    """0 high, 1 medium, 2 low, of each pair."""
    is_high = (distance <= options.high_m) & (angle_deg <= options.high_deg)
    is_medium = (distance <= options.medium_m) & (angle_deg <= options.medium_deg)
    # High lies within medium.
    return (2 - is_high.astype(np.int8) - is_medium).astype(np.int8)
