"""Attempts at a model, run in order with their second chances until one is good enough."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from spn_data.colmap.database import DatabaseImage, MapDatabase
from spn_data.colmap.job import MappingJob
from spn_data.colmap.mapping import latest_snapshot, run_mapping, triangulate
from spn_data.colmap.misplaced import drop_misplaced
from spn_data.colmap.model import count_registered, read_scene
from spn_data.matching.features import FeatureOptions
from spn_data.matching.pairs import PairOptions, choose_pairs
from spn_data.reconstruction import saved_models
from spn_data.reconstruction.attempts import (
    Attempt,
    Chance,
    ReconstructOptions,
    attempts,
    chances,
    neighbours_attempt,
)
from spn_data.reconstruction.contradiction import contradictions, focal_changes, shape_error
from spn_data.reconstruction.correspondences import (
    FramesToMap,
    appearance_of,
    extract_missing,
    held_cameras,
    match_missing,
)
from spn_data.reconstruction.look_alikes import checked_pairs, neighbours_in_time
from spn_data.reconstruction.notes import (
    attempt_note,
    checked_note,
    contradiction_note,
    drift_note,
    misplaced_note,
    shape_note,
)
from spn_data.work.parallel import Dispatch
from spn_data.work.timing import Progress, Stopwatch

_DRIFTED = 1.5  # ratio of focal lengths; a video cropped for stabilisation has 1.1 to 1.4


@dataclass(frozen=True, eq=False)
class ReconstructionRun:
    """Input shared by all steps of a reconstruction."""

    frames: FramesToMap
    work: Path
    options: ReconstructOptions
    dispatch: Dispatch  # computes features and matches
    progress: Progress
    stopwatch: Stopwatch

    def named(self, name: str) -> ReconstructionRun:
        """Return a run whose steps carry a name, so that a second round is not mistaken for the first."""
        report = self.progress
        return replace(self, progress=lambda step, *counts: report(f"{step} ({name})", *counts))


@dataclass(frozen=True)
class AttemptResult:
    """Result of one attempt."""

    objections: tuple[str, ...]  # to the model, in sentences
    contradicted: bool  # by the matches of its images or by their fixes
    registered: int
    model: Path
    database: str
    submodels: tuple[int, ...] = ()

    @property
    def sound(self) -> bool:
        """Whether there is a model and nothing contradicts it."""
        return self.registered > 2 and not self.objections

    @property
    def rank(self) -> tuple[bool, int]:
        """How good it is: sound before unsound, then the number of registered frames."""
        return self.sound, self.registered


def best_attempt(run: ReconstructionRun, notes: list[str]) -> AttemptResult | None:
    """Return the first attempt that is good enough, otherwise the best of all."""
    options = run.options
    best: AttemptResult | None = None
    known = all(lens.focal_is_known for lens in run.frames.lenses.values())
    for attempt in attempts(options, focal_is_known=known):
        if attempt.checks and not (best and best.contradicted):
            continue
        found = _try(run if attempt.name == "first" else run.named(attempt.name), attempt, notes)
        if found is None:
            continue
        if best is None or found.rank > best.rank:
            best = found
        # More features or wider pairs would add pairs that are not checked.
        enough = options.usable_share if attempt.checks else options.enough_share
        if found.sound and found.registered >= enough * len(run.frames.names):
            break
    return best


def _try(run: ReconstructionRun, attempt: Attempt, notes: list[str]) -> AttemptResult | None:
    """Run an attempt and the second chances of its missing frames; append what happened to the notes."""
    if attempt.checks:
        notes.append(_check_pairs(run, attempt))
    else:
        _match_all(run, attempt)
    models = _map(run, attempt)
    submodels = tuple(count_registered(model) for model in models)
    notes.append(attempt_note(attempt, submodels, len(run.frames.names)))
    if not models:
        return None
    model, kept = _settled(run, attempt, models[0], notes), attempt.database
    found = _judged(run, model, kept)
    is_incomplete = 2 < found.registered < len(run.frames.names)
    if is_incomplete and not found.contradicted and chances(attempt):
        model, kept = _second_chances(run, attempt, model, notes)
        found = _judged(run, model, kept)
    notes += found.objections
    return replace(found, submodels=submodels)


def _judged(run: ReconstructionRun, model: Path, database: str) -> AttemptResult:
    """Check a model against the matches and fixes of its images and the focal lengths of its cameras."""
    scene = read_scene(model)
    with MapDatabase.open(run.work / database) as opened:
        wrong = contradictions(opened, scene)
    shape = shape_error(scene.poses.centers, run.frames.positions_of(scene.names))
    drifted = focal_changes(scene, run.frames, _DRIFTED)
    objections = [
        *([contradiction_note(wrong)] if wrong else []),
        *([shape_note(shape)] if shape else []),
        *([drift_note(drifted)] if drifted else []),
    ]
    return AttemptResult(tuple(objections), bool(wrong or shape), len(scene.names), model, database)


def _match_all(run: ReconstructionRun, attempt: Attempt) -> None:
    """Extract the features and match the pairs of an attempt."""
    frames = run.frames
    with MapDatabase.open(run.work / attempt.database) as database:
        images = [
            DatabaseImage(name, str(key))
            for name, key in zip(frames.names, frames.cameras, strict=True)
        ]
        database.add_images(images, frames.lenses)
        _extract(run, database, attempt.features)
        _match(run, database, _pairs(run, database, attempt.pairs))


def _check_pairs(run: ReconstructionRun, attempt: Attempt) -> str:
    """Write the database of the pairs that models of neighbours in time agree with; return a note."""
    frames, near = run.frames, neighbours_attempt(attempt)
    source, target = run.work / attempt.checks, run.work / attempt.database
    neighbours = neighbours_in_time(frames, attempt.pairs)
    with MapDatabase.open(source) as database:
        verified = database.verified_pairs()
        if not target.exists():
            database.write_with_pairs(run.work / near.database, neighbours & verified.keys())
            models = [_with_all_points(run, near, model) for model in _map(run, near)]
            with run.stopwatch.step("look-alikes"):
                checked = checked_pairs(database, models, frames, neighbours)
                database.write_with_pairs(target, checked)
    with MapDatabase.open(target) as database:
        return checked_note(len(database.verified_pairs()), len(verified))


def _second_chances(
    run: ReconstructionRun, attempt: Attempt, model: Path, notes: list[str]
) -> tuple[Path, str]:
    """Return the model with the frames that the second chances of an attempt connect, and its database."""
    n, registered, kept = len(run.frames.names), count_registered(model), attempt.database
    with MapDatabase.open(run.work / attempt.database) as database:
        wider = _pairs(run, database, attempt.pairs.wider())
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
    return model, kept


def _extract(run: ReconstructionRun, database: MapDatabase, features: FeatureOptions) -> None:
    with run.stopwatch.step("features"):
        extract_missing(database, run.frames, features, run.dispatch, run.progress)


def _pairs(
    run: ReconstructionRun, database: MapDatabase, options: PairOptions
) -> list[tuple[int, int]]:
    frames = run.frames
    with run.stopwatch.step("pairs"):
        appearance = appearance_of(database, frames, options)
        return choose_pairs(frames.sequences, frames.positions_m, appearance, options)


def _match(run: ReconstructionRun, database: MapDatabase, pairs: list[tuple[int, int]]) -> None:
    matching = run.options.matching
    with run.stopwatch.step("matching"):
        match_missing(database, run.frames, pairs, matching, run.dispatch, run.progress)


def _map(
    run: ReconstructionRun,
    attempt: Attempt,
    chance: Chance | None = None,
    start_from: Path | None = None,
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
            held=tuple(held_cameras(database, run.frames, attempt.hold_focal).items()),
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


def _settled(run: ReconstructionRun, attempt: Attempt, model: Path, notes: list[str]) -> Path:
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


def _with_all_points(run: ReconstructionRun, attempt: Attempt, model: Path) -> Path:
    """Triangulate the points of all features in the model from the features with most matches."""
    target = model.with_name(f"{model.name}-all-points")
    with run.stopwatch.step("mapping"):
        triangulate(
            model, target, database=run.work / attempt.database, log=run.work / "mapping.log"
        )
    return target


def _grow(
    run: ReconstructionRun,
    attempt: Attempt,
    chance: Chance,
    pairs: list[tuple[int, int]],
    model: Path,
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


def _without_misplaced(
    run: ReconstructionRun, database: str, model: Path, notes: list[str]
) -> Path:
    with run.stopwatch.step("mapping"):
        with MapDatabase.open(run.work / database) as opened:
            matches = opened.verified_pairs()
        target = model.with_name(f"{model.name}-placed")
        wrong = drop_misplaced(model, target, matches)
    if not wrong:
        return model
    notes.append(misplaced_note(wrong))
    return target
