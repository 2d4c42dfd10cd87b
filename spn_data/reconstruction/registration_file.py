"""File registration.csv: whether each frame was registered, and why not."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path

from spn_data.reconstruction.diagnosis import FrameRegistration
from spn_data.storage.files import read_csv, write_csv

REGISTRATION = "registration.csv"


def write_registration(folder: Path, rows: tuple[FrameRegistration, ...]) -> None:
    """Write registration.csv into the folder of a model.

    Parameters
    ----------
    folder : Path
        Folder of the model.
    rows : tuple of FrameRegistration
        One per frame.
    """
    columns = {f.name: [getattr(row, f.name) for row in rows] for f in fields(FrameRegistration)}
    columns["registered"] = ["registered" if row.registered else "missing" for row in rows]
    columns["error_px"] = ["" if math.isnan(r.error_px) else f"{r.error_px:.4f}" for r in rows]
    write_csv(folder / REGISTRATION, columns)


def read_reasons(folder: Path) -> dict[str, str]:
    """Read why frames are missing in a model.

    Parameters
    ----------
    folder : Path
        Folder of the model.

    Returns
    -------
    dict of str to str
        Reason by frame name; empty for registered frames.
    """
    columns = [f.name for f in fields(FrameRegistration)]
    return {row["name"]: row["reason"] for _, row in read_csv(folder / REGISTRATION, columns)}
