"""How sharp each image of a sequence is, and how far the image moved since the one before."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np

MEASURE_WIDTH = 640  # columns on which sharpness is measured
_TRACK_WIDTH = 320
_MAX_CORNERS = 150
_MIN_TRACKS = 12
_REDETECT_BELOW = 90
LOST_AFTER = 5  # images in a row that could not be tracked from the last one that could


@dataclass(frozen=True, eq=False)
class Measurements:
    """N images of one sequence in the order of time, as measured in one cheap pass.

    source_idx : (N,) which of the sequence's files; index : (N,) among that file's frames.
    time_s : (N,) on the sequence's clock. width, height : (N,) full size, pixels; 0 where unreadable.
    sharpness : (N,) grey levels, see `sharpness_of`; NaN where unreadable.
    motion : (N, 2, 3) affine map of image positions from the image before, in shares of the image's width,
    zero at its centre; NaN where the two could not be tied (cut, other camera, darkness).
    damaged : (N,) bool. problem : (N,) str, why an image is unreadable, else empty.
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
        """(N,) bool."""
        return self.problem == ""

    def select(self, index: np.ndarray) -> Measurements:
        """The rows of an index or mask (N,)."""
        return replace(self, **{f.name: getattr(self, f.name)[index] for f in fields(self)})


@dataclass(frozen=True, eq=False)
class GrayImage:
    """One image to measure; `gray` is uint8, at most MEASURE_WIDTH wide, None where `problem` says why."""

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
    """Sharpness and motion of a sequence's images; `progress` hears how many are done.

    lost_after : images in a row that could not be tracked, at which motion is unknown. Below that they are
    taken to be blurred and to stand where the one before stood: right for video, where one lasts a moment;
    for photos it is 1.
    """
    rows: list[GrayImage] = []
    sharpness: list[float] = []
    motions: list[np.ndarray] = []
    tracker = _Tracker(lost_after)
    for image in images:
        known = image.gray is not None
        sharpness.append(sharpness_of(image.gray) if image.gray is not None else np.nan)
        motions.append(tracker.follow(image.gray) if image.gray is not None else _IDENTITY)
        rows.append(replace(image, gray=None, problem=image.problem if not known else ""))
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


def sharpness_of(gray: np.ndarray) -> float:
    """RMS second difference of a grey image (h, w) uint8, in grey levels.

    The geometric mean of both directions, so that motion blur along one shows; smoothed across each, so that
    noise counts less.
    """
    horizontal = cv2.Sobel(gray, cv2.CV_16S, 2, 0, ksize=3)
    vertical = cv2.Sobel(gray, cv2.CV_16S, 0, 2, ksize=3)
    energy = cv2.norm(horizontal, cv2.NORM_L2) * cv2.norm(vertical, cv2.NORM_L2)
    return float(np.sqrt(energy / gray.size) / 4)  # the kernels' smoothing weights add up to 4


_IDENTITY = np.eye(2, 3)
_UNKNOWN = np.full((2, 3), np.nan)


class _Tracker:
    """Follows corners from image to image and fits an affine map to each step."""

    def __init__(self, lost_after: int) -> None:
        self._lost_after = lost_after
        self._previous: np.ndarray | None = None
        self._points = np.empty((0, 1, 2), np.float32)
        self._missed = 0

    def follow(self, gray: np.ndarray) -> np.ndarray:
        """(2, 3) affine from the last image that could be followed; identity where it can't, NaN: a break.

        A blurred image is passed over: the next is followed from the one before it, so that the product
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
    """(K, 1, 2) float32 corners spread over the image."""
    found = cv2.goodFeaturesToTrack(gray, _MAX_CORNERS, 0.01, 8)
    return np.empty((0, 1, 2), np.float32) if found is None else found


def _affine_step(
    before: np.ndarray, after: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray | None, np.ndarray]:
    """The affine map of one step, in shares of the width about the centre, and the points that followed it.

    None where fewer than _MIN_TRACKS corners are found again, forward and back.
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
    """(2, 3) affine map of (K, 2) to (K, 2) by least squares, three rounds of Cauchy weights."""
    design = np.column_stack([start, np.ones(len(start))])
    weights = np.ones(len(start))
    for _ in range(3):
        root = np.sqrt(weights)[:, None]
        solution = np.linalg.lstsq(design * root, end * root, rcond=None)[0]
        residual = np.linalg.norm(end - design @ solution, axis=1)
        scale = max(float(np.median(residual)), 1e-4)
        weights = 1 / (1 + (residual / scale) ** 2)
    return solution.T
