"""Fixes of a flight: each image is searched for or followed, judged, and compared with those before it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_at_size
from spn_data.geometry.image_texture import missing_texture
from spn_data.geometry.pose import Poses
from spn_data.matching.features import extract
from spn_model.integrity.agreement import Agreement, MotionLimits
from spn_model.integrity.fix import Fix, FixSource, FixState, NoFix
from spn_model.integrity.judgement import IntegrityLimits, Judgement, Witness, judge
from spn_model.landmarks.landmark_map import LandmarkMap
from spn_model.landmarks.matching import ImageFeatures
from spn_model.landmarks.search import Candidate, Found, Hypothesis, follow, search, witness_of
from spn_model.landmarks.solver import KnownVertical
from spn_model.onboard.bundle import verified_landmarks
from spn_model.onboard.localizer import Localizer

_FORGET = 0.95  # weight of the images before, for each new one


@dataclass(frozen=True, kw_only=True)
class PilotOptions:
    """Options of a flight.

    Attributes
    ----------
    limits : IntegrityLimits
    motion : MotionLimits
    sequence : bool
        Whether images follow each other: poses are then followed, and published once they agree. Otherwise
        each image is searched for alone.
    network : bool
        Whether the network gives a hypothesis when an image is searched for.
    search_s : float
        Time after which an image is searched for independently although it could be followed.
    radius_px : float
        Search radius around predicted projections, plus `radius_px_s` for each second since the last fix.
    radius_px_s : float
    """

    limits: IntegrityLimits = field(default_factory=IntegrityLimits)
    motion: MotionLimits = field(default_factory=MotionLimits)
    sequence: bool = True
    network: bool = True
    search_s: float = 3.0
    radius_px: float = 30.0
    radius_px_s: float = 150.0


class Pilot:
    """Fixes of one camera with a bundle.

    Parameters
    ----------
    folder : Path
        Folder of a bundle with landmarks.
    camera : Camera
        Camera of the images.
    options : PilotOptions, optional
    int8 : bool
        Use the 8-bit graph of the network.
    threads : int
        Threads of the network.

    Raises
    ------
    InputError
        If the bundle has no landmarks.
    FormatError
        If the bundle is damaged.
    """

    def __init__(
        self,
        folder: Path,
        camera: Camera,
        options: PilotOptions | None = None,
        *,
        int8: bool = False,
        threads: int = 1,
    ):
        self.options = options or PilotOptions()
        self.camera = camera
        self.localizer = Localizer(folder, int8=int8, threads=threads)
        self.landmarks = LandmarkMap.load(verified_landmarks(self.localizer.bundle))
        self._agreement = Agreement(self.options.motion)
        self._offset = np.array(self.localizer.bundle.view.offset)
        self._last: tuple[int, np.ndarray, np.ndarray] | None = None  # time, centre, rotation
        self._velocity = np.zeros(3)
        self._searched_us = 0
        self._focal = np.zeros(2)  # weight, and weighted sum of the changes that images ask for

    def fix(
        self, image: np.ndarray, time_us: int, vertical: KnownVertical | None = None
    ) -> Fix | NoFix:
        """Localize an image.

        Parameters
        ----------
        image : ndarray, shape (H, W, 3)
            uint8, BGR.
        time_us : int
            Middle of the exposure; later than that of the last image.
        vertical : KnownVertical, optional
            Direction of up in the camera.

        Returns
        -------
        Fix or NoFix
            In sequences, only fixes of the state TRACK are usable.

        Raises
        ------
        InputError
            If the image has another aspect ratio than the camera.
        """
        begin = time.perf_counter()
        found, verdict, reason = self._found(image, time_us, vertical)
        if found is None or verdict is None or verdict.reason:
            if verdict is not None:
                reason = verdict.reason
            state = self._agreement.failed(time_us) if self.options.sequence else FixState.SEARCH
            return NoFix(
                time_us=time_us,
                state=state,
                reason=reason,
                processing_s=time.perf_counter() - begin,
            )
        pose = found.pose
        state = FixState.TRACK
        if self.options.sequence:
            sigma_m = float(np.sqrt(np.linalg.eigvalsh(verdict.covariance[:3, :3])[-1]))
            state = self._agreement.passed(time_us, pose.center, pose.rotation, sigma_m)
            if state in (FixState.COAST, FixState.LOST):
                return NoFix(
                    time_us=time_us,
                    state=state,
                    reason="the pose contradicts the motion since the last fix",
                    processing_s=time.perf_counter() - begin,
                )
            self._remember(time_us, pose.center, pose.rotation)
        shown = Poses.from_rotations((pose.center + self._offset)[None], pose.rotation[None])
        return Fix(
            time_us=time_us,
            center=shown.centers[0],
            quat_wxyz=shown.quats_wxyz[0],
            covariance=verdict.covariance,
            horizontal_protection_m=verdict.horizontal_m,
            vertical_protection_m=verdict.vertical_m,
            state=state,
            source=FixSource(found.source),
            quality=verdict.quality,
            processing_s=time.perf_counter() - begin,
        )

    def _found(
        self, image: np.ndarray, time_us: int, vertical: KnownVertical | None
    ) -> tuple[Candidate | None, Judgement | None, str]:
        """Return the best pose with its judgement, or why there is none."""
        lack = missing_texture(image)
        if lack:
            return None, None, lack
        features = self._features(image)
        guess = self._prediction(time_us)
        if guess is not None and time_us - self._searched_us < self.options.search_s * 1e6:
            found = follow(self.landmarks, features, guess)
            verdict = self._judged(found, features, vertical)
            if found is not None and verdict is not None and not verdict.reason:
                return found.best, verdict, ""
        self._searched_us = time_us
        guesses = [guess] if guess is not None else []
        found = search(self.landmarks, features, [*guesses, *self._from_network(image, vertical)])
        if found is None:
            return None, None, "too few landmarks agree on any pose"
        return found.best, self._judged(found, features, vertical), ""

    def _judged(
        self, found: Found | None, features: ImageFeatures, vertical: KnownVertical | None
    ) -> Judgement | None:
        if found is None:
            return None
        witness = witness_of(found, features, vertical)
        verdict = judge(witness, self.options.limits)
        reason = verdict.reason or (self._lens_over_time(witness) if self.options.sequence else "")
        return replace(verdict, reason=reason)

    def _lens_over_time(self, witness: Witness) -> str:
        """Return why the stated lens cannot be right, from all images so far that determine it together."""
        change, sigma = witness.focal_change
        weight = 1 / (sigma**2 + self.options.limits.focal_sigma**2)
        kept = np.array([weight, weight * change]) + _FORGET * self._focal
        self._focal = kept
        mean = kept[1] / kept[0]
        allowed = self.options.limits.max_focal_sigmas * max(
            kept[0] ** -0.5, self.options.limits.focal_sigma
        )
        if abs(mean) <= allowed:
            return ""
        return f"the landmarks of many images fit a focal length {100 * mean:+.1f} % from the stated one"

    def _features(self, image: np.ndarray) -> ImageFeatures:
        height, width = image.shape[:2]
        camera = camera_at_size(self.camera, width, height)
        options = self.landmarks.facts.features
        found = extract(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), None, options)
        return ImageFeatures.of(found, camera, options.max_image_size_px)

    def _from_network(self, image: np.ndarray, vertical: KnownVertical | None) -> list[Hypothesis]:
        if not self.options.network:
            return []
        located = self.localizer.localize(image, self.camera, vertical=vertical)
        if located.reason:
            return []
        center = located.poses.centers[0] - self._offset
        return [Hypothesis("network", center, located.poses.rotations[0])]

    def _prediction(self, time_us: int) -> Hypothesis | None:
        """Return the last pose moved on at the last velocity, while the localization is not lost."""
        if self._last is None or self._agreement.state not in (FixState.TRACK, FixState.COAST):
            return None
        since_s = (time_us - self._last[0]) * 1e-6
        radius = self.options.radius_px + self.options.radius_px_s * since_s
        return Hypothesis("track", self._last[1] + self._velocity * since_s, self._last[2], radius)

    def _remember(self, time_us: int, center: np.ndarray, rotation: np.ndarray) -> None:
        if self._last is not None and time_us > self._last[0]:
            between_s = (time_us - self._last[0]) * 1e-6
            if between_s < self.options.motion.coast_s:
                self._velocity = (center - self._last[1]) / between_s
            else:
                self._velocity = np.zeros(3)
        self._last = (time_us, center, rotation)
