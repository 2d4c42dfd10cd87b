"""Attempts of a reconstruction: what is tried in which order, also for frames that were not registered."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from spn_data.matching.features import FeatureOptions
from spn_data.matching.pairs import PairOptions
from spn_data.matching.putative import MatchOptions


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions:
    """Options of a reconstruction.

    Attributes
    ----------
    features : FeatureOptions
    pairs : PairOptions
    matching : MatchOptions
    engine : str
        COLMAP's mapper: "incremental" or "global".
    thinned_features : int
        Number of features per image, those with most matches, from which poses are first estimated.
    camera_model : str
        Camera model of the final bundle adjustments.
    refine_principal_point : bool
    threads : int
        Threads of the mapper, and worker processes before it.
    cluster : str
        Address of a Dask scheduler whose workers extract and match features; empty for this machine.
    seed : int
        Random seed.
    enough_share : float
        Share of registered frames below which everything is tried again with more features.
    usable_share : float
        Share of registered frames below which there is no model.
    """

    features: FeatureOptions = field(default_factory=FeatureOptions)
    pairs: PairOptions = field(default_factory=PairOptions)
    matching: MatchOptions = field(default_factory=MatchOptions)
    engine: str = "incremental"
    thinned_features: int = 512
    camera_model: str = "RADIAL"
    refine_principal_point: bool = False
    threads: int = 2
    cluster: str = ""
    seed: int = 0
    enough_share: float = 0.95
    usable_share: float = 0.1


@dataclass(frozen=True)
class Attempt:
    """One attempt at a reconstruction.

    Attributes
    ----------
    name : str
    why : str
        How it differs from the first attempt, for the user.
    database : str
        Name of its database file.
    features : FeatureOptions
    pairs : PairOptions
    missing_features : FeatureOptions
        Options for the few frames that are still not registered.
    hold_intrinsics : bool
        Keep intrinsics fixed until the final bundle adjustment.
    thinned : bool
        Estimate poses from the features with most matches, then triangulate points from all features.
    hold_focal : bool
        Keep known focal lengths fixed until the final bundle adjustment.
    checks : str
        Name of a database: only those of its pairs are used that agree with models of neighbours in time. If
        empty, the attempt selects and matches its own pairs.
    """

    name: str
    why: str
    database: str
    features: FeatureOptions
    pairs: PairOptions
    missing_features: FeatureOptions
    hold_intrinsics: bool = False
    thinned: bool = False
    hold_focal: bool = False
    checks: str = ""


@dataclass(frozen=True)
class Chance:
    """A second chance for the frames that a model does not contain.

    Attributes
    ----------
    name : str
    what : str
        What is tried, for the user.
    database : str
        Name of its database file.
    features : FeatureOptions
    most_missing : float
        Maximum share of missing frames for which it is tried.
    """

    name: str
    what: str
    database: str
    features: FeatureOptions
    most_missing: float


def attempts(options: ReconstructOptions, *, focal_is_known: bool) -> list[Attempt]:
    """Return the attempts in order: as configured, with checked pairs, fixed intrinsics, and more features.

    Poses from all features take four times as long and have the same accuracy; all features are used only if
    the first attempt fails. Pairs are checked only if the first attempt is contradicted. Where a focal length
    is a guess, it is held only if nothing else gives a model.
    """
    features, pairs = options.features, options.pairs
    more = replace(
        features,
        max_features=features.max_features * 2,
        contrast_threshold=features.contrast_threshold / 2,
    )
    incremental = options.engine == "incremental"
    first = Attempt("first", "", "database.db", features, pairs, more, thinned=incremental)
    why = "more features, wider pairs"
    wider = Attempt("more features", why, "database-more-features.db", more, pairs.wider(), more)
    why = "only pairs that agree with models of neighbours in time"
    checked = replace(first, name="look-alikes", why=why, database="database-look-alikes.db")
    checked = replace(checked, checks=first.database)
    if not incremental:
        return [first, checked, wider]
    why = "intrinsics held until the end"
    steady = replace(first, name="steady", why=why, hold_intrinsics=True, thinned=False)
    return [first, checked, *((steady, wider) if focal_is_known else (wider, steady))]


def neighbours_attempt(attempt: Attempt) -> Attempt:
    """Return the mapping of neighbours in time by which the pairs of an attempt are checked."""
    name = "neighbours"
    return replace(attempt, name=name, database=f"database-{name}.db", checks="", hold_focal=True)


_FEW_MISSING = (
    0.2  # share of the frames; with more missing, the features of single frames are not the cause
)


def chances(attempt: Attempt) -> list[Chance]:
    """Return the second chances of an attempt: wider pairs, then more features if few frames are missing.

    There are none for checked pairs: more of them would not be checked.
    """
    if attempt.checks:
        return []
    again = Chance(
        "again", "wider pairs for the missing frames", attempt.database, attempt.features, 1.0
    )
    if attempt.missing_features == attempt.features:
        return [again]
    closer = Chance(
        "closer",
        "more features in the missing frames",
        f"database-{attempt.name}-closer.db",
        attempt.missing_features,
        _FEW_MISSING,
    )
    return [again, closer]
