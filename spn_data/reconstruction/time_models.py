"""Models of neighbours in time, and the similarities that bring them into one frame.

Pairs of images far apart in time may show different places that look alike; neighbours in time hardly do.
Their models are right but short: they drift, and break where the camera turns quickly. Two of them are joined
where many pairs between them agree on one similarity that also agrees with the fixes. Wrong pairs agree on
none: each has its own displacement.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spn_data.colmap.database import MapDatabase
from spn_data.colmap.model import read_map_with_keypoints
from spn_data.colmap.similarity import robust_similarity
from spn_data.errors import GeometryError
from spn_data.geometry.pose import Similarity
from spn_data.reconstruction.contradiction import shape_error

SAME_PLACE = (
    0.08  # distance of two estimates of one point, relative to its distance from the camera
)
MIN_POINTS = 12  # of a pair that says anything about the places of its images
_MIN_SHARE = 0.4  # of the points of a pair, to support a similarity
_MIN_PAIRS = 3  # that support a similarity
_MAX_HYPOTHESES = 50  # similarities of single pairs that are tried for two groups


@dataclass(frozen=True, eq=False)
class TimeModels:
    """Images of M models, in one frame per group of joined models.

    Attributes
    ----------
    model : dict of str to int
        Model of each image, by name.
    group : list of int
        Group of each model.
    frame : list of Similarity
        group_from_model of each model.
    centers : dict of str to ndarray, shape (3,)
        Camera centres, in the frame of their model.
    points : dict of str to ndarray, shape (K, 3), float32
        By image, the point of each feature in the frame of the model; NaN if it has none.
    """

    model: dict[str, int]
    group: list[int]
    frame: list[Similarity]
    centers: dict[str, np.ndarray]
    points: dict[str, np.ndarray]

    @classmethod
    def read(cls, folders: Sequence[Path]) -> TimeModels:
        """Read models, each of which is a group of its own."""
        found = cls({}, list(range(len(folders))), [Similarity.identity()] * len(folders), {}, {})
        for m, folder in enumerate(folders):
            scene, _, table, ids = read_map_with_keypoints(folder)
            for name, center in zip(scene.names, scene.poses.centers, strict=True):
                seen = ids[name] >= 0
                points = np.full((len(ids[name]), 3), np.nan, np.float32)
                points[seen] = scene.points[table.rows_of(ids[name][seen])]
                found.model[name], found.centers[name], found.points[name] = m, center, points
        return found

    def centers_of(self, names: Sequence[str]) -> np.ndarray:
        """Return the camera centres (N, 3) of images of one group, in its frame."""
        return np.array([self.frame[self.model[n]].apply(self.centers[n]) for n in names])

    def members(self, group: int) -> list[str]:
        """Return the images of a group."""
        return [name for name, m in self.model.items() if self.group[m] == group]


@dataclass(frozen=True, eq=False)
class PairPoints:
    """Points that two images have for their N common matches, each in the frame of its image's model.

    Attributes
    ----------
    images : (str, str)
    first, second : ndarray, shape (N, 3)
    distance : ndarray, shape (N,)
        Of the first image from its points.
    """

    images: tuple[str, str]
    first: np.ndarray
    second: np.ndarray
    distance: np.ndarray


def points_of_pairs(models: TimeModels, database: MapDatabase) -> list[PairPoints]:
    """Return the points of all verified pairs whose images are in models and have enough of them."""
    found = []
    for images in database.verified_pairs():
        if not all(name in models.model for name in images):
            continue
        matches = database.read_inliers(*images)
        first, second = (models.points[name][matches[:, k]] for k, name in enumerate(images))
        known = np.isfinite(first[:, 0]) & np.isfinite(second[:, 0])
        if np.count_nonzero(known) >= MIN_POINTS:
            first, second = first[known].astype(np.float64), second[known].astype(np.float64)
            distance = np.linalg.norm(first - models.centers[images[0]], axis=1)
            found.append(PairPoints(images, first, second, distance))
    return found


def displacements(models: TimeModels, pair: PairPoints) -> np.ndarray:
    """Return the distances (N,) of the two estimates of each point, relative to that from the first camera.

    The models of both images must be in one group.
    """
    one, other = (models.frame[models.model[name]] for name in pair.images)
    apart = np.linalg.norm(one.apply(pair.first) - other.apply(pair.second), axis=1)
    return np.asarray(apart / (one.scale * pair.distance))


@dataclass(frozen=True, eq=False)
class _Join:
    """Similarity of the frames of two groups, and the number of matches that support it."""

    support: int
    groups: tuple[int, int]
    first_from_second: Similarity


def join_models(
    models: TimeModels, pairs: Sequence[PairPoints], positions: dict[str, np.ndarray]
) -> None:
    """Join models for as long as pairs between two groups agree on a similarity.

    Parameters
    ----------
    models : TimeModels
        Its groups and frames are changed.
    pairs : sequence of PairPoints
    positions : dict of str to ndarray, shape (3,)
        Fixes in ENU metres, of the images that have one.
    """
    joins: dict[tuple[int, int], _Join | None] = {}
    while True:
        for groups in itertools.combinations(sorted(set(models.group)), 2):
            if groups not in joins:
                joins[groups] = _join(models, pairs, groups, positions)
        possible = [join for join in joins.values() if join is not None]
        if not possible:
            return
        best = max(possible, key=lambda join: join.support)
        kept, joined = best.groups
        for m, group in enumerate(models.group):
            if group == joined:
                models.group[m] = kept
                models.frame[m] = best.first_from_second @ models.frame[m]
        joins = {key: join for key, join in joins.items() if not {kept, joined} & {*key}}


class _Between:
    """Points of all pairs between two groups, in the groups' frames."""

    def __init__(self, models: TimeModels, pairs: Sequence[PairPoints], groups: tuple[int, int]):
        first, second, limit = [], [], []
        for pair in pairs:
            one, other = (models.model[name] for name in pair.images)
            a, b = models.frame[one].apply(pair.first), models.frame[other].apply(pair.second)
            if (models.group[one], models.group[other]) == groups:
                seen_from = models.frame[one].scale * pair.distance
            elif (models.group[other], models.group[one]) == groups:
                a, b = b, a
                center = models.centers_of([pair.images[1]])[0]
                seen_from = np.linalg.norm(a - center, axis=1)
            else:
                continue
            first.append(a)
            second.append(b)
            limit.append(SAME_PLACE * seen_from)
        self.sizes = np.array([len(points) for points in first], np.int64)
        self.first = np.concatenate([np.zeros((0, 3)), *first])
        self.second = np.concatenate([np.zeros((0, 3)), *second])
        self.limit = np.concatenate([np.zeros(0), *limit])
        self._pair = np.repeat(np.arange(len(first)), self.sizes)

    def support(self, similarity: Similarity) -> tuple[np.ndarray, int]:
        """Return the points (N,) bool by which pairs support a similarity, and the number of such pairs."""
        near = np.linalg.norm(similarity.apply(self.second) - self.first, axis=1) < self.limit
        counts = np.bincount(self._pair[near], minlength=len(self.sizes))
        supports = (counts >= MIN_POINTS) & (counts >= _MIN_SHARE * self.sizes)
        return near & supports[self._pair], int(np.count_nonzero(supports))

    def hypotheses(self) -> list[Similarity]:
        """Return the similarities on which most points of single pairs agree."""
        ends = np.cumsum(self.sizes)
        found = []
        for k in np.argsort(-self.sizes, kind="stable")[:_MAX_HYPOTHESES]:
            mine = slice(ends[k] - self.sizes[k], ends[k])
            limit = float(np.median(self.limit[mine]))
            similarity = robust_similarity(self.second[mine], self.first[mine], max_error=limit)
            if similarity is not None:
                found.append(similarity)
        return found


def _join(
    models: TimeModels,
    pairs: Sequence[PairPoints],
    groups: tuple[int, int],
    positions: dict[str, np.ndarray],
) -> _Join | None:
    between = _Between(models, pairs, groups)
    best: _Join | None = None
    for hypothesis in between.hypotheses() if len(between.sizes) >= _MIN_PAIRS else []:
        similarity, (near, supporting) = hypothesis, between.support(hypothesis)
        try:
            for _ in range(3):  # the first is of one pair, others are metres away
                if supporting:
                    similarity = Similarity.fit(between.second[near], between.first[near])
                    near, supporting = between.support(similarity)
        except GeometryError:  # points on a line
            continue
        support = int(np.count_nonzero(near))
        if supporting < _MIN_PAIRS or (best is not None and support <= best.support):
            continue
        share = supporting / len(between.sizes)
        if _is_possible(models, groups, similarity, positions, share):
            best = _Join(support, groups, similarity)
    return best


def _is_possible(
    models: TimeModels,
    groups: tuple[int, int],
    similarity: Similarity,
    positions: dict[str, np.ndarray],
    share: float,
) -> bool:
    """Return whether fixes do not contradict a join; without fixes half of the pairs must support it."""
    names = [[n for n in models.members(group) if n in positions] for group in groups]
    if not all(names):
        return share >= 0.5
    centers = [models.centers_of(names[0]), similarity.apply(models.centers_of(names[1]))]
    fixes = np.array([positions[name] for name in [*names[0], *names[1]]])
    return shape_error(np.concatenate(centers), fixes) is None
