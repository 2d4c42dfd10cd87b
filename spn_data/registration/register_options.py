"""All that registering a sequence depends on."""

from __future__ import annotations

from dataclasses import dataclass, field

from spn_data.matching.features import FeatureOptions
from spn_data.matching.putative import MatchOptions


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """When a pose becomes a label. Lengths are shares of the median distance of the points that are seen."""

    min_inliers: int = 30  # map points that agree with the pose
    # Of the features that match the map, so that a pose stands without a neighbour. True poses have 0.2 and
    # more where the image is sharp; in another place with the same window grid, wrong ones reach 0.10.
    min_inlier_ratio: float = 0.15
    min_coverage: float = 0.08  # share of the image's cells that hold an inlier
    max_rival: float = 0.5  # inliers of the second-best pose, as a share of the best one's
    same_place: float = 0.025  # poses nearer than this, and
    same_rotation_deg: float = 2.0  # turned by less, are one
    min_pair_matches: int = 30  # with a neighbour, so that it can testify
    min_pair_agreement: float = 0.5  # share of them that the two poses explain
    max_sigma: float = 0.0125  # of the position
    max_sigma_deg: float = 0.5  # of the rotation


@dataclass(frozen=True, kw_only=True)
class RegisterOptions:
    """How a sequence is registered."""

    rate_hz: float = 2.0  # frames taken of a video, whatever they show
    map_frames: int = 12  # most similar map frames that a frame is matched with
    neighbors: int = 3  # following frames of its sequence that it is matched with
    hold_lens: bool = False  # keep the lens that is given as it is
    start_error_px: float = 12.0  # of an inlier while the lens is being found
    max_error_px: float = 4.0  # of an inlier afterwards
    features: FeatureOptions = field(default_factory=FeatureOptions)
    matching: MatchOptions = field(default_factory=MatchOptions)
    checks: CheckOptions = field(default_factory=CheckOptions)
    seed: int = 0
