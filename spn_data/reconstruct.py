"""From frames to one model: features, pairs, matches, mapping, a second chance, and a diagnosis."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

from spn_data.cluster import dispatch_to
from spn_data.colmap.database import DatabaseImage, MapDatabase
from spn_data.colmap.mapping import MappingJob, latest_snapshot, refine, run_mapping, triangulate
from spn_data.colmap.model import Scene, count_registered, read_scene
from spn_data.contradiction import Contradiction, contradictions
from spn_data.correspondences import FramesToMap, extract_missing, match_missing, pairs_of
from spn_data.diagnosis import FrameRegistration, diagnose
from spn_data.errors import StageError
from spn_data.features import FeatureOptions
from spn_data.files import write_whole
from spn_data.matching import MatchOptions
from spn_data.pairs import PairOptions
from spn_data.parallel import Dispatch
from spn_data.timing import Progress, Stopwatch


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions:
    """How a model is made from frames."""

    features: FeatureOptions = field(default_factory=FeatureOptions)
    pairs: PairOptions = field(default_factory=PairOptions)
    matching: MatchOptions = field(default_factory=MatchOptions)
    engine: str = "incremental"  # or "global"
    thinned_features: int = (
        512  # of each image, those matched most, from which poses are found first
    )
    camera_model: str = "RADIAL"  # of the last bundle adjustments
    refine_principal_point: bool = False
    threads: int = 2  # of the mapper, and worker processes before it
    cluster: str = (
        ""  # address of a Dask scheduler, whose workers find features and matches instead
    )
    seed: int = 0
    enough_share: float = 0.95  # registered, below which all is tried again with more features
    usable_share: float = 0.1  # registered, below which there is no model

    @property
    def dispatch(self) -> Dispatch:
        """Who computes features and matches."""
        return dispatch_to(self.cluster, self.threads)


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
class _Chance:
    """What is tried for the frames that a model leaves out."""

    name: str
    what: str
    database: str
    features: FeatureOptions


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
    return [*ladder, Attempt("dense", why, "database-dense.db", more, pairs.wider(), more)]


_FEW_SHARE = 0.2  # left out, above which it is not for the features of some frames


def _chances(attempt: Attempt, missing_share: float) -> list[_Chance]:
    """Wider pairs, and then more features too where few are missing."""
    again = _Chance(
        "again", "wider pairs for the missing frames", attempt.database, attempt.features
    )
    if missing_share > _FEW_SHARE or attempt.missing_features == attempt.features:
        return [again]
    closer = _Chance(
        "closer",
        "more features in the missing frames",
        f"database-{attempt.name}-closer.db",
        attempt.missing_features,
    )
    return [again, closer]


@dataclass(frozen=True)
class _Candidate:
    """What an attempt gave."""

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
    """Where the model lies and how it came about."""

    model: Path
    database: Path
    registrations: tuple[FrameRegistration, ...]
    submodels: tuple[int, ...]  # images in each, of the attempt that was kept
    attempts: tuple[str, ...]  # sentences: what was tried and what it gave
    pairs_tried: int
    pairs_verified: int
    scene: Scene


# Measured on drone video and photos of 0.5 to 2 megapixels, two cores, 4,096 features an image.
FEATURES_CPU_S_PER_MEGAPIXEL = 0.27
PAIRS_PER_FRAME = 11
MATCHING_CPU_S_PER_PAIR = 0.025
MAPPING_S_PER_FRAME = 0.17
DATABASE_BYTES_PER_FRAME = 800_000


def estimate_model_cost(
    frames: int, megapixels: float, options: ReconstructOptions
) -> tuple[float, int]:
    """(seconds, bytes on disk) that a model of so many frames is expected to take, within a factor of two.

    megapixels : of one frame, as far as features are looked for. Mapping grows faster than the number of
    frames above some hundreds.
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
    """Make one model of the frames, in `work`, going on from whatever an interrupted run left there.

    Raises StageError where fewer than three images, or less than `usable_share` of them, register.
    """
    best: _Candidate | None = None
    story: list[str] = []
    for attempt in attempts(options):
        told = progress if attempt.name == "first" else _named(progress, attempt.name)
        with MapDatabase.open(work / attempt.database) as database:
            images = [
                DatabaseImage(name, str(key))
                for name, key in zip(frames.names, frames.cameras, strict=True)
            ]
            database.add_images(images, frames.start_cameras)
            with stopwatch.step("features"):
                extract_missing(database, frames, attempt.features, options.dispatch, told)
            with stopwatch.step("pairs"):
                pairs = pairs_of(database, frames, attempt.pairs)
            with stopwatch.step("matching"):
                match_missing(database, frames, pairs, options.matching, options.dispatch, told)
        with stopwatch.step("mapping"):
            models = _map(work, attempt, frames, options, told)
        submodels = tuple(count_registered(model) for model in models)
        registered, model = (submodels[0], models[0]) if models else (0, None)
        if model is not None and attempt.thinned:
            with stopwatch.step("mapping"):
                model = _with_all_points(work, attempt, model)
        story.append(_tell(attempt, submodels, len(frames.names)))
        if model is None:
            continue
        kept = attempt.database
        for chance in _chances(attempt, 1 - registered / len(frames.names)):
            if not 2 < registered < len(frames.names):
                break
            grown = _grow(
                work, attempt, chance, frames, model, options, _named(told, chance.name), stopwatch
            )
            gained = count_registered(grown) - registered
            if gained > 0:
                story.append(f"{chance.what} registered {gained} more")
                registered, model, kept = registered + gained, grown, chance.database
        with MapDatabase.open(work / kept) as database:
            wrong = contradictions(database, read_scene(model))
        if wrong:
            story.append(_tell_contradictions(wrong))
        found = _Candidate(not wrong, registered, model, kept, submodels)
        if best is None or found.rank > best.rank:
            best = found
        if found.sound and registered >= options.enough_share * len(frames.names):
            break
    if best is None or best.registered < max(3, options.usable_share * len(frames.names)):
        raise StageError(_no_model(work, frames, 0 if best is None else best.registered, story))
    with stopwatch.step("refinement"):
        refined = _refine(work, best.model, frames.folder, options, progress)
    with MapDatabase.open(work / best.database) as database:
        registrations = diagnose(database, frames, refined)
        verified = len(database.verified_pairs())
        tried = database.num_pairs()
    return ReconstructResult(
        refined,
        work / best.database,
        registrations,
        best.submodels,
        tuple(story),
        tried,
        verified,
        read_scene(refined),
    )


def _map(
    work: Path,
    attempt: Attempt,
    frames: FramesToMap,
    options: ReconstructOptions,
    progress: Progress,
    chance: _Chance | None = None,
    start_from: Path | None = None,
) -> list[Path]:
    """Sub-models, most images first; an interrupted run goes on from its last snapshot."""
    folder = work / "-".join(["mapping", attempt.name, *([chance.name] if chance else [])])
    done = folder / "models.json"
    if done.exists():
        return [folder / "models" / name for name in json.loads(done.read_text())]
    for name in ("models", "snapshots"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    snapshot = latest_snapshot(folder / "snapshots") or start_from
    n = len(frames.names)
    database = work / (chance or attempt).database
    # What these left out has its chance with all features.
    if attempt.thinned and chance is None:
        database = folder / "thinned.db"
        with MapDatabase.open(work / attempt.database) as whole:
            whole.write_thinned(database, options.thinned_features)
    job = MappingJob(
        database=str(database),
        images=str(frames.folder),
        output=str(folder / "models"),
        snapshots=str(folder / "snapshots"),
        engine=options.engine,
        threads=options.threads,
        seed=options.seed,
        snapshot_every=max(3, n // 10),
        min_model_size=10 if n >= 30 else 3,
        hold_intrinsics=attempt.hold_intrinsics,
        start_from="" if snapshot is None else str(snapshot),
    )
    models = run_mapping(
        job,
        log=work / "mapping.log",
        progress=lambda registered: progress("mapping", min(registered, n), n),
    )
    write_whole(done, json.dumps([model.name for model in models]))
    return models


def _with_all_points(work: Path, attempt: Attempt, model: Path) -> Path:
    """The model from the features that match most, with the points of all."""
    target = work / f"mapping-{attempt.name}" / "all-points"
    triangulate(model, target, database=work / attempt.database, log=work / "mapping.log")
    return target


def _grow(
    work: Path,
    attempt: Attempt,
    chance: _Chance,
    frames: FramesToMap,
    model: Path,
    options: ReconstructOptions,
    progress: Progress,
    stopwatch: Stopwatch,
) -> Path:
    """The model, grown by frames that a chance connects: sub-models join it that way too."""
    registered = set(read_scene(model).names)
    missing = [name for name in frames.names if name not in registered]
    if not (work / chance.database).exists():
        with MapDatabase.open(work / attempt.database) as database:
            database.write_without(work / chance.database, missing)
    with MapDatabase.open(work / chance.database) as database:
        with stopwatch.step("features"):
            extract_missing(database, frames, chance.features, options.dispatch, progress)
        with stopwatch.step("pairs"):
            pairs = pairs_of(database, frames, attempt.pairs.wider())
        for_missing = [
            (i, j)
            for i, j in pairs
            if frames.names[i] not in registered or frames.names[j] not in registered
        ]
        with stopwatch.step("matching"):
            match_missing(
                database, frames, for_missing, options.matching, options.dispatch, progress
            )
    with stopwatch.step("mapping"):
        models = _map(work, attempt, frames, options, progress, chance, start_from=model)
    return max([model, *models], key=count_registered)


def _refine(
    work: Path, model: Path, images: Path, options: ReconstructOptions, progress: Progress
) -> Path:
    target = work / "refined"
    progress("refinement", 0, 1)
    refine(
        model,
        target,
        images=images,
        camera_model=options.camera_model,
        refine_principal_point=options.refine_principal_point,
        threads=options.threads,
        log=work / "mapping.log",
    )
    progress("refinement", 1, 1)
    return target


def _named(progress: Progress, name: str) -> Progress:
    """Steps under a name of their own, so that a second round is not taken for the first."""
    return lambda step, done, total: progress(f"{step} ({name})", done, total)


def _tell(attempt: Attempt, submodels: tuple[int, ...], n: int) -> str:
    how = f"{attempt.name} attempt{f' ({attempt.why})' if attempt.why else ''}"
    if not submodels:
        return f"{how}: no model"
    rest = f"; sub-models of {', '.join(map(str, submodels[1:]))}" if len(submodels) > 1 else ""
    return f"{how}: {submodels[0]} of {n} frames in the largest model{rest}"


def _tell_contradictions(wrong: list[Contradiction]) -> str:
    worst = wrong[0]
    others = f", and {len(wrong) - 1} more such pairs" if len(wrong) > 1 else ""
    return (
        f"parts of it lie wrongly to each other: {worst.images[0]} and {worst.images[1]} share "
        f"{worst.matches} matches, of which its poses explain {worst.share:.0%}{others}"
    )


def _no_model(work: Path, frames: FramesToMap, registered: int, story: list[str]) -> str:
    return (
        f"no usable model: {registered} of {len(frames.names)} frames fit together "
        f"({'; '.join(story)}). Frames must overlap by at least two thirds, be sharp, and show "
        f"textured, rigid things from changing positions; COLMAP's log is {work / 'mapping.log'}"
    )
