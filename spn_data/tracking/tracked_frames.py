"""Input and result of tracking points into video frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses


@dataclass(frozen=True, kw_only=True)
class TrackingOptions:
    """How frames are tracked, and when a pose becomes a label.

    Pixels refer to the image in which points are tracked. Lengths are relative to the median distance of the
    points that the frame observes, so that they also apply to a map without metric scale.

    Attributes
    ----------
    max_width_px : int
        Wider images are reduced to this width.
    max_points : int
        Maximum number of points tracked from each labelled frame, spread over the image.
    start_points : int
        Number of these that are tracked first, with a large search range, to estimate a rough pose.
    window_px : int
        Side of a patch.
    start_halvings : int
        Number of times that the image is halved for the first search.
    start_levels : int
        Further pyramid levels of the first search.
    levels : int
        Pyramid levels of the second search, which starts from a rough pose.
    round_trip_px : float
        Maximum distance between a point and its position after tracking forwards and backwards.
    max_error_px : float
        Maximum reprojection error of an inlier.
    min_inliers : int
    min_inlier_ratio : float
        Minimum share of the tracked points that are inliers.
    min_coverage : float
        Minimum share of the image's cells that contain an inlier.
    max_sigma, max_sigma_deg : float
        Maximum standard deviation of position and rotation by these points alone.
    max_split, max_split_deg : float
        Maximum difference between the poses from the points of either labelled frame alone.
    max_jump, max_jump_deg : float
        Maximum deviation from the constant motion between the frames before and after.
    max_acceleration, max_turn_deg_s2 : float
        Acceleration, per s^2, that is allowed in addition to this deviation.
    max_batch_mb : int
        Maximum size of the images between two labelled frames; the middle of a longer gap is left out.
    """

    max_width_px: int = 1600
    max_points: int = 400
    start_points: int = 120
    window_px: int = 21
    start_halvings: int = 2
    start_levels: int = 2
    levels: int = 1
    round_trip_px: float = 0.5
    max_error_px: float = 2.0
    min_inliers: int = 30
    min_inlier_ratio: float = 0.5
    min_coverage: float = 0.06
    max_sigma: float = 0.005
    max_sigma_deg: float = 0.25
    max_split: float = 0.0125
    max_split_deg: float = 0.5
    max_jump: float = 0.01
    max_jump_deg: float = 1.0
    max_acceleration: float = 0.5
    max_turn_deg_s2: float = 100.0
    max_batch_mb: int = 256


@dataclass(frozen=True, eq=False)
class Anchor:
    """Labelled frame and K map points that it observes, the most accurate first.

    Attributes
    ----------
    time_s : float
    gray : ndarray, shape (h, w), uint8
        Possibly reduced image.
    poses : Poses
        One pose.
    point_ids : ndarray, shape (K,)
    xyz : ndarray, shape (K, 3)
    pixels : ndarray, shape (K, 2)
        In the full-size image.
    """

    time_s: float
    gray: np.ndarray
    poses: Poses
    point_ids: np.ndarray
    xyz: np.ndarray
    pixels: np.ndarray


@dataclass(frozen=True, eq=False)
class Segment:
    """N frames to label and the one or two labelled frames around them, in the order of time.

    Attributes
    ----------
    rows : ndarray, shape (N,)
        Rows in the caller's table.
    time_s : ndarray, shape (N,)
    grays : list of ndarray, shape (h, w), uint8
        N images of equal size.
    camera : Camera
        Of all frames including the anchors, at full size.
    anchors : list of Anchor
    """

    rows: np.ndarray
    time_s: np.ndarray
    grays: list[np.ndarray]
    camera: Camera
    anchors: list[Anchor]


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """Result for one frame.

    Attributes
    ----------
    row : int
        Row in the caller's table.
    reason : str
        Why it has no label; empty if it has one.
    poses : Poses
        One pose; NaN without a label.
    point_ids : ndarray, shape (K,)
    pixels : ndarray, shape (K, 2)
        Inliers, in the full-size image.
    coverage : float
        Share of the image that the inliers cover.
    error_px : float
        RMS reprojection error of the inliers at full size.
    inlier_ratio : float
    distance : float
        Median distance of the points.
    sigma, sigma_deg : float
        Standard deviation of position, relative to `distance`, and rotation, from the residuals alone.
    split, split_deg : float
        Difference between the poses from two labelled frames, the position relative to `distance`; NaN if
        only one gives a pose.
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


def failed_frame(reason: str, row: int = -1) -> TrackedFrame:
    """Return a frame without a label."""
    return TrackedFrame(row, reason, Poses.unknown(1), np.zeros(0, np.int64), np.zeros((0, 2)))
