"""registration.csv: what became of each frame that was to be mapped."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path

from spn_data.reconstruction.diagnosis import FrameRegistration
from spn_data.storage.files import read_csv, write_csv

REGISTRATION = "registration.csv"


def write_registration(folder: Path, rows: tuple[FrameRegistration, ...]) -> None:
    """Write what became of each frame beside the model."""
    columns = {f.name: [getattr(row, f.name) for row in rows] for f in fields(FrameRegistration)}
    columns["registered"] = ["registered" if row.registered else "missing" for row in rows]
    columns["error_px"] = ["" if math.isnan(r.error_px) else f"{r.error_px:.4f}" for r in rows]
    write_csv(folder / REGISTRATION, columns)


def read_reasons(folder: Path) -> dict[str, str]:
    """Why a frame is missing in the model of a folder, by name; empty where it is not."""
    columns = [f.name for f in fields(FrameRegistration)]
    return {row["name"]: row["reason"] for _, row in read_csv(folder / REGISTRATION, columns)}
