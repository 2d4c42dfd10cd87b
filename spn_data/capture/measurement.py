"""Sharpness of each image of a sequence and its motion relative to the image before."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np

MEASURE_WIDTH = 640  # image width in pixels at which sharpness is measured
_TRACK_WIDTH = 320
_MAX_CORNERS = 150
_MIN_TRACKS = 12
_REDETECT_BELOW = 90
LOST_AFTER = 5  # consecutive images that could not be tracked from the last tracked one


@dataclass(frozen=True, eq=False)
class Measurements:
    """N images of one sequence in order of time, as measured in one cheap pass.

    Attributes
    ----------
    source_idx : ndarray of int, shape (N,)
        Which of the sequence's files the image is from.
    index : ndarray of int, shape (N,)
        Index among that file's frames.
    time_s : ndarray, shape (N,)
        Seconds on the sequence's clock.
    width, height : ndarray of int, shape (N,)
        Full size in pixels; 0 if unreadable.
    sharpness : ndarray, shape (N,)
        Grey levels, see `image_sharpness`; NaN if unreadable.
    motion : ndarray, shape (N, 2, 3)
        Affine map of image positions from the image before, in fractions of the image width, with the
        origin at the centre; NaN if the two could not be linked (cut, other camera, darkness).
    damaged : ndarray of bool, shape (N,)
        Packets were lost since the last key frame.
    problem : ndarray of str, shape (N,)
        Why an image is unreadable, or "".
    """

    source_idx: np.ndarray
    index: np.ndarray
    time_s: np.ndarray
    width: np.ndarray
    height: np.ndarray
    sharpness: np.ndarray
    motion: np.ndarray
    damaged: np.ndarray
    problem: np.ndarray

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def readable(self) -> np.ndarray:
        """Images that could be decoded, (N,) bool."""
        return self.problem == ""

    def select(self, index: np.ndarray) -> Measurements:
        """Return the rows selected by an index or mask (N,)."""
        return replace(self, **{f.name: getattr(self, f.name)[index] for f in fields(self)})


@dataclass(frozen=True, eq=False)
class GrayImage:
    """One image to measure.

    `gray` is uint8 and at most MEASURE_WIDTH wide; None if unreadable, with the reason in `problem`.
    """

    source_idx: int
    index: int
    time_s: float
    width: int
    height: int
    gray: np.ndarray | None
    damaged: bool = False
    problem: str = ""


def measure(
    images: Iterable[GrayImage],
    *,
    lost_after: int = LOST_AFTER,
    progress: Callable[[int], None] | None = None,
) -> Measurements:
    """Measure sharpness and motion of a sequence's images.

    Parameters
    ----------
    images : iterable of GrayImage
        In order of time.
    lost_after : int
        Number of consecutive untracked images at which motion becomes unknown. Shorter runs count as
        blurred images at the position of the image before: right for video, in which blur is brief; use 1
        for photos.
    progress : callable, optional
        Called with the number of images done.

    Returns
    -------
    Measurements
        One row per image.
    """
    rows: list[GrayImage] = []
    sharpness: list[float] = []
    motions: list[np.ndarray] = []
    tracker = _Tracker(lost_after)
    for image in images:
        readable = image.gray is not None
        sharpness.append(image_sharpness(image.gray) if image.gray is not None else np.nan)
        motions.append(tracker.follow(image.gray) if image.gray is not None else _IDENTITY)
        rows.append(replace(image, gray=None, problem=image.problem if not readable else ""))
        if progress is not None:
            progress(len(rows))
    return Measurements(
        source_idx=np.array([r.source_idx for r in rows], dtype=np.int64),
        index=np.array([r.index for r in rows], dtype=np.int64),
        time_s=np.array([r.time_s for r in rows], dtype=np.float64),
        width=np.array([r.width for r in rows], dtype=np.int64),
        height=np.array([r.height for r in rows], dtype=np.int64),
        sharpness=np.array(sharpness, dtype=np.float64),
        motion=np.array(motions, dtype=np.float64).reshape(-1, 2, 3),
        damaged=np.array([r.damaged for r in rows], dtype=bool),
        problem=np.array([r.problem for r in rows], dtype=np.str_),
    )


def image_sharpness(gray: np.ndarray) -> float:
    """Return the RMS second difference of a grey image (h, w) uint8, in grey levels.

    It is the geometric mean of both directions, so that motion blur along one of them shows, and is smoothed
    across each, which reduces the influence of noise.
    """
    horizontal = cv2.Sobel(gray, cv2.CV_16S, 2, 0, ksize=3)
    vertical = cv2.Sobel(gray, cv2.CV_16S, 0, 2, ksize=3)
    energy = cv2.norm(horizontal, cv2.NORM_L2) * cv2.norm(vertical, cv2.NORM_L2)
    return float(np.sqrt(energy / gray.size) / 4)  # the kernels' smoothing weights sum to 4


_IDENTITY = np.eye(2, 3)
_UNKNOWN = np.full((2, 3), np.nan)


class _Tracker:
    """Optical-flow tracker: follows corners from image to image and fits an affine map to each step."""

    def __init__(self, lost_after: int) -> None:
        self._lost_after = lost_after
        self._previous: np.ndarray | None = None
        self._points = np.empty((0, 1, 2), np.float32)
        self._missed = 0

    def follow(self, gray: np.ndarray) -> np.ndarray:
        """Return the affine map (2, 3) from the last tracked image; identity if untracked, NaN at a break.

        A blurred image is skipped and the next one is tracked from the image before it, so that the product
        of all maps stays right.
        """
        scale = _TRACK_WIDTH / gray.shape[1]
        size = (_TRACK_WIDTH, max(16, round(gray.shape[0] * scale)))
        small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
        if self._previous is None or self._previous.shape != small.shape:
            broken = self._previous is not None
            self._restart(small)
            return _UNKNOWN if broken else _IDENTITY
        if len(self._points) < _REDETECT_BELOW:
            self._points = _corners(self._previous)
        step, points = _affine_step(self._previous, small, self._points)
        if step is None:
            self._missed += 1
            if self._missed < self._lost_after:
                return _IDENTITY
            self._restart(small)
            return _UNKNOWN
        self._previous, self._points, self._missed = small, points, 0
        return step

    def _restart(self, small: np.ndarray) -> None:
        self._previous, self._points, self._missed = small, _corners(small), 0


def _corners(gray: np.ndarray) -> np.ndarray:
    """Detect corners (K, 1, 2) float32 spread over the image."""
    found = cv2.goodFeaturesToTrack(gray, _MAX_CORNERS, 0.01, 8)
    return np.empty((0, 1, 2), np.float32) if found is None else found


def _affine_step(
    before: np.ndarray, after: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray | None, np.ndarray]:
    """Fit the affine map of one step, in fractions of the width about the centre; also return its points.

    The map is None if fewer than _MIN_TRACKS corners pass the forward-backward check.
    """
    if len(points) < _MIN_TRACKS:
        return None, points
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, points, None, **_LK)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(after, before, moved, None, **_LK)
    good = (found[:, 0] == 1) & (found_back[:, 0] == 1)
    good &= np.linalg.norm((back - points)[:, 0], axis=1) < 0.5
    inside = (moved[:, 0] >= 0) & (moved[:, 0] < np.array(after.shape[::-1]))
    good &= inside.all(axis=1)
    if good.sum() < _MIN_TRACKS:
        return None, points
    height, width = before.shape
    center = np.array([(width - 1) / 2, (height - 1) / 2])
    start = (points[good, 0] - center) / width
    end = (moved[good, 0] - center) / width
    return _fit_affine(start, end), moved[good]


_LK = {
    "winSize": (11, 11),
    "maxLevel": 3,
    "criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.05),
}


def _fit_affine(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Fit an affine map (2, 3) from points (K, 2) to (K, 2) by least squares, reweighted thrice (Cauchy)."""
    design = np.column_stack([start, np.ones(len(start))])
    weights = np.ones(len(start))
    for _ in range(3):
        root = np.sqrt(weights)[:, None]
        solution = np.linalg.lstsq(design * root, end * root, rcond=None)[0]
        residual = np.linalg.norm(end - design @ solution, axis=1)
        scale = max(float(np.median(residual)), 1e-4)
        weights = 1 / (1 + (residual / scale) ** 2)
    return solution.T


def relative_sharpness(measured: Measurements, neighbours_s: float) -> np.ndarray:
    """Return sharpness (N,) relative to the median of the frames within `neighbours_s`; NaN if unreadable."""
    result = np.full(len(measured), np.nan)
    rows = np.flatnonzero(measured.readable)
    times, sharpness = measured.time_s[rows], measured.sharpness[rows]
    first = np.searchsorted(times, times - neighbours_s - 1e-9)
    last = np.searchsorted(times, times + neighbours_s + 1e-9)
    for k, row in enumerate(rows):
        middle = float(np.median(sharpness[first[k] : last[k]]))
        result[row] = sharpness[k] / middle if middle > 0 else 1.0
    return result


# Image positions at which motion is measured, in fractions of the width about the centre.
_GRID = np.array([[x, y, 1.0] for y in (-0.2, 0.0, 0.2) for x in (-0.4, -0.2, 0.0, 0.2, 0.4)])


def homogeneous(affine: np.ndarray) -> np.ndarray:
    """Extend an affine map (2, 3) to a homogeneous matrix (3, 3)."""
    return np.vstack([affine, [0.0, 0.0, 1.0]])


def displacement(total: np.ndarray) -> float:
    """Return how far a homogeneous affine map moves the image, in fractions of its width; inf if unknown."""
    moved = _GRID @ total[:2].T - _GRID[:, :2]
    distance = float(np.median(np.linalg.norm(moved, axis=1)))
    return distance if np.isfinite(distance) else float("inf")
