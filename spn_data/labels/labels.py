"""Labels (poses of frames in a frozen map, with covariance) and their observations.

Labels are stored as poses.csv, observations as observations.npz.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.capture.frames import Frames, check_name
from spn_data.errors import InputError
from spn_data.geometry.pose import Poses, Similarity
from spn_data.geometry.rotations import canonical_quats
from spn_data.storage.array_files import ARRAY_DAMAGE
from spn_data.storage.files import atomic_writer, read_csv, write_csv

_MAX_CSV_BYTES = 2_000_000_000
_UPPER = np.triu_indices(6)


class LabelStatus(StrEnum):
    """Whether a frame has a pose."""

    REGISTERED = "registered"
    FAILED = "failed"


@dataclass(frozen=True, eq=False)
class Labels:
    """Labels of N frames of one kind, sorted by sequence and time; numbers of frames without a pose are NaN.

    Attributes
    ----------
    names : ndarray of str, shape (N,)
        `<sequence>/<frame>.jpg`; unique.
    sequences, cameras : ndarray of str, shape (N,)
        Sequence, and key of the camera.
    sources : ndarray of str, shape (N,)
        Name of the file that the frame is from.
    video_frame : ndarray of int, shape (N,)
        Index among the decoded frames of the video, -1 for a photo.
    tracked : ndarray of bool, shape (N,)
        Tracked frames, whose pixels are read from the video; chosen frames have a stored image.
    time_s : ndarray, shape (N,)
        Seconds since the sequence's first frame.
    status : ndarray of str, shape (N,)
        A `LabelStatus`.
    reason : ndarray of str, shape (N,)
        Why the frame failed; empty for registered frames.
    poses : Poses
        N poses in the map's frame (East-North-Up metres once georeferenced).
    covariance : ndarray, shape (N, 6, 6)
        Relative to the map, over the centre (east, north, up; metres) and a rotation vector v in the camera
        frame (radians): R_true = exp(v) @ R.
    inliers : ndarray of int, shape (N,)
        Number of map points that agree with the pose.
    coverage : ndarray, shape (N,)
        Share of the image that these points cover.
    error_px : ndarray, shape (N,)
        Root mean square of their reprojection errors.
    """

    names: np.ndarray
    sequences: np.ndarray
    cameras: np.ndarray
    sources: np.ndarray
    video_frame: np.ndarray
    tracked: np.ndarray
    time_s: np.ndarray
    status: np.ndarray
    reason: np.ndarray
    poses: Poses
    covariance: np.ndarray
    inliers: np.ndarray
    coverage: np.ndarray
    error_px: np.ndarray

    def __post_init__(self) -> None:
        n = len(self.names)
        for column in fields(self):
            if len(getattr(self, column.name)) != n:
                raise ValueError(
                    f"{column.name} has {len(getattr(self, column.name))} rows, not {n}"
                )
        if len(set(self.names.tolist())) != n:
            raise ValueError("frame names are not unique")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def registered(self) -> np.ndarray:
        """Mask (N,) of frames with a pose."""
        return self.status == LabelStatus.REGISTERED

    def select(self, index: np.ndarray) -> Labels:
        """Return the rows of an index or mask (N,)."""
        return replace(self, **{f.name: getattr(self, f.name)[index] for f in fields(self)})

    @classmethod
    def of_frames(
        cls,
        frames: Frames,
        poses: Poses,
        *,
        tracked: bool,
        reason: Sequence[str],
        covariance: np.ndarray,
        inliers: np.ndarray,
        coverage: np.ndarray,
        error_px: np.ndarray,
    ) -> Labels:
        """Return labels of N frames; frames with a finite pose are registered, the others failed.

        Parameters
        ----------
        frames : Frames
            The N frames.
        poses : Poses
            N poses, NaN for failed frames.
        tracked : bool
            Whether these are tracked frames.
        reason, covariance, inliers, coverage, error_px
            As in the attributes of `Labels`.

        Returns
        -------
        Labels
        """
        registered = np.isfinite(poses.centers).all(axis=1)
        return cls(
            names=frames.names,
            sequences=frames.sequences,
            cameras=frames.cameras,
            sources=frames.sources,
            video_frame=frames.video_frame,
            tracked=np.full(len(frames), tracked),
            time_s=frames.time_s,
            status=np.where(registered, LabelStatus.REGISTERED.value, LabelStatus.FAILED.value),
            reason=np.array(reason, dtype=np.str_),
            poses=poses,
            covariance=covariance,
            inliers=inliers,
            coverage=coverage,
            error_px=error_px,
        )

    @classmethod
    def concatenate(cls, parts: list[Labels]) -> Labels:
        """Return the rows of all parts in order."""
        if not parts:
            raise ValueError("no labels to concatenate")
        values: dict[str, Any] = {
            f.name: np.concatenate([getattr(p, f.name) for p in parts])
            for f in fields(cls)
            if f.name != "poses"
        }
        return cls(**values, poses=Poses.concatenate(p.poses for p in parts))

    def transformed(self, b_from_a: Similarity) -> Labels:
        """Return the same labels in another frame of the same map, with covariances propagated.

        Parameters
        ----------
        b_from_a : Similarity
            From the present frame to the other.
        """
        has = np.flatnonzero(self.registered)
        poses = b_from_a.apply_to_poses(self.poses[has]).at_rows(has, len(self))
        jacobian = np.eye(6)  # rotation vectors in the camera frame do not change
        jacobian[:3, :3] = b_from_a.scale * b_from_a.rotation
        covariance = jacobian @ self.covariance @ jacobian.T
        return replace(self, poses=poses, covariance=covariance)


def pose_sigmas(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return standard deviations of position and rotation.

    Parameters
    ----------
    covariance : ndarray, shape (N, 6, 6)
        As in `Labels`.

    Returns
    -------
    sigma : ndarray, shape (N,)
        Square root of the trace of the position block, in the map's unit.
    sigma_deg : ndarray, shape (N,)
        Square root of the trace of the rotation block, in degrees.
    """
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    sigma, sigma_rad = (np.sqrt(part.sum(axis=1)) for part in np.split(variances, 2, axis=1))
    return sigma, np.rad2deg(sigma_rad)


@dataclass(frozen=True, eq=False)
class LabelObservations:
    """M observations of map points in N labelled frames, sorted by frame.

    Attributes
    ----------
    frame_idx : ndarray of int, shape (M,)
        Row of the frame in its `Labels`.
    point_ids : ndarray of int, shape (M,)
        COLMAP's point ids in the map.
    pixels : ndarray, shape (M, 2)
        Keypoints in COLMAP's pixel convention, in the frame's own (distorted) image.
    """

    frame_idx: np.ndarray
    point_ids: np.ndarray
    pixels: np.ndarray

    def __post_init__(self) -> None:
        if not len(self.frame_idx) == len(self.point_ids) == len(self.pixels):
            raise ValueError("observations of points differ in length")
        if np.any(np.diff(self.frame_idx) < 0):
            raise ValueError("observations are not sorted by frame")

    def of_frame(self, row: int) -> tuple[np.ndarray, np.ndarray]:
        """Return point ids (K,) and pixels (K, 2) of the frame at a row."""
        first, last = np.searchsorted(self.frame_idx, [row, row + 1])
        return self.point_ids[first:last], self.pixels[first:last]

    def select(self, rows: np.ndarray) -> LabelObservations:
        """Return the observations of the frames at `rows`, renumbered in that order."""
        starts = np.searchsorted(self.frame_idx, rows)
        ends = np.searchsorted(self.frame_idx, rows, side="right")
        index = np.concatenate(
            [np.arange(a, b) for a, b in zip(starts, ends, strict=True)] or [np.zeros(0, np.int64)]
        ).astype(np.int64)
        frame_idx = np.repeat(np.arange(len(rows)), ends - starts)
        return LabelObservations(frame_idx, self.point_ids[index], self.pixels[index])


_POSE_COLUMNS = ["x", "y", "z", "qw", "qx", "qy", "qz"]
_COVARIANCE_COLUMNS = [f"cov_{i}{j}" for i, j in zip(*_UPPER, strict=True)]
_COLUMNS = [
    *("name", "time_s", "status", "reason", *_POSE_COLUMNS, "inliers", "coverage", "error_px"),
    *("camera", "source", "video_frame", "dense"),
    *_COVARIANCE_COLUMNS,
]


def write_labels(path: Path, labels: Labels) -> None:
    """Write labels as poses.csv (docs/formats.md), atomically.

    Raises
    ------
    StageError
        If the file cannot be written.
    """
    poses = np.concatenate([labels.poses.centers, labels.poses.quats_wxyz], axis=1)
    covariance = labels.covariance[:, _UPPER[0], _UPPER[1]]
    columns: dict[str, list[object]] = {
        "name": labels.names.tolist(),
        "time_s": [repr(t) for t in labels.time_s.tolist()],
        "status": labels.status.tolist(),
        "reason": labels.reason.tolist(),
        **{name: _cells(poses[:, k]) for k, name in enumerate(_POSE_COLUMNS)},
        "inliers": labels.inliers.tolist(),
        "coverage": _cells(labels.coverage),
        "error_px": _cells(labels.error_px),
        "camera": labels.cameras.tolist(),
        "source": labels.sources.tolist(),
        "video_frame": labels.video_frame.tolist(),
        "dense": labels.tracked.astype(np.int64).tolist(),
        **{name: _cells(covariance[:, k]) for k, name in enumerate(_COVARIANCE_COLUMNS)},
    }
    write_csv(path, {name: columns[name] for name in _COLUMNS})


def read_labels(path: Path) -> Labels:
    """Read labels from poses.csv.

    Raises
    ------
    InputError
        If the file is not as written by `write_labels`; with the line if known.
    """
    table = read_csv(path, _COLUMNS, max_bytes=_MAX_CSV_BYTES)
    rows = [_parse(path, line, row) for line, row in table]
    try:
        return _labels_of(rows)
    except ValueError as error:
        raise InputError(str(error), path=path) from error


def _parse(path: Path, line: int, row: dict[str, Any]) -> dict[str, Any]:
    try:
        check_name(row["name"])
        if row["status"] not in set(LabelStatus):
            raise ValueError(f"status {row['status']!r} is none of {', '.join(LabelStatus)}")
        if "/" in row["source"] or "\\" in row["source"] or row["source"] in ("", ".", ".."):
            raise ValueError(f"source {row['source']!r} is not the name of a file")
        row["pose"] = [_number(row[c]) for c in _POSE_COLUMNS]
        row["covariance"] = [_number(row[c]) for c in _COVARIANCE_COLUMNS]
        if row["status"] == LabelStatus.REGISTERED:
            if not np.isfinite(row["pose"]).all():
                raise ValueError("a registered frame has no pose")
            row["pose"][3:] = canonical_quats(np.array(row["pose"][3:])).tolist()
        elif np.isfinite(row["pose"]).any():
            raise ValueError("a failed frame has a pose")
        for column in ("inliers", "video_frame", "dense"):
            row[column] = int(row[column])
        for column in ("time_s", "coverage", "error_px"):
            row[column] = _number(row[column])
    except ValueError as error:
        raise InputError(str(error), path=path, line=line) from error
    return row


def _labels_of(rows: list[dict[str, Any]]) -> Labels:
    def strings(column: str) -> np.ndarray:
        return np.array([row[column] for row in rows], dtype=np.str_)

    def numbers(column: str, dtype: Any) -> np.ndarray:
        return np.array([row[column] for row in rows], dtype=dtype)

    names = strings("name")
    poses = numbers("pose", np.float64).reshape(-1, 7)
    covariance = np.zeros((len(rows), 6, 6))
    covariance[:, _UPPER[0], _UPPER[1]] = numbers("covariance", np.float64).reshape(-1, 21)
    covariance[:, _UPPER[1], _UPPER[0]] = covariance[:, _UPPER[0], _UPPER[1]]
    return Labels(
        names=names,
        sequences=np.array([name.split("/")[0] for name in names.tolist()], dtype=np.str_),
        cameras=strings("camera"),
        sources=strings("source"),
        video_frame=numbers("video_frame", np.int64),
        tracked=numbers("dense", np.int64) != 0,
        time_s=numbers("time_s", np.float64),
        status=strings("status"),
        reason=strings("reason"),
        poses=Poses(poses[:, :3], poses[:, 3:]),
        covariance=covariance,
        inliers=numbers("inliers", np.int64),
        coverage=numbers("coverage", np.float64),
        error_px=numbers("error_px", np.float64),
    )


def _cells(values: np.ndarray) -> list[object]:
    return ["" if np.isnan(v) else repr(v) for v in values.tolist()]


def _number(cell: str) -> float:
    if cell == "":
        return float("nan")
    value = float(cell)
    if not abs(value) <= 1e15:
        raise ValueError(f"{cell!r} is not a finite number")
    return value


def write_label_observations(path: Path, seen: LabelObservations) -> None:
    """Write observations as observations.npz (plain arrays), atomically.

    Raises
    ------
    StageError
        If the file cannot be written.
    """
    with atomic_writer(path) as file:
        np.savez_compressed(
            file,
            frame_idx=seen.frame_idx.astype(np.int64),
            point_ids=seen.point_ids.astype(np.int64),
            pixels=seen.pixels.astype(np.float64),
        )


def read_label_observations(path: Path) -> LabelObservations:
    """Read observations.npz; pickled data is refused.

    Raises
    ------
    InputError
        If the file is not as written by `write_label_observations`.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            seen = LabelObservations(arrays["frame_idx"], arrays["point_ids"], arrays["pixels"])
    except ARRAY_DAMAGE as error:
        raise InputError(f"is not an observations file ({error})", path=path) from error
    if seen.pixels.shape != (len(seen.frame_idx), 2):
        raise InputError("is not an observations file (shapes differ)", path=path)
    return seen
