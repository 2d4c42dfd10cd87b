"""Reconstruction of one model from frames: features, pairs, matches, mapping, second chances, diagnosis."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from spn_data.colmap.database import MapDatabase
from spn_data.errors import StageError
from spn_data.matching.features import FeatureOptions
from spn_data.reconstruction.attempts import (
    ReconstructOptions,
)
from spn_data.reconstruction.best_attempt import ReconstructionRun, best_attempt
from spn_data.reconstruction.correspondences import (
    FramesToMap,
)
from spn_data.reconstruction.diagnosis import FrameRegistration, diagnose
from spn_data.reconstruction.notes import (
    failure_message,
)
from spn_data.reconstruction.refinement import RefinedModel, refine_model
from spn_data.work.cluster import dispatch_to
from spn_data.work.timing import Progress, Stopwatch


@dataclass(frozen=True, eq=False)
class ReconstructResult:
    """Model and how it was made.

    Attributes
    ----------
    refined : RefinedModel
    database : Path
        Database file of the attempt that was kept.
    registrations : tuple of FrameRegistration
        One per frame.
    contradicted : bool
        Whether matches or fixes contradict the model, so that parts of it lie at wrong places.
    submodels : tuple of int
        Number of images in each sub-model of the attempt that was kept.
    attempts : tuple of str
        Sentences: what was tried, with which result.
    pairs_tried, pairs_verified : int
        Number of matched and verified pairs.
    """

    refined: RefinedModel
    database: Path
    registrations: tuple[FrameRegistration, ...]
    contradicted: bool
    submodels: tuple[int, ...]
    attempts: tuple[str, ...]
    pairs_tried: int
    pairs_verified: int


# Measured on drone video and photos of 0.5 to 2 megapixels, with two cores and 4,096 features per image.
FEATURES_CPU_S_PER_MEGAPIXEL = 0.27
PAIRS_PER_FRAME = 11
MATCHING_CPU_S_PER_PAIR = 0.025
MAPPING_S_PER_FRAME = 0.17
DATABASE_BYTES_PER_FRAME = 800_000


def estimate_model_cost(
    frames: int, megapixels: float, options: ReconstructOptions
) -> tuple[float, int]:
    """Estimate time and disk space of a reconstruction, within a factor of two.

    Parameters
    ----------
    frames : int
        Number of frames.
    megapixels : float
        Size of a frame as used for feature extraction.
    options : ReconstructOptions

    Returns
    -------
    seconds : float
        Mapping grows faster than the number of frames above some hundreds.
    size : int
        Bytes on disk.
    """
    features = frames * megapixels * FEATURES_CPU_S_PER_MEGAPIXEL
    share = (options.features.max_features / FeatureOptions.max_features) ** 2
    matching = frames * PAIRS_PER_FRAME * MATCHING_CPU_S_PER_PAIR * share
    mapping = frames * MAPPING_S_PER_FRAME
    return (features + matching) / options.threads + mapping, frames * DATABASE_BYTES_PER_FRAME


def reconstruct(
    frames: FramesToMap,
    work: Path,
    options: ReconstructOptions,
    progress: Progress,
    stopwatch: Stopwatch,
) -> ReconstructResult:
    """Reconstruct one model from frames.

    Parameters
    ----------
    frames : FramesToMap
    work : Path
        Working folder. Results of an interrupted run there are reused.
    options : ReconstructOptions
    progress : Progress
    stopwatch : Stopwatch

    Returns
    -------
    ReconstructResult

    Raises
    ------
    StageError
        If fewer than three images, or less than the share `options.usable_share` of them, are registered.
    """
    notes: list[str] = []
    with dispatch_to(options.cluster, options.threads) as dispatch:
        run = ReconstructionRun(frames, work, options, dispatch, progress, stopwatch)
        best = best_attempt(run, notes)
    if best is None or best.registered < max(3, options.usable_share * len(frames.names)):
        raise StageError(
            failure_message(work, len(frames.names), 0 if best is None else best.registered, notes)
        )
    refined = refine_model(
        best.model, work / best.database, frames, work, options, progress, stopwatch
    )
    notes += refined.notes
    scene, observations = refined.scene, refined.observations
    with MapDatabase.open(work / best.database) as database:
        registrations = diagnose(database, frames, scene, observations)
        verified = len(database.verified_pairs())
        tried = database.num_pairs()
    return ReconstructResult(
        refined,
        work / best.database,
        registrations,
        best.contradicted,
        best.submodels,
        tuple(notes),
        tried,
        verified,
    )
