"""Registration of a sequence: from its images to labels in the frozen map, in the map's own gauge."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spn_data.capture.frames import Frames
from spn_data.colmap.database import DatabaseImage, MapDatabase
from spn_data.colmap.model import Scene
from spn_data.labels.labels import LabelObservations, Labels
from spn_data.labels.map_points import MapPoints
from spn_data.matching.pairs import PairOptions, sequence_pairs
from spn_data.reconstruction.correspondences import FramesToMap, extract_missing, match_missing
from spn_data.registration.checks import check_poses, gather_evidence
from spn_data.registration.covariance import SequenceCovariance, sequence_covariance
from spn_data.registration.frozen_map import FrozenMap
from spn_data.registration.map_matching import match_missing_to_map
from spn_data.registration.recovery import carry_failed_frames, check_carried
from spn_data.registration.register_options import RegisterOptions
from spn_data.registration.solution import (
    SequenceSolution,
    UnsolvedSequence,
    adjust_inliers,
    estimated_intrinsics,
    remove_frames,
)
from spn_data.registration.solve import solve
from spn_data.registration.tracks import find_tracks
from spn_data.uncertainty.map_covariance import MapCovariance, MapCovarianceOptions
from spn_data.uncertainty.shared_errors import LensPrior
from spn_data.work.parallel import Dispatch
from spn_data.work.timing import Progress, Stopwatch

DATABASE = "database.db"
_MATCHES = ".matches"


@dataclass(frozen=True, eq=False)
class RegisteredSequence:
    """Result of registering N frames.

    Attributes
    ----------
    solution : SequenceSolution
        Contains the accepted frames.
    reason : tuple of str
        Why each frame was rejected; empty if it was accepted.
    inliers : ndarray, shape (N,)
        Number of agreeing map points.
    coverage : ndarray, shape (N,)
        Share of the image that they cover.
    covariance : SequenceCovariance or None
        None if no frame was accepted.
    covariances : ndarray, shape (N, 6, 6)
        NaN for frames without a pose.
    seen : LabelObservations
        Map points that each frame observes.
    map_sigma_px : float
        Standard deviation of the map's own residuals.
    """

    solution: SequenceSolution
    reason: tuple[str, ...]
    inliers: np.ndarray
    coverage: np.ndarray
    covariance: SequenceCovariance | None
    covariances: np.ndarray
    seen: LabelObservations
    map_sigma_px: float


def register_sequence(
    to_match: FramesToMap,
    folder: Path,
    map_folder: Path,
    map_lenses: Callable[[Scene], Mapping[int, LensPrior]],
    options: RegisterOptions,
    progress: Progress,
    *,
    dispatch: Dispatch,
    stopwatch: Stopwatch,
) -> RegisteredSequence:
    """Register N frames of one lens in a frozen map. The map's files are only read.

    Parameters
    ----------
    to_match : FramesToMap
        The frames; they share one camera.
    folder : Path
        Working folder, which may contain features and matches of an earlier run.
    map_folder : Path
        Folder of a model and its database.
    map_lenses : callable
        Returns what is known of the lenses of the map, by camera id.
    options : RegisterOptions
    progress : Progress
    dispatch : Dispatch
        Runs the work on workers.
    stopwatch : Stopwatch

    Returns
    -------
    RegisteredSequence

    Raises
    ------
    FormatError
        If the map or a database is damaged.
    StageError
        If the disk is full.
    """
    names = to_match.names
    neighbours = sorted(
        sequence_pairs(to_match.sequences, PairOptions(overlap=options.neighbors, far_steps=0))
    )
    with MapDatabase.open(folder / DATABASE) as database:
        database.add_images(
            [DatabaseImage(n, str(c)) for n, c in zip(names, to_match.cameras, strict=True)],
            to_match.lenses,
        )
        with stopwatch.step("features"):
            extract_missing(database, to_match, options.features, dispatch, progress)
        with stopwatch.step("neighbours"):
            match_missing(database, to_match, neighbours, options.matching, dispatch, progress)
        with FrozenMap.open(map_folder, map_folder / DATABASE) as frozen:
            with stopwatch.step("map"):
                putative = match_missing_to_map(
                    names, database, frozen, folder / _MATCHES, options, dispatch, progress
                )
            progress("poses", 0, len(names))
            with stopwatch.step("poses"):
                pixels = [
                    database.read_features(name).keypoints[:, :2].astype(np.float64)
                    for name in names
                ]
                pairs = {(i, j): database.read_inliers(names[i], names[j]) for i, j in neighbours}
                tracks = find_tracks(pairs, [len(p) for p in pixels])
                matches = [putative[name] for name in names]
                sequence = UnsolvedSequence(pixels, matches, tracks, frozen.points.xyz)
                (lens,) = to_match.lenses.values()
                solution = solve(sequence, lens, options)
                known = MapCovarianceOptions(lenses=map_lenses(frozen.scene))
                covariance = MapCovariance.of(frozen.scene, frozen.observations, known)
                registered = accept_poses(
                    sequence, solution, pairs, covariance, frozen.points, options
                )
                registered = recover_frames(
                    sequence,
                    registered,
                    pairs,
                    covariance,
                    frozen,
                    lambda row: database.read_features(names[row]).descriptors,
                    options,
                )
    progress("poses", len(names), len(names))
    return registered


def accept_poses(
    sequence: UnsolvedSequence,
    solution: SequenceSolution,
    pairs: dict[tuple[int, int], np.ndarray],
    map_covariance: MapCovariance,
    points: MapPoints,
    options: RegisterOptions,
) -> RegisteredSequence:
    """Drop poses that fail the checks, adjust the rest and check it again, until none fails."""
    n = len(solution.posed)
    reason, inliers, coverage = [""] * n, np.zeros(n, np.int64), np.zeros(n)
    settled = np.zeros(n, bool)  # a rejected frame keeps the reason and figures from when it failed
    while True:
        covariance = _covariance(sequence, solution, map_covariance, options)
        measured = _of_all_frames(solution, None if covariance is None else covariance.measured)
        evidence = gather_evidence(sequence, solution, measured, pairs, options)
        verdict = check_poses(solution.posed, evidence, options.checks)
        for row in np.flatnonzero(~settled):
            reason[row] = verdict.reason[row]
            inliers[row], coverage[row] = evidence.inliers[row], evidence.coverage[row]
        settled |= ~verdict.accepted
        failing = solution.posed & ~verdict.accepted
        if not failing.any():
            break
        solution = adjust_inliers(sequence, remove_frames(solution, failing), options)
    return _registered(
        sequence,
        solution,
        reason,
        inliers,
        coverage,
        covariance,
        map_covariance,
        points,
    )


def recover_frames(
    sequence: UnsolvedSequence,
    first: RegisteredSequence,
    pairs: dict[tuple[int, int], np.ndarray],
    map_covariance: MapCovariance,
    frozen: FrozenMap,
    describe: Callable[[int], np.ndarray],
    options: RegisterOptions,
) -> RegisteredSequence:
    """Try again with the frames that failed, from the accepted ones, which stay accepted.

    `describe` returns the descriptors (K, 128) of a frame. Frames that fail again keep their reasons.
    """
    accepted = first.solution.posed
    if accepted.all() or not accepted.any():
        return first
    carried = carry_failed_frames(sequence, first.solution, frozen, describe, options)
    if carried is None:
        return first
    sequence, solution = carried
    while True:
        if not (solution.posed & ~accepted).any() or not solution.posed[accepted].all():
            return first
        covariance = _covariance(sequence, solution, map_covariance, options)
        measured = _of_all_frames(solution, None if covariance is None else covariance.measured)
        evidence = gather_evidence(sequence, solution, measured, pairs, options, find_rivals=False)
        stands = check_carried(sequence, solution, accepted, evidence, options.checks)
        failing = solution.posed & ~stands
        if not failing.any():
            break
        solution = adjust_inliers(sequence, remove_frames(solution, failing), options)
    posed = solution.posed
    return _registered(
        sequence,
        solution,
        np.where(posed, "", first.reason).tolist(),
        np.where(posed, evidence.inliers, first.inliers),
        np.where(posed, evidence.coverage, first.coverage),
        covariance,
        map_covariance,
        frozen.points,
    )


def _registered(
    sequence: UnsolvedSequence,
    solution: SequenceSolution,
    reason: list[str],
    inliers: np.ndarray,
    coverage: np.ndarray,
    covariance: SequenceCovariance | None,
    map_covariance: MapCovariance,
    points: MapPoints,
) -> RegisteredSequence:
    of_map = np.flatnonzero(solution.point_row >= 0)
    seen = LabelObservations(
        solution.frame[of_map],
        points.ids[solution.point_row[of_map]],
        sequence.pixels_of(solution.frame[of_map], solution.feature[of_map]),
    )
    return RegisteredSequence(
        solution=solution,
        reason=tuple(reason),
        inliers=inliers,
        coverage=coverage,
        covariance=covariance,
        covariances=_of_all_frames(solution, None if covariance is None else covariance.poses),
        seen=seen,
        map_sigma_px=map_covariance.sigma_px,
    )


def _covariance(
    sequence: UnsolvedSequence,
    solution: SequenceSolution,
    map_covariance: MapCovariance,
    options: RegisterOptions,
) -> SequenceCovariance | None:
    """Return the covariance of the posed frames, None if there is none."""
    if not solution.posed.any():
        return None
    state, observations = solution.least_squares(sequence)
    return sequence_covariance(
        state,
        observations,
        solution.point_row,
        map_covariance,
        estimated_intrinsics(solution.camera, len(state.poses), options),
    )


def _of_all_frames(solution: SequenceSolution, of_posed: np.ndarray | None) -> np.ndarray:
    """Return covariances (N, 6, 6) of all frames from those of the posed ones, NaN without a pose."""
    covariances = np.full((len(solution.posed), 6, 6), np.nan)
    if of_posed is not None:
        covariances[solution.posed] = of_posed
    return covariances


def labels_of(chosen: Frames, registered: RegisteredSequence) -> Labels:
    """Convert registered frames to labels in the map's gauge.

    Parameters
    ----------
    chosen : Frames
        The N frames, in the order in which they were registered.
    registered : RegisteredSequence

    Returns
    -------
    Labels
    """
    solution, covariance = registered.solution, registered.covariance
    n = len(chosen)
    error_px = np.full(n, np.nan)
    if covariance is not None:
        squared = (covariance.residuals_px**2).sum(axis=1)
        of_map = solution.point_row >= 0
        count = np.bincount(solution.frame[of_map], minlength=n)
        total = np.bincount(solution.frame[of_map], weights=squared[of_map], minlength=n)
        error_px = np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
    return Labels.of_frames(
        chosen,
        solution.poses,
        tracked=False,
        reason=registered.reason,
        covariance=registered.covariances,
        inliers=registered.inliers,
        coverage=registered.coverage,
        error_px=error_px,
    )
