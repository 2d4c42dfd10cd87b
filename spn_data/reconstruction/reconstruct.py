"""Reconstruction of one model from frames: features, pairs, matches, mapping, second chances, diagnosis."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from spn_data.colmap.database import DatabaseImage, MapDatabase
from spn_data.colmap.job import MappingJob
from spn_data.colmap.mapping import latest_snapshot, run_mapping, triangulate
from spn_data.colmap.misplaced import drop_misplaced
from spn_data.colmap.model import count_registered, read_scene
from spn_data.errors import StageError
from spn_data.matching.features import FeatureOptions
from spn_data.matching.pairs import PairOptions, choose_pairs
from spn_data.reconstruction import saved_models
from spn_data.reconstruction.attempts import Attempt, Chance, ReconstructOptions, attempts, chances
from spn_data.reconstruction.contradiction import contradictions, focal_changes
from spn_data.reconstruction.correspondences import (
    FramesToMap,
    appearance_of,
    extract_missing,
    held_cameras,
    match_missing,
)
from spn_data.reconstruction.diagnosis import FrameRegistration, diagnose
from spn_data.reconstruction.notes import (
    attempt_note,
    contradiction_note,
    drift_note,
    failure_message,
    misplaced_note,
)
from spn_data.reconstruction.refinement import RefinedModel, refine_model
from spn_data.work.cluster import dispatch_to
from spn_data.work.parallel import Dispatch
from spn_data.work.timing import Progress, Stopwatch

_DRIFTED = 1.5  # ratio of focal lengths; a video cropped for stabilisation has 1.1 to 1.4


@dataclass(frozen=True, eq=False)
class _Run:
    """Input shared by all steps of a reconstruction."""

    frames: FramesToMap
    work: Path
    options: ReconstructOptions
    dispatch: Dispatch  # computes features and matches
    progress: Progress
    stopwatch: Stopwatch

    def named(self, name: str) -> _Run:
        """Return a run whose steps carry a name, so that a second round is not mistaken for the first."""
        report = self.progress
        return replace(self, progress=lambda step, *counts: report(f"{step} ({name})", *counts))


@dataclass(frozen=True)
class _Candidate:
    """Result of one attempt."""

    sound: bool  # whether nothing contradicts it
    registered: int
    model: Path
    database: str
    submodels: tuple[int, ...]

    @property
    def rank(self) -> tuple[bool, int]:
        return self.sound, self.registered


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
        run = _Run(frames, work, options, dispatch, progress, stopwatch)
        best = _best_attempt(run, notes)
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
        best.submodels,
        tuple(notes),
        tried,
        verified,
    )


def _best_attempt(run: _Run, notes: list[str]) -> _Candidate | None:
    """Return the first attempt that is good enough, otherwise the best of all."""
    options = run.options
    best: _Candidate | None = None
    known = all(lens.focal_is_known for lens in run.frames.lenses.values())
    for attempt in attempts(options, focal_is_known=known):
        found = _try(run if attempt.name == "first" else run.named(attempt.name), attempt, notes)
        if found is None:
            continue
        if best is None or found.rank > best.rank:
            best = found
        if found.sound and found.registered >= options.enough_share * len(run.frames.names):
            break
    return best


def _try(run: _Run, attempt: Attempt, notes: list[str]) -> _Candidate | None:
    """Run an attempt and the second chances of its missing frames; append what happened to the notes."""
    frames, work, stopwatch = run.frames, run.work, run.stopwatch
    n = len(frames.names)
    with MapDatabase.open(work / attempt.database) as database:
        images = [
            DatabaseImage(name, str(key))
            for name, key in zip(frames.names, frames.cameras, strict=True)
        ]
        database.add_images(images, frames.lenses)
        _extract(run, database, attempt.features)
        with stopwatch.step("pairs"):
            appearance = appearance_of(database, frames, attempt.pairs)
            pairs = _pairs(frames, appearance, attempt.pairs)
        _match(run, database, pairs)
    models = _map(run, attempt)
    submodels = tuple(count_registered(model) for model in models)
    notes.append(attempt_note(attempt, submodels, n))
    if not models:
        return None
    model, kept = _settled(run, attempt, models[0], notes), attempt.database
    registered = count_registered(model)
    if registered > 2:
        with stopwatch.step("pairs"):
            wider = _pairs(frames, appearance, attempt.pairs.wider())
        for chance in chances(attempt):
            if not 0 < n - registered <= chance.most_missing * n:
                break
            messages: list[str] = []
            grown = _grow(run.named(chance.name), attempt, chance, wider, model)
            grown = _without_misplaced(run, chance.database, grown, messages)
            gained = count_registered(grown) - registered
            if gained > 0:
                notes += [*messages, f"{chance.what} registered {gained} more"]
                registered, model, kept = registered + gained, grown, chance.database
    scene = read_scene(model)
    with MapDatabase.open(work / kept) as database:
        wrong = contradictions(database, scene)
    drifted = focal_changes(scene, frames, _DRIFTED)
    if wrong:
        notes.append(contradiction_note(wrong))
    if drifted:
        notes.append(drift_note(drifted))
    sound = registered > 2 and not (wrong or drifted)  # nothing contradicts a model of no frames
    return _Candidate(sound, registered, model, kept, submodels)


def _extract(run: _Run, database: MapDatabase, features: FeatureOptions) -> None:
    with run.stopwatch.step("features"):
        extract_missing(database, run.frames, features, run.dispatch, run.progress)


def _pairs(
    frames: FramesToMap, appearance: np.ndarray, options: PairOptions
) -> list[tuple[int, int]]:
    return choose_pairs(frames.sequences, frames.positions_m, appearance, options)


def _match(run: _Run, database: MapDatabase, pairs: list[tuple[int, int]]) -> None:
    matching = run.options.matching
    with run.stopwatch.step("matching"):
        match_missing(database, run.frames, pairs, matching, run.dispatch, run.progress)


def _map(
    run: _Run, attempt: Attempt, chance: Chance | None = None, start_from: Path | None = None
) -> list[Path]:
    """Return the sub-models, most images first. An interrupted run continues from its last snapshot."""
    folder = run.work / "-".join(["mapping", attempt.name, *([chance.name] if chance else [])])
    finished = saved_models.read_submodels(folder)
    if finished is not None:
        return finished
    for name in ("models", "snapshots"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    snapshot = latest_snapshot(folder / "snapshots") or start_from
    n = len(run.frames.names)
    with run.stopwatch.step("mapping"):
        database = run.work / (chance or attempt).database
        # Frames that are missing then get a second chance with all features.
        if attempt.thinned and chance is None:
            thinned = folder / "thinned.db"
            with MapDatabase.open(database) as whole:
                whole.write_thinned(thinned, run.options.thinned_features)
            database = thinned
        job = MappingJob(
            database=str(database),
            images=str(run.frames.folder),
            output=str(folder / "models"),
            snapshots=str(folder / "snapshots"),
            engine=run.options.engine,
            threads=run.options.threads,
            seed=run.options.seed,
            snapshot_every=max(3, n // 10),
            min_model_size=10 if n >= 30 else 3,
            hold_intrinsics=attempt.hold_intrinsics,
            held=tuple(held_cameras(database, run.frames).items()),
            start_from="" if snapshot is None else str(snapshot),
        )
        run.progress("mapping", 0 if snapshot is None else count_registered(snapshot), n)
        models = run_mapping(
            job,
            log=run.work / "mapping.log",
            progress=lambda registered: run.progress("mapping", registered, n),
        )
    saved_models.write_submodels(folder, models)
    return models


def _settled(run: _Run, attempt: Attempt, model: Path, notes: list[str]) -> Path:
    """Return the model with the points of all matches and without misplaced frames.

    It is computed only once: later chances add matches to the database, and an interrupted run that
    recomputed it would continue from a different model.
    """
    folder = run.work / f"mapping-{attempt.name}"
    settled = saved_models.read_settled(folder, run.work)
    if settled is None:
        messages: list[str] = []
        if attempt.thinned:
            model = _with_all_points(run, attempt, model)
        model = _without_misplaced(run, attempt.database, model, messages)
        saved_models.write_settled(folder, run.work, model, messages)
        settled = model, messages
    notes += settled[1]
    return settled[0]


def _with_all_points(run: _Run, attempt: Attempt, model: Path) -> Path:
    """Triangulate the points of all features in the model from the features with most matches."""
    target = run.work / f"mapping-{attempt.name}" / "all-points"
    with run.stopwatch.step("mapping"):
        triangulate(
            model, target, database=run.work / attempt.database, log=run.work / "mapping.log"
        )
    return target


def _grow(
    run: _Run, attempt: Attempt, chance: Chance, pairs: list[tuple[int, int]], model: Path
) -> Path:
    """Extend the model by the frames that a chance connects; sub-models join it in the same way."""
    names = run.frames.names
    missing = set(names) - set(read_scene(model).names)
    if not (run.work / chance.database).exists():
        with MapDatabase.open(run.work / attempt.database) as database:
            database.write_without(run.work / chance.database, sorted(missing))
    with MapDatabase.open(run.work / chance.database) as database:
        _extract(run, database, chance.features)
        _match(run, database, [p for p in pairs if not missing.isdisjoint(names[k] for k in p)])
    models = _map(run, attempt, chance, start_from=model)
    return max([model, *models], key=count_registered)


def _without_misplaced(run: _Run, database: str, model: Path, notes: list[str]) -> Path:
    with run.stopwatch.step("mapping"):
        with MapDatabase.open(run.work / database) as opened:
            matches = opened.verified_pairs()
        target = model.with_name(f"{model.name}-placed")
        wrong = drop_misplaced(model, target, matches)
    if not wrong:
        return model
    notes.append(misplaced_note(wrong))
    return target
