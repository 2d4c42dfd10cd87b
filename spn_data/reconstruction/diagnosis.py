"""Result of a reconstruction for each frame, and the reasons for missing frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.colmap.database import MapDatabase
from spn_data.colmap.model import MapObservations, Scene
from spn_data.geometry.grouping import runs_of
from spn_data.reconstruction.correspondences import FramesToMap


@dataclass(frozen=True)
class FrameRegistration:
    """Result for one frame.

    Attributes
    ----------
    name : str
    registered : bool
    reason : str
        Why it is missing; empty if it is registered.
    keypoints : int
    verified_pairs : int
    observations : int
        Number of observed points of the model.
    error_px : float
        Mean reprojection error; NaN if it is not registered.
    """

    name: str
    registered: bool
    reason: str
    keypoints: int
    verified_pairs: int
    observations: int
    error_px: float


def diagnose(
    database: MapDatabase, frames: FramesToMap, scene: Scene, seen: MapObservations
) -> tuple[FrameRegistration, ...]:
    """Return the result for each frame, and for missing frames the reason."""
    position = {name: k for k, name in enumerate(scene.names)}
    partners: dict[str, dict[str, int]] = {name: {} for name in frames.names}
    for (a, b), inliers in database.verified_pairs().items():
        partners[a][b] = inliers
        partners[b][a] = inliers
    errors = np.linalg.norm(seen.residuals_px, axis=1)
    counts = np.bincount(seen.image_idx, minlength=len(scene.names))
    sums = np.bincount(seen.image_idx, errors, minlength=len(scene.names))
    rows = []
    for name in frames.names:
        keypoints = database.num_keypoints(name)
        k = position.get(name)
        reason = "" if k is not None else _why_missing(keypoints, partners[name], position)
        observations = 0 if k is None else int(counts[k])
        error = float("nan") if k is None or counts[k] == 0 else float(sums[k] / counts[k])
        rows.append(
            FrameRegistration(
                name, k is not None, reason, keypoints, len(partners[name]), observations, error
            )
        )
    return tuple(rows)


def _why_missing(keypoints: int, partners: dict[str, int], registered: dict[str, int]) -> str:
    if keypoints < 100:
        return f"only {keypoints} features: blurred, dark or without texture"
    if not partners:
        return f"{keypoints} features, but no verified match with any frame"
    inside = {name: inliers for name, inliers in partners.items() if name in registered}
    if not inside:
        best = max(partners, key=lambda name: partners[name])
        return (
            f"matches {len(partners)} frames (best {best}, {partners[best]} inliers), "
            "all of them missing too"
        )
    best = max(inside, key=lambda name: inside[name])
    return (
        f"matches {len(inside)} registered frames (best {best}, {inside[best]} inliers), "
        "but no pose agrees with the model's points"
    )


def missing_passages(
    registrations: tuple[FrameRegistration, ...], sequences: np.ndarray, time_s: np.ndarray
) -> tuple[str, ...]:
    """Describe each run of missing frames in a sequence: when, how many, and the most frequent reason.

    Parameters
    ----------
    registrations : tuple of FrameRegistration
        Of N frames.
    sequences : ndarray, shape (N,), str
    time_s : ndarray, shape (N,)

    Returns
    -------
    tuple of str
        One sentence per run.
    """
    sentences = []
    for sequence in dict.fromkeys(sequences.tolist()):
        rows = np.flatnonzero(sequences == sequence)
        missing = np.array([not registrations[i].registered for i in rows])
        for start, end in zip(*runs_of(missing), strict=True):
            run = rows[start:end]
            reasons = [registrations[i].reason for i in run]
            common = max(set(reasons), key=reasons.count)
            sentences.append(
                f"{sequence}, {time_s[run[0]]:.1f} to {time_s[run[-1]]:.1f} s: {len(run)} of "
                f"{len(rows)} frames are missing; {common}"
            )
    return tuple(sentences)
