"""Coverage of query poses by mapping frames: nearest frame, strata, best nearest-neighbour answer."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from scipy.spatial.distance import cdist

from spn_data.coverage.view_share import ViewShareOptions
from spn_data.errors import GeometryError
from spn_data.geometry.pose import Poses, pose_errors

_PAIRS_AT_ONCE = 2_000_000  # pairs of query and mapping frame per batch, to limit memory


class Stratum(StrEnum):
    """Stratum of a pose: how well mapping frames cover it."""

    HIGH = "high"
    MEDIUM = "medium"
    LOW = "low"


_BY_LEVEL = np.array([Stratum.HIGH.value, Stratum.MEDIUM.value, Stratum.LOW.value])


@dataclass(frozen=True, kw_only=True)
class CoverageOptions:
    """Limits of the strata and the metric between poses.

    Attributes
    ----------
    high_m, high_deg : float
        Coverage is high if a mapping frame is within this distance and this angle.
    medium_m, medium_deg : float
        The same for medium coverage.
    deg_per_m : float
        Angle equivalent to one metre in the combined metric ``distance + angle / deg_per_m``.
    view : ViewShareOptions
        Options of the view share.

    Notes
    -----
    Lengths are in the unit of the world.
    """

    high_m: float = 2.0
    high_deg: float = 15.0
    medium_m: float = 5.0
    medium_deg: float = 40.0
    deg_per_m: float = 10.0
    view: ViewShareOptions = field(default_factory=ViewShareOptions)

    def __post_init__(self) -> None:
        if not (0 < self.high_m <= self.medium_m and 0 < self.high_deg <= self.medium_deg):
            raise ValueError(
                "thresholds of high coverage must be positive and within those of medium coverage"
            )

    def limits(self, stratum: Stratum) -> tuple[float, float]:
        """Return the limits (distance, angle in degrees) of stratum HIGH or MEDIUM."""
        return {
            Stratum.HIGH: (self.high_m, self.high_deg),
            Stratum.MEDIUM: (self.medium_m, self.medium_deg),
        }[stratum]


@dataclass(frozen=True, eq=False)
class Nearest:
    """Nearest mapping frames of N queries; lengths in the unit of the world.

    Attributes
    ----------
    stratum : ndarray of str, shape (N,)
        Best stratum given by any mapping frame.
    frame : ndarray of int, shape (N,)
        Nearest mapping frame: among the frames that give the stratum, the one with the smallest
        ``distance + angle / deg_per_m``.
    distance, angle_deg : ndarray, shape (N,)
        Distance and angle to the nearest mapping frame.
    height : ndarray, shape (N,)
        Height of the query above it.
    answer_distance, answer_angle_deg : ndarray, shape (N,)
        Errors of the best possible nearest-neighbour answer: the frame with the smallest
        ``distance + angle / deg_per_m`` of all. It differs from `frame` only if a frame with a larger sum is
        within the limits of a better stratum.
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
    """Find the nearest mapping frame of each query by exhaustive search.

    Parameters
    ----------
    queries : Poses
        N query poses, all finite.
    mapping : Poses
        M poses of mapping frames, all finite.
    options : CoverageOptions, optional
        Limits of the strata and the metric.

    Returns
    -------
    Nearest
        Nearest frames, strata and errors of the nearest-neighbour answer.

    Raises
    ------
    GeometryError
        If there is no mapping frame.

    Notes
    -----
    Angles are of the full relative rotation, including roll, so they equal the error of a nearest-neighbour
    answer.
    """
    options = options or CoverageOptions()
    if len(mapping) == 0:
        raise GeometryError("there is no mapping frame with a pose, so coverage cannot be computed")
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
    """Return distances (N, M) and angles (N, M), in degrees to 1e-5, between all pairs of N and M poses."""
    cosine = np.minimum(np.abs(a.quats_wxyz @ b.quats_wxyz.T), 1.0)
    return cdist(a.centers, b.centers), np.rad2deg(2 * np.arccos(cosine))


def coverage_strata(
    queries: Poses, mapping: Poses, options: CoverageOptions | None = None
) -> np.ndarray:
    """Return the stratum of each query.

    Parameters
    ----------
    queries, mapping : Poses
        N queries and M mapping frames; NaN if a frame has no pose. Mapping frames without a pose are ignored.
    options : CoverageOptions, optional
        Limits of the strata and the metric.

    Returns
    -------
    ndarray of str, shape (N,)
        Stratum; empty for queries without a pose.

    Raises
    ------
    GeometryError
        If no mapping frame has a pose.
    """
    known = np.isfinite(queries.centers).all(axis=1)
    nearest = nearest_frames(
        queries[known], mapping[np.isfinite(mapping.centers).all(axis=1)], options
    )
    strata = np.full(len(queries), "", dtype=_BY_LEVEL.dtype)
    strata[known] = nearest.stratum
    return strata


def height_outside_range(heights: np.ndarray, mapping_heights: np.ndarray) -> np.ndarray:
    """Return heights (N,) above the highest mapping frame, negative below the lowest, 0 in between."""
    low, high = mapping_heights.min(), mapping_heights.max()
    return np.maximum(heights - high, 0.0) + np.minimum(heights - low, 0.0)


def _levels(distance: np.ndarray, angle_deg: np.ndarray, options: CoverageOptions) -> np.ndarray:
    """Return the level of each pair: 0 high, 1 medium, 2 low."""
    is_high = (distance <= options.high_m) & (angle_deg <= options.high_deg)
    is_medium = (distance <= options.medium_m) & (angle_deg <= options.medium_deg)
    # The limits of high coverage are within those of medium.
    return (2 - is_high.astype(np.int8) - is_medium).astype(np.int8)
