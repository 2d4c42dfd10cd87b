"""How far a member is off while it is trained: on validation frames, and on images that it trains on."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np

from spn_data.geometry.pose import Poses
from spn_model.evaluation.metrics import Estimates, frame_errors, quantile
from spn_model.models.pose_model import PoseEstimates, PoseModel

_AT_ONCE = 8  # images given to `estimate`


class PosedImages(Protocol):
    """Images with poses: a group of a data set, or rendered views."""

    @property
    def intrinsics(self) -> np.ndarray:
        """(N, 3, 3)."""

    @property
    def poses(self) -> Poses:
        """The true ones (N)."""

    def image(self, row: int) -> np.ndarray:
        """(H, W, 3) uint8 RGB."""


@dataclass(frozen=True)
class Errors:
    """Of some frames; one without a pose is infinitely wrong. Metres, or the world's unit; degrees."""

    frames: int
    located: int
    median_m: float
    median_deg: float
    p95_m: float
    p95_deg: float

    @property
    def score(self) -> float:
        """What is compared between moments of a training: the lower the better, of any unit."""
        return float(np.sqrt(self.median_m * self.median_deg))

    def plain(self) -> dict[str, Any]:
        """By name, as the log has them."""
        return asdict(self)


def spread_rows(count: int, limit: int) -> np.ndarray:
    """At most `limit` rows of `count`, evenly spread, always the same."""
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(int))


def judge(model: PoseModel, frames: PosedImages, rows: np.ndarray) -> tuple[Errors, PoseEstimates]:
    """The member's estimates of these rows, and their errors. The network is left in eval mode."""
    model.network.eval()
    intrinsics = frames.intrinsics
    found = []
    for first in range(0, len(rows), _AT_ONCE):
        part = rows[first : first + _AT_ONCE]
        images = np.stack([frames.image(int(row)) for row in part])
        found.append(model.estimate(images, intrinsics[part]))
    estimates = PoseEstimates.concatenate(found)
    errors = frame_errors(Estimates("network", estimates.poses), frames.poses[rows])
    position, rotation = (
        np.where(np.isnan(values), np.inf, values) for values in (errors.error_m, errors.error_deg)
    )
    summary = Errors(
        frames=len(rows),
        located=int(errors.located.sum()),
        median_m=quantile(position, 0.5),
        median_deg=quantile(rotation, 0.5),
        p95_m=quantile(position, 0.95),
        p95_deg=quantile(rotation, 0.95),
    )
    return summary, estimates
