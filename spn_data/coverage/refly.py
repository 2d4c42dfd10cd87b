"""Where to fly again: few poses from which new mapping frames would cover what is covered badly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.coverage.nearest_frame import CoverageOptions, Stratum, distances_and_angles
from spn_data.geometry.pose import (
    Poses,
    angles_from_rotations,
    rotation_errors_deg,
    rotations_from_angles,
)

_ALIKE = 0.25  # of the limits: queries within it of a candidate make no candidate of their own
_MAX_PASSES = 20  # of shortening the path
_MAX_SHORTENED = 400  # stops; a longer path stays as the nearest stop was chosen each time


@dataclass(frozen=True, kw_only=True)
class ReflyOptions:
    """What the new frames should reach."""

    wanted: Stratum = Stratum.HIGH  # or MEDIUM: what each query should reach
    # Share of the limits that is planned with: what is left is for the error of flying there.
    margin: float = 0.7


@dataclass(frozen=True, eq=False)
class FlyAgain:
    """K poses to take mapping frames from, in the order of a short path.

    poses : East-North-Up; angles_deg : (K, 3) heading, pitch and roll of the same; serves : (K,) int,
    queries for which each is the nearest of them; query_stop : (N,) int, which of them serves each query,
    -1 for one that needs none.
    """

    poses: Poses
    angles_deg: np.ndarray
    serves: np.ndarray
    query_stop: np.ndarray

    def __len__(self) -> int:
        return len(self.poses)


def where_to_fly_again(
    queries: Poses,
    strata: np.ndarray,
    options: CoverageOptions | None = None,
    refly: ReflyOptions | None = None,
) -> FlyAgain:
    """Poses such that a mapping frame at each brings every one of N queries to the stratum wanted.

    queries : finite, in an East-North-Up frame; strata : (N,) what they have. The new poses are such of
    the queries themselves, with the camera level, or rolled as the query where it is rolled by more than
    a small part of the limit. Chosen one by one, each time that which covers most of what is left
    (greedy set cover, Chvatal 1979), then those that became superfluous are left out.
    """
    options, refly = options or CoverageOptions(), refly or ReflyOptions()
    limit, limit_deg = (refly.margin * value for value in options.limits(refly.wanted))
    enough = {Stratum.HIGH.value} | (
        {Stratum.MEDIUM.value} if refly.wanted is Stratum.MEDIUM else set()
    )
    needy = np.flatnonzero(~np.isin(strata, list(enough)))
    left = queries[needy]
    candidates = _level(left[_leaders(left, _ALIKE * limit, _ALIKE * limit_deg)], limit_deg)
    chosen = candidates[_cover(_within(candidates, left, limit, limit_deg))]
    chosen = chosen[_path(chosen, options.deg_per_m)]
    stop = np.full(len(queries), -1, dtype=np.int64)
    if len(chosen):
        within = _within(chosen, left, limit, limit_deg)
        cost = np.where(within, _costs(chosen, left, options.deg_per_m), np.inf)
        stop[needy] = cost.argmin(axis=0)
    return FlyAgain(
        poses=chosen,
        angles_deg=angles_from_rotations(chosen.rotations),
        serves=np.bincount(stop[needy], minlength=len(chosen)),
        query_stop=stop,
    )


def _leaders(poses: Poses, limit: float, limit_deg: float) -> np.ndarray:
    """Rows such that every pose lies within the limits of one of them."""
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
    """The poses without roll, where leaving it out turns them by little."""
    angles = angles_from_rotations(poses.rotations)
    level = Poses.from_rotations(
        poses.centers, rotations_from_angles(angles * np.array([1.0, 1.0, 0.0]))
    )
    is_close = rotation_errors_deg(level.quats_wxyz, poses.quats_wxyz) <= _ALIKE * limit_deg
    return Poses(poses.centers, np.where(is_close[:, None], level.quats_wxyz, poses.quats_wxyz))


def _within(stops: Poses, queries: Poses, limit: float, limit_deg: float) -> np.ndarray:
    """(K, N) bool: a frame at the stop covers the query."""
    distance, angle = distances_and_angles(stops, queries)
    return (distance <= limit) & (angle <= limit_deg)


def _costs(stops: Poses, queries: Poses, deg_per_m: float) -> np.ndarray:
    """(K, N) distance plus angle, in the unit of length."""
    distance, angle = distances_and_angles(stops, queries)
    return distance + angle / deg_per_m


def _cover(covers: np.ndarray) -> np.ndarray:
    """Rows of covers (K, N) that together cover every column, few of them."""
    rows: list[int] = []
    open_columns = np.ones(covers.shape[1], dtype=bool)
    gains = covers.sum(axis=1)
    while open_columns.any():
        best = int(gains.argmax())
        assert gains[best] > 0, "every query lies near a candidate"
        newly = covers[best] & open_columns
        rows.append(best)
        open_columns &= ~newly
        gains = gains - covers[:, newly].sum(axis=1)
    counts = covers[rows].sum(axis=0)
    for row in list(rows):  # the first were chosen blind to those that came later
        if (counts[covers[row]] > 1).all():
            counts = counts - covers[row]
            rows.remove(row)
    return np.array(rows, dtype=np.int64)


def _path(stops: Poses, deg_per_m: float) -> np.ndarray:
    """An order (K,) in which little is flown and turned: nearest next stop, then 2-opt, ends free."""
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
    """Turn stretches of the path round while that makes it shorter."""
    n = len(path)
    # A stop that is nowhere, before the first and after the last, leaves the ends free.
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
