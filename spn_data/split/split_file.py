"""Reading and writing of split.json, including the known limitations of a split in words."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.capture.frames import check_name
from spn_data.errors import FormatError
from spn_data.split.groups import (
    LEFT_OUT,
    OPTIMISTIC,
    VALIDATION,
    HeldOutBlock,
    Policy,
    Split,
    SplitOptions,
)
from spn_data.storage.json_files import DAMAGE, VERSION, kind_of, read_json, write_json
from spn_data.storage.stage_record import current_options

_VALIDATION_LIMITATIONS = (
    "Validation frames were bundle-adjusted jointly with the training frames: their poses and points were "
    "estimated together, and they share some map points.",
    "Validation frames come from the same flights as training (same light, same day, same camera). Use them "
    "to choose between networks; only an evaluation sequence shows how a network performs on another flight.",
    "The guard separates training from held-out frames within a sequence. It does not exclude frames if a "
    "flight returns to the same place: audit.json lists training frames near a held-out frame.",
)
_TEST_LIMITATION = (
    f"{OPTIMISTIC}. No evaluation sequence had a pose, so the test frames are a block of a mapping flight; "
    "they were also bundle-adjusted jointly with the training frames."
)


def limitations(split: Split) -> tuple[str, ...]:
    """Return the known limitations of a split as sentences for split.json and the report."""
    sentences = _VALIDATION_LIMITATIONS if VALIDATION in split.groups() else ()
    return (_TEST_LIMITATION, *sentences) if split.optimistic else sentences


def write_split(path: Path, split: Split) -> None:
    """Write split.json (docs/split.md) atomically."""
    names, group = split.names.tolist(), split.group.tolist()
    left_out = {
        name: reason
        for name, own, reason in zip(names, group, split.reason.tolist(), strict=True)
        if own == LEFT_OUT
    }
    write_json(
        path,
        {
            "version": VERSION,
            "options": asdict(split.options),
            "optimistic": split.optimistic,
            "not_free_of": list(limitations(split)),
            "counts": {**split.counts(), "left_out": len(left_out)},
            "blocks": [_block_to_json(block) for block in split.blocks],
            "groups": {own: split.names[split.group == own].tolist() for own in split.groups()},
            "left_out": left_out,
            "notes": list(split.notes),
        },
    )


def read_split(path: Path) -> Split:
    """Read split.json; frames are sorted by group, left-out frames last.

    Raises FormatError if the file was not written by `write_split`.
    """
    table = read_json(path)
    try:
        options = current_options(table["options"])
        options["validation"] = Policy(options["validation"])
        names, group, reason = [], [], []
        for own, members in table["groups"].items():
            if not isinstance(members, list):
                raise TypeError(f"group {own!r} is {kind_of(members)} instead of a list")
            names += members
            group += [str(own)] * len(members)
            reason += [""] * len(members)
        names += list(table["left_out"])
        group += [LEFT_OUT] * len(table["left_out"])
        reason += [str(why) for why in table["left_out"].values()]
        for name in names:
            check_name(name)
        split = Split(
            np.array(names, dtype=np.str_),
            np.array(group, dtype=np.str_),
            np.array(reason, dtype=np.str_),
            SplitOptions(**options),
            tuple(_block_from_json(block) for block in table["blocks"]),
            optimistic=bool(table["optimistic"]),
            notes=tuple(str(note) for note in table["notes"]),
        )
    except DAMAGE as error:
        raise FormatError(f"{path}: is not a split written by this program ({error!r})") from error
    return split


def _block_to_json(block: HeldOutBlock) -> dict[str, Any]:
    if block.seconds is not None:
        first, last = block.seconds
        where: dict[str, Any] = {"sequence": block.sequence, "first_s": first, "last_s": last}
    elif block.heights_m is not None:
        where = {"low_m": block.heights_m[0], "high_m": block.heights_m[1]}
    else:
        where = {"cell_m": block.cell_m, "cells": [list(cell) for cell in block.cells]}
    return {"group": block.group, **where}


def _block_from_json(table: dict[str, Any]) -> HeldOutBlock:
    group = str(table["group"])
    if "first_s" in table:
        seconds = (float(table["first_s"]), float(table["last_s"]))
        return HeldOutBlock(group, sequence=str(table["sequence"]), seconds=seconds)
    if "low_m" in table:
        return HeldOutBlock(group, heights_m=(float(table["low_m"]), float(table["high_m"])))
    cells = tuple((int(i), int(j)) for i, j in table["cells"])
    return HeldOutBlock(group, cells=cells, cell_m=float(table["cell_m"]))
