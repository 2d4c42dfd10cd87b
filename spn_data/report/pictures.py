"""What the page draws of networks and images: estimated poses, and small images of the frames."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from spn_data.coverage.nearest_frame import CoverageOptions, nearest_frames
from spn_data.geometry.pose import Poses
from spn_data.report.data import FrameTable
from spn_data.report.ground_texture import GroundTexture
from spn_data.report.pack import pack, pack_texts
from spn_data.split.groups import TRAIN

COARSE = "coarse"  # the network alone
TRACK = "track"  # the way of fixing that a flight uses: image after image
_SAME = 1e-3  # in the world's unit: cells are rounded to a tenth of it
_WORST = 3  # frames of each flight and network
# Without limits, the nearest frame is the one with the smallest sum of distance and angle.
_NEAREST = CoverageOptions(high_m=np.inf, high_deg=np.inf, medium_m=np.inf, medium_deg=np.inf)


@dataclass(frozen=True, eq=False)
class RunEstimates:
    """Poses that one way to localize gave for N frames.

    Attributes
    ----------
    run : str
        Name of the run.
    method : str
        `COARSE` for the network alone, otherwise that of fixes of its bundle, such as "search".
    names : ndarray of str, shape (N,)
        Frames, each once.
    poses : Poses
        NaN where there is no pose, or no usable fix.
    error, error_deg : ndarray, shape (N,)
        Errors against the label; NaN where unknown.
    reasons : ndarray of str, shape (N,)
        Why there is no usable fix.
    """

    run: str
    method: str
    names: np.ndarray
    poses: Poses
    error: np.ndarray
    error_deg: np.ndarray
    reasons: np.ndarray

    @property
    def located(self) -> np.ndarray:
        """Mask (N,) of the frames with an estimated pose."""
        return np.isfinite(self.poses.centers).all(axis=1)


@dataclass(frozen=True, kw_only=True)
class WorstFrame:
    """A frame of a flight with one of the largest errors of a network.

    Attributes
    ----------
    run, sequence, name : str
    error, error_deg : float
        Of the network's pose.
    nearest : str
        Training frame nearest to the true pose.
    distance, angle_deg : float
        From the true pose to that frame.
    taken_for : str
        Training frame nearest to the estimated pose.
    """

    run: str
    sequence: str
    name: str
    error: float
    error_deg: float
    nearest: str
    distance: float
    angle_deg: float
    taken_for: str


@dataclass(frozen=True, eq=False, kw_only=True)
class Pictures:
    """Estimates and images of a page.

    Attributes
    ----------
    estimates : tuple of RunEstimates
    worst : tuple of WorstFrame
        Of these estimates.
    thumbnails : mapping of str to bytes
        JPEG files by frame.
    files : mapping of str to str
        Full images by frame: paths relative to the page.
    ground : GroundTexture or None
    notes : tuple of str
        What is missing, and why.
    """

    estimates: tuple[RunEstimates, ...] = ()
    worst: tuple[WorstFrame, ...] = ()
    thumbnails: Mapping[str, bytes] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    ground: GroundTexture | None = None
    notes: tuple[str, ...] = ()


def with_image(frames: FrameTable) -> np.ndarray:
    """Return the mask (N,) of frames whose images are stored in the area."""
    return ~frames.tracked & (frames.tried | (frames.status == "chosen"))


def fits_labels(frames: FrameTable, one: RunEstimates) -> bool:
    """Return whether errors against the labels are those that the evaluation found: of the same map."""
    row = {name: k for k, name in enumerate(frames.names.tolist())}
    both = [(k, row[name]) for k, name in enumerate(one.names.tolist()) if name in row]
    if not both:
        return False
    k, i = np.array(both).T
    distance = np.linalg.norm(one.poses.centers[k] - frames.poses.centers[i], axis=1)
    off = np.abs(distance - one.error[k])
    return not bool((off[np.isfinite(off)] > _SAME).any())


def worst_frames(frames: FrameTable, estimates: tuple[RunEstimates, ...]) -> tuple[WorstFrame, ...]:
    """Return the frames of each flight with the largest errors of each network, the worst first.

    Parameters
    ----------
    frames : FrameTable
    estimates : tuple of RunEstimates
        Only those of networks alone count.

    Returns
    -------
    tuple of WorstFrame
        Only frames that have a label, an estimate and a stored image; training frames beside them too.
    """
    shown = with_image(frames) & frames.registered
    training = np.flatnonzero(shown & (frames.group == TRAIN))
    if not len(training):
        return ()
    found = []
    for one in estimates:
        if one.method != COARSE:
            continue
        of = {name: k for k, name in enumerate(one.names.tolist())}
        for sequence in np.unique(frames.sequences[frames.evaluation]).tolist():
            mine = np.flatnonzero(shown & frames.evaluation & (frames.sequences == sequence))
            pairs = [(of[n], i) for i in mine.tolist() if (n := str(frames.names[i])) in of]
            judged = [(k, i) for k, i in pairs if one.located[k] and np.isfinite(one.error[k])]
            judged.sort(key=lambda pair: -one.error[pair[0]])
            for k, i in judged[:_WORST]:
                found.append(_worst(frames, training, one, k, i))
    return tuple(found)


def _worst(
    frames: FrameTable, training: np.ndarray, one: RunEstimates, k: int, i: int
) -> WorstFrame:
    """Describe frame i, of which k is the estimate."""
    both = Poses.concatenate([frames.poses[i : i + 1], one.poses[k : k + 1]])
    near = nearest_frames(both, frames.poses[training], _NEAREST)
    nearest, taken_for = (str(frames.names[training[row]]) for row in near.frame)
    return WorstFrame(
        run=one.run,
        sequence=str(frames.sequences[i]),
        name=str(frames.names[i]),
        error=float(one.error[k]),
        error_deg=float(one.error_deg[k]),
        nearest=nearest,
        distance=float(near.distance[0]),
        angle_deg=float(near.angle_deg[0]),
        taken_for=taken_for,
    )


def pack_pictures(pictures: Pictures, frames: FrameTable) -> dict[str, Any]:
    """Pack estimates and images of the frames of a page for its script."""
    rows = {name: row for row, name in enumerate(frames.names.tolist())}
    is_training = frames.group == TRAIN
    packed = []
    for one in pictures.estimates:
        row_of = np.array([rows.get(name, -1) for name in one.names.tolist()])
        keep = (row_of >= 0) & ~is_training[row_of]
        if not keep.any():
            continue
        packed.append(
            {
                "run": one.run,
                "method": one.method,
                "row": pack(row_of[keep], "i4"),
                "center": pack(one.poses.centers[keep], "f4"),
                "quat": pack(one.poses.quats_wxyz[keep], "f4"),
                "error": pack(one.error[keep], "f4"),
                "error_deg": pack(one.error_deg[keep], "f4"),
                "reason": pack_texts(one.reasons[keep]),
            }
        )
    images = {name: image for name, image in pictures.thumbnails.items() if name in rows}
    return {
        "estimates": packed,
        "ground": None if pictures.ground is None else pictures.ground.to_json(),
        "images": {rows[n]: base64.b64encode(i).decode("ascii") for n, i in images.items()},
        "files": {rows[n]: path for n, path in pictures.files.items() if n in rows},
    }
