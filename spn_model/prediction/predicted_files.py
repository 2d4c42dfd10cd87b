"""Files of predicted poses: CSV written row by row, TUM, and WGS84 positions."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import IO

import numpy as np

from spn_data.errors import StageError
from spn_data.exports.tum import tum_text
from spn_data.geometry.geodesy import GeoOrigin
from spn_data.geometry.pose import Poses
from spn_data.geometry.rotations import angles_from_rotations, canonical_quats
from spn_data.storage.files import write_csv
from spn_model.models.pose_model import PoseEstimates
from spn_model.prediction.flights import FlightFrame

ESTIMATED, FAILED, UNREADABLE = "estimated", "failed", "unreadable"
_UPPER = np.triu_indices(6)
COLUMNS = (
    *("name", "time_s", "status", "reason", "x", "y", "z", "qw", "qx", "qy", "qz"),
    *("source", "video_frame"),
    *(f"cov_{i}{j}" for i, j in zip(*_UPPER, strict=True)),
)


@dataclass(eq=False)
class PoseRows:
    """N frames with their poses. status : ESTIMATED, FAILED (the image has no pose) or UNREADABLE.

    poses, covariance (N, 6, 6) : NaN where there is none, or it is unknown.
    """

    names: np.ndarray
    sequences: np.ndarray
    sources: np.ndarray
    video_frame: np.ndarray
    time_s: np.ndarray
    status: np.ndarray
    reason: np.ndarray
    poses: Poses
    covariance: np.ndarray

    @classmethod
    def unknown(cls, frames: Sequence[FlightFrame]) -> PoseRows:
        """Return rows of frames without poses."""
        n = len(frames)
        return cls(
            np.array([frame.name for frame in frames], dtype=object),
            np.array([frame.sequence for frame in frames], dtype=object),
            np.array([frame.source for frame in frames], dtype=object),
            np.array([frame.video_frame for frame in frames], dtype=np.int64),
            np.array([frame.time_s for frame in frames], dtype=np.float64),
            np.array(
                [UNREADABLE if f.image is None and not f.readable else FAILED for f in frames],
                dtype=object,
            ),
            np.array([frame.problem for frame in frames], dtype=object),
            Poses.unknown(n),
            np.full((n, 6, 6), np.nan),
        )

    def set_estimates(self, chosen: np.ndarray, estimates: PoseEstimates) -> None:
        """Store the estimates of some rows."""
        found = np.isfinite(estimates.poses.centers).all(axis=1)
        found &= np.isfinite(estimates.poses.quats_wxyz).all(axis=1)
        self.status[chosen] = np.where(found, ESTIMATED, FAILED)
        reasons = [str(reason) or "no pose was found" for reason in estimates.reasons]
        self.reason[chosen] = np.where(found, "", np.array(reasons, dtype=object))
        rows = chosen[found]
        self.poses.centers[rows] = estimates.poses.centers[found]
        self.poses.quats_wxyz[rows] = canonical_quats(estimates.poses.quats_wxyz[found])
        self.covariance[rows] = estimates.covariance[found]

    @classmethod
    def concatenate(cls, parts: Sequence[PoseRows]) -> PoseRows:
        """Concatenate rows in order."""
        if not parts:
            return cls.unknown([])
        columns = {
            f.name: np.concatenate([getattr(part, f.name) for part in parts])
            for f in fields(cls)
            if f.name != "poses"
        }
        return cls(**columns, poses=Poses.concatenate(part.poses for part in parts))

    def __len__(self) -> int:
        return len(self.names)

    def counts(self) -> dict[str, int]:
        """Return the number of frames by status."""
        return {s: int((self.status == s).sum()) for s in (ESTIMATED, FAILED, UNREADABLE)}

    def reasons(self) -> list[tuple[str, int]]:
        """Return the reasons for missing poses with their counts, most frequent first."""
        return Counter(self.reason[self.status != ESTIMATED].tolist()).most_common()


class PoseTable:
    """poses.csv, written batch by batch; keeps the rows for the other formats."""

    def __init__(self, path: Path):
        self._path = path
        self._parts: list[PoseRows] = []
        self._length = 0  # bytes of complete batches
        self._file: IO[bytes] | None = None

    def __enter__(self) -> PoseTable:
        with self._reporting_errors():
            self._file = self._path.open("wb")
            self._length = self._file.write(_lines([COLUMNS]))
        return self

    def __exit__(self, *error: object) -> None:
        assert self._file is not None
        with self._reporting_errors():
            self._file.close()

    def add(self, rows: PoseRows) -> None:
        """Append rows; raise StageError if the disk does not accept them."""
        assert self._file is not None
        poses = np.hstack([rows.poses.centers, rows.poses.quats_wxyz])
        covariance = rows.covariance[:, _UPPER[0], _UPPER[1]]
        content = _lines(
            [
                *(rows.names[k], _cell(rows.time_s[k]), rows.status[k], rows.reason[k]),
                *(_cell(value) for value in poses[k]),
                *(rows.sources[k], rows.video_frame[k]),
                *(_cell(value) for value in covariance[k]),
            ]
            for k in range(len(rows))
        )
        with self._reporting_errors():
            self._file.write(content)
            self._file.flush()
        self._parts.append(rows)
        self._length += len(content)

    def rows(self) -> PoseRows:
        """Return all rows, and cut off what an interrupted batch has left in the file."""
        assert self._file is not None
        with self._reporting_errors():
            self._file.flush()
            self._file.truncate(self._length)
        return PoseRows.concatenate(self._parts)

    @contextmanager
    def _reporting_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise StageError(f"{self._path} cannot be written: {error.strerror}") from error


def _lines(rows: Iterable[Sequence[object]]) -> bytes:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode("utf-8")


def tum_texts(rows: PoseRows, world: str) -> Iterator[tuple[str, str]]:
    """Yield the name of each flight with its trajectory as the content of a TUM file.

    Frames without a pose have no line, because the format cannot represent them.
    """
    for name in dict.fromkeys(rows.sequences.tolist()):
        mine = np.flatnonzero((rows.sequences == name) & (rows.status == ESTIMATED))
        yield name, tum_text(name, rows.time_s[mine], rows.poses[mine], world)


def write_wgs84(path: Path, rows: PoseRows, origin: GeoOrigin) -> None:
    """Write one row per frame: latitude, longitude, height, angles, standard deviations.

    Unknown values are empty.
    """
    found = rows.status == ESTIMATED
    places, angles = np.full((len(rows), 3), np.nan), np.full((len(rows), 3), np.nan)
    poses = rows.poses[np.flatnonzero(found)]
    places[found] = origin.wgs84_from_enu(poses.centers)
    angles[found] = angles_from_rotations(poses.rotations)
    variance = np.einsum("nii->ni", rows.covariance)[:, :3]
    sigma = np.sqrt(np.where(variance >= 0, variance, np.nan))
    columns: dict[str, list[str]] = {
        "name": rows.names.tolist(),
        "time_s": [_cell(value) for value in rows.time_s],
        "status": rows.status.tolist(),
        "reason": rows.reason.tolist(),
        "lat_deg": [_cell(value, 10) for value in places[:, 0]],
        "lon_deg": [_cell(value, 10) for value in places[:, 1]],
        "height_m": [_cell(value, 4) for value in places[:, 2]],
        "height_reference": [origin.height_reference.value] * len(rows),
        **{
            f"{name}_deg": [_cell(value, 4) for value in angles[:, k]]
            for k, name in enumerate(("heading", "pitch", "roll"))
        },
        **{
            f"sigma_{name}_m": [_cell(value, 4) for value in sigma[:, k]]
            for k, name in enumerate(("east", "north", "up"))
        },
    }
    write_csv(path, columns)


def _cell(value: float, digits: int | None = None) -> str:
    """Format a number; empty if unknown."""
    if not np.isfinite(value):
        return ""
    return repr(float(value)) if digits is None else f"{value:.{digits}f}"
