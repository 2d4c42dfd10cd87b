"""Reflight planning: a small set of poses at which new mapping frames would cover poorly covered queries."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from spn_data.coverage.nearest_frame import CoverageOptions, Stratum, distances_and_angles
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import (
    angles_from_rotations,
    rotation_errors_deg,
    rotations_from_angles,
)

_ALIKE = 0.25  # share of the limits within which a query is represented by another candidate
_MAX_PASSES = 20  # of 2-opt
_AROUND_M = (3.0, 10.0)  # horizontally, in which points show the ground
_ENOUGH, _LOW_PERCENT = 20, 5
_OBSTACLE = 3  # map points within the clearance; single ones may be wrong
_MAX_RAISED = 10  # steps
_MAX_SHORTENED = 400  # stops; longer paths keep the nearest-neighbour order without 2-opt


@dataclass(frozen=True, kw_only=True)
class ReflyOptions:
    """Target coverage of the new frames.

    Attributes
    ----------
    wanted : Stratum
        Stratum each query should reach, HIGH or MEDIUM.
    margin : float
        Share of the stratum's limits used for planning; the rest allows for the error of flying there.
    floor_m : float
        Least height of a stop above the map points below it.
    clearance_m : float
        Least distance of a stop to map points.
    """

    wanted: Stratum = Stratum.HIGH
    margin: float = 0.7
    floor_m: float = 2.0
    clearance_m: float = 1.0


@dataclass(frozen=True, eq=False)
class ReflightPlan:
    """Stops at which to take new mapping frames, in the order of a short path.

    Attributes
    ----------
    poses : Poses
        Poses of the K stops, East-North-Up.
    angles_deg : ndarray, shape (K, 3)
        Heading, pitch and roll of the stops in degrees.
    serves : ndarray of int, shape (K,)
        Number of queries for which each stop is the nearest.
    query_stop : ndarray of int, shape (N,)
        Stop that serves each query; -1 for queries that need none, or that no stop can serve.
    out_of_reach : int
        Number of queries that need a stop where none may be: too low, or too near to map points.
    """

    poses: Poses
    angles_deg: np.ndarray
    serves: np.ndarray
    query_stop: np.ndarray
    out_of_reach: int = 0

    def __len__(self) -> int:
        return len(self.poses)


def plan_reflight(
    queries: Poses,
    strata: np.ndarray,
    options: CoverageOptions | None = None,
    refly: ReflyOptions | None = None,
    *,
    map_xyz: np.ndarray | None = None,
) -> ReflightPlan:
    """Plan poses at which mapping frames bring every query to the wanted stratum.

    Parameters
    ----------
    queries : Poses
        N query poses, finite, in an East-North-Up frame.
    strata : ndarray of str, shape (N,)
        Current strata of the queries.
    options : CoverageOptions, optional
        Limits of the strata and the metric.
    refly : ReflyOptions, optional
        Target coverage, and where stops may be.
    map_xyz : ndarray, shape (P, 3), optional
        Map points: the ground and the obstacles. Without them, stops may be anywhere.

    Returns
    -------
    ReflightPlan
        Stops and their assignment to the queries; no stops if all queries are covered, or out of reach.

    Notes
    -----
    Candidates are poses of the queries, with the roll removed unless it exceeds a small part of the limit.
    Those below the floor or too near to map points are raised, as far as they then still serve a query. They
    are chosen by greedy set cover (Chvatal 1979), after which redundant stops are removed.
    """
    options, refly = options or CoverageOptions(), refly or ReflyOptions()
    limit, limit_deg = (refly.margin * value for value in options.limits(refly.wanted))
    enough = {Stratum.HIGH.value} | (
        {Stratum.MEDIUM.value} if refly.wanted is Stratum.MEDIUM else set()
    )
    uncovered = np.flatnonzero(~np.isin(strata, list(enough)))
    left = queries[uncovered]
    candidates = _level(left[_thin_out(left, _ALIKE * limit, _ALIKE * limit_deg)], limit_deg)
    if map_xyz is not None and len(map_xyz):
        candidates = _free(candidates, map_xyz, refly, limit)
    covers = _within(candidates, left, limit, limit_deg)
    served = covers.any(axis=0)
    chosen = candidates[_set_cover(covers[:, served])]
    chosen = chosen[_path(chosen, options.deg_per_m)]
    stop = np.full(len(queries), -1, dtype=np.int64)
    if len(chosen):
        within = _within(chosen, left, limit, limit_deg)
        cost = np.where(within, _costs(chosen, left, options.deg_per_m), np.inf)
        stop[uncovered[served]] = cost[:, served].argmin(axis=0)
    return ReflightPlan(
        poses=chosen,
        angles_deg=angles_from_rotations(chosen.rotations),
        serves=np.bincount(stop[uncovered[served]], minlength=len(chosen)),
        query_stop=stop,
        out_of_reach=int((~served).sum()),
    )


def reach_notes(plan: ReflightPlan, refly: ReflyOptions) -> tuple[str, ...]:
    """Return a sentence on the queries that no stop can serve, if there are any."""
    if not plan.out_of_reach:
        return ()
    return (
        f"{plan.out_of_reach} frames would need a place to fly again that is less than {refly.floor_m:g} m "
        f"above the ground or {refly.clearance_m:g} m from map points: none is proposed for them (--floor).",
    )


def _free(poses: Poses, map_xyz: np.ndarray, refly: ReflyOptions, limit: float) -> Poses:
    """Raise poses to the floor and out of the way of map points; leave out those that this moves too far."""
    tree, plan = cKDTree(map_xyz), cKDTree(map_xyz[:, :2])
    centers = poses.centers.copy()
    lowest = np.array([_ground(centre, plan, map_xyz[:, 2]) for centre in centers]) + refly.floor_m
    centers[:, 2] = np.maximum(centers[:, 2], lowest.reshape(-1))
    top = poses.centers[:, 2] + limit
    for _ in range(_MAX_RAISED):
        near = tree.query_ball_point(centers, refly.clearance_m, return_length=True)
        blocked = (near >= _OBSTACLE) & (centers[:, 2] <= top)
        if not blocked.any():
            break
        centers[blocked, 2] += limit / _MAX_RAISED
    near = tree.query_ball_point(centers, refly.clearance_m, return_length=True)
    kept = (near < _OBSTACLE) & (centers[:, 2] <= top)
    return Poses(centers, poses.quats_wxyz)[np.flatnonzero(kept)]


def _ground(center: np.ndarray, plan: cKDTree, heights: np.ndarray) -> float:
    """Return the height of the ground below a place: that of low points around it."""
    for radius in _AROUND_M:
        rows = plan.query_ball_point(center[:2], radius)
        if len(rows) >= _ENOUGH:
            return float(np.percentile(heights[rows], _LOW_PERCENT))
    return float(np.percentile(heights, _LOW_PERCENT))


def _thin_out(poses: Poses, limit: float, limit_deg: float) -> np.ndarray:
    """Select rows such that every pose is within the limits of a selected one."""
    rows: list[int] = []
    free = np.ones(len(poses), dtype=bool)
    for k in range(len(poses)):
        if not free[k]:
            continue
        rows.append(k)
        near = np.flatnonzero(np.linalg.norm(poses.centers - poses.centers[k], axis=1) <= limit)
        angle = rotation_errors_deg(poses.quats_wxyz[near], poses.quats_wxyz[k])
        free[near[angle <= limit_deg]] = False
    return np.array(rows, dtype=np.int64)


def _level(poses: Poses, limit_deg: float) -> Poses:
    """Remove the roll of poses that this rotates only slightly."""
    angles = angles_from_rotations(poses.rotations)
    level = Poses.from_rotations(
        poses.centers, rotations_from_angles(angles * np.array([1.0, 1.0, 0.0]))
    )
    is_close = rotation_errors_deg(level.quats_wxyz, poses.quats_wxyz) <= _ALIKE * limit_deg
    return Poses(poses.centers, np.where(is_close[:, None], level.quats_wxyz, poses.quats_wxyz))


def _within(stops: Poses, queries: Poses, limit: float, limit_deg: float) -> np.ndarray:
    """Return a mask (K, N) of queries covered by a frame at each stop."""
    distance, angle = distances_and_angles(stops, queries)
    return (distance <= limit) & (angle <= limit_deg)


def _costs(stops: Poses, queries: Poses, deg_per_m: float) -> np.ndarray:
    """Return the combined distance and angle (K, N), in the unit of length."""
    distance, angle = distances_and_angles(stops, queries)
    return distance + angle / deg_per_m


def _set_cover(covers: np.ndarray) -> np.ndarray:
    """Select few rows of `covers` (K, N) that together cover every column, by greedy set cover."""
    rows: list[int] = []
    open_columns = np.ones(covers.shape[1], dtype=bool)
    gains = covers.sum(axis=1)
    while open_columns.any():
        best = int(gains.argmax())
        assert gains[best] > 0, "every query must be near a candidate"
        newly = covers[best] & open_columns
        rows.append(best)
        open_columns &= ~newly
        gains = gains - covers[:, newly].sum(axis=1)
    counts = covers[rows].sum(axis=0)
    for row in list(rows):  # rows chosen early may have become redundant
        if (counts[covers[row]] > 1).all():
            counts = counts - covers[row]
            rows.remove(row)
    return np.array(rows, dtype=np.int64)


def _path(stops: Poses, deg_per_m: float) -> np.ndarray:
    """Order the stops (K,) along a short open path with little turning: nearest neighbour, then 2-opt."""
    n = len(stops)
    if n < 3:
        return np.arange(n)
    cost = _costs(stops, stops, deg_per_m)
    middle = stops.centers.mean(axis=0)
    order = [int(np.linalg.norm(stops.centers - middle, axis=1).argmax())]
    free = np.ones(n, dtype=bool)
    free[order[0]] = False
    while free.any():
        order.append(int(np.where(free, cost[order[-1]], np.inf).argmin()))
        free[order[-1]] = False
    path = np.array(order)
    return path if n > _MAX_SHORTENED else _two_opt(path, cost)


def _two_opt(path: np.ndarray, cost: np.ndarray) -> np.ndarray:
    """Shorten an open path by 2-opt."""
    n = len(path)
    # A dummy stop at distance zero from all others, before the first and after the last, frees the ends.
    cost = np.pad(cost, (0, 1))
    path = np.concatenate([[n], path, [n]])
    for _ in range(_MAX_PASSES):
        is_shorter = False
        for i in range(1, n):
            ends = np.arange(i + 1, n + 1)
            gain = (
                cost[path[i - 1], path[i]]
                + cost[path[ends], path[ends + 1]]
                - cost[path[i - 1], path[ends]]
                - cost[path[i], path[ends + 1]]
            )
            best = int(gain.argmax())
            if gain[best] > 1e-9:
                path[i : ends[best] + 1] = path[i : ends[best] + 1][::-1].copy()
                is_shorter = True
        if not is_shorter:
            break
    return path[1:-1]
