"""Features and verified matches of frames, computed by workers into one database."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spn_data.colmap.database import MapDatabase
from spn_data.colmap.verify import ImageForMatching, VerifiedPair, match_pairs
from spn_data.geometry.camera import Camera
from spn_data.matching.features import FeatureOptions, Features, extract_from_bytes
from spn_data.matching.pairs import PairOptions, visual_vocabulary, vlad_descriptor
from spn_data.matching.putative import MatchOptions
from spn_data.work.parallel import Dispatch
from spn_data.work.timing import Progress


@dataclass(frozen=True, eq=False)
class FramesToMap:
    """What reconstruction knows of N frames.

    names : relative to `folder`; sequences, cameras : (N,) keys; positions_m : (N, 3) ENU, NaN where
    unknown; start_cameras : by key, with whether the focal length is known; masks : file by sequence.
    """

    folder: Path
    names: tuple[str, ...]
    sequences: np.ndarray
    cameras: np.ndarray
    positions_m: np.ndarray
    start_cameras: dict[str, tuple[Camera, bool]]
    masks: dict[str, Path]


def extract_missing(
    database: MapDatabase,
    frames: FramesToMap,
    options: FeatureOptions,
    dispatch: Dispatch,
    progress: Progress,
) -> None:
    """Features of the frames that have none in the database yet."""
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

    def store(result: tuple[str, Features]) -> None:
        nonlocal done
        database.write_features(*result)
        done += 1
        progress("features", done, len(frames.names))

    dispatch(extract_from_bytes, batches(), store)


_FRAMES_OF_VOCABULARY = 200  # whose descriptors its words are drawn from


def appearance_of(database: MapDatabase, frames: FramesToMap, options: PairOptions) -> np.ndarray:
    """(N, D) of the frames, in words made of these very frames."""
    # All descriptors at once would be half a megabyte a frame.
    telling = frames.names[:: math.ceil(len(frames.names) / _FRAMES_OF_VOCABULARY)]
    described = [database.read_features(name).descriptors for name in telling]
    vocabulary = visual_vocabulary(described, options)
    return np.stack(
        [
            vlad_descriptor(database.read_features(name).descriptors, vocabulary)
            for name in frames.names
        ]
    )


_PAIRS_A_BATCH = 16


def match_missing(
    database: MapDatabase,
    frames: FramesToMap,
    pairs: list[tuple[int, int]],
    options: MatchOptions,
    dispatch: Dispatch,
    progress: Progress,
) -> None:
    """Match and verify the pairs that the database does not hold yet."""
    ids = [database.ids[name] for name in frames.names]
    missing = [(i, j) for i, j in pairs if not database.has_pair((ids[i], ids[j]))]
    done = len(pairs) - len(missing)
    cache: dict[int, Features] = {}

    def image(i: int) -> ImageForMatching:
        camera, focal_is_known = frames.start_cameras[str(frames.cameras[i])]
        return ImageForMatching(cache[i], camera, focal_is_known)

    def batches() -> Iterator[tuple[str, tuple[object, ...]]]:
        for start in range(0, len(missing), _PAIRS_A_BATCH):
            batch = missing[start : start + _PAIRS_A_BATCH]
            needed = {i for pair in batch for i in pair}
            for i in set(cache) - needed:
                del cache[i]
            for i in needed - set(cache):
                cache[i] = database.read_features(frames.names[i])
            images = {ids[i]: image(i) for i in sorted(needed)}
            label = f"matching {frames.names[batch[0][0]]} and {len(batch)} others"
            yield label, (images, [(ids[i], ids[j]) for i, j in batch], options)

    def store(result: list[VerifiedPair]) -> None:
        nonlocal done
        for pair in result:
            database.write_pair(pair)
        done += len(result)
        progress("matching", done, len(pairs))

    dispatch(match_pairs, batches(), store)
