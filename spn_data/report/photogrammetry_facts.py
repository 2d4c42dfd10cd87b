"""Photogrammetric facts of an area: lenses, reprojection errors, tracks, overlap, ellipses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.geometry.camera import MODELS, Camera
from spn_data.geometry.pose import Poses
from spn_data.labels.labels import LabelObservations, Labels
from spn_data.labels.map_points import MapPoints

_CELLS_ACROSS = 12  # of the image
_LEAST_IN_CELL = 10  # measurements; fewer do not give a mean


@dataclass(frozen=True, eq=False)
class LensCalibration:
    """What is stored of the accuracy of a lens.

    Attributes
    ----------
    estimated : tuple of str
        Names of the adjusted parameters.
    sigma : ndarray, shape (L,)
        Their standard deviations.
    correlation : ndarray, shape (L, L)
    """

    estimated: tuple[str, ...]
    sigma: np.ndarray
    correlation: np.ndarray


@dataclass(frozen=True, eq=False)
class ReprojectionErrors:
    """Reprojection errors, projected minus measured, of all frames of a lens.

    Attributes
    ----------
    errors_px : ndarray, shape (M,)
        Their lengths.
    cells_px : ndarray, shape (R, C, 2)
        Mean error in each cell of the image; NaN with too few measurements.
    """

    errors_px: np.ndarray
    cells_px: np.ndarray

    @property
    def rms_px(self) -> float:
        """Root of the mean square."""
        return float(np.sqrt(np.mean(self.errors_px**2)))


@dataclass(frozen=True, eq=False)
class LensFacts:
    """A lens and the frames that it took.

    Attributes
    ----------
    key : str
        Key of the camera.
    is_evaluation : bool
        Whether it took an evaluation flight.
    camera : Camera
    frames : int
        Number of its chosen frames with a pose.
    calibration : LensCalibration or None
        None if nothing is stored.
    errors : ReprojectionErrors or None
        None if no frame observes a point.
    """

    key: str
    is_evaluation: bool
    camera: Camera
    frames: int
    calibration: LensCalibration | None
    errors: ReprojectionErrors | None


@dataclass(frozen=True, eq=False)
class PositionCovariances:
    """Covariances of camera positions relative to the map, of chosen frames.

    Attributes
    ----------
    names, sequences : ndarray of str, shape (N,)
    centers : ndarray, shape (N, 3)
    covariance : ndarray, shape (N, 3, 3)
    """

    names: np.ndarray
    sequences: np.ndarray
    centers: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class Overlap:
    """Number of mapping frames that see each cell of the ground; row 0 is in the south.

    Attributes
    ----------
    low : ndarray, shape (2,)
        East and north of the south-western corner.
    cell_m : float
    count : ndarray of int, shape (R, C)
        -1 where the ground is unknown.
    centers : ndarray, shape (N, 2)
        East and north of the frames.
    """

    low: np.ndarray
    cell_m: float
    count: np.ndarray
    centers: np.ndarray


@dataclass(frozen=True, eq=False)
class Photogrammetry:
    """Photogrammetric facts of an area.

    Attributes
    ----------
    lenses : tuple of LensFacts
    track_lengths : ndarray, shape (P,)
        Number of mapping frames that observe each point.
    positions : PositionCovariances
    overlap : Overlap or None
    no_overlap : str
        Why there is none.
    """

    lenses: tuple[LensFacts, ...]
    track_lengths: np.ndarray
    positions: PositionCovariances
    overlap: Overlap | None
    no_overlap: str = ""


def calibration_of(names: tuple[str, ...], covariance: np.ndarray) -> LensCalibration:
    """Return sigma and correlations of parameters with a covariance (L, L)."""
    sigma = np.sqrt(np.diag(covariance))
    scale = np.where(sigma > 0, sigma, 1.0)
    return LensCalibration(names, sigma, covariance / np.outer(scale, scale))


def check_calibration(calibration: LensCalibration, camera: Camera) -> None:
    """Raise ValueError unless a stored calibration is one of a camera."""
    n = len(calibration.estimated)
    if calibration.sigma.shape != (n,) or calibration.correlation.shape != (n, n):
        raise ValueError("the sizes of sigma and correlation are not those of the lens")
    unknown = set(calibration.estimated) - set(MODELS[camera.model])
    if unknown or len(set(calibration.estimated)) != n:
        raise ValueError("sigma is stated for parameters that the lens does not have")
    values = np.concatenate([calibration.sigma, calibration.correlation.ravel()])
    if not np.isfinite(values).all() or np.any(calibration.sigma < 0):
        raise ValueError("sigma or correlation is not finite")
    if np.any(np.abs(calibration.correlation) > 1 + 1e-6):
        raise ValueError("a correlation is larger than 1")


def reprojection_errors(
    labels: Labels, seen: LabelObservations, points: MapPoints, camera: Camera, rows: np.ndarray
) -> ReprojectionErrors | None:
    """Return the reprojection errors of frames of one lens; None if they observe no point.

    Parameters
    ----------
    labels : Labels
    seen : LabelObservations
    points : MapPoints
    camera : Camera
        The lens.
    rows : ndarray of int
        Its registered frames.

    Returns
    -------
    ReprojectionErrors or None
    """
    chosen = seen.select(rows)
    if not len(chosen.frame_idx):
        return None
    poses: Poses = labels.poses[rows]
    residuals = np.empty((len(chosen.frame_idx), 2))
    ends = np.searchsorted(chosen.frame_idx, np.arange(len(rows) + 1))
    index = points.rows_of(chosen.point_ids)
    for k in range(len(rows)):
        mine = slice(ends[k], ends[k + 1])
        projected = camera.project(poses.to_camera(points.xyz[index[mine]], k))
        residuals[mine] = projected - chosen.pixels[mine]
    known = np.isfinite(residuals).all(axis=1)
    if not known.any():
        return None
    residuals, pixels = residuals[known], chosen.pixels[known]
    return ReprojectionErrors(
        np.linalg.norm(residuals, axis=1), _mean_by_cell(residuals, pixels, camera)
    )


def _mean_by_cell(residuals: np.ndarray, pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the mean residual (R, C, 2) in square cells of the image."""
    side = camera.width / _CELLS_ACROSS
    columns, rows = _CELLS_ACROSS, max(1, round(camera.height / side))
    x = np.clip(pixels[:, 0] * columns / camera.width, 0, columns - 1).astype(np.int64)
    y = np.clip(pixels[:, 1] * rows / camera.height, 0, rows - 1).astype(np.int64)
    cell = y * columns + x
    count = np.bincount(cell, minlength=rows * columns)
    sums = [np.bincount(cell, residuals[:, k], minlength=rows * columns) for k in range(2)]
    mean = np.stack(sums, axis=1) / np.maximum(count, 1)[:, None]
    mean[count < _LEAST_IN_CELL] = np.nan
    return mean.reshape(rows, columns, 2)


def position_covariances(parts: list[Labels]) -> PositionCovariances:
    """Return the covariances of the positions of chosen frames that have one."""
    chosen = []
    for labels in parts:
        stated = np.isfinite(labels.covariance[:, :3, :3]).all(axis=(1, 2))
        chosen.append(labels.select(labels.registered & ~labels.tracked & stated))
    labels = Labels.concatenate(chosen)
    return PositionCovariances(
        labels.names, labels.sequences, labels.poses.centers, labels.covariance[:, :3, :3]
    )
