"""From frames to one model: features, pairs, matches, mapping, a second chance, and a diagnosis."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from spn_data.camera import Camera
from spn_data.colmap.database import DatabaseImage, MapDatabase
from spn_data.colmap.mapping import MappingJob, latest_snapshot, refine, run_mapping
from spn_data.colmap.model import count_registered, read_scene
from spn_data.colmap.verify import ImageForMatching, VerifiedPair, match_pairs
from spn_data.errors import InputError, StageError
from spn_data.features import FeatureOptions, Features, extract
from spn_data.matching import MatchOptions
from spn_data.pairs import PairOptions, appearance_vocabulary, choose_pairs, describe_appearance
from spn_data.parallel import run_batches
from spn_data.timing import Progress, Stopwatch


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions:
    """How a model is made from frames."""

    features: FeatureOptions = field(default_factory=FeatureOptions)
    pairs: PairOptions = field(default_factory=PairOptions)
    matching: MatchOptions = field(default_factory=MatchOptions)
    engine: str = "incremental"  # or "global"
    camera_model: str = "OPENCV"  # of the last bundle adjustments
    refine_principal_point: bool = False
    threads: int = 2  # of the mapper, and worker processes before it
    seed: int = 0
    enough_share: float = 0.9  # registered, below which all is matched again, more widely
    usable_share: float = 0.1  # registered, below which there is no model


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


@dataclass(frozen=True)
class FrameRegistration:
    """What became of one frame."""

    name: str
    registered: bool
    reason: str  # empty where it is registered
    keypoints: int
    verified_pairs: int
    observations: int  # of points of the model
    error_px: float  # mean; NaN where it is not registered


@dataclass(frozen=True)
class Attempt:
    """One rung of the ladder of retries."""

    name: str
    why: str
    database: str
    features: FeatureOptions
    pairs: PairOptions


def attempts(options: ReconstructOptions) -> list[Attempt]:
    """From the options as they are to wider pairs and then more features."""
    wide = replace(
        options.pairs,
        overlap=options.pairs.overlap * 3,
        spatial_neighbors=options.pairs.spatial_neighbors * 3,
        appearance_neighbors=options.pairs.appearance_neighbors * 3,
    )
    more = replace(
        options.features,
        max_features=options.features.max_features * 2,
        contrast_threshold=options.features.contrast_threshold / 2,
    )
    return [
        Attempt("first", "", "database.db", options.features, options.pairs),
        Attempt("wide", "pairs three times as wide", "database.db", options.features, wide),
        Attempt("dense", "twice the features, wide pairs", "database-dense.db", more, wide),
    ]


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
    best: tuple[int, Path, Attempt, tuple[int, ...]] | None = None
    story: list[str] = []
    for attempt in attempts(options):
        with MapDatabase.open(work / attempt.database) as database:
            images = [
                DatabaseImage(name, str(key))
                for name, key in zip(frames.names, frames.cameras, strict=True)
            ]
            database.add_images(images, frames.start_cameras)
            with stopwatch.step("features"):
                extract_missing(database, frames, attempt.features, options.threads, progress)
            with stopwatch.step("pairs"):
                pairs = pairs_of(database, frames, attempt.pairs)
            with stopwatch.step("matching"):
                match_missing(database, frames, pairs, options, progress)
        with stopwatch.step("mapping"):
            models = _map(work, attempt, frames, options, progress, start_from=None)
        submodels = tuple(count_registered(model) for model in models)
        registered, model = (submodels[0], models[0]) if models else (0, None)
        story.append(_tell(attempt, submodels, len(frames.names)))
        if model is not None and 2 < registered < len(frames.names):
            second = _second_chance(work, attempt, frames, model, options, progress, stopwatch)
            gained = count_registered(second) - registered
            if gained > 0:
                story.append(f"wider pairs for the missing frames registered {gained} more")
                registered, model = registered + gained, second
        if model is not None and (best is None or registered > best[0]):
            best = (registered, model, attempt, submodels)
        if registered >= options.enough_share * len(frames.names):
            break
    if best is None or best[0] < max(3, options.usable_share * len(frames.names)):
        raise StageError(_no_model(work, frames, best, story))
    registered, model, attempt, submodels = best
    with stopwatch.step("refinement"):
        refined = _refine(work, model, options, progress)
    with MapDatabase.open(work / attempt.database) as database:
        registrations = diagnose(database, frames, refined)
        verified = len(database.verified_pairs())
        tried = database.num_pairs()
    return ReconstructResult(
        refined, work / attempt.database, registrations, submodels, tuple(story), tried, verified
    )


def extract_missing(
    database: MapDatabase,
    frames: FramesToMap,
    options: FeatureOptions,
    workers: int,
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

    run_batches(extract_from_bytes, batches(), workers=workers, on_result=store)


def extract_from_bytes(
    name: str, image: bytes, mask: bytes | None, options: FeatureOptions
) -> tuple[str, Features]:
    """Features of an encoded image. Pure: the same bytes give the same features anywhere."""
    gray = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_GRAYSCALE)
    if gray is None:
        raise InputError("is no image that can be decoded", path=name)
    use = None
    if mask is not None:
        decoded = cv2.imdecode(np.frombuffer(mask, np.uint8), cv2.IMREAD_GRAYSCALE)
        if decoded is None:
            raise InputError("its mask is no image that can be decoded", path=name)
        use = decoded > 127
    return name, extract(gray, use, options)


def pairs_of(
    database: MapDatabase, frames: FramesToMap, options: PairOptions
) -> list[tuple[int, int]]:
    """Pairs of positions in `frames` to match."""
    described = [database.read_features(name).descriptors for name in frames.names]
    vocabulary = appearance_vocabulary(described, options)
    appearance = np.stack([describe_appearance(d, vocabulary) for d in described])
    return choose_pairs(frames.sequences, frames.positions_m, appearance, options)


_PAIRS_A_BATCH = 16


def match_missing(
    database: MapDatabase,
    frames: FramesToMap,
    pairs: list[tuple[int, int]],
    options: ReconstructOptions,
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
            yield label, (images, [(ids[i], ids[j]) for i, j in batch], options.matching)

    def store(result: list[VerifiedPair]) -> None:
        nonlocal done
        for pair in result:
            database.write_pair(pair)
        done += len(result)
        progress("matching", done, len(pairs))

    run_batches(match_pairs, batches(), workers=options.threads, on_result=store)


def _map(
    work: Path,
    attempt: Attempt,
    frames: FramesToMap,
    options: ReconstructOptions,
    progress: Progress,
    *,
    start_from: Path | None,
    suffix: str = "",
) -> list[Path]:
    """Sub-models, most images first; an interrupted run goes on from its last snapshot."""
    folder = work / f"mapping-{attempt.name}{suffix}"
    done = folder / "models.json"
    if done.exists():
        return [folder / "models" / name for name in json.loads(done.read_text())]
    for name in ("models", "snapshots"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    snapshot = latest_snapshot(folder / "snapshots") or start_from
    n = len(frames.names)
    job = MappingJob(
        database=str(work / attempt.database),
        images=str(frames.folder),
        output=str(folder / "models"),
        snapshots=str(folder / "snapshots"),
        engine=options.engine,
        threads=options.threads,
        seed=options.seed,
        snapshot_every=max(3, n // 10),
        start_from="" if snapshot is None else str(snapshot),
    )
    models = run_mapping(
        job,
        log=work / "mapping.log",
        progress=lambda registered: progress("mapping", registered, n),
    )
    done.write_text(json.dumps([model.name for model in models]))
    return models


def _second_chance(
    work: Path,
    attempt: Attempt,
    frames: FramesToMap,
    model: Path,
    options: ReconstructOptions,
    progress: Progress,
    stopwatch: Stopwatch,
) -> Path:
    """The model, grown by frames that only wider pairs connect: sub-models join it that way too."""
    wide = attempts(options)[1].pairs
    registered = set(read_scene(model).names)
    with MapDatabase.open(work / attempt.database) as database:
        with stopwatch.step("pairs"):
            pairs = pairs_of(database, frames, wide)
        for_missing = [
            (i, j)
            for i, j in pairs
            if frames.names[i] not in registered or frames.names[j] not in registered
        ]
        with stopwatch.step("matching"):
            match_missing(database, frames, for_missing, options, progress)
    with stopwatch.step("mapping"):
        models = _map(work, attempt, frames, options, progress, start_from=model, suffix="-second")
    return max([model, *models], key=count_registered)


def _refine(work: Path, model: Path, options: ReconstructOptions, progress: Progress) -> Path:
    target = work / "refined"
    progress("refinement", 0, 1)
    refine(
        model,
        target,
        camera_model=options.camera_model,
        refine_principal_point=options.refine_principal_point,
        threads=options.threads,
        log=work / "mapping.log",
    )
    progress("refinement", 1, 1)
    return target


def diagnose(
    database: MapDatabase, frames: FramesToMap, model: Path
) -> tuple[FrameRegistration, ...]:
    """What became of each frame, and for the missing ones why."""
    from spn_data.colmap.model import read_observations

    scene, seen = read_observations(model)
    position = {name: k for k, name in enumerate(scene.names)}
    partners: dict[str, dict[str, int]] = {name: {} for name in frames.names}
    for (a, b), inliers in database.verified_pairs().items():
        partners[a][b] = inliers
        partners[b][a] = inliers
    errors = np.linalg.norm(seen.residuals_px, axis=1)
    counts = np.bincount(seen.image_idx, minlength=len(scene.names))
    sums = np.bincount(seen.image_idx, errors, minlength=len(scene.names))
    rows = []
    for name in frames.names:
        keypoints = database.num_keypoints(name)
        k = position.get(name)
        reason = "" if k is not None else _why_missing(keypoints, partners[name], position)
        observations = 0 if k is None else int(counts[k])
        error = float("nan") if k is None or counts[k] == 0 else float(sums[k] / counts[k])
        rows.append(
            FrameRegistration(
                name, k is not None, reason, keypoints, len(partners[name]), observations, error
            )
        )
    return tuple(rows)


def _why_missing(keypoints: int, partners: dict[str, int], registered: dict[str, int]) -> str:
    if keypoints < 100:
        return f"only {keypoints} features: too blurred, dark or bare"
    if not partners:
        return f"{keypoints} features, but no verified match with any frame"
    inside = {name: inliers for name, inliers in partners.items() if name in registered}
    if not inside:
        best = max(partners, key=lambda name: partners[name])
        return (
            f"matches {len(partners)} frames (best {best}, {partners[best]} inliers), "
            "all of them missing too"
        )
    best = max(inside, key=lambda name: inside[name])
    return (
        f"matches {len(inside)} registered frames (best {best}, {inside[best]} inliers), "
        "but no pose agrees with the model's points"
    )


def _tell(attempt: Attempt, submodels: tuple[int, ...], n: int) -> str:
    how = f"{attempt.name} attempt{f' ({attempt.why})' if attempt.why else ''}"
    if not submodels:
        return f"{how}: no model"
    rest = f"; sub-models of {', '.join(map(str, submodels[1:]))}" if len(submodels) > 1 else ""
    return f"{how}: {submodels[0]} of {n} frames in the largest model{rest}"


def _no_model(
    work: Path,
    frames: FramesToMap,
    best: tuple[int, Path, Attempt, tuple[int, ...]] | None,
    story: list[str],
) -> str:
    found = 0 if best is None else best[0]
    return (
        f"no usable model: {found} of {len(frames.names)} frames fit together "
        f"({'; '.join(story)}). Frames must overlap by at least two thirds, be sharp, and show "
        f"textured, rigid things from changing positions; COLMAP's log is {work / 'mapping.log'}"
    )
