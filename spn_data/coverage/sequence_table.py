"""Coverage of a whole sequence, including frames without a pose: summary, notes and coverage.csv."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.coverage.nearest_frame import (
    CoverageOptions,
    Stratum,
    height_outside_range,
    nearest_frames,
)
from spn_data.coverage.view_share import SeenMap, view_shares
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.storage.files import read_csv, write_csv
from spn_data.work.timing import Progress

_MIN_BEYOND_M = 0.05  # smaller excesses over the range of mapping heights are not reported
_FAR_M = 1000.0  # median distance to the map above which coordinates are probably wrong

COLUMNS = (
    *("name", "status", "stratum", "nearest", "distance", "angle_deg", "height", "above_mapping"),
    *("view_share", "answer_distance", "answer_angle_deg", "x", "y", "z", "reason"),
)


@dataclass(frozen=True, eq=False)
class Queries:
    """Query frames of one sequence or flight plan.

    Attributes
    ----------
    names : ndarray of str, shape (N,)
        Names of the frames.
    poses : Poses
        N poses; NaN if a frame has none.
    cameras : sequence of Camera
        N cameras, one per pose.
    reason : ndarray of str, shape (N,)
        Why a frame has no pose.
    """

    names: np.ndarray
    poses: Poses
    cameras: Sequence[Camera]
    reason: np.ndarray

    @property
    def known(self) -> np.ndarray:
        """Mask (N,) of frames with a pose."""
        return np.asarray(np.isfinite(self.poses.centers).all(axis=1))


@dataclass(frozen=True, eq=False)
class MappingFrames:
    """Mapping frames with a pose, and the map points they observed.

    Attributes
    ----------
    names : ndarray of str, shape (M,)
        Names of the frames.
    poses : Poses
        M poses.
    seen : SeenMap
        Map points and their sightings.
    has_up : bool
        Whether the third axis points up, so that heights are meaningful.
    """

    names: np.ndarray
    poses: Poses
    seen: SeenMap
    has_up: bool = True


@dataclass(frozen=True, eq=False)
class Coverage:
    """Coverage of N queries; NaN or "" if a query has no pose. Lengths in the unit of the map.

    Attributes
    ----------
    queries : Queries
        The query frames.
    mapping_heights : tuple of float
        Lowest and highest mapping frame.
    stratum : ndarray of str, shape (N,)
        Stratum, empty if the unit of the map is unknown.
    nearest : ndarray of str, shape (N,)
        Name of the nearest mapping frame.
    distance, angle_deg : ndarray, shape (N,)
        Distance and angle to the nearest mapping frame.
    height : ndarray, shape (N,)
        Height of the query above the nearest mapping frame; NaN if no axis points up.
    above_mapping : ndarray, shape (N,)
        Height above the highest mapping frame, negative below the lowest, 0 in between; NaN if no axis points
        up.
    view_share : ndarray, shape (N,)
        Share of the view for which the map has points.
    answer_distance, answer_angle_deg : ndarray, shape (N,)
        Errors of the best nearest-neighbour answer.
    """

    queries: Queries
    mapping_heights: tuple[float, float]
    stratum: np.ndarray
    nearest: np.ndarray
    distance: np.ndarray
    angle_deg: np.ndarray
    height: np.ndarray
    above_mapping: np.ndarray
    view_share: np.ndarray
    answer_distance: np.ndarray
    answer_angle_deg: np.ndarray

    def summary(self) -> dict[str, Any]:
        """Return counts, and medians over the queries with a pose (NaN if none has one)."""
        known = self.queries.known
        heights = self.queries.poses.centers[known, 2]
        beyond = self.above_mapping[known]
        return {
            "frames": len(known),
            "failed": int(np.count_nonzero(~known)),
            "strata": {s.value: int(np.count_nonzero(self.stratum == s.value)) for s in Stratum},
            "median": {
                name: _median(getattr(self, name)[known])
                for name in (
                    *("distance", "angle_deg", "height", "view_share"),
                    *("answer_distance", "answer_angle_deg"),
                )
            },
            "heights": {
                "mapping": list(self.mapping_heights),
                "here": [float(heights.min()), float(heights.max())] if len(heights) else None,
                "above": int(np.count_nonzero(beyond > 0)),
                "below": int(np.count_nonzero(beyond < 0)),
                "highest_above": float(beyond.max(initial=0.0)),
                "lowest_below": float(beyond.min(initial=0.0)),
            }
            if np.isfinite(self.mapping_heights).all()
            else None,
        }


def assess_coverage(
    queries: Queries,
    mapping: MappingFrames,
    options: CoverageOptions | None,
    progress: Progress | None = None,
) -> Coverage:
    """Assess how well mapping frames cover the queries.

    Parameters
    ----------
    queries : Queries
        N query frames.
    mapping : MappingFrames
        Mapping frames and map points.
    options : CoverageOptions or None
        Limits of the strata. None if the unit of the map is unknown; strata are then left empty.
    progress : Progress, optional
        Progress callback.

    Returns
    -------
    Coverage
        Coverage of the N queries.

    Raises
    ------
    GeometryError
        If there is no mapping frame.
    """
    known = queries.known
    chosen = options or CoverageOptions()
    found = nearest_frames(queries.poses[known], mapping.poses, chosen)
    cameras = [camera for camera, is_known in zip(queries.cameras, known, strict=True) if is_known]
    shares = view_shares(queries.poses[known], cameras, mapping.seen, chosen.view, progress)
    heights = mapping.poses.centers[:, 2]
    up = 0.0 if mapping.has_up else np.nan

    def spread(values: np.ndarray) -> np.ndarray:
        column = np.full(len(known), np.nan)
        column[known] = values
        return column

    stratum = np.full(len(known), "", dtype="<U6")
    stratum[known] = found.stratum if options else ""
    nearest = np.full(len(known), "", dtype=mapping.names.dtype)
    nearest[known] = mapping.names[found.frame]
    return Coverage(
        queries=queries,
        mapping_heights=(float(heights.min()) + up, float(heights.max()) + up),
        stratum=stratum,
        nearest=nearest,
        distance=spread(found.distance),
        angle_deg=spread(found.angle_deg),
        height=spread(found.height + up),
        above_mapping=spread(height_outside_range(queries.poses.centers[known, 2], heights) + up),
        view_share=spread(shares),
        answer_distance=spread(found.answer_distance),
        answer_angle_deg=spread(found.answer_angle_deg),
    )


def coverage_notes(name: str, coverage: Coverage) -> list[str]:
    """Return sentences for the user on one sequence or flight plan called `name`."""
    summary = coverage.summary()
    known = summary["frames"] - summary["failed"]
    notes = []
    if summary["failed"]:
        notes.append(
            f"{name}: {summary['failed']} of {summary['frames']} frames failed; their coverage is unknown "
            "because they have no pose."
        )
    heights = summary["heights"]
    if heights is None or known == 0:
        return notes
    low, high = heights["mapping"]
    for count, side, by in (
        (heights["above"], "above the highest", heights["highest_above"]),
        (heights["below"], "below the lowest", -heights["lowest_below"]),
    ):
        if by >= _MIN_BEYOND_M:
            notes.append(
                f"{name}: {count} of {known} are {side} mapping frame, by up to {by:.1f} m "
                f"(mapping heights {low:.1f} to {high:.1f} m): a network trained on the map has "
                "never seen such heights."
            )
    if summary["median"]["distance"] > _FAR_M:
        notes.append(
            f"{name}: the map is {summary['median']['distance'] / 1000:.0f} km away: check latitude, "
            "longitude and their signs."
        )
    return notes


def write_coverage(path: Path, coverage: Coverage) -> None:
    """Write coverage CSV (docs/coverage.md): one row per query, including those without a pose."""
    queries = coverage.queries
    centers = queries.poses.centers
    status = np.where(queries.known, "registered", "failed")
    columns: dict[str, Any] = {
        "name": queries.names,
        "status": status,
        "stratum": coverage.stratum,
        "nearest": coverage.nearest,
        "distance": _cells(coverage.distance, 4),
        "angle_deg": _cells(coverage.angle_deg, 3),
        "height": _cells(coverage.height, 4),
        "above_mapping": _cells(coverage.above_mapping, 4),
        "view_share": _cells(coverage.view_share, 4),
        "answer_distance": _cells(coverage.answer_distance, 4),
        "answer_angle_deg": _cells(coverage.answer_angle_deg, 3),
        **{axis: _cells(centers[:, k], 4) for k, axis in enumerate("xyz")},
        "reason": queries.reason,
    }
    write_csv(path, {name: [str(cell) for cell in columns[name]] for name in COLUMNS})


def read_strata(path: Path) -> dict[str, str]:
    """Read the stratum by frame name from coverage CSV; raise InputError for any other file."""
    return {row["name"]: row["stratum"] for _, row in read_csv(path, COLUMNS)}


def _cells(values: np.ndarray, digits: int) -> list[str]:
    return ["" if np.isnan(v) else f"{v + 0.0:.{digits}f}" for v in values]


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else float("nan")
