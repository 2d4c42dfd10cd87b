"""Verified pairs of images that show different places which look alike: found, and left out of a database."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spn_data.colmap.database import MapDatabase
from spn_data.matching.pairs import PairOptions, sequence_pairs
from spn_data.reconstruction.correspondences import FramesToMap
from spn_data.reconstruction.time_models import (
    SAME_PLACE,
    TimeModels,
    displacements,
    join_models,
    points_of_pairs,
)

Pair = tuple[str, str]


def neighbours_in_time(frames: FramesToMap, options: PairOptions) -> set[Pair]:
    """Return the pairs of frames, in both orders of names, that follow one another closely."""
    steps = PairOptions(overlap=options.overlap, far_steps=1)
    pairs = [
        tuple(frames.names[k] for k in pair) for pair in sequence_pairs(frames.sequences, steps)
    ]
    return {ordered for a, b in pairs for ordered in ((a, b), (b, a))}


def checked_pairs(
    database: MapDatabase, folders: Sequence[Path], frames: FramesToMap, neighbours: set[Pair]
) -> set[Pair]:
    """Return the verified pairs whose images see the same points in models of neighbours in time.

    Neighbours in time are returned too, unless such a model contradicts them.

    Parameters
    ----------
    database : MapDatabase
        With the pairs to check.
    folders : sequence of Path
        Models of neighbours in time, with points of all features.
    frames : FramesToMap
        Supplies the fixes.
    neighbours : set of (str, str)
        From `neighbours_in_time`.

    Returns
    -------
    set of (str, str)
    """
    models = TimeModels.read(folders)
    pairs = points_of_pairs(models, database)
    known = np.flatnonzero(np.isfinite(frames.positions_m).all(axis=1))
    join_models(models, pairs, {frames.names[k]: frames.positions_m[k] for k in known})
    agrees: dict[Pair, bool] = {}
    for pair in pairs:
        one, other = (models.group[models.model[name]] for name in pair.images)
        if one == other:
            agrees[pair.images] = float(np.median(displacements(models, pair))) < SAME_PLACE
    return {pair for pair in database.verified_pairs() if agrees.get(pair, pair in neighbours)}
