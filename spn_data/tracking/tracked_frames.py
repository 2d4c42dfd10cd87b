"""What following points into video frames is given, and what becomes of a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses


@dataclass(frozen=True, kw_only=True)
class TrackingOptions:
    """How frames are followed, and when a pose becomes a label.

    Pixels are those of the image in which points are followed. Lengths are shares of the median distance
    of the points that the frame sees, so that they hold in a map without a unit as well.
    """

    max_width_px: int = 1600  # wider images are reduced to this
    max_points: int = 400  # followed from each labelled frame, spread over the image
    start_points: int = 120  # of them, followed first and from far, to find the frame's rough pose
    window_px: int = 21  # side of a patch
    start_halvings: int = 2  # of the image for the first search
    start_levels: int = 2  # further halvings that the first search begins at
    levels: int = 1  # halvings that the second search begins at: it knows where to look
    round_trip_px: float = 0.5  # a point followed there and back misses its beginning by no more
    max_error_px: float = 2.0  # of an inlier
    min_inliers: int = 30
    min_inlier_ratio: float = 0.5  # of the points that were followed
    min_coverage: float = 0.06  # share of the image's cells that hold an inlier
    max_sigma: float = 0.005  # standard deviation of the position from these points alone
    max_sigma_deg: float = 0.25  # of the rotation
    max_split: float = 0.0125  # between the positions by either labelled frame's points alone
    max_split_deg: float = 0.5  # between the rotations
    max_jump: float = 0.01  # off the straight motion from the frame before to the frame after ...
    max_jump_deg: float = 1.0
    max_acceleration: float = 0.5  # ... and what this adds, per s2,
    max_turn_deg_s2: float = 100.0  # and this
    max_batch_mb: int = (
        256  # of images between two labelled frames; the middle beyond it is left out
    )


@dataclass(frozen=True, eq=False)
class Anchor:
    """A labelled frame and K map points that it sees, those known best first.

    gray : (h, w) uint8, maybe reduced; poses : (1,); point_ids : (K,); xyz : (K, 3); pixels : (K, 2) of
    the full-size image.
    """

    time_s: float
    gray: np.ndarray
    poses: Poses
    point_ids: np.ndarray
    xyz: np.ndarray
    pixels: np.ndarray


@dataclass(frozen=True, eq=False)
class Segment:
    """N frames to label between or beside one or two labelled ones, in the order of time.

    rows : (N,) their rows in the caller's table; time_s : (N,); grays : N images (h, w) uint8, all of one
    size; camera : of all, anchors included, at full size.
    """

    rows: np.ndarray
    time_s: np.ndarray
    grays: list[np.ndarray]
    camera: Camera
    anchors: list[Anchor]


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """What became of one frame.

    reason : why it has no label, empty where it has one. poses : (1,), NaN without a label; point_ids (K,)
    and full-size pixels (K, 2) of the inliers, coverage and error_px, their spread and root mean square
    residual (full size). distance : median, of the points; sigma, sigma_deg : of position and rotation, from
    the residuals alone; split, split_deg : between the answers of two labelled frames, NaN where only one
    answers. Positions as shares of distance.
    """

    row: int
    reason: str
    poses: Poses
    point_ids: np.ndarray
    pixels: np.ndarray
    coverage: float = 0.0
    error_px: float = np.nan
    inlier_ratio: float = np.nan
    distance: float = np.nan
    sigma: float = np.nan
    sigma_deg: float = np.nan
    split: float = np.nan
    split_deg: float = np.nan


def failed(reason: str, row: int = -1) -> TrackedFrame:
    """A frame without a label."""
    return TrackedFrame(row, reason, Poses.unknown(1), np.zeros(0, np.int64), np.zeros((0, 2)))
