"""Search: the pose of one image in the landmark map, from several hypotheses that one judge compares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.geometry.pose import to_camera
from spn_model.landmarks.landmark_map import LandmarkMap
from spn_model.landmarks.matching import (
    STRONGEST,
    Expected,
    ImageFeatures,
    expected,
    match,
    match_all,
    match_near,
)
from spn_model.landmarks.solver import (
    KnownVertical,
    Sightings,
    SolvedPose,
    first_pose,
    solve,
)

FIRST_PX = 4.0  # of RANSAC
SEARCH_PX = 12.0  # around a projection, once there is a pose
AGREE_PX = 3.0
_MIN_FIRST = 8  # sightings that agree with a first pose
_ROUNDS = 2  # of matching around the projections
_MARGIN = 1.25  # on the field of view of an uncertain hypothesis


@dataclass(frozen=True, eq=False, kw_only=True)
class Hypothesis:
    """A supposed pose: which landmarks to look for.

    Attributes
    ----------
    source : str
        "network", "prior" or "track".
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
    candidates : Expected
        Landmarks that the pose should see.
    """

    source: str
    pose: SolvedPose
    seen: Sightings
    candidates: Expected


def candidate(
    landmarks: LandmarkMap,
    features: ImageFeatures,
    guess: Hypothesis | None,
    vertical: KnownVertical | None = None,
) -> Candidate | None:
    """Find and refine a pose from a hypothesis, or from a comparison with all landmarks.

    Parameters
    ----------
    landmarks : LandmarkMap
    features : ImageFeatures
    guess : Hypothesis or None
        None to compare with all landmarks.
    vertical : KnownVertical, optional

    Returns
    -------
    Candidate or None
        None if too few landmarks agree on a pose.
    """
    first = None
    if guess is None:
        for strongest in (
            STRONGEST,
            len(features),
        ):  # all of them only where the strongest do not do
            first = first_pose(match_all(features, landmarks, strongest), FIRST_PX, _MIN_FIRST)
            if first is not None:
                break
    else:
        wide = _MARGIN if guess.radius_px is None else 1.0
        wanted = _seen_from(landmarks, features, guess.center, guess.rotation, wide)
        seen = (
            match(features, landmarks, wanted)
            if guess.radius_px is None
            else match_near(features, landmarks, wanted, guess.radius_px)
        )
        first = first_pose(seen, FIRST_PX, _MIN_FIRST)
    if first is None:
        return None
    center, rotation = first
    for _ in range(_ROUNDS):
        wanted = _seen_from(landmarks, features, center, rotation, 1.0)
        seen = match_near(features, landmarks, wanted, SEARCH_PX)
        pose = solve(seen, center, rotation, vertical) if len(seen) >= _MIN_FIRST else None
        if pose is None:
            return None
        center, rotation = pose.center, pose.rotation
    return Candidate(
        source="map" if guess is None else guess.source, pose=pose, seen=seen, candidates=wanted
    )


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


def projections(
    landmarks: LandmarkMap, rows: np.ndarray, pose: SolvedPose, focal_px: float
) -> np.ndarray:
    """Return where landmarks (K,) are in the image of a pose, in pixels from the principal point."""
    x = to_camera(landmarks.xyz[rows], pose.center, pose.rotation)
    found: np.ndarray = x[:, :2] / x[:, 2:] * focal_px
    return found
