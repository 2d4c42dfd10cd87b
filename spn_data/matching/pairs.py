"""Selection of image pairs to match: neighbours in time, in space and in appearance."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from spn_data.matching.putative import unit_descriptors


@dataclass(frozen=True, kw_only=True)
class PairOptions:
    """Options of the pair selection.

    Attributes
    ----------
    overlap : int
        Number of following frames of the same sequence to pair with.
    far_steps : int
        Number of further frames, at 2, 4, ... times `overlap`.
    spatial_neighbors : int
        Number of nearest frames by GNSS position, apart from those directly before or after.
    spatial_max_m : float
        Distance beyond which no frame is a spatial neighbour.
    appearance_neighbors : int
        Number of most similar frames that are not already paired in time.
    words : int
        Size of the visual vocabulary.
    seed : int
        Random seed.
    """

    overlap: int = 2
    far_steps: int = 3
    spatial_neighbors: int = 5
    spatial_max_m: float = 60.0
    appearance_neighbors: int = 4
    words: int = 64
    seed: int = 0

    @property
    def farthest_step(self) -> int:
        """Largest step between frames of a sequence that are paired in time."""
        return int(self.overlap * 2**self.far_steps)

    def wider(self) -> PairOptions:
        """Return options with three times as many neighbours of each kind."""
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
    """Choose the image pairs to match.

    Parameters
    ----------
    sequences : ndarray of str, shape (N,)
        Sequence of each frame; frames of one sequence are in order of time.
    positions_m : ndarray, shape (N, 3)
        ENU positions in metres; NaN if unknown.
    appearance : ndarray, shape (N, D), or None
        Unit vectors from `vlad_descriptor`.
    options : PairOptions
        Options of the pair selection.

    Returns
    -------
    list of (int, int)
        Sorted pairs (i, j) of frame indices, i < j.
    """
    return sorted(
        sequence_pairs(sequences, options)
        | spatial_pairs(sequences, positions_m, options)
        | (set() if appearance is None else appearance_pairs(sequences, appearance, options))
    )


def sequence_pairs(sequences: np.ndarray, options: PairOptions) -> set[tuple[int, int]]:
    """Pair frames of a sequence with the next `overlap` ones and with some further ones.

    Parameters
    ----------
    sequences : ndarray of str, shape (N,)
        Sequence of each frame; frames of one sequence are in order of time.
    options : PairOptions
        Supplies `overlap` and `far_steps`.

    Returns
    -------
    set of (int, int)
        Pairs (i, j) of frame indices, i < j.
    """
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
    """Pair frames with their nearest neighbours by position.

    Neighbours may be in any sequence. In the same one they must be on another part of the path, that is,
    nearer than half the distance flown in between: an adjacent flight line or a revisited place. Frames
    straight ahead are paired in time.
    """
    known = np.flatnonzero(np.isfinite(positions_m).all(axis=1))
    if len(known) < 2 or options.spatial_neighbors == 0:
        return set()
    positions, sequence = positions_m[known], sequences[known]
    k = min(options.spatial_neighbors + 2 * options.farthest_step + 1, len(known))
    distance_m, neighbor = cKDTree(positions).query(positions, k=k)
    step_m = np.linalg.norm(np.diff(positions, axis=0, prepend=positions[:1]), axis=1)
    flown_m = np.cumsum(step_m)
    pairs = set()
    for i in range(len(known)):
        others, away_m = neighbor[i], distance_m[i]
        straight_on = away_m > 0.5 * np.abs(flown_m[others] - flown_m[i])
        wanted = (others != i) & (away_m <= options.spatial_max_m)
        wanted &= (sequence[others] != sequence[i]) | ~straight_on
        for j in others[wanted][: options.spatial_neighbors].tolist():
            pairs.add(_ordered(int(known[i]), int(known[j])))
    return pairs


def appearance_pairs(
    sequences: np.ndarray, appearance: np.ndarray, options: PairOptions
) -> set[tuple[int, int]]:
    """Pair the most similar frames, except those close in time (loop closures)."""
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


def visual_vocabulary(descriptors: list[np.ndarray], options: PairOptions) -> np.ndarray:
    """Train a visual vocabulary by k-means on a sample of the descriptors.

    Parameters
    ----------
    descriptors : list of ndarray of uint8, shape (N_i, 128)
        RootSIFT descriptors of each frame.
    options : PairOptions
        Supplies `words` and `seed`.

    Returns
    -------
    ndarray of float32, shape (W, 128)
        Visual words; fewer than `words` if there are fewer descriptors.
    """
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
        # A word without descriptors only leaves its part of the VLAD vector empty.
        warnings.filterwarnings("ignore", "One of the clusters is empty")
        centers, _ = kmeans2(unit_descriptors(sample), words, iter=12, minit="points", rng=rng)
    return np.asarray(centers, np.float32)


def vlad_descriptor(descriptors: np.ndarray, vocabulary: np.ndarray) -> np.ndarray:
    """Describe the appearance of an image by VLAD with intra-normalisation.

    Parameters
    ----------
    descriptors : ndarray of uint8, shape (N, 128)
        RootSIFT descriptors of the image.
    vocabulary : ndarray, shape (W, 128)
        From `visual_vocabulary`.

    Returns
    -------
    ndarray of float32, shape (W * 128,)
        Unit vector; zero for an image without features.

    References
    ----------
    Jegou et al. 2010, "Aggregating local descriptors into a compact image representation";
    Arandjelovic & Zisserman 2013, "All about VLAD".
    """
    vlad = np.zeros_like(vocabulary, dtype=np.float32)
    if len(descriptors) and len(vocabulary):
        units = unit_descriptors(descriptors)
        word = np.argmax(units @ vocabulary.T - 0.5 * (vocabulary**2).sum(axis=1), axis=1)
        np.add.at(vlad, word, units - vocabulary[word])
        vlad /= np.maximum(np.linalg.norm(vlad, axis=1, keepdims=True), 1e-12)
        vlad /= np.maximum(np.linalg.norm(vlad), 1e-12)
    return vlad.ravel()
