"""Which pairs of frames to match: neighbours in time, in space, and in appearance."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from spn_data.matching.putative import unit_descriptors


@dataclass(frozen=True, kw_only=True)
class PairOptions:
    """How pairs are chosen."""

    overlap: int = 2  # following frames of the same sequence
    far_steps: int = 3  # further ones at 2, 4, ... times the overlap
    spatial_neighbors: int = 5  # nearest frames by GNSS that lie not just before or behind
    spatial_max_m: float = 60.0  # beyond which no frame is a neighbour
    appearance_neighbors: int = 4  # most similar frames that time does not pair already
    words: int = 64  # of the vocabulary that appearance is described with
    seed: int = 0

    @property
    def farthest_step(self) -> int:
        """Between frames of a sequence that time pairs."""
        return int(self.overlap * 2**self.far_steps)

    def wider(self) -> PairOptions:
        """Three times as many neighbours of each kind."""
        return replace(
            self,
            overlap=self.overlap * 3 + self.far_steps * 2,
            spatial_neighbors=self.spatial_neighbors * 3,
            appearance_neighbors=self.appearance_neighbors * 3,
        )


def choose_pairs(
    sequences: np.ndarray,
    positions_m: np.ndarray,
    appearance: np.ndarray | None,
    options: PairOptions,
) -> list[tuple[int, int]]:
    """Pairs (i, j) of frame indices, i < j, sorted.

    sequences : (N,) names; frames of one sequence stand in the order of time. positions_m : (N, 3) ENU,
    NaN where unknown. appearance : (N, D) unit vectors (`describe_appearance`), or None.
    """
    return sorted(
        sequence_pairs(sequences, options)
        | spatial_pairs(sequences, positions_m, options)
        | (set() if appearance is None else appearance_pairs(sequences, appearance, options))
    )


def sequence_pairs(sequences: np.ndarray, options: PairOptions) -> set[tuple[int, int]]:
    """Frames of a sequence with the next `overlap` ones, and some further ones."""
    steps = [
        *range(1, options.overlap + 1),
        *(options.overlap * 2**k for k in range(1, options.far_steps + 1)),
    ]
    pairs: set[tuple[int, int]] = set()
    for name in np.unique(sequences):
        index = np.flatnonzero(sequences == name)
        for step in steps:
            pairs.update(zip(index[:-step].tolist(), index[step:].tolist(), strict=True))
    return pairs


def spatial_pairs(
    sequences: np.ndarray, positions_m: np.ndarray, options: PairOptions
) -> set[tuple[int, int]]:
    """Nearest frames by position, over all sequences; within one, of those on another part of the path.

    On another part is what lies nearer than half the way that was flown in between: a neighbouring line, a
    place seen again. What lies straight on is paired by time.
    """
    known = np.flatnonzero(np.isfinite(positions_m).all(axis=1))
    if len(known) < 2 or options.spatial_neighbors == 0:
        return set()
    places, of_place = positions_m[known], sequences[known]
    k = min(options.spatial_neighbors + 2 * options.farthest_step + 1, len(known))
    distance_m, neighbor = cKDTree(places).query(places, k=k)
    step_m = np.linalg.norm(np.diff(places, axis=0, prepend=places[:1]), axis=1)
    flown_m = np.cumsum(step_m)
    pairs = set()
    for i in range(len(known)):
        others, away_m = neighbor[i], distance_m[i]
        straight_on = away_m > 0.5 * np.abs(flown_m[others] - flown_m[i])
        wanted = (others != i) & (away_m <= options.spatial_max_m)
        wanted &= (of_place[others] != of_place[i]) | ~straight_on
        for j in others[wanted][: options.spatial_neighbors].tolist():
            pairs.add(_ordered(int(known[i]), int(known[j])))
    return pairs


def appearance_pairs(
    sequences: np.ndarray, appearance: np.ndarray, options: PairOptions
) -> set[tuple[int, int]]:
    """Most similar frames, leaving out those that are close in time anyway (loop closures)."""
    n = len(appearance)
    similarity = appearance @ appearance.T
    order = np.arange(n)
    near = (np.abs(order[:, None] - order[None]) <= options.farthest_step // 2) & (
        sequences[:, None] == sequences[None]
    )
    similarity[near] = -np.inf
    k = min(options.appearance_neighbors, n - 1)
    pairs = set()
    for i in range(n):
        for j in np.argsort(-similarity[i], kind="stable")[:k]:
            if np.isfinite(similarity[i, j]):
                pairs.add(_ordered(i, int(j)))
    return pairs


def _ordered(i: int, j: int) -> tuple[int, int]:
    return (i, j) if i < j else (j, i)


def appearance_vocabulary(descriptors: list[np.ndarray], options: PairOptions) -> np.ndarray:
    """Words (W, 128): k-means over a sample of the descriptors of the frames themselves."""
    rng = np.random.default_rng(options.seed)
    filled = [d for d in descriptors if len(d)]
    per_image = max(1, 50_000 // max(1, len(filled)))
    sample = np.concatenate(
        [d[rng.permutation(len(d))[:per_image]] for d in filled] or [np.zeros((0, 128), np.uint8)]
    )
    words = min(options.words, len(sample))
    if words == 0:
        return np.zeros((0, 128), np.float32)
    with warnings.catch_warnings():
        # A word that no descriptor is nearest to only leaves its part of the description empty.
        warnings.filterwarnings("ignore", "One of the clusters is empty")
        centers, _ = kmeans2(unit_descriptors(sample), words, iter=12, minit="points", rng=rng)
    return np.asarray(centers, np.float32)


def describe_appearance(descriptors: np.ndarray, vocabulary: np.ndarray) -> np.ndarray:
    """One unit vector (W * 128,) for an image: VLAD with intra-normalisation.

    Jegou et al. 2010, "Aggregating local descriptors into a compact image representation";
    Arandjelovic & Zisserman 2013, "All about VLAD". An image without features is the zero vector.
    """
    vlad = np.zeros_like(vocabulary, dtype=np.float32)
    if len(descriptors) and len(vocabulary):
        units = unit_descriptors(descriptors)
        word = np.argmax(units @ vocabulary.T - 0.5 * (vocabulary**2).sum(axis=1), axis=1)
        np.add.at(vlad, word, units - vocabulary[word])
        vlad /= np.maximum(np.linalg.norm(vlad, axis=1, keepdims=True), 1e-12)
        vlad /= np.maximum(np.linalg.norm(vlad), 1e-12)
    return vlad.ravel()
