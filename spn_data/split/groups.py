"""Which frames train, validate and test: the groups, and the blocks held out of mapping flights."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from spn_data.labels.labels import Labels

TRAIN, VALIDATION, TEST, LEFT_OUT = "train", "validation", "test", ""
GROUPS = (TRAIN, VALIDATION, TEST)  # no evaluation sequence may have the name of one
OPTIMISTIC = "same flight as training: optimistic"
GUARD_GAP, GUARD_DISTANCE = "guard gap", "guard distance"

# Times and distances are compared with this slack: 2.0 s apart is not nearer than a gap of 2 s.
SLACK = 1e-6


class Policy(StrEnum):
    """How validation frames are chosen among the mapping frames."""

    TIME = "time"
    SPACE = "space"
    HEIGHT = "height"


@dataclass(frozen=True, kw_only=True)
class SplitOptions:
    """How frames are divided. Shares are of the chosen mapping frames that have a pose."""

    validation: Policy = Policy.TIME
    validation_share: float = 0.11  # the paper's
    test_share: float = 0.15  # one block, only where there is no evaluation sequence
    gap_s: float = 2.0  # no training frame of a sequence is nearer in time to a held-out one
    block_s: float = 5.0  # length aimed at for a validation block in time
    cell_m: float = 4.0  # edge of a cell in plan view (space)
    guard_distance_m: float = 3.0  # in plan view, from validation to training (space)
    guard_height_m: float = 1.0  # in height, from validation to training (height)
    tracked: bool = True  # frames that were not chosen take part
    seed: int = 0

    def __post_init__(self) -> None:
        for share in (self.validation_share, self.test_share):
            if not 0 < share < 1:
                raise ValueError("a share lies between 0 and 1")
        lengths = (self.gap_s, self.guard_distance_m, self.guard_height_m)
        if not (min(lengths) >= 0 and min(self.block_s, self.cell_m) > 0):
            raise ValueError("gap and guards are at least 0, block and cell more than 0")


@dataclass(frozen=True)
class HeldOutBlock:
    """What is held out as `group`: a stretch of one sequence, cells in plan view, or a band of heights.

    Bounds belong to the block. One of seconds, cells and heights_m is given.
    """

    group: str
    sequence: str = ""  # of a stretch in time
    seconds: tuple[float, float] | None = None
    cells: tuple[tuple[int, int], ...] = ()  # cell (i, j) is [i, i + 1) x [j, j + 1) times cell_m
    cell_m: float = 0.0
    heights_m: tuple[float, float] | None = None

    def holds(self, labels: Labels) -> np.ndarray:
        """(N,) bool: frames that lie in it; one without a pose lies in no cell and no band."""
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
    """The group of N frames.

    names : (N,) str; group : (N,) str, "train", "validation", "test", the name of an evaluation sequence,
    or "" for what is left out; reason : (N,) str, why it is left out, empty else.
    blocks : what was held out of the mapping flights. optimistic : the test frames are of a mapping flight.
    notes : what the user should know.
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
            raise ValueError("columns of a split differ in length")

    def groups(self) -> tuple[str, ...]:
        """Names of the groups that hold frames: train, validation, then the others, sorted."""
        found = set(self.group.tolist()) - {LEFT_OUT}
        own = [g for g in (TRAIN, VALIDATION) if g in found]
        return (*own, *sorted(found - {TRAIN, VALIDATION}))

    def counts(self) -> dict[str, int]:
        """Frames by group."""
        return {name: int((self.group == name).sum()) for name in self.groups()}

    def of(self, names: np.ndarray) -> np.ndarray:
        """(K,) group of each name. Raises KeyError for a name that the split does not know."""
        group = dict(zip(self.names.tolist(), self.group.tolist(), strict=True))
        return np.array([group[name] for name in names.tolist()], dtype=np.str_)


def seconds_apart(labels: Labels, held: np.ndarray) -> np.ndarray:
    """(N,) seconds from each frame to the nearest of its sequence that is held; infinite without one."""
    apart = np.full(len(labels), np.inf)
    for sequence in np.unique(labels.sequences[held]):
        mine = labels.sequences == sequence
        times = np.sort(labels.time_s[mine & held])
        own = labels.time_s[mine]
        after = np.searchsorted(times, own).clip(max=len(times) - 1)
        before = np.maximum(after - 1, 0)
        apart[mine] = np.minimum(np.abs(times[after] - own), np.abs(own - times[before]))
    return apart


def next_to(labels: Labels, held: np.ndarray) -> np.ndarray:
    """(N,) bool: frames that no chosen frame with a pose separates in time from one of their sequence held.

    Chosen frames are some motion apart: a guard that reaches over one has seen the camera move, also
    where it hovered, and where photos are farther apart than any gap in seconds.
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
    """The cell in plan view of each frame; None without a pose."""
    plan_view = labels.poses.centers[:, :2]
    has = np.isfinite(plan_view).all(axis=1)
    index = np.floor(np.where(has[:, None], plan_view, 0.0) / cell_m).astype(np.int64)
    return [(i, j) if k else None for (i, j), k in zip(index.tolist(), has.tolist(), strict=True)]
