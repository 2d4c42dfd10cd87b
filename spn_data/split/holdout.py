"""Selection of held-out blocks in the mapping flights, and the resulting split."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from spn_data.errors import GeometryError, StageError
from spn_data.labels.labels import Labels
from spn_data.split.groups import (
    GROUPS,
    GUARD_DISTANCE,
    GUARD_GAP,
    LEFT_OUT,
    SLACK,
    TEST,
    TRAIN,
    VALIDATION,
    HeldOutBlock,
    Policy,
    Split,
    SplitOptions,
    adjacent_to_held_out,
    cells_of,
    seconds_to_held_out,
)

# Share of the frames a block is taken from that should remain for training, if possible.
_ENOUGH_LEFT = 0.5
# Minimum number of frames of a block in time, if validation has that many; photos are seconds apart.
_MIN_FRAMES = 4
# Options to reduce in order to leave more frames for training.
_OPTIONS_TO_REDUCE = {
    Policy.TIME: "--gap or --validation-share",
    Policy.SPACE: "--gap, --guard-distance or --validation-share",
    Policy.HEIGHT: "--gap, --guard-height or --validation-share",
}
_MAX_CANDIDATES = 64  # positions of a block that are tried


def make_split(
    mapping: Labels,
    tracked: Labels,
    evaluation: Mapping[str, Labels],
    options: SplitOptions,
    *,
    metric: bool = True,
) -> Split:
    """Split frames into groups.

    Mapping frames are used for training except for held-out blocks and their guard bands. Each evaluation
    sequence forms its own group.

    Parameters
    ----------
    mapping : Labels
        Chosen frames of the mapping flights.
    tracked : Labels
        Tracked frames of the mapping flights.
    evaluation : mapping of str to Labels
        Frames of the evaluation sequences, by name.
    options : SplitOptions
        Options.
    metric : bool
        Whether the poses are in metres with a known direction of up.

    Returns
    -------
    Split
        The split. If no evaluation frame has a pose, one block in time is held out as "test".

    Raises
    ------
    GeometryError
        If a group would remain empty, or if the policy needs metres and `metric` is false.
    StageError
        If an evaluation sequence has the name of a group.

    Notes
    -----
    The split depends only on frames, options and seed, not on the order of the frames. With blocks in time,
    the blocks of a sequence do not depend on the other sequences.
    """
    for name in evaluation:
        if name in GROUPS:
            raise StageError(
                f"an evaluation sequence may not be called {name!r}: this is the name of a group"
            )
    if options.validation is not Policy.TIME and not metric:
        raise GeometryError(
            f"--validation {options.validation} needs metres and a known direction of up, but the model is "
            "in its own gauge: use --validation time, or run spn-data georegister first"
        )
    flights = Labels.concatenate([mapping, tracked])
    plan = _Plan(flights, options, *_columns(flights, TRAIN, options))
    if not plan.trained.any():
        raise GeometryError("no mapping frame has a pose, so there are no training frames")
    tested = {name: labels for name, labels in evaluation.items() if labels.registered.any()}
    if not tested:
        plan = _hold_out_test(plan)
    _check_filled(plan, (TRAIN,) if tested else (TRAIN, TEST))
    plan = _VALIDATION[options.validation](plan)
    _check_filled(plan, (TRAIN, VALIDATION))
    parts = [
        (flights.names, plan.group, plan.reason),
        *((labels.names, *_columns(labels, name, options)) for name, labels in evaluation.items()),
    ]
    names, group, reason = (
        np.concatenate(column).astype(np.str_) for column in zip(*parts, strict=True)
    )
    notes = (
        *plan.notes,
        *(f"{name}: no frame has a pose" for name in evaluation if name not in tested),
    )
    return Split(names, group, reason, options, plan.blocks, optimistic=not tested, notes=notes)


@dataclass(frozen=True, eq=False)
class _Plan:
    """Split of the mapping flights under construction."""

    flights: Labels
    options: SplitOptions
    group: np.ndarray
    reason: np.ndarray
    blocks: tuple[HeldOutBlock, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def trained(self) -> np.ndarray:
        """Mask (N,) of chosen frames that are still used for training."""
        return np.asarray((self.group == TRAIN) & ~self.flights.tracked)

    def rng(self, purpose: str) -> np.random.Generator:
        """Return a separate generator for each purpose, so that draws are independent of each other."""
        return np.random.default_rng([self.options.seed, zlib.crc32(purpose.encode())])

    def with_block(self, block: HeldOutBlock) -> _Plan:
        """Return the plan with a block held out and its guard band left out."""
        held = block.contains(self.flights) & (self.group == TRAIN)
        group = np.where(held, block.group, self.group)
        reason = self.reason.copy()
        near = seconds_to_held_out(self.flights, held) < self.options.gap_s - SLACK
        if self.options.gap_s > 0:
            near |= adjacent_to_held_out(self.flights, held)
        for left_out, why in (
            (near, GUARD_GAP),
            (_within_guard(self.flights, held, block, self.options), GUARD_DISTANCE),
        ):
            left_out = left_out & (group == TRAIN)
            group[left_out], reason[left_out] = LEFT_OUT, why
        return replace(self, group=group, reason=reason, blocks=(*self.blocks, block))


def _within_guard(
    flights: Labels, held: np.ndarray, block: HeldOutBlock, options: SplitOptions
) -> np.ndarray:
    """Return a mask (N,) of frames within the guard band of a block in space or height."""
    near = np.zeros(len(flights), dtype=bool)
    if block.seconds is not None or not held.any():
        return near
    has = flights.registered
    if block.heights_m is not None:
        low, high = block.heights_m
        height, guard = flights.poses.centers[has, 2], options.guard_height_m - SLACK
        near[has] = (height > low - guard) & (height < high + guard)
        return near
    tree = cKDTree(flights.poses.centers[held, :2])
    apart, _ = tree.query(flights.poses.centers[has, :2])
    near[has] = apart < options.guard_distance_m - SLACK
    return near


def _columns(labels: Labels, group: str, options: SplitOptions) -> tuple[np.ndarray, np.ndarray]:
    """Return group and reason (N,), dtype object, with all frames that have a pose in `group`."""
    failed = [f"failed: {why}" if why else "failed" for why in labels.reason.tolist()]
    reason = np.where(labels.registered, "", np.array(failed, dtype=object))
    groups = np.where(labels.registered, np.array(group, dtype=object), LEFT_OUT)
    if not options.tracked:
        left_out = labels.tracked & labels.registered
        groups[left_out], reason[left_out] = LEFT_OUT, "tracked frames are left out"
    return groups, reason


def _hold_out_test(plan: _Plan) -> _Plan:
    """Hold out one test block in time from the sequence with the most frames."""
    names, counts = np.unique(plan.flights.sequences[plan.trained], return_counts=True)
    sequence = str(names[np.argmax(counts)])
    wanted = round(plan.options.test_share * counts.sum())
    size = int(np.clip(wanted, 1, max(1, counts.max() // 2)))
    rows = _rows(plan, sequence)
    return _hold_out_one(
        plan, _windows(plan, rows, rows, TEST, size), plan.rng(f"test {sequence}"), rows
    )


def _hold_out_in_time(plan: _Plan) -> _Plan:
    """Hold out validation blocks in each sequence, one in each of several equal parts."""
    before, short = plan, []
    sequences = np.unique(plan.flights.sequences[plan.trained]).tolist()
    for sequence in sequences:
        following = _validate_sequence(plan, sequence)
        rows = _rows(plan, sequence)
        if following.trained[rows].sum() >= _ENOUGH_LEFT * plan.trained[rows].sum():
            plan = following
        else:
            short.append(sequence)
    if len(short) == len(sequences):  # prefer few training frames to no validation
        longest = max(sequences, key=lambda s: int(before.trained[_rows(before, s)].sum()))
        short.remove(longest)
        plan = _validate_sequence(before, longest)
    notes = tuple(
        f"{sequence} is too short for a validation block and its guard: all its frames are used for training"
        for sequence in short
    )
    return replace(plan, notes=(*plan.notes, *notes))


def _validate_sequence(plan: _Plan, sequence: str) -> _Plan:
    """Return the plan with the validation blocks of one sequence held out."""
    options, rng = plan.options, plan.rng(f"validation {sequence}")
    rows = _rows(plan, sequence)
    free = rows[plan.trained[rows]]
    wanted_s = options.validation_share * float(np.ptp(plan.flights.time_s[free]))
    wanted = max(1, round(options.validation_share * len(free)))
    count = int(np.clip(round(wanted_s / options.block_s), 1, max(1, wanted // _MIN_FRAMES)))
    for part in np.array_split(free, count):
        windows = _windows(plan, rows, part, VALIDATION, max(1, round(wanted / count)))
        plan = _hold_out_one(plan, windows, rng, part)
    return plan


def _rows(plan: _Plan, sequence: str) -> np.ndarray:
    """Return the rows of a sequence's chosen frames that have a pose, sorted by time."""
    flights = plan.flights
    rows = np.flatnonzero((flights.sequences == sequence) & flights.registered & ~flights.tracked)
    return np.asarray(rows[np.lexsort((flights.names[rows], flights.time_s[rows]))])


def _windows(
    plan: _Plan, rows: np.ndarray, part: np.ndarray, group: str, size: int
) -> list[HeldOutBlock]:
    """Return all blocks of `size` consecutive frames of `rows` that are in `part` and still in training."""
    flights = plan.flights
    free = plan.trained[rows] & np.isin(rows, part)
    starts = np.flatnonzero(np.convolve(free, np.ones(size), "valid") > size - 0.5)
    return [
        HeldOutBlock(
            group,
            sequence=str(flights.sequences[rows[k]]),
            seconds=(float(flights.time_s[rows[k]]), float(flights.time_s[rows[k + size - 1]])),
        )
        for k in starts.tolist()
    ]


def _hold_out_one(
    plan: _Plan, blocks: Sequence[HeldOutBlock], rng: np.random.Generator, rows: np.ndarray
) -> _Plan:
    """Hold out a random block among those that leave enough of `rows` for training.

    If none does, hold out the one that leaves the most. Without blocks, the plan is returned unchanged.
    """
    if not blocks:
        return plan
    if len(blocks) > _MAX_CANDIDATES:
        picked = np.linspace(0, len(blocks) - 1, _MAX_CANDIDATES).round().astype(int)
        blocks = [blocks[k] for k in picked]
    # Tracked frames, which are often far more numerous, do not affect the choice.
    chosen = np.flatnonzero(~plan.flights.tracked)
    small = replace(
        plan,
        flights=plan.flights.select(chosen),
        group=plan.group[chosen],
        reason=plan.reason[chosen],
    )
    mine = np.isin(chosen, rows)
    left = np.array([small.with_block(block).trained[mine].sum() for block in blocks])
    enough = np.flatnonzero(left >= _ENOUGH_LEFT * plan.trained[rows].sum())
    best = rng.choice(enough) if len(enough) else int(np.argmax(left))
    return plan.with_block(blocks[best])


def _hold_out_in_space(plan: _Plan) -> _Plan:
    """Hold out a region of adjacent cells, grown from one cell until it contains the validation share."""
    cells = cells_of(plan.flights.select(plan.trained), plan.options.cell_m)
    found, counts = np.unique(np.array(cells, dtype=np.int64), axis=0, return_counts=True)
    occupied = {(int(i), int(j)): int(n) for (i, j), n in zip(found, counts, strict=True)}
    wanted = plan.options.validation_share * counts.sum()
    regions = dict.fromkeys(_grown(cell, occupied, wanted) for cell in sorted(occupied))
    blocks = [
        HeldOutBlock(VALIDATION, cells=region, cell_m=plan.options.cell_m)
        for region in regions
        if region
    ]
    return _hold_out_one(plan, blocks, plan.rng("validation space"), np.flatnonzero(plan.trained))


def _grown(
    start: tuple[int, int], occupied: Mapping[tuple[int, int], int], wanted: float
) -> tuple[tuple[int, int], ...]:
    """Grow a connected region of occupied cells around `start`; () if it stays below half the target."""
    region, held = [start], occupied[start]
    while held < wanted:
        border = {
            (i + di, j + dj) for i, j in region for di in (-1, 0, 1) for dj in (-1, 0, 1)
        } & set(occupied)
        border -= set(region)
        if not border:
            break
        nearest = min(border, key=lambda c: ((c[0] - start[0]) ** 2 + (c[1] - start[1]) ** 2, c))
        region.append(nearest)
        held += occupied[nearest]
    return tuple(sorted(region)) if held >= wanted / 2 else ()


def _hold_out_in_height(plan: _Plan) -> _Plan:
    """Hold out a band of heights that contains the validation share."""
    heights = np.sort(plan.flights.poses.centers[plan.trained, 2])
    size = max(1, round(plan.options.validation_share * len(heights)))
    blocks = [
        HeldOutBlock(VALIDATION, heights_m=(float(heights[k]), float(heights[k + size - 1])))
        for k in range(len(heights) - size + 1)
    ]
    return _hold_out_one(plan, blocks, plan.rng("validation height"), np.flatnonzero(plan.trained))


_VALIDATION = {
    Policy.TIME: _hold_out_in_time,
    Policy.SPACE: _hold_out_in_space,
    Policy.HEIGHT: _hold_out_in_height,
}


def _check_filled(plan: _Plan, groups: Sequence[str]) -> None:
    options = plan.options
    for group in groups:
        if not ((plan.group == group) & ~plan.flights.tracked).any():
            registered = int((plan.flights.registered & ~plan.flights.tracked).sum())
            raise GeometryError(
                f"--validation {options.validation} with a gap of {options.gap_s:g} s leaves no frame for "
                f"{group} out of {registered} mapping frames with a pose; try a smaller "
                f"{_OPTIONS_TO_REDUCE[options.validation]}, or another --validation"
            )
