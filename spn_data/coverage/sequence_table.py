"""Coverage of a whole sequence, frames without a pose included: its figures, coverage.csv."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.coverage.nearest_frame import CoverageOptions, Stratum, above_range, nearest_frames
from spn_data.coverage.view_share import SeenMap, view_shares
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_data.storage.files import read_csv, write_csv
from spn_data.work.timing import Progress

_TELLING_M = 0.05  # less beyond the range of heights is not worth a sentence
_FAR_M = 1000.0  # from the map: nobody plans that

COLUMNS = (
    *("name", "status", "stratum", "nearest", "distance", "angle_deg", "height", "above_mapping"),
    *("view_share", "answer_distance", "answer_angle_deg", "x", "y", "z", "reason"),
)


@dataclass(frozen=True, eq=False)
class Queries:
    """N poses whose coverage is asked for, of one sequence or plan.

    names : (N,) str; poses : NaN where there is none; cameras : N, one a pose; reason : (N,) str, why
    there is no pose.
    """

    names: np.ndarray
    poses: Poses
    cameras: Sequence[Camera]
    reason: np.ndarray

    @property
    def known(self) -> np.ndarray:
        """(N,) bool: has a pose."""
        return np.asarray(np.isfinite(self.poses.centers).all(axis=1))


@dataclass(frozen=True, eq=False)
class MappingFrames:
    """What covers: M frames with a pose, and the points that they saw.

    has_up : the third axis points up, so that it measures heights.
    """

    names: np.ndarray
    poses: Poses
    seen: SeenMap
    has_up: bool = True


@dataclass(frozen=True, eq=False)
class Coverage:
    """What covers each of N queries; NaN and "" where a query has no pose. Lengths in the map's unit.

    stratum : (N,) str; nearest : (N,) str, name of the nearest mapping frame; distance, angle_deg : (N,)
    to it; height : (N,) of the query above it; above_mapping : (N,) above the highest of all mapping
    frames, negative below the lowest, 0 between; both NaN where no axis points up. view_share : (N,) share
    of the view for which the map has points. answer_distance, answer_angle_deg : (N,) errors of the best
    nearest-neighbour answer.
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
        """Counts, and medians over the queries with a pose; NaN where none has."""
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


def cover(
    queries: Queries,
    mapping: MappingFrames,
    options: CoverageOptions | None,
    progress: Progress | None = None,
) -> Coverage:
    """How mapping frames cover the queries.

    options : None where the map's unit is not known: nothing is put into strata then.
    Raises GeometryError where there is no mapping frame.
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
        above_mapping=spread(above_range(queries.poses.centers[known, 2], heights) + up),
        view_share=spread(shares),
        answer_distance=spread(found.answer_distance),
        answer_angle_deg=spread(found.answer_angle_deg),
    )


def remarks(name: str, coverage: Coverage) -> list[str]:
    """What the user should know of one sequence or plan, a sentence each."""
    summary = coverage.summary()
    known = summary["frames"] - summary["failed"]
    notes = []
    if summary["failed"]:
        notes.append(
            f"{name}: {summary['failed']} of {summary['frames']} frames failed: without a pose, what "
            "covers them is not known."
        )
    heights = summary["heights"]
    if heights is None or known == 0:
        return notes
    low, high = heights["mapping"]
    for count, side, by in (
        (heights["above"], "above the highest", heights["highest_above"]),
        (heights["below"], "below the lowest", -heights["lowest_below"]),
    ):
        if by >= _TELLING_M:
            notes.append(
                f"{name}: {count} of {known} lie {side} mapping frame, by up to {by:.1f} m "
                f"(mapping heights {low:.1f} to {high:.1f} m): what is trained on the map has "
                "seen no such height."
            )
    if summary["median"]["distance"] > _FAR_M:
        notes.append(
            f"{name}: the map is {summary['median']['distance'] / 1000:.0f} km away: are latitude, "
            "longitude and their signs right?"
        )
    return notes


def write_coverage(path: Path, coverage: Coverage) -> None:
    """As coverage CSV (docs/coverage.md): one row a query, also for those without a pose."""
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
    """Of coverage CSV: stratum by name. Raises InputError where it is not what `write_coverage` writes."""
    return {row["name"]: row["stratum"] for _, row in read_csv(path, COLUMNS)}


def _cells(values: np.ndarray, digits: int) -> list[str]:
    return ["" if np.isnan(v) else f"{v + 0.0:.{digits}f}" for v in values]


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else float("nan")
