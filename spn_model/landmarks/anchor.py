"""Anchors: landmarks found in one image and followed by their patches, so that others need no features.

Patches are always those of the anchor, never of the image before, so what is followed does not drift.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import to_camera
from spn_data.matching.patches import track_points
from spn_model.landmarks.search import Candidate, Found, Hypothesis
from spn_model.landmarks.solver import Sightings, solve

_WINDOW_PX = 17
_LEVELS = 3  # of the pyramid: 80 px of error in the prediction
_ROUND_TRIP_PX = 0.3
_NOISE_PX = 0.2  # standard deviation that following adds to that of the anchor
_MAX_POINTS = 240
_MIN_POINTS = 60  # below which features are detected instead


@dataclass(frozen=True, eq=False)
class LandmarkAnchor:
    """Landmarks that agreed with the pose of an image, and the image.

    Attributes
    ----------
    gray : ndarray of uint8, shape (H, W)
        The image at the size that features are detected at.
    camera : Camera
        Of images of that size.
    seen : Sightings
        The landmarks.
    pixels : ndarray, shape (K, 2)
        Where they are in the image.
    half_view : ndarray, shape (2,)
        Tangents of half the field of view, with distortion.
    """

    gray: np.ndarray
    camera: Camera
    seen: Sightings
    pixels: np.ndarray
    half_view: np.ndarray

    @classmethod
    def of(
        cls, gray: np.ndarray, camera: Camera, candidate: Candidate, half_view: np.ndarray
    ) -> LandmarkAnchor:
        """Return the anchor of an image with its pose; the landmarks that agree best are kept."""
        off = (candidate.pose.residuals**2).sum(axis=1)
        rows = np.argsort(off, kind="stable")[: min(candidate.agreeing, _MAX_POINTS)]
        seen = candidate.seen.select(np.sort(rows))
        pixels = camera.project(np.column_stack([seen.at / seen.focal_px, np.ones(len(seen))]))
        return cls(gray, camera, seen, pixels, half_view)

    def follow(self, gray: np.ndarray, guess: Hypothesis) -> Found | None:
        """Find the pose of another image of the same size close to a predicted one.

        Parameters
        ----------
        gray : ndarray of uint8, shape (H, W)
        guess : Hypothesis

        Returns
        -------
        Found or None
            None if fewer than 60 patches, or half of those of the anchor, are found again.
        """
        expected = self.camera.project(to_camera(self.seen.xyz, guess.center, guess.rotation))
        there, found = track_points(
            self.gray,
            gray,
            self.pixels,
            expected,
            levels=_LEVELS,
            window_px=_WINDOW_PX,
            round_trip_px=_ROUND_TRIP_PX,
        )
        if np.count_nonzero(found) < max(_MIN_POINTS, len(found) / 2):
            return None
        kept = self.seen.select(found)
        seen = replace(
            kept,
            at=self.camera.unproject(there[found]) * kept.focal_px,
            sigma_px=np.hypot(kept.sigma_px, _NOISE_PX),
        )
        pose = solve(seen, guess.center, guess.rotation)
        return (
            None if pose is None else Found(Candidate(source=guess.source, pose=pose, seen=seen), 0)
        )
