"""split.json: a split as a file, with what it cannot promise said in words."""

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
from spn_data.storage.json_files import VERSION, read_json, write_json
from spn_data.storage.stage_record import current_options

_NOT_FREE = (
    "Validation frames were bundle-adjusted jointly with the training frames: poses and points of both "
    "fitted each other, and the points that they see are partly the same ones.",
    "Validation is of the same flights as training (same light, same day, same camera). It serves to "
    "choose between networks; what a network does on another flight, only an evaluation sequence tells.",
    "The guard keeps frames apart within a sequence. A flight that comes back to a place is not cut: "
    "audit.json lists the training frames near a held-out one.",
)
_TEST_NOT_FREE = (
    f"{OPTIMISTIC}. No evaluation sequence had a pose, so that the test frames are a block of a mapping "
    "flight; they were bundle-adjusted jointly with the training frames too."
)


def statements(split: Split) -> tuple[str, ...]:
    """What the groups cannot be free of, as sentences for split.json and the report."""
    said = _NOT_FREE if VALIDATION in split.groups() else ()
    return (_TEST_NOT_FREE, *said) if split.optimistic else said


def write_split(path: Path, split: Split) -> None:
    """As split.json (docs/split.md); the file appears whole."""
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
            "not_free_of": list(statements(split)),
            "counts": {**split.counts(), "left_out": len(left_out)},
            "blocks": [_block_to_json(block) for block in split.blocks],
            "groups": {own: split.names[split.group == own].tolist() for own in split.groups()},
            "left_out": left_out,
            "notes": list(split.notes),
        },
    )


def read_split(path: Path) -> Split:
    """The frames by group, those left out last. Raises FormatError where it is not of `write_split`."""
    table = read_json(path)
    try:
        options = current_options(table["options"])
        options["validation"] = Policy(options["validation"])
        names, group, reason = [], [], []
        for own, members in table["groups"].items():
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
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FormatError(f"{path}: is no split of this program ({error!r})") from error
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
