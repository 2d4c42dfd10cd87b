"""Fixes as JSON lines and as CSV: one line an image, also of those without a fix, with the reason."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import IO, Any

import numpy as np

from spn_data.errors import InputError
from spn_model.autopilot.datum import Datum
from spn_model.autopilot.frames import Mounting
from spn_model.autopilot.ros2 import Ros2Writer
from spn_model.integrity.fix import Fix, NoFix

_UPPER = list(zip(*np.triu_indices(6), strict=True))
COLUMNS = (
    *("time_us", "state", "usable", "source", "reason", "x", "y", "z", "qw", "qx", "qy", "qz"),
    *("lat_deg", "lon_deg", "ellipsoid_m", "amsl_m"),
    *("horizontal_sigma_m", "vertical_sigma_m"),
    *("horizontal_protection_m", "vertical_protection_m", "quality", "processing_s"),
    *(f"cov_{i}{j}" for i, j in _UPPER),
)


def plain(item: Fix | NoFix, datum: Datum | None) -> dict[str, Any]:
    """Return a result as plain values for JSON; what is unknown is None. The pose is the camera's."""
    values: dict[str, Any] = {
        "time_us": item.time_us,
        "state": item.state.value,
        "usable": isinstance(item, Fix) and item.usable,
        "source": None,
        "reason": "",
        "center": None,
        "quat_wxyz": None,
        "lat_deg": None,
        "lon_deg": None,
        "ellipsoid_m": None,
        "amsl_m": None,
        "covariance": None,
        "horizontal_sigma_m": None,
        "vertical_sigma_m": None,
        "horizontal_protection_m": None,
        "vertical_protection_m": None,
        "quality": None,
        "processing_s": item.processing_s,
    }
    if isinstance(item, NoFix):
        return {**values, "reason": item.reason}
    values |= {
        "source": item.source.value,
        "center": item.center.tolist(),
        "quat_wxyz": item.quat_wxyz.tolist(),
        "covariance": item.covariance.tolist(),
        "horizontal_sigma_m": item.horizontal_sigma_m,
        "vertical_sigma_m": item.vertical_sigma_m,
        "horizontal_protection_m": item.horizontal_protection_m,
        "vertical_protection_m": item.vertical_protection_m,
        "quality": item.quality,
    }
    if datum is not None:
        place = datum.geodetic(item.center)
        for name in ("lat_deg", "lon_deg", "ellipsoid_m", "amsl_m"):
            value = getattr(place, name)
            values[name] = value if math.isfinite(value) else None
    return values


class _TextWriter:
    """Writes one line for each result, and none of it is held back."""

    def __init__(self, path: Path, datum: Datum | None):
        self._path, self._datum = path, datum
        try:
            self._file: IO[str] = path.open("x", encoding="utf-8", newline="")
        except FileExistsError as error:
            raise InputError(
                "already exists; choose another file for the fixes", path=path
            ) from error
        except OSError as error:
            raise InputError(f"cannot be written: {error.strerror}", path=path) from error

    def close(self) -> None:
        """Close the file."""
        self._guard(self._file.close)

    def _guard(self, action: Any, *values: Any) -> None:
        try:
            action(*values)
        except OSError as error:
            raise InputError(f"cannot be written: {error.strerror}", path=self._path) from error


class JsonLinesWriter(_TextWriter):
    """Writes JSON lines; unknown values are null."""

    def send(self, item: Fix | NoFix) -> None:
        """Write one line."""
        line = json.dumps(plain(item, self._datum), allow_nan=False)
        self._guard(self._file.write, line + "\n")
        self._guard(self._file.flush)


class CsvWriter(_TextWriter):
    """Writes CSV with the header `COLUMNS`; unknown values are empty, the covariance its upper triangle."""

    def __init__(self, path: Path, datum: Datum | None):
        super().__init__(path, datum)
        self._rows = csv.writer(self._file, lineterminator="\n")
        self._guard(self._rows.writerow, COLUMNS)

    def send(self, item: Fix | NoFix) -> None:
        """Write one line."""
        values = plain(item, self._datum)
        if isinstance(item, Fix):
            values |= dict(zip("xyz", values["center"], strict=True))
            values |= dict(zip(("qw", "qx", "qy", "qz"), values["quat_wxyz"], strict=True))
            values |= {f"cov_{i}{j}": values["covariance"][i][j] for i, j in _UPPER}
        self._guard(self._rows.writerow, [_cell(values.get(name)) for name in COLUMNS])
        self._guard(self._file.flush)


def open_writer(
    path: Path, *, datum: Datum | None, mounting: Mounting, coast_s: float = 0.5
) -> JsonLinesWriter | CsvWriter | Ros2Writer:
    """Open a file of fixes by its suffix: `.jsonl`, `.csv`, or none for the folder of a ROS 2 bag.

    Parameters
    ----------
    path : Path
        File or folder that does not exist yet.
    datum : Datum or None
        Where the world is on the Earth; None if unknown.
    mounting : Mounting
        Of the camera in the body; used by a bag.
    coast_s : float
        Age of the last fix up to which a bag gets predictions.

    Returns
    -------
    JsonLinesWriter, CsvWriter or Ros2Writer
        Call `send` for each image, then `close`.

    Raises
    ------
    InputError
        If the path exists, or has another suffix.
    """
    if path.suffix == ".jsonl":
        return JsonLinesWriter(path, datum)
    if path.suffix == ".csv":
        return CsvWriter(path, datum)
    if path.suffix == "":
        return Ros2Writer(path, mounting=mounting, datum=datum, coast_s=coast_s)
    raise InputError(
        "no file of fixes: name it .jsonl, .csv, or a folder for a ROS 2 bag", path=path
    )


def _cell(value: Any) -> Any:
    if value is None:
        return ""
    return int(value) if isinstance(value, bool) else value
