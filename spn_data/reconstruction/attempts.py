"""The ladder of reconstruction: what is tried in which order, and for the frames that are left out."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from spn_data.matching.features import FeatureOptions
from spn_data.matching.pairs import PairOptions
from spn_data.matching.putative import MatchOptions


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions:
    """How a model is made from frames."""

    features: FeatureOptions = field(default_factory=FeatureOptions)
    pairs: PairOptions = field(default_factory=PairOptions)
    matching: MatchOptions = field(default_factory=MatchOptions)
    engine: str = "incremental"  # or "global"
    thinned_features: int = 512  # of each image, matched most: from which poses are found first
    camera_model: str = "RADIAL"  # of the last bundle adjustments
    refine_principal_point: bool = False
    threads: int = 2  # of the mapper, and worker processes before it
    cluster: str = ""  # address of a Dask scheduler, whose workers find features and matches
    seed: int = 0
    enough_share: float = 0.95  # registered, below which all is tried again with more features
    usable_share: float = 0.1  # registered, below which there is no model


@dataclass(frozen=True)
class Attempt:
    """One rung of the ladder of retries."""

    name: str
    why: str
    database: str
    features: FeatureOptions
    pairs: PairOptions
    missing_features: FeatureOptions  # of the few frames that are left out all the same
    hold_intrinsics: bool = False
    thinned: bool = False  # poses from the features that match most, then points from all


@dataclass(frozen=True)
class Chance:
    """What is tried for the frames that a model leaves out."""

    name: str
    what: str
    database: str
    features: FeatureOptions
    most_missing: float  # share of the frames, above which it is not tried


def attempts(options: ReconstructOptions) -> list[Attempt]:
    """As the options are; with intrinsics that cannot drift; and with more features on wider pairs.

    Poses from all features take four times as long and come out the same: only where that fails are all used.
    """
    features, pairs = options.features, options.pairs
    more = replace(
        features,
        max_features=features.max_features * 2,
        contrast_threshold=features.contrast_threshold / 2,
    )
    incremental = options.engine == "incremental"
    first = Attempt("first", "", "database.db", features, pairs, more, thinned=incremental)
    ladder = [first]
    if incremental:
        why = "intrinsics held until the end"
        ladder.append(replace(first, name="steady", why=why, hold_intrinsics=True, thinned=False))
    why = "more features, wider pairs"
    return [
        *ladder,
        Attempt("more features", why, "database-more-features.db", more, pairs.wider(), more),
    ]


_FEW_SHARE = 0.2  # left out, above which it is not for the features of some frames


def chances(attempt: Attempt) -> list[Chance]:
    """Wider pairs, and then more features too where few are missing."""
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
        _FEW_SHARE,
    )
    return [again, closer]
