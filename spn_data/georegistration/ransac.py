"""First step of georegistration: RANSAC for an initial similarity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.errors import GeometryError
from spn_data.geometry.pose import Similarity
from spn_data.geometry.rotations import rotations_from_vectors
from spn_data.georegistration.georegister_options import GeoregisterOptions
from spn_data.georegistration.observe import Fixes


@dataclass(frozen=True, eq=False)
class RansacResult:
    """Similarity of the best sample and its inlier frames (N,)."""

    world_from_model: Similarity
    inlier: np.ndarray
    sigma_factor: float  # factor by which the stated sigmas were enlarged to find a consensus


def rotation_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the smallest rotation (3, 3) that maps direction a (3,) to direction b (3,)."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        # Rotate by 180 degrees about any axis orthogonal to a.
        axis = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
        sine = float(np.linalg.norm(axis))
    return rotations_from_vectors(axis / sine * np.arctan2(np.linalg.norm(np.cross(a, b)), cosine))


def _distances(fixes: Fixes, predicted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return horizontal and vertical distances (S, N), in sigma, of S hypotheses' centres (S, N, 3).

    Unknown distances are NaN. Vertical distances are relative to their flight's median if each flight has an
    unknown vertical offset.
    """
    difference = fixes.enu_m - predicted
    horizontal = np.linalg.norm(difference[..., :2] / fixes.sigma_m[:, :2], axis=-1)
    vertical = difference[..., 2].copy()
    for f in range(len(fixes.flights)):
        mine = np.flatnonzero((fixes.flight == f) & np.isfinite(fixes.enu_m[:, 2]))
        if len(mine) and fixes.free_heights:
            vertical[..., mine] -= np.median(vertical[..., mine], axis=-1, keepdims=True)
    return horizontal, np.abs(vertical) / fixes.sigma_m[:, 2]


def _sample_pairs(
    rng: np.random.Generator, points: np.ndarray, candidates: np.ndarray, samples: int
) -> np.ndarray:
    """Sample pairs (S, 2) of candidates, keeping the half with the larger horizontal distances."""
    pairs = rng.choice(candidates, size=(2 * samples, 2))
    length = np.linalg.norm(points[pairs[:, 0], :2] - points[pairs[:, 1], :2], axis=1)
    return pairs[length >= max(float(np.median(length)), 1e-6)][:samples]


def _with_gravity(
    model: np.ndarray, fixes: Fixes, up_model: np.ndarray, samples: int, rng: np.random.Generator
) -> list[Similarity]:
    """Compute hypotheses (heading, scale, translation) from two fixes each, given the direction of up."""
    level_from_model = rotation_between(up_model, np.array([0.0, 0.0, 1.0]))
    level = model @ level_from_model.T
    candidates = np.flatnonzero(fixes.has_fix)
    pairs = _sample_pairs(rng, fixes.enu_m, candidates, samples)
    a = level[:, 0] + 1j * level[:, 1]
    b = fixes.enu_m[:, 0] + 1j * fixes.enu_m[:, 1]
    i, j = pairs.T
    moved = np.abs(a[j] - a[i])
    i, j = i[moved > 1e-9], j[moved > 1e-9]
    turn = (b[j] - b[i]) / (a[j] - a[i])
    hypotheses = []
    for k, q in enumerate(turn):
        rotation = rotations_from_vectors(np.array([0.0, 0.0, np.angle(q)])) @ level_from_model
        scale = float(np.abs(q))
        shift = fixes.enu_m[i[k]] - scale * rotation @ model[i[k]]
        up = fixes.enu_m[:, 2] - scale * model @ rotation[2]
        shift[2] = np.nanmedian(up) if fixes.has_heights else -np.mean(scale * model @ rotation[2])
        hypotheses.append(Similarity(scale, rotation, shift))
    return hypotheses


def _without_gravity(
    model: np.ndarray, fixes: Fixes, samples: int, rng: np.random.Generator
) -> list[Similarity]:
    """Compute hypotheses from three fixes of one flight each, using only wide triangles."""
    known = np.isfinite(fixes.enu_m).all(axis=1)
    counts = np.bincount(fixes.flight[known], minlength=len(fixes.flights))
    triples = []
    for f in np.flatnonzero(counts >= 3):
        mine = np.flatnonzero(known & (fixes.flight == f))
        triples.append(rng.choice(mine, size=(int(4 * samples * counts[f] / counts.sum()) + 4, 3)))
    if not triples:
        raise GeometryError(
            "no flight has three fixes with heights, and there are no gimbal angles"
        )
    all_triples = np.concatenate(triples)
    p, q, r = (fixes.enu_m[all_triples[:, k]] for k in range(3))
    longest = np.maximum.reduce([np.linalg.norm(d, axis=1) for d in (p - q, q - r, r - p)])
    area = np.linalg.norm(np.cross(q - p, r - p), axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        # The smallest altitude of the triangle measures how well it determines rotation about its long side.
        width = np.where(longest > 0, area / longest, 0.0)
    wide = np.argsort(-width, kind="stable")[:samples]
    wide = wide[width[wide] > 1e-3]
    hypotheses = []
    for triple in all_triples[wide]:
        source = model[triple]
        spread = np.linalg.svd(source - source.mean(axis=0), compute_uv=False)
        if spread[1] > 1e-6 * max(spread[0], 1e-300):
            hypotheses.append(Similarity.fit(source, fixes.enu_m[triple]))
    return hypotheses


def ransac_similarity(
    model: np.ndarray, fixes: Fixes, up_model: np.ndarray | None, options: GeoregisterOptions
) -> RansacResult:
    """Find the sampled similarity with the smallest truncated cost (MSAC, Torr & Zisserman 2000).

    model : (N, 3) camera centres; up_model : (3,) direction of up in the model if known. If fewer than half
    of the fixes are inliers, the sigmas are enlarged up to fourfold, as long as they stay well below the
    extent of the flight. Raises GeometryError if no similarity has at least half of the fixes as inliers.
    """
    rng = np.random.default_rng(options.seed)
    if up_model is not None:
        hypotheses = _with_gravity(model, fixes, up_model, options.ransac_samples, rng)
    else:
        hypotheses = _without_gravity(model, fixes, options.ransac_samples, rng)
    if not hypotheses:
        raise GeometryError(
            "the fixes coincide or are collinear: fly a cross leg of at least 20 m, "
            "or give gimbal angles"
        )
    has_fix = fixes.has_fix
    spread = extent(fixes)
    sigma = float(np.median(fixes.sigma_m[has_fix, :2]))
    distances = []
    for first in range(0, len(hypotheses), 100):
        some = hypotheses[first : first + 100]
        predicted = np.stack([h.apply(model) for h in some])
        distances.append(_distances(fixes, predicted))
    horizontal = np.concatenate([d[0] for d in distances])
    vertical = np.nan_to_num(np.concatenate([d[1] for d in distances]))
    best_share, best = 0.0, 0
    for factor in (1.0, 2.0, 4.0):
        if factor > 1 and 4 * factor * sigma > spread:
            break
        limit = options.ransac_sigmas * factor
        cost = np.minimum(horizontal[:, has_fix], limit) ** 2
        cost = cost + np.minimum(vertical[:, has_fix], limit) ** 2
        best = int(np.argmin(cost.sum(axis=1)))
        inlier = has_fix & (horizontal[best] < limit) & (vertical[best] < limit)
        best_share = inlier.sum() / has_fix.sum()
        if best_share >= 0.5:
            return RansacResult(hypotheses[best], inlier, factor)
    raise GeometryError(
        f"only {best_share:.0%} of {has_fix.sum()} fixes agree with the model's shape "
        f"within {options.ransac_sigmas:g} sigma ({sigma:.2g} m each): this may be the telemetry of another "
        "flight, or its clock may be off"
    )


def extent(fixes: Fixes) -> float:
    """Return the RMS distance in metres of the fixes from their median, without the farthest tenth."""
    points = fixes.enu_m[fixes.has_fix]
    points = points[:, :2] if not np.isfinite(points).all() else points
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    # Bursts of outliers are rare, so 90 % of the fixes show the extent of the flight.
    return float(np.sqrt(np.mean(np.sort(distance)[: max(1, int(0.9 * len(distance)))] ** 2)))
