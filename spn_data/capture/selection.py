"""The choice of frames: sharp beside their neighbours, and far enough apart to see parallax."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spn_data.capture.frames import FrameStatus
from spn_data.capture.measurement import Measurements
from spn_data.errors import InputError

_UNKNOWN_HEIGHT_M = 100.0
# Positions in the image at which motion is measured, in shares of its width about the centre.
_GRID = np.array([[x, y, 1.0] for y in (-0.2, 0.0, 0.2) for x in (-0.4, -0.2, 0.0, 0.2, 0.4)])


@dataclass(frozen=True, kw_only=True)
class SelectionOptions:
    """How frames are chosen."""

    motion_share: float = 0.10  # motion of the image between chosen frames, as a share of its width
    window: float = (
        0.35  # the sharpest is taken within this part of motion_share before and after it
    )
    min_spacing_s: float = 0.3  # chosen frames are never closer in time
    max_spacing_s: float = 4.0  # nor further apart, though the image stands still
    max_distance_m: float = 3.0  # nor further apart by the telemetry, where it is known ...
    max_distance_share: float = (
        0.1  # ... or this share of the height above take-off, if that is more
    )
    blur_ratio: float = (
        0.75  # a frame is blurred below this share of its neighbours' median sharpness
    )
    neighbours_s: float = 1.0  # frames this near in time are its neighbours
    min_sharpness: float = 1.0  # grey levels; a source whose best frames stay below it is unusable
    still_share: float = 0.005  # photos that moved less, at one place, are the same photo twice
    still_m: float = 0.5  # and lie nearer than this by their telemetry
    target_count: int | None = None  # of all sources; scales motion_share and max_spacing_s
    min_count: int = (
        30  # of a video, where no target is given: below it frames are chosen more densely
    )


@dataclass(frozen=True, eq=False)
class FrameChoice:
    """What became of N measured frames.

    status : (N,) str, a FrameStatus; reason : (N,) str; motion_px : (N,) motion of the image since the frame
    chosen before, in full-size pixels, NaN before the first and where it is not known.
    """

    status: np.ndarray
    reason: np.ndarray
    motion_px: np.ndarray

    @property
    def chosen(self) -> np.ndarray:
        """(N,) bool."""
        return self.status == FrameStatus.CHOSEN


def relative_sharpness(measured: Measurements, neighbours_s: float) -> np.ndarray:
    """(N,) sharpness over the median of the frames within `neighbours_s`; NaN where unreadable."""
    result = np.full(len(measured), np.nan)
    rows = np.flatnonzero(measured.readable)
    times, sharpness = measured.time_s[rows], measured.sharpness[rows]
    first = np.searchsorted(times, times - neighbours_s - 1e-9)
    last = np.searchsorted(times, times + neighbours_s + 1e-9)
    for k, row in enumerate(rows):
        middle = float(np.median(sharpness[first[k] : last[k]]))
        result[row] = sharpness[k] / middle if middle > 0 else 1.0
    return result


def check_usable(measured: Measurements, options: SelectionOptions, name: str) -> None:
    """InputError where nothing of a source can be used: nothing readable, or the sharpest tenth near zero."""
    sharpness = measured.sharpness[measured.readable]
    if len(sharpness) == 0:
        why = measured.problem[0] if len(measured) else "it holds none"
        raise InputError(f"not one image can be read: {why}", path=name)
    best = float(np.quantile(sharpness, 0.9))
    if best < options.min_sharpness:
        raise InputError(
            f"every frame is blurred, dark or empty: sharpness {best:.1f} grey levels in the best tenth of "
            f"{len(sharpness)}, needed {options.min_sharpness:g}; check lens, focus and exposure",
            path=name,
        )


def choose(
    measured: Measurements, options: SelectionOptions, *, position_m: np.ndarray | None = None
) -> FrameChoice:
    """Which frames of a video are used, and why.

    position_m : (N, 3) by the telemetry: east, north and height above take-off; NaN where unknown. An
    unknown height is taken as 100 m, so that distance adds few frames.

    From each chosen frame, the next is the sharpest whose motion is near `motion_share`. Where the image
    stands still it is the sharpest before `max_spacing_s`. A passage without a sharp frame still gives its
    best one.
    """
    n = len(measured)
    status = np.full(n, str(FrameStatus.SKIPPED), dtype="U10")
    reason = np.full(n, "", dtype=object)
    motion_px = np.full(n, np.nan)
    unreadable = ~measured.readable
    status[unreadable] = FrameStatus.UNREADABLE
    reason[unreadable] = measured.problem[unreadable]
    passage = _Passage.of(measured, options, position_m)
    rows, done, last = passage.rows, 0, None
    while done < len(rows):
        ahead = passage.ahead(last)
        window, widened = passage.windows(ahead)
        if len(window) == 0:
            pick, end = None, len(rows)
        else:
            pick, why = passage.best(window, widened)
            end = pick
        for k in range(done, end):
            reason[rows[k]] = passage.why_skipped(k, ahead)
            motion_px[rows[k]] = passage.pixels(k, ahead)
        if pick is not None:
            status[rows[pick]] = FrameStatus.CHOSEN
            reason[rows[pick]] = why
            motion_px[rows[pick]] = passage.pixels(pick, ahead)
        last, done = pick, end + 1
    return FrameChoice(status, reason.astype(np.str_), motion_px)


def choose_all(
    sources: list[tuple[Measurements, np.ndarray | None]], options: SelectionOptions
) -> list[FrameChoice]:
    """`choose` for several videos (measurements, positions), near `target_count` frames in all where given.

    Without a target, a video that gives fewer than `min_count` frames is chosen from more densely: a short
    clip, or one far from what it shows, would else fall apart.
    """
    if options.target_count is not None:
        return _choose_near(sources, options, options.target_count)
    choices = [choose(m, options, position_m=p) for m, p in sources]
    return [
        choice
        if choice.chosen.sum() >= options.min_count
        else _choose_near([source], options, options.min_count)[0]
        for source, choice in zip(sources, choices, strict=True)
    ]


def _choose_near(
    sources: list[tuple[Measurements, np.ndarray | None]], options: SelectionOptions, target: int
) -> list[FrameChoice]:
    """Near `target` frames in all: motion and the longest spacing are scaled together.

    The shortest spacing holds, so that a target may stay out of reach.
    """

    def scaled(factor: float) -> list[FrameChoice]:
        these = replace(
            options,
            motion_share=options.motion_share * factor,
            max_spacing_s=max(options.max_spacing_s * factor, options.min_spacing_s),
            max_distance_m=options.max_distance_m * factor,
            max_distance_share=options.max_distance_share * factor,
        )
        return [choose(m, these, position_m=p) for m, p in sources]

    low, high = 1 / 64, 64.0
    best: tuple[int, list[FrameChoice]] | None = None
    for _ in range(16):
        middle = float(np.sqrt(low * high))
        choices = scaled(middle)
        count = sum(int(c.chosen.sum()) for c in choices)
        error = abs(count - target)
        if best is None or error < best[0]:
            best = (error, choices)
        if error == 0:
            break
        low, high = (middle, high) if count > target else (low, middle)
    assert best is not None
    return best[1]


def choose_photos(
    measured: Measurements, options: SelectionOptions, *, position_m: np.ndarray | None = None
) -> FrameChoice:
    """All readable photos but those that repeat the one chosen before: same place, image unmoved.

    position_m : (N, 3) as for `choose`.
    """
    n = len(measured)
    status = np.full(n, str(FrameStatus.CHOSEN), dtype="U10")
    reason = np.full(n, "chosen: photo", dtype=object)
    motion_px = np.full(n, np.nan)
    last: int | None = None
    total = np.eye(3)
    for row in range(n):
        total = _homogeneous(measured.motion[row]) @ total
        if not measured.readable[row]:
            status[row], reason[row] = FrameStatus.UNREADABLE, measured.problem[row]
            continue
        if last is not None:
            share = _displacement(total)
            motion_px[row] = share * measured.width[row] if np.isfinite(share) else np.nan
            apart = np.nan
            if position_m is not None:
                apart = float(np.linalg.norm(position_m[row, :2] - position_m[last, :2]))
            if share < options.still_share and not apart > options.still_m:
                status[row] = FrameStatus.SKIPPED
                reason[row] = f"skipped: the photo before, {motion_px[row]:.1f} px apart"
                continue
        last, total = row, np.eye(3)
    return FrameChoice(status, reason.astype(np.str_), motion_px)


@dataclass(frozen=True, eq=False)
class _Ahead:
    """The frames after the one chosen last, as far as the next must be chosen.

    first : position of the first of them; elapsed_s, motion (shares of the width, inf beyond a break of the
    image), distance (NaN unknown, 1 at the greatest that is allowed) : (K,) since the frame chosen last.
    """

    first: int
    elapsed_s: np.ndarray
    motion: np.ndarray
    distance: np.ndarray
    at_start: bool


@dataclass(frozen=True, eq=False)
class _Passage:
    """The M readable frames of a video; rows : (M,) where they stand among all."""

    rows: np.ndarray
    time_s: np.ndarray
    width: np.ndarray
    steps: np.ndarray  # (M, 3, 3) motion from the frame before
    relative: np.ndarray  # (M,) sharpness beside the neighbours
    score: np.ndarray  # (M,) the same, with damaged frames below all others
    damaged: np.ndarray
    position_m: np.ndarray | None
    options: SelectionOptions

    @classmethod
    def of(
        cls, measured: Measurements, options: SelectionOptions, position_m: np.ndarray | None
    ) -> _Passage:
        # The step of an unreadable frame is the identity: leaving its row out loses no motion.
        rows = np.flatnonzero(measured.readable)
        relative = relative_sharpness(measured, options.neighbours_s)[rows]
        damaged = measured.damaged[rows]
        return cls(
            rows,
            measured.time_s[rows],
            measured.width[rows],
            np.array([_homogeneous(a) for a in measured.motion[rows]]).reshape(-1, 3, 3),
            relative,
            np.where(damaged, 0.1 * relative, relative),
            damaged,
            None if position_m is None else position_m[rows],
            options,
        )

    def ahead(self, last: int | None) -> _Ahead:
        """What lies after frame `last`, up to the longest spacing (a frame at least); None for the start."""
        first = 0 if last is None else last + 1
        origin = 0 if last is None else last
        limit = self.time_s[origin] + self.options.max_spacing_s
        stop = int(np.searchsorted(self.time_s, limit + 1e-9, side="right"))
        stop = min(max(stop, first + 1), len(self.rows))
        motion = np.zeros(stop - first)
        total = np.eye(3)
        for i, k in enumerate(range(first, stop)):
            if k > 0:
                total = self.steps[k] @ total
            motion[i] = _displacement(total)
        distance = np.full(stop - first, np.nan)
        if self.position_m is not None:
            apart = self.position_m[first:stop] - self.position_m[origin]
            height = np.nan_to_num(self.position_m[first:stop, 2], nan=_UNKNOWN_HEIGHT_M)
            limit_m = np.maximum(
                self.options.max_distance_m, self.options.max_distance_share * height
            )
            distance = np.linalg.norm(apart[:, :2], axis=1) / limit_m
        elapsed = self.time_s[first:stop] - self.time_s[origin]
        return _Ahead(first, elapsed, motion, distance, last is None)

    def windows(self, ahead: _Ahead) -> tuple[np.ndarray, np.ndarray]:
        """Positions of the frames from which the next is taken, and of a wider window should they be blurred.

        Empty where the video ends before another frame is due.
        """
        near = self._between(ahead, 1 - self.options.window, 1 + self.options.window)
        if len(near) == 0:
            return near, near
        return near, np.union1d(near, self._between(ahead, 0.4, 2.5))

    def _between(self, ahead: _Ahead, low: float, high: float) -> np.ndarray:
        options = self.options
        if ahead.at_start:
            late = (ahead.motion > 0.5 * options.motion_share * high) | (
                ahead.elapsed_s > min(1.0, options.max_spacing_s)
            )
            stop = int(np.argmax(late)) if late.any() else len(late)
            return ahead.first + np.arange(max(stop, 1))
        farthest_s = options.max_spacing_s
        due = (
            (ahead.motion >= low * options.motion_share)
            | (ahead.distance >= min(low, 1))
            | (ahead.elapsed_s >= min(low, 1) * farthest_s)
        ) & (ahead.elapsed_s >= options.min_spacing_s - 1e-9)
        if not due.any():
            return np.array([], dtype=np.int64)
        start = int(np.argmax(due))
        # Where the image moves too fast for the shortest spacing, a few frames still compete.
        grace_s = ahead.elapsed_s[start] + 0.5 * options.min_spacing_s
        over = (ahead.motion > high * options.motion_share) | (ahead.distance > high)
        over &= ahead.elapsed_s > grace_s
        over[: start + 1] = False
        stop = int(np.argmax(over)) if over.any() else len(over)
        return ahead.first + np.arange(start, stop)

    def best(self, window: np.ndarray, widened: np.ndarray) -> tuple[int, str]:
        """The frame taken from a window, and the reason in words."""
        pick = int(window[np.argmax(self.score[window])])
        if self._good(pick):
            return pick, f"chosen: sharpest of {len(window)} in its window"
        pick = int(widened[np.argmax(self.score[widened])])
        if self._good(pick):
            return (
                pick,
                f"chosen: sharpest of {len(widened)}, all nearer the wanted place are blurred",
            )
        if self.damaged[pick]:
            return (
                pick,
                f"chosen: damaged by lost packets, as are all {len(widened)} in its passage",
            )
        return pick, (
            f"chosen: blurred ({self.relative[pick]:.2f} of its neighbours' sharpness), but the best of "
            f"{len(widened)} in its passage"
        )

    def _good(self, k: int) -> bool:
        return bool(self.score[k] >= self.options.blur_ratio)

    def pixels(self, k: int, ahead: _Ahead) -> float:
        """Motion since the frame chosen last, full-size pixels; NaN where unknown."""
        i = k - ahead.first
        if ahead.at_start or i >= len(ahead.motion) or not np.isfinite(ahead.motion[i]):
            return float("nan")
        return round(float(ahead.motion[i] * self.width[k]), 1)

    def why_skipped(self, k: int, ahead: _Ahead) -> str:
        """The reason in words."""
        if self.damaged[k]:
            return "skipped: damaged by lost packets"
        if self.relative[k] < self.options.blur_ratio:
            return f"skipped: blurred, {self.relative[k]:.2f} of its neighbours' sharpness"
        moved = self.pixels(k, ahead)
        share = moved / self.width[k]
        if share < (1 - self.options.window) * self.options.motion_share:
            return f"skipped: {moved:.0f} px from the frame chosen before"
        return "skipped: the frame chosen after it is sharper"


def _homogeneous(affine: np.ndarray) -> np.ndarray:
    return np.vstack([affine, [0.0, 0.0, 1.0]])


def _displacement(total: np.ndarray) -> float:
    """How far an affine map (3, 3) moves the image, in shares of its width; inf where it is not known."""
    moved = _GRID @ total[:2].T - _GRID[:, :2]
    distance = float(np.median(np.linalg.norm(moved, axis=1)))
    return distance if np.isfinite(distance) else float("inf")
