"""Matching of frames with the map: their features against those of similar map frames."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from spn_data.colmap.database import MapDatabase
from spn_data.matching.putative import MatchOptions, match_descriptors
from spn_data.registration.frozen_map import FrozenMap, MapFrame
from spn_data.registration.register_options import RegisterOptions
from spn_data.storage.files import atomic_writer
from spn_data.work.answers import check_asked, check_complete, check_indices, check_kind
from spn_data.work.parallel import Dispatch
from spn_data.work.timing import Progress

_FRAMES_PER_BATCH = 4  # adjacent frames resemble the same map frames


def match_frame_to_map(
    name: str,
    descriptors: np.ndarray,
    map_frames: list[MapFrame],
    options: MatchOptions,
) -> tuple[str, np.ndarray]:
    """Match a frame's descriptors with those of similar map frames.

    Returns its name and the unique putative matches (M, 2) int64: feature and map point row. A pure function.
    """
    parts = []
    for frame in map_frames:
        matches = match_descriptors(descriptors, frame.descriptors, options).astype(np.int64)
        parts.append(np.column_stack([matches[:, 0], frame.point_rows[matches[:, 1]]]))
    together = np.concatenate(parts) if parts else np.zeros((0, 2), np.int64)
    return name, np.unique(together, axis=0)


def _match_batch(
    batch: list[tuple[str, np.ndarray, list[str]]],
    map_frames: dict[str, MapFrame],
    options: MatchOptions,
) -> list[tuple[str, np.ndarray]]:
    return [
        match_frame_to_map(name, descriptors, [map_frames[n] for n in similar], options)
        for name, descriptors, similar in batch
    ]


def match_missing_to_map(
    names: tuple[str, ...],
    database: MapDatabase,
    frozen: FrozenMap,
    folder: Path,
    options: RegisterOptions,
    dispatch: Dispatch,
    progress: Progress,
) -> dict[str, np.ndarray]:
    """Return the putative matches of every frame by name.

    Matches from an earlier run are read from `folder`, which holds one file per frame; missing ones are
    computed.
    """
    folder.mkdir(exist_ok=True)
    files = {name: folder / f"{name.replace('/', '-')}.npy" for name in names}
    missing = [name for name in names if not files[name].exists()]
    done = len(names) - len(missing)
    sizes: dict[str, int] = {}  # number of features of each frame
    asked = set(missing)

    def batches() -> Iterator[tuple[str, tuple[object, ...]]]:
        for start in range(0, len(missing), _FRAMES_PER_BATCH):
            batch = []
            for name in missing[start : start + _FRAMES_PER_BATCH]:
                descriptors = database.read_features(name).descriptors
                sizes[name] = len(descriptors)
                batch.append((name, descriptors, frozen.similar(descriptors, options.map_frames)))
            needed = sorted({n for _, _, similar in batch for n in similar})
            yield (
                f"matching {batch[0][0]} with the map",
                (batch, frozen.frames(needed), options.matching),
            )

    def store(result: list[tuple[str, np.ndarray]]) -> None:
        nonlocal done
        check_kind(result, list)
        for answer in result:
            check_kind(answer, tuple, 2)
            name, matches = answer
            check_asked(name, asked)
            below = (sizes[name], len(frozen.points))
            most = sizes[name] * options.map_frames
            check_indices(matches, "matches", np.int64, below, most)
            with atomic_writer(files[name]) as file:
                np.save(file, matches)
        done += len(result)
        progress("map matches", done, len(names))

    dispatch(_match_batch, batches(), store)
    check_complete(asked)
    return {name: np.load(files[name], allow_pickle=False) for name in names}
