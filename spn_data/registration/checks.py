"""Checks that decide which poses become labels. A wrong pose is worse than none.

There is evidence of two kinds for a pose: the map points that the frame itself matched, and its neighbours in
the sequence, whose relative pose is known from common features without the map. A frame whose matches clearly
determine one pose is accepted on its own. A frame with few or ambiguous matches needs an accepted neighbour
that agrees with it. If a frame and its neighbours contradict each other, the majority decides; without a
majority, all of them fail.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.colmap.resection import resect
from spn_data.geometry.epipolar import essential_matrix, sampson_errors
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import rotation_errors_deg
from spn_data.labels.labels import pose_sigmas
from spn_data.labels.map_points import covered_share
from spn_data.registration.register_options import CheckOptions, RegisterOptions
from spn_data.registration.solution import SequenceSolution, UnsolvedSequence, reprojection_errors

_MIN_SHARED = 10  # map points that two frames must share to compare their poses


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence for each of N poses.

    Attributes
    ----------
    direct : ndarray, shape (N,), int
        Number of agreeing map points that the frame itself matched.
    putative : ndarray, shape (N,), int
        Number of its features that were matched with the map.
    inliers : ndarray, shape (N,), int
        Number of agreeing map points, including those propagated from neighbours.
    coverage : ndarray, shape (N,)
        Share of the image that they cover.
    rival : ndarray, shape (N,), int
        Inliers of the best pose elsewhere.
    depth : ndarray, shape (N,)
        Median distance of the points in the map's unit.
    sigma, sigma_deg : ndarray, shape (N,)
        Standard deviations of position and rotation by the covariance.
    pairs : ndarray, shape (P, 2)
        Neighbours, i < j.
    matches : ndarray, shape (P,)
        Number of their matches.
    agreement : ndarray, shape (P,)
        Share of the matches that both poses explain (see `_agreement`); NaN if one of them has no pose.
    """

    direct: np.ndarray
    putative: np.ndarray
    inliers: np.ndarray
    coverage: np.ndarray
    rival: np.ndarray
    depth: np.ndarray
    sigma: np.ndarray
    sigma_deg: np.ndarray
    pairs: np.ndarray
    matches: np.ndarray
    agreement: np.ndarray


def gather_evidence(
    sequence: UnsolvedSequence,
    solution: SequenceSolution,
    covariances: np.ndarray,
    pairs: dict[tuple[int, int], np.ndarray],
    options: RegisterOptions,
    *,
    find_rivals: bool = True,
) -> Evidence:
    """Collect the evidence for the poses of a solution.

    The covariances (N, 6, 6) are NaN for frames without a pose; `pairs` holds the verified matches (K, 2) of
    neighbours. Without `find_rivals`, which takes most of the time, no frame has a rival.
    """
    n = len(solution.posed)
    direct, inliers, rival = (np.zeros(n, np.int64) for _ in range(3))
    coverage, depth = np.zeros(n), np.full(n, np.nan)
    camera = solution.camera
    for row in np.flatnonzero(solution.posed).tolist():
        feature, point = solution.inliers(row)
        pixels = sequence.pixels[row][feature]
        matched = set(map(tuple, sequence.putative[row].tolist()))
        own = [pair in matched for pair in zip(feature.tolist(), point.tolist(), strict=True)]
        direct[row] = len(set(feature[own].tolist()))
        inliers[row] = len(np.unique(feature))
        if len(feature):
            coverage[row] = covered_share(pixels, camera.width, camera.height)
            away = sequence.map_xyz[point] - solution.poses.centers[row]
            depth[row] = np.median(np.linalg.norm(away, axis=1))
            if find_rivals:
                rival[row] = _rival_inliers(sequence, solution, row, depth[row], options)
    shown = [_points_of_features(sequence, solution, row) for row in range(n)]
    sigma, sigma_deg = pose_sigmas(covariances)
    keys = np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)
    return Evidence(
        direct=direct,
        putative=np.array([len(set(m[:, 0].tolist())) for m in sequence.putative]),
        inliers=inliers,
        coverage=coverage,
        rival=rival,
        depth=depth,
        sigma=sigma,
        sigma_deg=sigma_deg,
        pairs=keys,
        matches=np.array([len(pairs[int(i), int(j)]) for i, j in keys], dtype=np.int64),
        agreement=np.array(
            [
                _agreement(sequence, solution, shown, pairs[int(i), int(j)], i, j, options)
                for i, j in keys
            ]
        ),
    )


def _rival_inliers(
    sequence: UnsolvedSequence,
    solution: SequenceSolution,
    row: int,
    depth: float,
    options: RegisterOptions,
) -> int:
    """Return the inliers of the best other pose from the matches that the pose does not explain."""
    matches = sequence.putative[row]
    pixels = sequence.pixels[row][matches[:, 0]]
    points = sequence.map_xyz[matches[:, 1]]
    pose = solution.poses[row : row + 1]
    error_px = reprojection_errors(pose, solution.camera, points, pixels)
    explained = set(matches[error_px <= 2 * options.max_error_px, 0].tolist())
    rest = np.array([f not in explained for f in matches[:, 0].tolist()], dtype=bool)
    second = resect(
        pixels[rest],
        points[rest],
        solution.camera,
        max_error_px=options.max_error_px,
        seed=options.seed,
    )
    if second is None or same_pose(pose, second.pose, depth, options.checks):
        return 0
    return len(set(matches[rest][second.inliers, 0].tolist()))


def same_pose(a: Poses, b: Poses, depth: float, options: CheckOptions) -> bool:
    """Return whether two poses are equal within the tolerances, given the distance of the points."""
    apart = float(np.linalg.norm(a.centers[0] - b.centers[0]))
    turned_deg = float(rotation_errors_deg(a.quats_wxyz, b.quats_wxyz)[0])
    return apart <= options.same_place * depth and turned_deg <= options.same_rotation_deg


def _points_of_features(
    sequence: UnsolvedSequence, solution: SequenceSolution, row: int
) -> np.ndarray:
    """Return for each feature (K,) of a frame the row of its agreeing map point; -1 for none."""
    shown = np.full(len(sequence.pixels[row]), -1)
    feature, point = solution.inliers(row)
    shown[feature] = point
    return shown


def _agreement(
    sequence: UnsolvedSequence,
    solution: SequenceSolution,
    shown: list[np.ndarray],
    matches: np.ndarray,
    i: int,
    j: int,
    options: RegisterOptions,
) -> float:
    """Return the share of the matches of two frames that both poses explain.

    It is the smallest of up to three shares. Matches must be near each other's epipolar lines (Sampson
    error), and a map point that one frame observes must project near the match in the other frame, in both
    directions. The epipolar error is blind to a pose error along the baseline, such as one window in a facade
    that the camera passes; the other two need map points.
    """
    if not (solution.posed[i] and solution.posed[j]) or not len(matches):
        return float("nan")
    shares = [_epipolar_share(sequence, solution, matches, i, j, options.max_error_px)]
    ends = ((i, matches[:, 0], j, matches[:, 1]), (j, matches[:, 1], i, matches[:, 0]))
    for here, features, there, matched in ends:
        point = shown[here][features]
        known = point >= 0
        if known.sum() >= _MIN_SHARED:
            error_px = reprojection_errors(
                solution.poses[there : there + 1],
                solution.camera,
                sequence.map_xyz[point[known]],
                sequence.pixels[there][matched[known]],
            )
            shares.append(float((error_px <= 2 * options.max_error_px).mean()))
    return min(shares)


def _epipolar_share(
    sequence: UnsolvedSequence,
    solution: SequenceSolution,
    matches: np.ndarray,
    i: int,
    j: int,
    max_error_px: float,
) -> float:
    camera = solution.camera
    a = camera.unproject(sequence.pixels[i][matches[:, 0]])
    b = camera.unproject(sequence.pixels[j][matches[:, 1]])
    error = sampson_errors(a, b, essential_matrix(solution.poses, i, j))
    return float((error * np.mean(camera.focal_px) <= max_error_px).mean())


@dataclass(frozen=True, eq=False)
class PoseVerdict:
    """Result of the checks.

    Attributes
    ----------
    accepted : ndarray, shape (N,), bool
    reason : tuple of str
        Why a pose was rejected; empty if it was accepted.
    """

    accepted: np.ndarray
    reason: tuple[str, ...]


def check_poses(posed: np.ndarray, evidence: Evidence, options: CheckOptions) -> PoseVerdict:
    """Accept or reject each of N poses."""
    n = len(posed)
    reason = ["" if posed[k] else _unposed_reason(evidence, k) for k in range(n)]
    possible = posed.copy()
    for k in np.flatnonzero(posed).tolist():
        reason[k] = _rejection_reason(evidence, k, options)
        possible[k] = not reason[k]
    agrees, contradicts = neighbour_votes(evidence, possible, options)
    for k in np.flatnonzero(possible).tolist():
        if len(contradicts[k]) > 0 and len(contradicts[k]) >= len(agrees[k]):
            possible[k] = False
            reason[k] = (
                f"ambiguous: {len(contradicts[k])} of {len(contradicts[k]) + len(agrees[k])} neighbours "
                "contradict its pose"
            )
    accepted = np.zeros(n, bool)
    for k in np.flatnonzero(possible).tolist():
        accepted[k] = not _doubt(evidence, k, options)
    while True:
        supported = [
            k for k in np.flatnonzero(possible & ~accepted) if any(accepted[j] for j in agrees[k])
        ]
        if not supported:
            break
        accepted[supported] = True
    for k in np.flatnonzero(possible & ~accepted).tolist():
        reason[k] = _doubt(evidence, k, options) + ", and no neighbour confirms its pose"
    return PoseVerdict(accepted, tuple("" if accepted[k] else reason[k] for k in range(n)))


def _unposed_reason(evidence: Evidence, k: int) -> str:
    if evidence.putative[k] == 0:
        return "no feature matches a point of the map"
    return f"no pose agrees with its {evidence.putative[k]} matches with the map"


def _rejection_reason(evidence: Evidence, k: int, options: CheckOptions) -> str:
    """Return why a pose is rejected regardless of its neighbours, or an empty string."""
    if evidence.inliers[k] < options.min_inliers:
        return f"only {evidence.inliers[k]} map points agree ({options.min_inliers} are needed)"
    if evidence.coverage[k] < options.min_coverage:
        return (
            f"the map points that agree cover {evidence.coverage[k]:.0%} of the image "
            f"({options.min_coverage:.0%} are needed)"
        )
    if not evidence.sigma[k] <= options.max_sigma * evidence.depth[k]:
        return f"its position is uncertain by {evidence.sigma[k] / evidence.depth[k]:.1%} of the distance"
    if not evidence.sigma_deg[k] <= options.max_sigma_deg:
        return f"its rotation is uncertain by {evidence.sigma_deg[k]:.2f} deg"
    return ""


def _doubt(evidence: Evidence, k: int, options: CheckOptions) -> str:
    """Return why a pose needs confirmation by a neighbour, or an empty string."""
    direct = int(evidence.direct[k])
    if evidence.rival[k] > options.max_rival * direct:
        return f"ambiguous: {direct} map points agree with the pose and {evidence.rival[k]} with another"
    if direct < options.min_inliers:
        return f"only {direct} map points found in it agree ({options.min_inliers} are needed)"
    if direct < options.min_inlier_ratio * evidence.putative[k]:
        return f"only {direct} of its {evidence.putative[k]} matches with the map agree"
    return ""


def neighbour_votes(
    evidence: Evidence, possible: np.ndarray, options: CheckOptions
) -> tuple[list[list[int]], list[list[int]]]:
    """Return for each frame the possible neighbours that agree with it and those that contradict it."""
    agrees: list[list[int]] = [[] for _ in possible]
    contradicts: list[list[int]] = [[] for _ in possible]
    for (i, j), matches, share in zip(
        evidence.pairs.tolist(), evidence.matches, evidence.agreement, strict=True
    ):
        if not (possible[i] and possible[j]) or matches < options.min_pair_matches:
            continue
        side = agrees if share >= options.min_pair_agreement else contradicts
        side[i].append(j)
        side[j].append(i)
    return agrees, contradicts
