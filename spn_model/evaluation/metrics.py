"""Errors of estimated poses, without any alignment (docs/evaluation.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from spn_data.coverage.nearest_frame import CoverageOptions, nearest_frames
from spn_data.dataset.hdf5_schema import DatasetInfo
from spn_data.geometry.pose import Poses, pose_errors
from spn_data.geometry.rotations import rotation_vectors
from spn_model.evaluation.calibration import Calibration, calibrate, nees, sigmas

ENU = ("east", "north", "up")
_UNREFERENCED_AXES = ("x", "y", "z")
STRATA = ("high", "medium", "low")
_UNIT_TOLERANCE = 1e-4
# Without limits all frames are in one stratum, and the nearest frame is the one with the smallest sum.
_NEAREST = CoverageOptions(high_m=np.inf, high_deg=np.inf, medium_m=np.inf, medium_deg=np.inf)
DEG_PER_M = _NEAREST.deg_per_m


@dataclass(frozen=True, kw_only=True)
class MetricOptions:
    """Thresholds and bins of the metrics, in the unit of the world's lengths."""

    within: tuple[tuple[float, float], ...] = ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))  # m, degrees
    # edges of the distance to the nearest training frame; the last bin is open-ended
    bin_edges_m: tuple[float, ...] = (0, 0.5, 1, 1.5, 2, 3, 4, 6, 8, 12, 16, 24, 32, 64)


@dataclass(frozen=True, eq=False)
class EvaluationFrames:
    """N frames of one group with their true poses.

    names, strata : (N,) str; a stratum of "" is unknown. poses : true poses, finite. nearest_m, nearest_deg :
    (N,) distance and angle to the nearest training frame, the one with the smallest distance +
    angle / (10 degrees per metre). axes : names of the world axes.
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
    """Pose estimates of one method for N frames.

    poses : NaN where there is none. covariance : (N, 6, 6), over (centre; rotation vector v in the camera
    frame, R_true = exp(v) R), NaN where unknown; None for a method without covariances.
    """

    method: str
    poses: Poses
    covariance: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class FrameErrors:
    """Errors of N frames; NaN where there is no pose, or no covariance.

    error_m, error_deg : (N,) as in `spn_data.geometry.pose.pose_errors`. signed_m : (N, 3), estimated minus
    true centre: a negative value along up is too low. sigma_m, sigma_deg : (N,) stated standard deviations.
    nees : (N,) NEES, e^T C^-1 e.
    """

    error_m: np.ndarray
    error_deg: np.ndarray
    signed_m: np.ndarray
    sigma_m: np.ndarray
    sigma_deg: np.ndarray
    nees: np.ndarray

    @property
    def located(self) -> np.ndarray:
        """Which frames have a pose, (N,) bool."""
        return np.isfinite(self.error_m)


@dataclass(frozen=True)
class Spread:
    """Median, mean and 95th percentile of errors.

    Attributes
    ----------
    median, p95 : float
        Over all frames; a frame without a pose counts as an infinite error.
    mean : float
        Over frames with a pose.
    """

    median: float
    mean: float
    p95: float


@dataclass(frozen=True)
class AxisErrors:
    """Position errors along one axis of the world.

    Attributes
    ----------
    axis : str
        Name of the axis, as in "east".
    signed_median, signed_mean : float
        Of estimated minus true, over frames with a pose.
    absolute_median, absolute_p95 : float
        Of absolute errors over all frames.
    """

    axis: str
    signed_median: float
    signed_mean: float
    absolute_median: float
    absolute_p95: float


@dataclass(frozen=True)
class Within:
    """Share of all frames whose position and rotation errors are both within limits.

    Attributes
    ----------
    limit : float
        Largest position error, in the world's unit.
    limit_deg : float
        Largest rotation error in degrees.
    share : float
        From 0 to 1.
    """

    limit: float
    limit_deg: float
    share: float


@dataclass(frozen=True)
class Summary:
    """Error statistics of some frames of a group.

    Attributes
    ----------
    frames : int
        All frames.
    located : int
        Frames with a pose.
    position : Spread
        Position errors in the world's unit.
    rotation_deg : Spread
        Rotation errors in degrees.
    within : tuple of Within
        Shares of frames within pairs of limits.
    axes : tuple of AxisErrors
        Position errors along the axes of the world.
    """

    frames: int
    located: int
    position: Spread
    rotation_deg: Spread
    within: tuple[Within, ...]
    axes: tuple[AxisErrors, ...]


@dataclass(frozen=True)
class CurveBin:
    """Errors of frames whose distance to the nearest training frame is in [low, high)."""

    low: float
    high: float
    frames: int
    position_q25: float
    position_median: float
    position_q75: float
    rotation_median_deg: float


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Evaluation of one method on one group.

    Attributes
    ----------
    method : str
        Name of the method.
    frames : EvaluationFrames
        The evaluated frames.
    poses : Poses
        Their estimated poses; NaN where there is none.
    errors : FrameErrors
        Errors of each frame.
    summary : Summary
        Statistics of all frames.
    strata : dict of str to Summary
        Statistics by stratum of coverage, for strata that have frames.
    curve : tuple of CurveBin
        Errors against the distance to the nearest training frame.
    calibration : Calibration or None
        None for a method without covariances.
    """

    method: str
    frames: EvaluationFrames
    poses: Poses
    errors: FrameErrors
    summary: Summary
    strata: dict[str, Summary]
    curve: tuple[CurveBin, ...]
    calibration: Calibration | None


def axes_of(info: DatasetInfo) -> tuple[str, str, str]:
    """Return the names of the axes of a data set's world."""
    return _UNREFERENCED_AXES if info.origin is None else ENU


def evaluation_frames(
    group: str,
    names: np.ndarray,
    strata: np.ndarray,
    poses: Poses,
    training: Poses,
    *,
    axes: tuple[str, str, str] = ENU,
) -> EvaluationFrames:
    """Return a group with its distances to the training frames.

    Raises GeometryError if there are no training frames.
    """
    nearest = nearest_frames(poses, training, _NEAREST)
    return EvaluationFrames(group, names, strata, poses, nearest.distance, nearest.angle_deg, axes)


def nearest_rows(poses: Poses, training: Poses) -> np.ndarray:
    """Return the row (N,) of the nearest training frame, as defined in `EvaluationFrames`."""
    return nearest_frames(poses, training, _NEAREST).frame


def evaluate(
    estimates: Estimates, frames: EvaluationFrames, options: MetricOptions | None = None
) -> Evaluation:
    """Compute errors, shares, strata, curve and calibration of one method on one group.

    Raises ValueError if the group is empty, and as `frame_errors` does.
    """
    options = options or MetricOptions()
    if len(frames) == 0:
        raise ValueError(f"group {frames.group} has no frames")
    errors, vectors = _errors_and_vectors(estimates, frames.poses)
    calibration = None
    if estimates.covariance is not None:
        located = errors.located
        calibration = calibrate(vectors[located], estimates.covariance[located])
    everything = np.ones(len(frames), bool)
    known = [s for s in (*STRATA, "") if np.any(frames.strata == s)]
    return Evaluation(
        method=estimates.method,
        frames=frames,
        poses=estimates.poses,
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
    """Return the errors of each frame.

    Raises ValueError if the numbers of frames differ, a true pose is not finite, or an estimated quaternion
    is not normalised.
    """
    return _errors_and_vectors(estimates, true)[0]


def _errors_and_vectors(estimates: Estimates, true: Poses) -> tuple[FrameErrors, np.ndarray]:
    """Return errors, and (N, 6) error vectors that match the covariance (true minus estimated, or NaN)."""
    found, n = estimates.poses, len(true)
    if len(found) != n:
        raise ValueError(f"{len(found)} estimated poses for {n} frames")
    if not (np.isfinite(true.centers).all() and np.isfinite(true.quats_wxyz).all()):
        raise ValueError("a true pose is not finite")
    located = np.isfinite(found.centers).all(axis=1) & np.isfinite(found.quats_wxyz).all(axis=1)
    length = np.linalg.norm(found.quats_wxyz[located], axis=1)
    if np.any(np.abs(length - 1) > _UNIT_TOLERANCE):
        raise ValueError(f"{estimates.method}: an estimated quaternion is not normalised")
    columns = np.full((n, 5), np.nan)
    vectors = np.full((n, 6), np.nan)
    sub, sub_true = found[located], true[located]
    columns[located, 0], columns[located, 1] = pose_errors(sub, sub_true)
    vectors[located, :3] = sub_true.centers - sub.centers
    turned = sub_true.rotations @ np.transpose(sub.rotations, (0, 2, 1))
    vectors[located, 3:] = rotation_vectors(turned)
    if estimates.covariance is not None:
        if estimates.covariance.shape != (n, 6, 6):
            raise ValueError(
                f"covariances have shape {estimates.covariance.shape}, expected {(n, 6, 6)}"
            )
        covariance = estimates.covariance[located]
        columns[located, 2], columns[located, 3] = sigmas(covariance)
        columns[located, 4] = nees(vectors[located], covariance)
    errors = FrameErrors(
        columns[:, 0], columns[:, 1], -vectors[:, :3], columns[:, 2], columns[:, 3], columns[:, 4]
    )
    return errors, vectors


def error_curve(
    errors: FrameErrors, nearest_m: np.ndarray, edges_m: Sequence[float]
) -> tuple[CurveBin, ...]:
    """Return errors against the distance to the nearest training frame, in non-empty bins, nearest first."""
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
    """Return a quantile, linearly interpolated between values, which may be infinite; NaN without values."""
    if len(values) == 0:
        return float("nan")
    ordered = np.sort(values)
    at = share * (len(values) - 1)
    low, high = ordered[int(np.floor(at))], ordered[int(np.ceil(at))]
    if low == high:  # also if both are infinite
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
