"""Search: the pose of one image in the landmark map, from several hypotheses that one judge compares."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from spn_model.integrity.judgement import Witness
from spn_model.landmarks.aids import KnownHeight, KnownVertical, height_sigmas, tilt_sigmas
from spn_model.landmarks.landmark_map import LandmarkMap
from spn_model.landmarks.matching import (
    STRONGEST,
    Expected,
    ImageFeatures,
    expected,
    match,
    match_all,
    match_near,
    projected,
)
from spn_model.landmarks.solver import Sightings, SolvedPose, first_pose, fit_focal_length, solve

FIRST_PX = 4.0  # of RANSAC
SEARCH_PX = 12.0  # around a projection, once there is a pose
FOLLOW_PX = 24.0  # around a predicted one
_MIN_FIRST = 8  # sightings that agree with a first pose
_ROUNDS = 6  # of matching around the projections
_SETTLED = 1.02  # growth of the landmarks that agree below which no further round follows
ELSEWHERE_M, ELSEWHERE_DEG = 0.5, 2.0
WEAK = 120  # landmarks that agree below which more is tried
MAP = "retrieval"  # among all landmarks
_MARGIN = 1.25  # on the field of view of an uncertain hypothesis


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A supposed pose: which landmarks to look for.

    Attributes
    ----------
    source : str
        "network", "retrieval", "prior" or "track", as in `FixSource`.
    center : ndarray, shape (3,)
    rotation : ndarray, shape (3, 3)
    radius_px : float or None
        How far landmarks may be from their projections; None if anywhere in the image.
    """

    source: str
    center: np.ndarray
    rotation: np.ndarray
    radius_px: float | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Candidate:
    """A pose with everything that speaks for and against it.

    Attributes
    ----------
    source : str
        Where the hypothesis came from.
    pose : SolvedPose
    seen : Sightings
        Landmarks found within `SEARCH_PX` of their projections.
    """

    source: str
    pose: SolvedPose
    seen: Sightings

    @property
    def agreeing(self) -> int:
        """Number of landmarks that agree with the pose."""
        return int(self.pose.inliers.sum())

    def is_elsewhere(self, other: Candidate) -> bool:
        """Return whether the pose is another one than that of `other`."""
        turn = np.trace(self.pose.rotation @ other.pose.rotation.T)
        return bool(
            np.linalg.norm(self.pose.center - other.pose.center) > ELSEWHERE_M
            or np.rad2deg(np.arccos(np.clip((turn - 1) / 2, -1, 1))) > ELSEWHERE_DEG
        )


@dataclass(frozen=True, eq=False)
class Found:
    """Result of a search: the best pose, and how many landmarks agree with the best pose elsewhere.

    Attributes
    ----------
    best : Candidate
    rival_inliers : int
        0 if no other pose was found.
    """

    best: Candidate
    rival_inliers: int


def search(
    landmarks: LandmarkMap,
    features: ImageFeatures,
    hypotheses: Iterable[Hypothesis] = (),
) -> Found | None:
    """Find the pose of an image.

    The strongest features are compared with all landmarks of the map. If few landmarks agree with the pose
    that follows, the hypotheses are tried, and at last all features are compared. What does not agree with
    the best pose is asked for another one.

    Parameters
    ----------
    landmarks : LandmarkMap
    features : ImageFeatures
    hypotheses : iterable of Hypothesis
        The most promising first; one that need not be tried is not drawn, so they may be costly.

    Returns
    -------
    Found or None
        None if too few landmarks agree on any pose.
    """
    compared = match_all(features, landmarks)
    found = [_candidate(landmarks, features, MAP, compared)]
    remaining = iter(hypotheses)
    while _is_weak(found) and (guess := next(remaining, None)) is not None:
        seen = _guided(landmarks, features, guess)
        found.append(_candidate(landmarks, features, guess.source, seen))
    if _is_weak(found):
        compared = compared.followed_by(match_all(features, landmarks, slice(STRONGEST, None)))
        found.append(_candidate(landmarks, features, MAP, compared))
    best = max((c for c in found if c), key=lambda c: c.agreeing, default=None)
    if best is None:
        return None
    # Sightings that nearly agree with the best pose would only lead to it again.
    off_px = np.abs(
        compared.at
        - projected(compared.xyz, best.pose.center, best.pose.rotation, features.focal_px)
    ).max(axis=1)
    rest = compared.select(off_px > SEARCH_PX)
    found.append(_candidate(landmarks, features, MAP, rest))
    poses = sorted((c for c in found if c), key=lambda c: -c.agreeing)
    rivals = [c.agreeing for c in poses[1:] if c.is_elsewhere(poses[0])]
    return Found(poses[0], max(rivals, default=0))


def _is_weak(found: list[Candidate | None]) -> bool:
    """Return whether few landmarks agree with the best pose so far."""
    return max((c.agreeing for c in found if c), default=0) < WEAK


def follow(
    landmarks: LandmarkMap,
    features: ImageFeatures,
    guess: Hypothesis,
) -> Found | None:
    """Find the pose of an image close to a predicted one; None if too few landmarks agree on a pose there.

    Landmarks are looked for close to their projections first, which is quick and mostly enough.
    """
    found = _refine(landmarks, features, guess.source, guess.center, guess.rotation, FOLLOW_PX)
    if found is None or found.agreeing < WEAK:
        seen = _guided(landmarks, features, guess)
        wide = _candidate(landmarks, features, guess.source, seen)
        found = max((c for c in (found, wide) if c), key=lambda c: c.agreeing, default=None)
    return None if found is None else Found(found, 0)


def _guided(landmarks: LandmarkMap, features: ImageFeatures, guess: Hypothesis) -> Sightings:
    margin = _MARGIN if guess.radius_px is None else 1.0
    wanted = _seen_from(landmarks, features, guess.center, guess.rotation, margin)
    return match(features, landmarks, wanted, guess.radius_px)


def _candidate(
    landmarks: LandmarkMap,
    features: ImageFeatures,
    source: str,
    seen: Sightings,
) -> Candidate | None:
    first = first_pose(seen, FIRST_PX, _MIN_FIRST)
    return None if first is None else _refine(landmarks, features, source, *first)


def _refine(
    landmarks: LandmarkMap,
    features: ImageFeatures,
    source: str,
    center: np.ndarray,
    rotation: np.ndarray,
    first_px: float = SEARCH_PX,
) -> Candidate | None:
    """Match around the projections and solve, until no more landmarks agree; at first within `first_px`."""
    best, agreeing = None, 0
    wanted = _seen_from(landmarks, features, center, rotation, 1.0)
    radius_px = first_px
    for _ in range(_ROUNDS):
        seen = match_near(features, landmarks, wanted, radius_px)
        pose = solve(seen, center, rotation) if len(seen) >= _MIN_FIRST else None
        if pose is None:
            break
        count = int(pose.inliers.sum())
        if count <= agreeing:
            break
        settled = count <= _SETTLED * agreeing
        best = Candidate(source=source, pose=pose, seen=seen)
        center, rotation = pose.center, pose.rotation
        if settled:
            break
        agreeing = count if radius_px == SEARCH_PX else 0  # a wide round is only a start
        radius_px = SEARCH_PX
        wanted = wanted.seen_from(landmarks, center, rotation, features.focal_px)
    return best


def _seen_from(
    landmarks: LandmarkMap,
    features: ImageFeatures,
    center: np.ndarray,
    rotation: np.ndarray,
    margin: float,
) -> Expected:
    return expected(
        landmarks, center, rotation, features.focal_px, features.half_view, margin=margin
    )


class HasView(Protocol):
    """What the landmarks of a candidate were found in: features, or an anchor."""

    @property
    def half_view(self) -> np.ndarray:
        """Tangents (2,) of half the field of view, with distortion."""


def witness_of(
    found: Found,
    features: HasView,
    vertical: KnownVertical | None = None,
    height: KnownHeight | None = None,
    focal_bound: float = np.inf,
) -> Witness:
    """Return what is known about the pose of a candidate, for its judgement."""
    best, tilt, off = found.best, 0.0, 0.0
    if vertical is not None:
        tilt = tilt_sigmas(vertical, best.pose.rotation, best.pose.covariance)
    if height is not None:
        off = height_sigmas(height, best.pose.center, best.pose.covariance)
    return Witness(
        at=best.seen.at / best.seen.focal_px / features.half_view,
        xyz=best.seen.xyz,
        residuals=best.pose.residuals,
        jacobian=best.pose.jacobian,
        by_focal=best.pose.by_focal,
        weights=best.pose.weights,
        inliers=best.pose.inliers,
        information=best.pose.information,
        tilt_sigmas=tilt,
        height_sigmas=off,
        rival_inliers=found.rival_inliers,
        focal_change=fit_focal_length(best.seen, best.pose),
        focal_bound=focal_bound,
    )
