"""Options of registration."""

from __future__ import annotations

from dataclasses import dataclass, field

from spn_data.matching.features import FeatureOptions
from spn_data.matching.putative import MatchOptions


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """Thresholds of the checks. Lengths are relative to the median distance of the observed points.

    Attributes
    ----------
    min_inliers : int
        Minimum number of map points that agree with the pose.
    min_inlier_ratio : float
        Minimum share of the features matched with the map that are inliers, for a pose that no neighbour
        confirms. Where nothing but the place looks alike, wrong poses reach 0.10 (another courtyard with the
        same window grid) to 0.22 (a wall of the same houses farther along a street). In each flight with
        correct poses, some frames reach 0.6 and more, and their neighbours confirm the others.
    min_coverage : float
        Minimum share of the image's cells that contain an inlier.
    max_rival : float
        Maximum number of inliers of the second-best pose, relative to the best one's.
    same_place, same_rotation_deg : float
        Poses are the same if they are closer than this in position and rotation.
    min_pair_matches : int
        Minimum number of matches with a neighbour for it to count as evidence.
    min_pair_agreement : float
        Minimum share of these matches that both poses explain.
    max_sigma : float
        Maximum standard deviation of the position.
    max_sigma_deg : float
        Maximum standard deviation of the rotation.
    """

    min_inliers: int = 30
    min_inlier_ratio: float = 0.3
    min_coverage: float = 0.08
    max_rival: float = 0.5
    same_place: float = 0.025
    same_rotation_deg: float = 2.0
    min_pair_matches: int = 30
    min_pair_agreement: float = 0.5
    max_sigma: float = 0.0125
    max_sigma_deg: float = 0.5


@dataclass(frozen=True, kw_only=True)
class RegisterOptions:
    """Options of the registration of a sequence.

    Attributes
    ----------
    rate_hz : float
        Frames taken from a video per second, regardless of their content.
    map_frames : int
        Number of most similar map frames with which a frame is matched.
    neighbors : int
        Number of following frames of its sequence with which a frame is matched.
    hold_lens : bool
        Keep the given intrinsics fixed.
    start_error_px : float
        Maximum reprojection error of an inlier while the intrinsics are estimated.
    max_error_px : float
        Maximum reprojection error of an inlier afterwards.
    features : FeatureOptions
    matching : MatchOptions
    checks : CheckOptions
    seed : int
        Random seed.
    """

    rate_hz: float = 2.0
    map_frames: int = 12
    neighbors: int = 3
    hold_lens: bool = False
    start_error_px: float = 12.0
    max_error_px: float = 4.0
    features: FeatureOptions = field(default_factory=FeatureOptions)
    matching: MatchOptions = field(default_factory=MatchOptions)
    checks: CheckOptions = field(default_factory=CheckOptions)
    seed: int = 0
