"""How far estimated poses are from true ones. Nothing is ever aligned (docs/evaluation.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from spn_data.coverage.nearest_frame import CoverageOptions, nearest_frames
from spn_data.dataset.hdf5_schema import DatasetInfo
from spn_data.geometry.pose import Poses, pose_errors, rotation_vectors
from spn_model.evaluation.calibration import Calibration, calibrate, sigmas, squared_distances

ENU = ("east", "north", "up")
_NO_PLACE = ("x", "y", "z")
STRATA = ("high", "medium", "low")
_UNIT_TOLERANCE = 1e-4
# With no limit on either, every frame is of one stratum, and the nearest is that of the smallest sum.
_NEAREST = CoverageOptions(high_m=np.inf, high_deg=np.inf, medium_m=np.inf, medium_deg=np.inf)
DEG_PER_M = _NEAREST.deg_per_m


@dataclass(frozen=True, kw_only=True)
class MetricOptions:
    """What is counted. Lengths in the world's unit."""

    within: tuple[tuple[float, float], ...] = ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))  # m, degrees
    # of the distance to the nearest training frame; the last bin has no end
    bin_edges_m: tuple[float, ...] = (0, 0.5, 1, 1.5, 2, 3, 4, 6, 8, 12, 16, 24, 32, 64)


@dataclass(frozen=True, eq=False)
class EvaluationFrames:
    """N frames of one group, with what is true of them.

    names, strata : (N,) str; a stratum may be "" (unknown). poses : the truth, finite.
    nearest_m, nearest_deg : (N,) to the nearest training frame: of all, the one with the smallest
    distance + angle / 10 degrees per metre. axes : names of the world's axes.
    """

    group: str
    names: np.ndarray
    strata: np.ndarray
    poses: Poses
    nearest_m: np.ndarray
    nearest_deg: np.ndarray
    axes: tuple[str, str, str] = ENU

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, eq=False)
class Estimates:
    """What one method says of N frames.

    poses : NaN where it gives none. covariance : (N, 6, 6), over (centre; rotation vector v in the camera
    frame, R_true = exp(v) R), NaN where unknown; None from a method that states none.
    """

    method: str
    poses: Poses
    covariance: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class FrameErrors:
    """Of N frames; NaN where there is no pose, or no covariance.

    error_m, error_deg : (N,) as `spn_data.geometry.pose.pose_errors`. signed_m : (N, 3), estimated minus true
    centre: negative up is too low. sigma_m, sigma_deg : (N,) stated. distance_sq : (N,) e^T C^-1 e.
    """

    error_m: np.ndarray
    error_deg: np.ndarray
    signed_m: np.ndarray
    sigma_m: np.ndarray
    sigma_deg: np.ndarray
    distance_sq: np.ndarray

    @property
    def located(self) -> np.ndarray:
        """(N,) bool: with a pose."""
        return np.isfinite(self.error_m)


@dataclass(frozen=True)
class Spread:
    """Of errors over all frames: one without a pose is infinitely wrong in median and p95, and not in the
    mean, which is over the frames with a pose."""

    median: float
    mean: float
    p95: float


@dataclass(frozen=True)
class AxisErrors:
    """Along one axis: signed (estimated minus true) over frames with a pose; absolute over all frames."""

    axis: str
    signed_median: float
    signed_mean: float
    absolute_median: float
    absolute_p95: float


@dataclass(frozen=True)
class Within:
    """Share of all frames within both limits."""

    limit: float
    limit_deg: float
    share: float


@dataclass(frozen=True)
class Summary:
    """Errors of some frames. located : of them have a pose."""

    frames: int
    located: int
    position: Spread
    rotation_deg: Spread
    within: tuple[Within, ...]
    axes: tuple[AxisErrors, ...]


@dataclass(frozen=True)
class CurveBin:
    """Errors of the frames whose nearest training frame is `low` to `high` away (low within, high not)."""

    low: float
    high: float
    frames: int
    position_q25: float
    position_median: float
    position_q75: float
    rotation_median_deg: float


@dataclass(frozen=True, eq=False)
class Evaluation:
    """One method on one group. strata : by name, those with frames; calibration : None without covariance."""

    method: str
    frames: EvaluationFrames
    errors: FrameErrors
    summary: Summary
    strata: dict[str, Summary]
    curve: tuple[CurveBin, ...]
    calibration: Calibration | None


def axes_of(info: DatasetInfo) -> tuple[str, str, str]:
    """Names of the axes of a data set's world."""
    return _NO_PLACE if info.origin is None else ENU


def evaluation_frames(
    group: str,
    names: np.ndarray,
    strata: np.ndarray,
    poses: Poses,
    training: Poses,
    *,
    axes: tuple[str, str, str] = ENU,
) -> EvaluationFrames:
    """The group with its distances to the training frames. Raises GeometryError without training frames."""
    nearest = nearest_frames(poses, training, _NEAREST)
    return EvaluationFrames(group, names, strata, poses, nearest.distance, nearest.angle_deg, axes)


def nearest_rows(poses: Poses, training: Poses) -> np.ndarray:
    """(N,) row of the nearest training frame, as `EvaluationFrames` means it."""
    return nearest_frames(poses, training, _NEAREST).frame


def evaluate(
    estimates: Estimates, frames: EvaluationFrames, options: MetricOptions | None = None
) -> Evaluation:
    """Errors, shares, strata, curve and calibration of one method on one group of at least one frame."""
    options = options or MetricOptions()
    if len(frames) == 0:
        raise ValueError(f"group {frames.group} holds no frames")
    errors, vectors = _errors(estimates, frames.poses)
    calibration = None
    if estimates.covariance is not None:
        located = errors.located
        calibration = calibrate(vectors[located], estimates.covariance[located])
    everything = np.ones(len(frames), bool)
    known = [s for s in (*STRATA, "") if np.any(frames.strata == s)]
    return Evaluation(
        method=estimates.method,
        frames=frames,
        errors=errors,
        summary=_summary(errors, everything, frames.axes, options),
        strata={
            s or "unknown": _summary(errors, frames.strata == s, frames.axes, options)
            for s in known
        },
        curve=error_curve(errors, frames.nearest_m, options.bin_edges_m),
        calibration=calibration,
    )


def frame_errors(estimates: Estimates, true: Poses) -> FrameErrors:
    """Errors of each frame. Raises ValueError where lengths differ or a quaternion is not unit."""
    return _errors(estimates, true)[0]


def _errors(estimates: Estimates, true: Poses) -> tuple[FrameErrors, np.ndarray]:
    """Errors, and error vectors (N, 6) as the covariance is of: true minus estimated, NaN without a pose."""
    found, n = estimates.poses, len(true)
    if len(found) != n:
        raise ValueError(f"{len(found)} estimated poses of {n} frames")
    if not (np.isfinite(true.centers).all() and np.isfinite(true.quats_wxyz).all()):
        raise ValueError("a true pose is not finite")
    located = np.isfinite(found.centers).all(axis=1) & np.isfinite(found.quats_wxyz).all(axis=1)
    length = np.linalg.norm(found.quats_wxyz[located], axis=1)
    if np.any(np.abs(length - 1) > _UNIT_TOLERANCE):
        raise ValueError(f"{estimates.method}: an estimated quaternion is not of length one")
    columns = np.full((n, 5), np.nan)
    vectors = np.full((n, 6), np.nan)
    sub, sub_true = found[located], true[located]
    columns[located, 0], columns[located, 1] = pose_errors(sub, sub_true)
    vectors[located, :3] = sub_true.centers - sub.centers
    turned = sub_true.rotations @ np.transpose(sub.rotations, (0, 2, 1))
    vectors[located, 3:] = rotation_vectors(turned)
    if estimates.covariance is not None:
        if estimates.covariance.shape != (n, 6, 6):
            raise ValueError(f"covariances {estimates.covariance.shape} of {n} frames")
        covariance = estimates.covariance[located]
        columns[located, 2], columns[located, 3] = sigmas(covariance)
        columns[located, 4] = squared_distances(vectors[located], covariance)
    errors = FrameErrors(
        columns[:, 0], columns[:, 1], -vectors[:, :3], columns[:, 2], columns[:, 3], columns[:, 4]
    )
    return errors, vectors


def error_curve(
    errors: FrameErrors, nearest_m: np.ndarray, edges_m: Sequence[float]
) -> tuple[CurveBin, ...]:
    """Errors against distance to the nearest training frame: bins that hold frames, nearest first."""
    edges = [*edges_m, np.inf]
    position, rotation = _or_infinite(errors.error_m), _or_infinite(errors.error_deg)
    bins = []
    for low, high in pairwise(edges):
        mine = (nearest_m >= low) & (nearest_m < high)
        if mine.any():
            q25, median, q75 = (quantile(position[mine], share) for share in (0.25, 0.5, 0.75))
            count, turn = int(mine.sum()), quantile(rotation[mine], 0.5)
            bins.append(CurveBin(float(low), float(high), count, q25, median, q75, turn))
    return tuple(bins)


def quantile(values: np.ndarray, share: float) -> float:
    """Linear between values, which may be infinite; NaN of no values."""
    if len(values) == 0:
        return float("nan")
    ordered = np.sort(values)
    at = share * (len(values) - 1)
    low, high = ordered[int(np.floor(at))], ordered[int(np.ceil(at))]
    if low == high:  # also where both are infinite
        return float(high)
    return float(low + (high - low) * (at - np.floor(at)))


def _summary(
    errors: FrameErrors, mask: np.ndarray, axes: Sequence[str], options: MetricOptions
) -> Summary:
    located = errors.located & mask
    position, rotation = _or_infinite(errors.error_m[mask]), _or_infinite(errors.error_deg[mask])
    return Summary(
        frames=int(mask.sum()),
        located=int(located.sum()),
        position=_spread(position),
        rotation_deg=_spread(rotation),
        within=tuple(
            Within(m, deg, float(((position <= m) & (rotation <= deg)).mean()))
            for m, deg in options.within
        ),
        axes=tuple(
            AxisErrors(
                axis,
                quantile(errors.signed_m[located, k], 0.5),
                _mean(errors.signed_m[located, k]),
                quantile(_or_infinite(np.abs(errors.signed_m[mask, k])), 0.5),
                quantile(_or_infinite(np.abs(errors.signed_m[mask, k])), 0.95),
            )
            for k, axis in enumerate(axes)
        ),
    )


def _spread(values: np.ndarray) -> Spread:
    finite = values[np.isfinite(values)]
    return Spread(quantile(values, 0.5), _mean(finite), quantile(values, 0.95))


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _or_infinite(values: np.ndarray) -> np.ndarray:
    return np.where(np.isnan(values), np.inf, values)
