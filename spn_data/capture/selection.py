"""Selection of frames: sharper than their neighbours and far enough apart for parallax."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spn_data.capture.frames import FrameStatus
from spn_data.capture.measurement import (
    Measurements,
    displacement,
    homogeneous,
    relative_sharpness,
)
from spn_data.errors import InputError

_UNKNOWN_HEIGHT_M = 100.0


@dataclass(frozen=True, kw_only=True)
class SelectionOptions:
    """Options of the frame selection.

    Attributes
    ----------
    motion_share : float
        Image motion between chosen frames, as a fraction of the image width.
    window : float
        The sharpest frame is taken within this fraction of `motion_share` before and after it.
    min_spacing_s : float
        Chosen frames are never closer in time.
    max_spacing_s : float
        Chosen frames are never further apart in time, even if the image does not move.
    max_distance_m, max_distance_share : float
        If the telemetry states positions, chosen frames are never further apart than `max_distance_m` or
        this fraction of the height above take-off, whichever is larger.
    blur_ratio : float
        A frame is blurred below this fraction of its neighbours' median sharpness.
    neighbours_s : float
        Frames this close in time are neighbours.
    min_sharpness : float
        Grey levels; a source whose best frames stay below it is unusable.
    still_share, still_m : float
        A photo repeats the one before if the image moved less than `still_share` of its width and, by
        telemetry, the camera moved no more than `still_m`.
    target_count : int, optional
        Frames wanted from all sources; scales `motion_share`, `max_spacing_s` and the distances.
    min_count : int
        If a video gives fewer frames than this and there is no target, frames are chosen more densely.
    """

    motion_share: float = 0.10
    window: float = 0.35
    min_spacing_s: float = 0.3
    max_spacing_s: float = 4.0
    max_distance_m: float = 3.0
    max_distance_share: float = 0.1
    blur_ratio: float = 0.75
    neighbours_s: float = 1.0
    min_sharpness: float = 1.0
    still_share: float = 0.005
    still_m: float = 0.5
    target_count: int | None = None
    min_count: int = 30


@dataclass(frozen=True, eq=False)
class FrameChoice:
    """Outcome of the selection for N measured frames.

    Attributes
    ----------
    status : ndarray of str, shape (N,)
        A `FrameStatus`.
    reason : ndarray of str, shape (N,)
        Why, for the user.
    motion_px : ndarray, shape (N,)
        Image motion since the previously chosen frame in full-size pixels; NaN before the first chosen
        frame and if unknown.
    """

    status: np.ndarray
    reason: np.ndarray
    motion_px: np.ndarray

    @property
    def chosen(self) -> np.ndarray:
        """Frames selected for mapping, (N,) bool."""
        return self.status == FrameStatus.CHOSEN


def check_usable(measured: Measurements, options: SelectionOptions, name: str) -> None:
    """Check that a source has usable images.

    Parameters
    ----------
    measured : Measurements
        The images of the source.
    options : SelectionOptions
        Supplies `min_sharpness`.
    name : str
        Names the source in messages.

    Raises
    ------
    InputError
        If no image is readable, or the 90 % quantile of sharpness is below `min_sharpness`.
    """
    sharpness = measured.sharpness[measured.readable]
    if len(sharpness) == 0:
        why = measured.problem[0] if len(measured) else "it contains none"
        raise InputError(f"no image can be read: {why}", path=name)
    best = float(np.quantile(sharpness, 0.9))
    if best < options.min_sharpness:
        raise InputError(
            f"every frame is blurred, dark or empty: the sharpest tenth of {len(sharpness)} reaches "
            f"{best:.1f} grey levels, {options.min_sharpness:g} are needed; check lens, focus and exposure",
            path=name,
        )


def choose(
    measured: Measurements, options: SelectionOptions, *, position_m: np.ndarray | None = None
) -> FrameChoice:
    """Choose frames of a video.

    From each chosen frame, the next one is the sharpest whose motion is near `motion_share`. If the image
    does not move, it is the sharpest before `max_spacing_s`. A stretch without a sharp frame still gives its
    best one.

    position_m : (N, 3) east, north and height above take-off from telemetry; NaN if unknown. An unknown
    height is taken as 100 m, so that distance adds few frames.
    """
    n = len(measured)
    status = np.full(n, str(FrameStatus.SKIPPED), dtype="U10")
    reason = np.full(n, "", dtype=object)
    motion_px = np.full(n, np.nan)
    unreadable = ~measured.readable
    status[unreadable] = FrameStatus.UNREADABLE
    reason[unreadable] = measured.problem[unreadable]
    frames = _VideoFrames.from_measurements(measured, options, position_m)
    rows, done, last = frames.rows, 0, None
    while done < len(rows):
        ahead = frames.look_ahead(last)
        window, widened = frames.windows(ahead)
        if len(window) == 0:
            pick, end = None, len(rows)
        else:
            pick, why = frames.pick_best(window, widened)
            end = pick
        for k in range(done, end):
            reason[rows[k]] = frames.why_skipped(k, ahead)
            motion_px[rows[k]] = frames.motion_px(k, ahead)
        if pick is not None:
            status[rows[pick]] = FrameStatus.CHOSEN
            reason[rows[pick]] = why
            motion_px[rows[pick]] = frames.motion_px(pick, ahead)
        last, done = pick, end + 1
    return FrameChoice(status, reason.astype(np.str_), motion_px)


def choose_all(
    sources: list[tuple[Measurements, np.ndarray | None]], options: SelectionOptions
) -> list[FrameChoice]:
    """Choose frames of several videos.

    Parameters
    ----------
    sources : list of (Measurements, ndarray or None)
        Measurements of each video, and its positions (N, 3) as in `choose`.
    options : SelectionOptions
        With a `target_count`, about that many frames are chosen in all. Without one, a video with fewer than
        `min_count` frames is sampled more densely: the frames of a short clip, or of one far from its
        subject, might otherwise not connect.

    Returns
    -------
    list of FrameChoice
        One per video.
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
    """Choose about `target` frames in all by scaling motion, longest spacing and distance together.

    The shortest spacing still holds, so the target may be out of reach.
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


@dataclass(frozen=True, eq=False)
class _Lookahead:
    """The K frames after the last chosen one, up to the longest spacing.

    first : index of the first of them. elapsed_s, motion (fractions of the width, inf beyond a break) and
    distance (1 at the greatest allowed, NaN if unknown) : (K,) since the last chosen frame.
    """

    first: int
    elapsed_s: np.ndarray
    motion: np.ndarray
    distance: np.ndarray
    at_start: bool


@dataclass(frozen=True, eq=False)
class _VideoFrames:
    """The M readable frames of a video; rows : (M,) their indices among all frames."""

    rows: np.ndarray
    time_s: np.ndarray
    width: np.ndarray
    steps: np.ndarray  # (M, 3, 3) homogeneous motion from the frame before
    relative: np.ndarray  # (M,) sharpness relative to the neighbours
    score: np.ndarray  # (M,) the same, lowered for damaged frames
    damaged: np.ndarray
    position_m: np.ndarray | None
    options: SelectionOptions

    @classmethod
    def from_measurements(
        cls, measured: Measurements, options: SelectionOptions, position_m: np.ndarray | None
    ) -> _VideoFrames:
        """Select the readable frames."""
        # Unreadable frames have identity motion, so dropping their rows loses none.
        rows = np.flatnonzero(measured.readable)
        relative = relative_sharpness(measured, options.neighbours_s)[rows]
        damaged = measured.damaged[rows]
        return cls(
            rows,
            measured.time_s[rows],
            measured.width[rows],
            np.array([homogeneous(a) for a in measured.motion[rows]]).reshape(-1, 3, 3),
            relative,
            np.where(damaged, 0.1 * relative, relative),
            damaged,
            None if position_m is None else position_m[rows],
            options,
        )

    def look_ahead(self, last: int | None) -> _Lookahead:
        """Describe the frames after `last` (None at the start), up to the longest spacing, at least one."""
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
            motion[i] = displacement(total)
        distance = np.full(stop - first, np.nan)
        if self.position_m is not None:
            apart = self.position_m[first:stop] - self.position_m[origin]
            height = np.nan_to_num(self.position_m[first:stop, 2], nan=_UNKNOWN_HEIGHT_M)
            limit_m = np.maximum(
                self.options.max_distance_m, self.options.max_distance_share * height
            )
            distance = np.linalg.norm(apart[:, :2], axis=1) / limit_m
        elapsed = self.time_s[first:stop] - self.time_s[origin]
        return _Lookahead(first, elapsed, motion, distance, last is None)

    def windows(self, ahead: _Lookahead) -> tuple[np.ndarray, np.ndarray]:
        """Return the frames that compete to be next, and a wider window in case they are all blurred.

        Both are empty if the video ends before another frame is due.
        """
        near = self._between(ahead, 1 - self.options.window, 1 + self.options.window)
        if len(near) == 0:
            return near, near
        return near, np.union1d(near, self._between(ahead, 0.4, 2.5))

    def _between(self, ahead: _Lookahead, low: float, high: float) -> np.ndarray:
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
        # If the image moves too fast for the shortest spacing, a few frames still compete.
        grace_s = ahead.elapsed_s[start] + 0.5 * options.min_spacing_s
        over = (ahead.motion > high * options.motion_share) | (ahead.distance > high)
        over &= ahead.elapsed_s > grace_s
        over[: start + 1] = False
        stop = int(np.argmax(over)) if over.any() else len(over)
        return ahead.first + np.arange(start, stop)

    def pick_best(self, window: np.ndarray, widened: np.ndarray) -> tuple[int, str]:
        """Return the sharpest acceptable frame of a window, and the reason for the user."""
        pick = int(window[np.argmax(self.score[window])])
        if self._is_sharp(pick):
            return pick, f"chosen: sharpest of {len(window)} in its window"
        pick = int(widened[np.argmax(self.score[widened])])
        if self._is_sharp(pick):
            return (
                pick,
                f"chosen: sharpest of {len(widened)}; those nearer the wanted spacing are blurred",
            )
        if self.damaged[pick]:
            return (
                pick,
                f"chosen: damaged by lost packets, like all {len(widened)} in this stretch",
            )
        return pick, (
            f"chosen: blurred ({self.relative[pick]:.2f} of its neighbours' sharpness), but the best of "
            f"{len(widened)} in this stretch"
        )

    def _is_sharp(self, k: int) -> bool:
        return bool(self.score[k] >= self.options.blur_ratio)

    def motion_px(self, k: int, ahead: _Lookahead) -> float:
        """Return motion since the last chosen frame in full-size pixels; NaN if unknown."""
        i = k - ahead.first
        if ahead.at_start or i >= len(ahead.motion) or not np.isfinite(ahead.motion[i]):
            return float("nan")
        return round(float(ahead.motion[i] * self.width[k]), 1)

    def why_skipped(self, k: int, ahead: _Lookahead) -> str:
        """Return the reason why a frame is skipped, for the user."""
        if self.damaged[k]:
            return "skipped: damaged by lost packets"
        if self.relative[k] < self.options.blur_ratio:
            return f"skipped: blurred, {self.relative[k]:.2f} of its neighbours' sharpness"
        moved = self.motion_px(k, ahead)
        share = moved / self.width[k]
        if share < (1 - self.options.window) * self.options.motion_share:
            return f"skipped: only {moved:.0f} px from the previously chosen frame"
        return "skipped: the next chosen frame is sharper"
