"""Frames: one row per candidate frame of the sources, chosen or not, and frames.csv."""

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
    """What became of a candidate."""

    CHOSEN = "chosen"
    SKIPPED = "skipped"
    UNREADABLE = "unreadable"


@dataclass(frozen=True, eq=False)
class Frames:
    """N candidate frames, in the order of sequence and time. What is not known is NaN.

    names : (N,) str, the image's name in the model, `<sequence>/<frame>.jpg`; unique.
    sequences, cameras : (N,) str; frames of one camera share their intrinsics (one lens, one flight).
    sources : (N,) str, name of the file that the frame is from.
    video_frame : (N,) int, index among that file's decoded frames; -1 for a photo.
    time_s : (N,) seconds since the sequence's first frame.
    status : (N,) str, a FrameStatus; reason : (N,) str.
    sharpness : (N,) grey levels (`spn_data.capture.selection`); motion_px : (N,) motion of the image since
    the frame chosen before, full-size pixels; width, height : (N,) int, upright image, 0 where unreadable.
    lat_lon_deg (N, 2) WGS84, rel_alt_m (N,), abs_alt_m (N,), sigma_m (N, 3) east, north, up,
    gimbal_deg (N, 3) heading, pitch, roll : telemetry at the frame's time, as in `Telemetry`.
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
                raise ValueError(f"{column.name} has {len(array)} rows, names {n}")
        if len(set(self.names.tolist())) != n:
            raise ValueError("names of frames are not unique")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def chosen(self) -> np.ndarray:
        """(N,) bool."""
        return self.status == FrameStatus.CHOSEN

    @property
    def has_fix(self) -> np.ndarray:
        """(N,) bool: the telemetry knows the horizontal position."""
        return np.isfinite(self.lat_lon_deg).all(axis=1)

    def select(self, index: np.ndarray) -> Frames:
        """The rows of an index or mask (N,)."""
        return replace(self, **{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def with_telemetry(self, telemetry: Telemetry) -> Frames:
        """The same frames with the telemetry's rows (N), one for each frame: `track.at(frames.time_s)`."""
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
        """The rows of several, one after the other."""
        if not parts:
            raise ValueError("no frames to put together")
        return cls(
            **{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)}
        )


# Column of the file -> field and, where the field has several, its column.
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
    """As frames.csv (docs/input.md); the file appears whole."""
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
    """From frames.csv; InputError with the line where it is not what `write_frames` writes."""
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
    if not abs(value) <= 1e15:  # NaN is not either
        raise ValueError(f"{column} {cell!r} is not a finite number")
    return value


def _check_row(row: dict[str, str], seen: set[str]) -> None:
    name, sequence, camera, source = (row[column] for column in _TEXT)
    check_name(name)
    if not name.startswith(sequence + "/"):
        raise ValueError(f"name {name!r} does not begin with its sequence {sequence!r}")
    if not _KEY.fullmatch(camera):
        raise ValueError(f"camera {camera!r} holds other characters than A-Z a-z 0-9 . _ -")
    if "/" in source or "\\" in source or source in ("", ".", ".."):
        raise ValueError(f"source {source!r} is not the name of a file")
    status = row["status"]
    if status not in set(FrameStatus):
        raise ValueError(f"status {status!r} is none of {', '.join(FrameStatus)}")
    if name in seen:
        raise ValueError(f"name {name!r} is there twice")
    seen.add(name)


def check_name(name: str) -> None:
    """ValueError unless the name is `<sequence>/<frame>.jpg` in plain characters: it stays in its folder."""
    if not _NAME.fullmatch(name) or any(part.startswith(".") for part in name.split("/")):
        raise ValueError(f"name {name!r} is not <sequence>/<frame>.jpg in plain characters")
