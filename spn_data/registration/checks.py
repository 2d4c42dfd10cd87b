"""Which poses become labels. A wrong pose is worse than none.

A pose has two kinds of witnesses: the map points that the frame itself found, and its neighbours in the
sequence, whose relative pose is known from their common features without the map. A frame that the map
places well, and in one place only, stands by itself. A frame that it places badly, or in two places, needs a
neighbour that stands and agrees. Where a frame and its neighbours contradict each other, the majority
holds; where there is none, all of them fail.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.colmap.resection import resect
from spn_data.geometry.epipolar import essential_matrix, sampson_errors
from spn_data.geometry.pose import Poses, rotation_errors_deg
from spn_data.labels.labels import sigmas
from spn_data.labels.map_points import covered_share
from spn_data.registration.register_options import CheckOptions, RegisterOptions
from spn_data.registration.solution import SequenceSolution, UnsolvedSequence, reprojection_errors

_MIN_SHARED = 10  # map points that two frames both show, to compare their poses by


@dataclass(frozen=True, eq=False)
class Evidence:
    """What speaks for each of N poses.

    direct : (N,) int, map points that the frame itself found and that agree; putative : (N,) int, that it
    found in all; inliers : (N,) int, agreeing map points, those that neighbours brought included;
    coverage : (N,) share of the image that these cover; rival : (N,) int, inliers of the best pose elsewhere;
    depth : (N,) median distance of the points, in the map's unit; sigma : (N,), sigma_deg : (N,) stated.
    pairs : (P, 2) neighbours, i < j; matches : (P,) of them; agreement : (P,) share of the matches that both
    poses explain, NaN where one has no pose (see `_agreement`).
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
) -> Evidence:
    """covariances : (N, 6, 6), NaN where there is no pose; pairs : verified matches (K, 2) of neighbours."""
    n = len(solution.posed)
    direct, inliers, rival = (np.zeros(n, np.int64) for _ in range(3))
    coverage, depth = np.zeros(n), np.full(n, np.nan)
    camera = solution.camera
    for row in np.flatnonzero(solution.posed).tolist():
        feature, point = solution.inliers(row)
        pixels = sequence.pixels[row][feature]
        found = set(map(tuple, sequence.putative[row].tolist()))
        own = [pair in found for pair in zip(feature.tolist(), point.tolist(), strict=True)]
        direct[row] = len(set(feature[own].tolist()))
        inliers[row] = len(np.unique(feature))
        if len(feature):
            coverage[row] = covered_share(pixels, camera.width, camera.height)
            away = sequence.map_xyz[point] - solution.poses.centers[row]
            depth[row] = np.median(np.linalg.norm(away, axis=1))
            rival[row] = _rival(sequence, solution, row, depth[row], options)
    shown = [_points_of_features(sequence, solution, row) for row in range(n)]
    sigma, sigma_deg = sigmas(covariances)
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


def _rival(
    sequence: UnsolvedSequence,
    solution: SequenceSolution,
    row: int,
    depth: float,
    options: RegisterOptions,
) -> int:
    """Inliers of the best pose among the matches that the pose leaves unexplained, if it lies elsewhere."""
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
    """Whether two poses are one, at the distance at which points are seen."""
    apart = float(np.linalg.norm(a.centers[0] - b.centers[0]))
    turned_deg = float(rotation_errors_deg(a.quats_wxyz, b.quats_wxyz)[0])
    return apart <= options.same_place * depth and turned_deg <= options.same_rotation_deg


def _points_of_features(
    sequence: UnsolvedSequence, solution: SequenceSolution, row: int
) -> np.ndarray:
    """(K,) row of the map point that the pose agrees with, of each feature of a frame; -1 for none."""
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
    """Share of the matches of two frames that both poses explain: by what they say least.

    Matches lie on each other's epipolar lines (Sampson's error); and the map point that one frame shows lies
    where the other has the match. The first says nothing of an error along the line between the frames, as
    of one window in a facade that they pass; the second needs map points.
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
    """accepted : (N,) bool; reason : N sentences, empty where accepted."""

    accepted: np.ndarray
    reason: tuple[str, ...]


def judge(posed: np.ndarray, evidence: Evidence, options: CheckOptions) -> PoseVerdict:
    """Accept or refuse each of N poses."""
    n = len(posed)
    reason = ["" if posed[k] else _unposed_reason(evidence, k) for k in range(n)]
    possible = posed.copy()
    for k in np.flatnonzero(posed).tolist():
        reason[k] = _weakness(evidence, k, options)
        possible[k] = not reason[k]
    agrees, contradicts = _testimony(evidence, possible, options)
    for k in np.flatnonzero(possible).tolist():
        if len(contradicts[k]) > 0 and len(contradicts[k]) >= len(agrees[k]):
            possible[k] = False
            reason[k] = (
                f"ambiguous: {len(contradicts[k])} of {len(contradicts[k]) + len(agrees[k])} neighbours "
                "contradict its pose"
            )
    accepted = np.zeros(n, bool)
    for k in np.flatnonzero(possible).tolist():
        accepted[k] = not _needs_support(evidence, k, options)
    while True:
        supported = [
            k for k in np.flatnonzero(possible & ~accepted) if any(accepted[j] for j in agrees[k])
        ]
        if not supported:
            break
        accepted[supported] = True
    for k in np.flatnonzero(possible & ~accepted).tolist():
        reason[k] = _needs_support(evidence, k, options) + ", and no neighbour confirms its pose"
    return PoseVerdict(accepted, tuple("" if accepted[k] else reason[k] for k in range(n)))


def _unposed_reason(evidence: Evidence, k: int) -> str:
    if evidence.putative[k] == 0:
        return "no feature matches a point of the map"
    return f"no pose agrees with its {evidence.putative[k]} matches with the map"


def _weakness(evidence: Evidence, k: int, options: CheckOptions) -> str:
    """What no neighbour can make good, or nothing."""
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


def _needs_support(evidence: Evidence, k: int, options: CheckOptions) -> str:
    """Why the map alone does not settle a pose, or nothing."""
    direct = int(evidence.direct[k])
    if evidence.rival[k] > options.max_rival * direct:
        return f"ambiguous: {direct} map points agree with the pose and {evidence.rival[k]} with another"
    if direct < options.min_inliers:
        return f"only {direct} map points found in it agree ({options.min_inliers} are needed)"
    if direct < options.min_inlier_ratio * evidence.putative[k]:
        return f"only {direct} of its {evidence.putative[k]} matches with the map agree"
    return ""


def _testimony(
    evidence: Evidence, possible: np.ndarray, options: CheckOptions
) -> tuple[list[list[int]], list[list[int]]]:
    """Neighbours that agree with each frame, and those that contradict it."""
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
