"""Groups of a split (training, validation, test), held-out blocks of mapping flights, and guard bands."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from spn_data.labels.labels import Labels

TRAIN, VALIDATION, TEST, LEFT_OUT = "train", "validation", "test", ""
GROUPS = (TRAIN, VALIDATION, TEST)  # reserved: not allowed as names of evaluation sequences
OPTIMISTIC = "same flight as training: optimistic"
GUARD_GAP, GUARD_DISTANCE = "guard gap", "guard distance"

# Tolerance when comparing times and distances: 2.0 s apart is not nearer than a gap of 2 s.
SLACK = 1e-6


class Policy(StrEnum):
    """Policy for choosing validation frames among the mapping frames."""

    TIME = "time"
    SPACE = "space"
    HEIGHT = "height"


@dataclass(frozen=True, kw_only=True)
class SplitOptions:
    """Options of a split. Shares refer to the chosen mapping frames that have a pose.

    Attributes
    ----------
    validation : Policy
        How validation frames are held out.
    validation_share : float
        Share of validation frames; the default is that of the paper.
    test_share : float
        Share of the single test block, used only if there is no evaluation sequence.
    gap_s : float
        Minimum time between a training frame and a held-out frame of the same sequence.
    block_s : float
        Target length of a validation block in time.
    cell_m : float
        Edge length of a cell in plan view (policy space).
    guard_distance_m : float
        Guard band in plan view between validation and training frames (policy space).
    guard_height_m : float
        Guard band in height between validation and training frames (policy height).
    tracked : bool
        Whether tracked frames take part.
    seed : int
        Random seed.
    """

    validation: Policy = Policy.TIME
    validation_share: float = 0.11
    test_share: float = 0.15
    gap_s: float = 2.0
    block_s: float = 5.0
    cell_m: float = 4.0
    guard_distance_m: float = 3.0
    guard_height_m: float = 1.0
    tracked: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        for share in (self.validation_share, self.test_share):
            if not 0 < share < 1:
                raise ValueError("shares must be between 0 and 1")
        lengths = (self.gap_s, self.guard_distance_m, self.guard_height_m)
        if not (min(lengths) >= 0 and min(self.block_s, self.cell_m) > 0):
            raise ValueError("gap and guards must be at least 0, block and cell greater than 0")


@dataclass(frozen=True)
class HeldOutBlock:
    """Block held out of the mapping flights: a time interval, cells in plan view, or a band of heights.

    Exactly one of `seconds`, `cells` and `heights_m` is given; bounds in time and height are inclusive.

    Attributes
    ----------
    group : str
        Group the frames in the block belong to.
    sequence : str
        Sequence of a block in time.
    seconds : tuple of float, optional
        First and last time of a block in time.
    cells : tuple of tuple of int
        Cells in plan view; cell (i, j) covers [i, i + 1) x [j, j + 1), times `cell_m`.
    cell_m : float
        Edge length of a cell.
    heights_m : tuple of float, optional
        Lowest and highest height of a band.
    """

    group: str
    sequence: str = ""
    seconds: tuple[float, float] | None = None
    cells: tuple[tuple[int, int], ...] = ()
    cell_m: float = 0.0
    heights_m: tuple[float, float] | None = None

    def contains(self, labels: Labels) -> np.ndarray:
        """Return a mask (N,) of frames in the block; frames without a pose are in no cell and no band."""
        if self.seconds is not None:
            first, last = self.seconds
            within = (labels.time_s >= first - SLACK) & (labels.time_s <= last + SLACK)
            return np.asarray((labels.sequences == self.sequence) & within)
        if self.heights_m is not None:
            low, high = self.heights_m
            height = labels.poses.centers[:, 2]
            return np.asarray((height >= low) & (height <= high))
        wanted = set(self.cells)
        return np.array([cell in wanted for cell in cells_of(labels, self.cell_m)], dtype=bool)


@dataclass(frozen=True, eq=False)
class Split:
    """Assignment of frames to groups.

    Attributes
    ----------
    names : ndarray of str, shape (N,)
        Names of the frames.
    group : ndarray of str, shape (N,)
        "train", "validation", "test", the name of an evaluation sequence, or "" if the frame is left out.
    reason : ndarray of str, shape (N,)
        Why the frame is left out; empty if it is not.
    options : SplitOptions
        Options the split was made with.
    blocks : tuple of HeldOutBlock
        Blocks held out of the mapping flights.
    optimistic : bool
        Whether the test frames come from a mapping flight.
    notes : tuple of str
        Sentences for the user.
    """

    names: np.ndarray
    group: np.ndarray
    reason: np.ndarray
    options: SplitOptions
    blocks: tuple[HeldOutBlock, ...] = ()
    optimistic: bool = False
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not len(self.names) == len(self.group) == len(self.reason):
            raise ValueError("names, group and reason of a split must have the same length")

    def groups(self) -> tuple[str, ...]:
        """Return the names of non-empty groups: train, validation, then the others, sorted."""
        found = set(self.group.tolist()) - {LEFT_OUT}
        own = [g for g in (TRAIN, VALIDATION) if g in found]
        return (*own, *sorted(found - {TRAIN, VALIDATION}))

    def counts(self) -> dict[str, int]:
        """Return the number of frames by group."""
        return {name: int((self.group == name).sum()) for name in self.groups()}

    def groups_of(self, names: np.ndarray) -> np.ndarray:
        """Return the group (K,) of each name; raise KeyError for unknown names."""
        group = dict(zip(self.names.tolist(), self.group.tolist(), strict=True))
        return np.array([group[name] for name in names.tolist()], dtype=np.str_)


def seconds_to_held_out(labels: Labels, held: np.ndarray) -> np.ndarray:
    """Return seconds (N,) from each frame to the nearest held-out one of its sequence, or infinity."""
    apart = np.full(len(labels), np.inf)
    for sequence in np.unique(labels.sequences[held]):
        mine = labels.sequences == sequence
        times = np.sort(labels.time_s[mine & held])
        own = labels.time_s[mine]
        after = np.searchsorted(times, own).clip(max=len(times) - 1)
        before = np.maximum(after - 1, 0)
        apart[mine] = np.minimum(np.abs(times[after] - own), np.abs(own - times[before]))
    return apart


def adjacent_to_held_out(labels: Labels, held: np.ndarray) -> np.ndarray:
    """Return a mask (N,) of frames with no chosen frame (with a pose) between them and a held-out one.

    Only frames of the same sequence are compared. The camera moves between chosen frames, so a guard that
    spans at least one of them contains motion, even if the drone hovers or if photos are farther apart than
    the gap in seconds.
    """
    near = np.zeros(len(labels), dtype=bool)
    for sequence in np.unique(labels.sequences[held]):
        mine = labels.sequences == sequence
        chosen = np.sort(labels.time_s[mine & labels.registered & ~labels.tracked])
        times, own = np.sort(labels.time_s[mine & held]), labels.time_s[mine]
        after = np.searchsorted(times, own)
        before = after - 1
        later, earlier = times[after.clip(max=len(times) - 1)], times[before.clip(min=0)]
        since = np.searchsorted(chosen, own) - np.searchsorted(chosen, earlier, side="right")
        until = np.searchsorted(chosen, later) - np.searchsorted(chosen, own, side="right")
        near[mine] = ((before >= 0) & (since < 1)) | ((after < len(times)) & (until < 1))
    return near & ~held


def cells_of(labels: Labels, cell_m: float) -> list[tuple[int, int] | None]:
    """Return the cell in plan view of each frame, None for frames without a pose."""
    plan_view = labels.poses.centers[:, :2]
    has = np.isfinite(plan_view).all(axis=1)
    index = np.floor(np.where(has[:, None], plan_view, 0.0) / cell_m).astype(np.int64)
    return [(i, j) if k else None for (i, j), k in zip(index.tolist(), has.tolist(), strict=True)]
