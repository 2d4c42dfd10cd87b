"""Errors of a pose model during training, on validation frames and on training images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np

from spn_data.geometry.pose import Poses
from spn_model.evaluation.metrics import Estimates, frame_errors, quantile
from spn_model.models.pose_model import PoseEstimates, PoseModel

_BATCH = 8  # batch size of `estimate`


class ValidationImages(Protocol):
    """Images with poses: a group of a data set, or rendered views.

    Attributes
    ----------
    intrinsics : ndarray, shape (N, 3, 3)
        Camera matrices.
    poses : Poses
        True poses (N).
    """

    @property
    def intrinsics(self) -> np.ndarray:
        """Camera matrices (N, 3, 3)."""

    @property
    def poses(self) -> Poses:
        """True poses (N)."""

    def image(self, row: int) -> np.ndarray:
        """Return an image, (H, W, 3) uint8 RGB."""


@dataclass(frozen=True)
class ValidationErrors:
    """Error statistics of some frames; a frame without a pose counts as an infinite error.

    Attributes
    ----------
    frames, located : int
        All frames, and frames with a pose.
    median_m, p95_m : float
        Position errors in metres, or in the world's unit.
    median_deg, p95_deg : float
        Rotation errors in degrees.
    """

    frames: int
    located: int
    median_m: float
    median_deg: float
    p95_m: float
    p95_deg: float

    @property
    def score(self) -> float:
        """Geometric mean of the median errors: lower is better, and the unit does not affect the order."""
        return float(np.sqrt(self.median_m * self.median_deg))

    def plain(self) -> dict[str, Any]:
        """Return the values by name, as written to the training log."""
        return asdict(self)


def spread_rows(count: int, limit: int) -> np.ndarray:
    """Return at most `limit` of `count` rows, evenly spread and always the same.

    Parameters
    ----------
    count : int
        Number of rows to choose from.
    limit : int
        Greatest number of rows to return.

    Returns
    -------
    ndarray of int
        Rows in ascending order.
    """
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(int))


def validate(
    model: PoseModel,
    frames: ValidationImages,
    rows: np.ndarray,
    check: Callable[[], None] = lambda: None,
    *,
    offset: Sequence[float] = (0.0, 0.0, 0.0),
) -> tuple[ValidationErrors, PoseEstimates]:
    """Estimate the poses of some rows and compare them with the true poses.

    Parameters
    ----------
    model : PoseModel
        Pose model; its network is left in eval mode.
    frames : ValidationImages
        Images with true poses.
    rows : ndarray of int
        Rows of `frames` to use.
    check : callable
        Called before each batch; may raise an exception to stop.
    offset : sequence of float
        Position of the model's zero in the world of the true poses.

    Returns
    -------
    errors : ValidationErrors
        Error statistics.
    estimates : PoseEstimates
        Estimates, in the order of `rows`.
    """
    model.network.eval()
    intrinsics = frames.intrinsics
    found = []
    for first in range(0, len(rows), _BATCH):
        check()
        part = rows[first : first + _BATCH]
        images = np.stack([frames.image(int(row)) for row in part])
        found.append(model.estimate(images, intrinsics[part]))
    estimates = PoseEstimates.concatenate(found).moved_by(offset)
    errors = frame_errors(Estimates("network", estimates.poses), frames.poses[rows])
    position, rotation = (
        np.where(np.isnan(values), np.inf, values) for values in (errors.error_m, errors.error_deg)
    )
    summary = ValidationErrors(
        frames=len(rows),
        located=int(errors.located.sum()),
        median_m=quantile(position, 0.5),
        median_deg=quantile(rotation, 0.5),
        p95_m=quantile(position, 0.95),
        p95_deg=quantile(rotation, 0.95),
    )
    return summary, estimates
