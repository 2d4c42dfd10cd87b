"""Frames: one row per candidate frame of the sources, chosen or not, and its file frames.csv."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from pathlib import Path

import numpy as np

from spn_data.errors import InputError
from spn_data.storage.files import read_csv, write_csv
from spn_data.telemetry.track import Telemetry

_NAME = re.compile(r"[A-Za-z0-9._-]{1,200}/[A-Za-z0-9._-]{1,200}\.jpg", re.ASCII)
_KEY = re.compile(r"[A-Za-z0-9._-]{1,200}", re.ASCII)


class FrameStatus(StrEnum):
    """Outcome of the frame selection for one candidate."""

    CHOSEN = "chosen"
    SKIPPED = "skipped"
    UNREADABLE = "unreadable"


@dataclass(frozen=True, eq=False)
class Frames:
    """N candidate frames in order of sequence and time; unknown values are NaN.

    Attributes
    ----------
    names : ndarray of str, shape (N,)
        Unique name of the image in the model, `<sequence>/<frame>.jpg`.
    sequences : ndarray of str, shape (N,)
        Sequence of the frame.
    cameras : ndarray of str, shape (N,)
        Frames of one camera share their intrinsics (one lens, one flight).
    sources : ndarray of str, shape (N,)
        Name of the source file.
    video_frame : ndarray of int, shape (N,)
        Index among that file's decoded frames; -1 for a photo.
    time_s : ndarray, shape (N,)
        Seconds since the sequence's first frame.
    status : ndarray of str, shape (N,)
        A `FrameStatus`.
    reason : ndarray of str, shape (N,)
        Why the frame has this status, for the user.
    sharpness : ndarray, shape (N,)
        Grey levels, see `spn_data.capture.measurement.image_sharpness`.
    motion_px : ndarray, shape (N,)
        Image motion since the previously chosen frame, in full-size pixels.
    width, height : ndarray of int, shape (N,)
        Size of the upright image in pixels; 0 if unreadable.
    lat_lon_deg : ndarray, shape (N, 2)
        WGS84 position; this and the columns below are telemetry at the frame's time, as in `Telemetry`.
    rel_alt_m : ndarray, shape (N,)
        Height above take-off.
    abs_alt_m : ndarray, shape (N,)
        Absolute height.
    sigma_m : ndarray, shape (N, 3)
        Standard deviations east, north, up.
    gimbal_deg : ndarray, shape (N, 3)
        Heading, pitch, roll.
    """

    names: np.ndarray
    sequences: np.ndarray
    cameras: np.ndarray
    sources: np.ndarray
    video_frame: np.ndarray
    time_s: np.ndarray
    status: np.ndarray
    reason: np.ndarray
    sharpness: np.ndarray
    motion_px: np.ndarray
    width: np.ndarray
    height: np.ndarray
    lat_lon_deg: np.ndarray
    rel_alt_m: np.ndarray
    abs_alt_m: np.ndarray
    sigma_m: np.ndarray
    gimbal_deg: np.ndarray

    def __post_init__(self) -> None:
        n = len(self.names)
        for column in fields(self):
            array = getattr(self, column.name)
            if len(array) != n:
                raise ValueError(f"{column.name} has {len(array)} rows, but names has {n}")
        if len(set(self.names.tolist())) != n:
            raise ValueError("frame names are not unique")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def chosen(self) -> np.ndarray:
        """Frames selected for mapping, (N,) bool."""
        return self.status == FrameStatus.CHOSEN

    @property
    def has_fix(self) -> np.ndarray:
        """Frames whose telemetry includes a horizontal position, (N,) bool."""
        return np.isfinite(self.lat_lon_deg).all(axis=1)

    def select(self, index: np.ndarray) -> Frames:
        """Return the rows selected by an index or mask (N,)."""
        return replace(self, **{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def with_telemetry(self, telemetry: Telemetry) -> Frames:
        """Return the same frames with telemetry of N rows, one per frame: `track.at(frames.time_s)`."""
        if len(telemetry) != len(self):
            raise ValueError(f"{len(telemetry)} rows of telemetry for {len(self)} frames")
        return replace(
            self,
            lat_lon_deg=telemetry.lat_lon_deg,
            rel_alt_m=telemetry.rel_alt_m,
            abs_alt_m=telemetry.abs_alt_m,
            sigma_m=telemetry.sigma_m,
            gimbal_deg=telemetry.gimbal_deg,
        )

    @classmethod
    def concatenate(cls, parts: Sequence[Frames]) -> Frames:
        """Concatenate the rows of several tables."""
        if not parts:
            raise ValueError("no frames to concatenate")
        return cls(
            **{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)}
        )


# Column of the file -> field and, if the field has several columns, the index of the column.
_TEXT = {
    "name": "names",
    "sequence": "sequences",
    "camera": "cameras",
    "source": "sources",
}
_COLUMNS: dict[str, tuple[str, int | None]] = {
    **{column: (field, None) for column, field in _TEXT.items()},
    "video_frame": ("video_frame", None),
    "time_s": ("time_s", None),
    "status": ("status", None),
    "reason": ("reason", None),
    "sharpness": ("sharpness", None),
    "motion_px": ("motion_px", None),
    "width_px": ("width", None),
    "height_px": ("height", None),
    "lat_deg": ("lat_lon_deg", 0),
    "lon_deg": ("lat_lon_deg", 1),
    "rel_alt_m": ("rel_alt_m", None),
    "abs_alt_m": ("abs_alt_m", None),
    "sigma_e_m": ("sigma_m", 0),
    "sigma_n_m": ("sigma_m", 1),
    "sigma_u_m": ("sigma_m", 2),
    "heading_deg": ("gimbal_deg", 0),
    "pitch_deg": ("gimbal_deg", 1),
    "roll_deg": ("gimbal_deg", 2),
}
_STRINGS = {*_TEXT, "status", "reason"}
_INTEGERS = {"video_frame", "width_px", "height_px"}
_MAY_BE_UNKNOWN = set(_COLUMNS) - _STRINGS - _INTEGERS - {"time_s"}


def write_frames(path: Path, frames: Frames) -> None:
    """Write frames.csv (docs/input.md); the file is written atomically.

    Parameters
    ----------
    path : Path
        Target file.
    frames : Frames
        Its rows.
    """
    columns = {}
    for name, (field, index) in _COLUMNS.items():
        values = getattr(frames, field)
        values = values if index is None else values[:, index]
        if name in _STRINGS or name in _INTEGERS:
            columns[name] = [str(v) for v in values.tolist()]
        else:
            columns[name] = ["" if np.isnan(v) else repr(float(v)) for v in values]
    write_csv(path, columns)


def read_frames(path: Path) -> Frames:
    """Read frames.csv.

    Parameters
    ----------
    path : Path
        A file written by `write_frames`.

    Returns
    -------
    Frames
        Its rows.

    Raises
    ------
    InputError
        With the line number, if the file is not as `write_frames` writes it.
    """
    table: dict[str, list[object]] = {column: [] for column in _COLUMNS}
    seen: set[str] = set()
    for line, row in read_csv(path, _COLUMNS):
        try:
            for column, cell in row.items():
                table[column].append(_convert(column, cell))
            _check_row(row, seen)
        except ValueError as error:
            raise InputError(str(error), path=path, line=line) from error
    arrays: dict[str, np.ndarray] = {}
    for column, (field, index) in _COLUMNS.items():
        dtype = np.str_ if column in _STRINGS else np.int64 if column in _INTEGERS else np.float64
        values = np.array(table[column], dtype=dtype)
        if index is None:
            arrays[field] = values
        elif index == 0:
            arrays[field] = values[:, None]
        else:
            arrays[field] = np.column_stack([arrays[field], values])
    return Frames(**arrays)


def _convert(column: str, cell: str) -> object:
    if column in _STRINGS:
        return cell
    if cell == "" and column in _MAY_BE_UNKNOWN:
        return float("nan")
    try:
        value = int(cell) if column in _INTEGERS else float(cell)
    except ValueError:
        raise ValueError(f"{column} {cell!r} is not a number") from None
    if not abs(value) <= 1e15:  # also catches NaN
        raise ValueError(f"{column} {cell!r} is not a finite number")
    return value


def _check_row(row: dict[str, str], seen: set[str]) -> None:
    name, sequence, camera, source = (row[column] for column in _TEXT)
    check_name(name)
    if not name.startswith(sequence + "/"):
        raise ValueError(f"name {name!r} does not start with its sequence {sequence!r}")
    if not _KEY.fullmatch(camera):
        raise ValueError(f"camera {camera!r} contains characters other than A-Z a-z 0-9 . _ -")
    if "/" in source or "\\" in source or source in ("", ".", ".."):
        raise ValueError(f"source {source!r} is not a file name")
    status = row["status"]
    if status not in set(FrameStatus):
        raise ValueError(f"status {status!r} is not one of {', '.join(FrameStatus)}")
    if name in seen:
        raise ValueError(f"duplicate name {name!r}")
    seen.add(name)


def check_name(name: str) -> None:
    """Check that a frame name is `<sequence>/<frame>.jpg` in plain characters, so it cannot leave its folder.

    Parameters
    ----------
    name : str
        Name to check.

    Raises
    ------
    ValueError
        If it is anything else.
    """
    if not _NAME.fullmatch(name) or any(part.startswith(".") for part in name.split("/")):
        raise ValueError(f"name {name!r} is not <sequence>/<frame>.jpg in plain characters")
