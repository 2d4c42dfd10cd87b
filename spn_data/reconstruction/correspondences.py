"""Features and verified matches of frames, computed by workers and stored in one database."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spn_data.colmap.database import MapDatabase
from spn_data.colmap.model import Scene
from spn_data.colmap.verify import ImageForMatching, VerifiedPair, check_pair, match_pairs
from spn_data.geometry.initial_lens import Hold, InitialLens
from spn_data.matching.features import FeatureOptions, Features, check_features, extract_from_bytes
from spn_data.matching.pairs import PairOptions, visual_vocabulary, vlad_descriptor
from spn_data.matching.putative import MatchOptions
from spn_data.uncertainty.shared_errors import LensPrior
from spn_data.work.answers import check_asked, check_complete, check_kind
from spn_data.work.parallel import Dispatch
from spn_data.work.timing import Progress


@dataclass(frozen=True, eq=False)
class FramesToMap:
    """Input of a reconstruction: N frames and what is known of them.

    Attributes
    ----------
    folder : Path
        Image folder.
    names : tuple of str
        Image paths relative to `folder`.
    sequences, cameras : ndarray, shape (N,), str
        Keys of sequences and cameras.
    positions_m : ndarray, shape (N, 3)
        ENU positions in metres; NaN if unknown.
    lenses : dict of str to InitialLens
        By camera key.
    masks : dict of str to Path
        Mask image by sequence.
    """

    folder: Path
    names: tuple[str, ...]
    sequences: np.ndarray
    cameras: np.ndarray
    positions_m: np.ndarray
    lenses: dict[str, InitialLens]
    masks: dict[str, Path]

    def positions_of(self, names: Sequence[str]) -> np.ndarray:
        """Return the ENU positions (M, 3) of some of the frames; NaN if unknown."""
        row = {name: k for k, name in enumerate(self.names)}
        return self.positions_m[[row[name] for name in names]]

    def camera_ids(self, scene: Scene) -> dict[str, int]:
        """Return the ids of the cameras in a model of the frames, by camera key."""
        key_of = dict(zip(self.names, self.cameras.tolist(), strict=True))
        return {key_of[name]: int(i) for name, i in zip(scene.names, scene.camera_ids, strict=True)}


def held_cameras(
    database: Path, frames: FramesToMap, known_focals: bool = False
) -> dict[int, Hold]:
    """Return what an adjustment may not change of the cameras, by their ids in a database of the frames.

    `known_focals`: hold known focal lengths too.
    """
    held: dict[int, Hold] = {}
    for i, lens in _lenses_of(database, frames).items():
        if lens.hold is not Hold.NOTHING:
            held[i] = lens.hold
        elif known_focals and lens.focal_is_known:
            held[i] = Hold.FOCAL
    return held


def lens_priors(database: Path, frames: FramesToMap) -> dict[int, LensPrior]:
    """Return what is known of the held cameras, by their ids in a database of the frames."""
    return {i: LensPrior.of(lens) for i, lens in _lenses_of(database, frames).items()}


def _lenses_of(database: Path, frames: FramesToMap) -> dict[int, InitialLens]:
    with MapDatabase.open(database) as opened:
        ids = opened.cameras_of(dict(zip(frames.names, frames.cameras.tolist(), strict=True)))
    return {ids[key]: lens for key, lens in frames.lenses.items()}


def extract_missing(
    database: MapDatabase,
    frames: FramesToMap,
    options: FeatureOptions,
    dispatch: Dispatch,
    progress: Progress,
) -> None:
    """Extract the features of all frames that have none in the database yet.

    Parameters
    ----------
    database : MapDatabase
        Features are written to it.
    frames : FramesToMap
    options : FeatureOptions
    dispatch : Dispatch
        Runs the work on workers.
    progress : Progress
    """
    missing = [
        (name, str(sequence))
        for name, sequence in zip(frames.names, frames.sequences, strict=True)
        if not database.has_features(name)
    ]
    done = len(frames.names) - len(missing)

    def batches() -> Iterator[tuple[str, tuple[object, ...]]]:
        for name, sequence in missing:
            mask = frames.masks.get(sequence)
            encoded_mask = None if mask is None else mask.read_bytes()
            yield name, (name, (frames.folder / name).read_bytes(), encoded_mask, options)

    asked = {name for name, _ in missing}

    def store(result: tuple[str, Features]) -> None:
        nonlocal done
        check_kind(result, tuple, 2)
        check_asked(result[0], asked)
        check_features(result[1], options)
        database.write_features(*result)
        done += 1
        progress("features", done, len(frames.names))

    dispatch(extract_from_bytes, batches(), store)
    check_complete(asked)


_VOCABULARY_FRAMES = 200  # whose descriptors the visual words are learnt from


def appearance_of(database: MapDatabase, frames: FramesToMap, options: PairOptions) -> np.ndarray:
    """Return appearance descriptors (N, D) of the frames, with visual words learnt from the same frames."""
    # All descriptors at once would take half a megabyte per frame.
    sample = frames.names[:: math.ceil(len(frames.names) / _VOCABULARY_FRAMES)]
    described = [database.read_features(name).descriptors for name in sample]
    vocabulary = visual_vocabulary(described, options)
    return np.stack(
        [
            vlad_descriptor(database.read_features(name).descriptors, vocabulary)
            for name in frames.names
        ]
    )


_PAIRS_PER_BATCH = 16


def match_missing(
    database: MapDatabase,
    frames: FramesToMap,
    pairs: list[tuple[int, int]],
    options: MatchOptions,
    dispatch: Dispatch,
    progress: Progress,
) -> None:
    """Match and verify the pairs that the database does not contain yet.

    Parameters
    ----------
    database : MapDatabase
        Contains the features of all frames; pairs are written to it.
    frames : FramesToMap
    pairs : list of (int, int)
        Rows of the frames.
    options : MatchOptions
    dispatch : Dispatch
        Runs the work on workers.
    progress : Progress
    """
    ids = [database.ids[name] for name in frames.names]
    missing = [(i, j) for i, j in pairs if not database.has_pair((ids[i], ids[j]))]
    done = len(pairs) - len(missing)
    cache: dict[int, Features] = {}

    sizes: dict[int, int] = {}  # of each image id, the number of its features

    def image(i: int) -> ImageForMatching:
        lens = frames.lenses[str(frames.cameras[i])]
        return ImageForMatching(cache[i], lens.camera, lens.focal_is_known)

    def batches() -> Iterator[tuple[str, tuple[object, ...]]]:
        for start in range(0, len(missing), _PAIRS_PER_BATCH):
            batch = missing[start : start + _PAIRS_PER_BATCH]
            needed = {i for pair in batch for i in pair}
            for i in set(cache) - needed:
                del cache[i]
            for i in needed - set(cache):
                cache[i] = database.read_features(frames.names[i])
                sizes[ids[i]] = len(cache[i])
            images = {ids[i]: image(i) for i in sorted(needed)}
            label = f"matching {frames.names[batch[0][0]]} and {len(batch)} others"
            yield label, (images, [(ids[i], ids[j]) for i, j in batch], options)

    asked = {(ids[i], ids[j]) for i, j in missing}

    def store(result: list[VerifiedPair]) -> None:
        nonlocal done
        check_kind(result, list)
        for pair in result:
            check_kind(pair, VerifiedPair)
            check_asked(pair.image_ids, asked)
            check_pair(pair, sizes)
        for pair in result:
            database.write_pair(pair)
        done += len(result)
        progress("matching", done, len(pairs))

    dispatch(match_pairs, batches(), store)
    check_complete(asked)
