"""Fixes of a flight: each image is searched for or followed, judged, and compared with those before it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from spn_data.geometry.camera import Camera
from spn_data.geometry.camera_file import camera_at_size
from spn_data.geometry.image_texture import missing_texture
from spn_data.geometry.pose import Poses, interpolate_pose
from spn_data.matching.features import Features, reduced
from spn_model.integrity.agreement import Agreement, MotionLimits
from spn_model.integrity.fix import Fix, FixSource, FixState, NoFix
from spn_model.integrity.height import HeightErrors, HeightZero
from spn_model.integrity.judgement import IntegrityLimits, Judgement, Witness, judge
from spn_model.landmarks.aids import KnownHeight, KnownVertical
from spn_model.landmarks.anchor import LandmarkAnchor
from spn_model.landmarks.landmark_map import LandmarkMap
from spn_model.landmarks.matching import ImageFeatures
from spn_model.landmarks.search import (
    Candidate,
    Found,
    HasView,
    Hypothesis,
    follow,
    search,
    witness_of,
)
from spn_model.landmarks.sift import Sift
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
    anchor_s : float
        Time for which the landmarks of an image are followed by their patches before features are detected
        again.
    sure_share : float
        Share of the landmarks found near their projections that must agree with a pose that is followed. If
        fewer do, as in an image blurred by motion, the image must give the pose without the prediction.
    radius_px : float
        Search radius around predicted projections, plus `radius_px_s` for each second since the last fix.
    radius_px_s : float
    height : HeightErrors
        Of a known height.
    """

    limits: IntegrityLimits = field(default_factory=IntegrityLimits)
    motion: MotionLimits = field(default_factory=MotionLimits)
    sequence: bool = True
    network: bool = True
    search_s: float = 3.0
    anchor_s: float = 1.0
    sure_share: float = 0.65
    radius_px: float = 30.0
    radius_px_s: float = 150.0
    height: HeightErrors = field(default_factory=HeightErrors)


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

    Attributes
    ----------
    steps_s : dict of str to float
        Time that each step of the last image took.
    focal_bound : float
        Bound of the relative error of the stated focal length, by the images of the sequence so far.
    height : HeightZero
        Zero of the known heights, as the usable fixes so far tell it.
    extract : callable
        Returns the features of a grey image; benchmarks replace it.

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
        self.extract: Callable[[np.ndarray], Features] = Sift(self.landmarks.facts.features).extract
        self._agreement = Agreement(self.options.motion)
        self._offset = np.array(self.localizer.bundle.view.offset)
        self.steps_s: dict[str, float] = {}
        self._passed: list[
            tuple[float, Poses]
        ] = []  # the last two poses that passed, with their times
        self._anchor: tuple[int, LandmarkAnchor] | None = None  # with its time
        self._searched_us = 0
        self.height = HeightZero(self.options.height)
        self._height: KnownHeight | None = None  # of the present image, without the offset
        self._focal = np.zeros(2)  # weight, and weighted sum of the changes that images ask for
        self.focal_bound = np.inf

    def fix(
        self,
        image: np.ndarray,
        time_us: int,
        vertical: KnownVertical | None = None,
        height_m: float | None = None,
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
        height_m : float, optional
            Up of the camera in the world by a barometer, whose zero may be wrong.

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
        self.steps_s = {}
        self._height = self._expected_height(height_m, time_us)
        found, verdict, reason = self._found(image, time_us, vertical)
        if found is None or verdict is None or verdict.reason:
            if verdict is not None:
                reason = verdict.reason
            state = self._agreement.failed(time_us) if self.options.sequence else FixState.SEARCH
            if state is FixState.LOST:
                self.height.reset()
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
                self._anchor = None
                if state is FixState.LOST:
                    self.height.reset()
                return NoFix(
                    time_us=time_us,
                    state=state,
                    reason="the pose contradicts the motion since the last fix",
                    processing_s=time.perf_counter() - begin,
                )
            self._remember(time_us, Poses.from_rotations(pose.center[None], pose.rotation[None]))
        shown = Poses.from_rotations((pose.center + self._offset)[None], pose.rotation[None])
        if height_m is not None and self.options.sequence and state is FixState.TRACK:
            sigma_m = float(np.sqrt(verdict.covariance[2, 2]))
            self.height.learn(height_m, time_us, float(shown.centers[0, 2]), sigma_m)
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

    def _expected_height(self, height_m: float | None, time_us: int) -> KnownHeight | None:
        if height_m is None:
            return None
        up_m, sigma_m = self.height.expected(height_m, time_us)
        return KnownHeight(up_m=up_m - float(self._offset[2]), sigma_m=sigma_m)

    def _found(
        self, image: np.ndarray, time_us: int, vertical: KnownVertical | None
    ) -> tuple[Candidate | None, Judgement | None, str]:
        """Return the best pose with its judgement, or why there is none."""
        with self._step("texture"):
            lack = missing_texture(image)
        if lack:
            return None, None, lack
        gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        guess = self._prediction(time_us)
        is_due = time_us - self._searched_us >= self.options.search_s * 1e6
        followed = None if is_due else guess
        if followed is not None:
            found, verdict = self._followed_patches(gray, time_us, followed, vertical)
            if found is not None:
                return found.best, verdict, ""
        with self._step("features"):
            features = self._features(gray)
        if followed is not None:
            with self._step("landmarks"):
                found = follow(self.landmarks, features, followed)
            verdict = self._judged(found, features, vertical)
            if found is not None and self._is_sure(verdict):
                self._keep_anchor(gray, time_us, found.best, features)
                return found.best, verdict, ""
            guess = None  # what could not be followed is not tried again
        self._searched_us = time_us
        hypotheses = self._hypotheses(image, guess, vertical)
        with self._step("landmarks"):
            found = search(self.landmarks, features, hypotheses)
        verdict = self._judged(found, features, vertical)
        if found is None or verdict is None:
            return None, None, "too few landmarks agree on any pose"
        if not verdict.reason:
            self._keep_anchor(gray, time_us, found.best, features)
        return found.best, verdict, ""

    def _followed_patches(
        self, gray: np.ndarray, time_us: int, guess: Hypothesis, vertical: KnownVertical | None
    ) -> tuple[Found | None, Judgement | None]:
        """Return pose and judgement by the patches of the anchor, or None and None if they do not do."""
        if self._anchor is None or time_us - self._anchor[0] > self.options.anchor_s * 1e6:
            return None, None
        anchor = self._anchor[1]
        with self._step("patches"):
            small = reduced(gray, self.landmarks.facts.features.max_image_size_px)
            if small.shape != anchor.gray.shape:
                return None, None
            found = anchor.follow(small, guess)
        verdict = self._judged(found, anchor, vertical)
        if not self._is_sure(verdict):
            return None, None
        return found, verdict

    def _is_sure(self, verdict: Judgement | None) -> bool:
        """Return whether a pose found with the help of a prediction needs no other evidence."""
        return (
            verdict is not None
            and not verdict.reason
            and verdict.quality >= 100 * self.options.sure_share
        )

    def _keep_anchor(
        self, gray: np.ndarray, time_us: int, candidate: Candidate, features: ImageFeatures
    ) -> None:
        if self.options.sequence:
            small = reduced(gray, self.landmarks.facts.features.max_image_size_px)
            camera = self.camera.scaled(small.shape[1], small.shape[0])
            self._anchor = (
                time_us,
                LandmarkAnchor.of(small, camera, candidate, features.half_view),
            )

    def _judged(
        self, found: Found | None, view: HasView, vertical: KnownVertical | None
    ) -> Judgement | None:
        if found is None:
            return None
        with self._step("judgement"):
            witness = witness_of(found, view, vertical, self._height, self.focal_bound)
            verdict = judge(witness, self.options.limits)
        if not self.options.sequence:
            return verdict
        if not isinstance(view, LandmarkAnchor):  # which has the errors of an image before
            self._weigh_lens(witness)
            self.focal_bound = min(self.focal_bound, verdict.focal_bound)
        return replace(verdict, reason=verdict.reason or self._lens_over_time())

    def _weigh_lens(self, witness: Witness) -> None:
        """Add what an image says about the focal length to what those before said."""
        change, sigma = witness.focal_change
        weight = 1 / (sigma**2 + self.options.limits.focal_sigma**2)
        self._focal = np.array([weight, weight * change]) + _FORGET * self._focal

    def _lens_over_time(self) -> str:
        """Return why the stated lens cannot be right, from all images so far that determine it together."""
        kept = self._focal
        mean = kept[1] / kept[0]
        allowed = self.options.limits.max_focal_sigmas * max(
            kept[0] ** -0.5, self.options.limits.focal_sigma
        )
        if abs(mean) <= allowed:
            return ""
        return f"the landmarks of many images fit a focal length {100 * mean:+.1f} % from the stated one"

    def _features(self, gray: np.ndarray) -> ImageFeatures:
        height, width = gray.shape
        camera = camera_at_size(self.camera, width, height)
        width_px = self.landmarks.facts.features.max_image_size_px
        return ImageFeatures.of(self.extract(gray), camera, width_px)

    def _hypotheses(
        self, image: np.ndarray, guess: Hypothesis | None, vertical: KnownVertical | None
    ) -> Iterator[Hypothesis]:
        """Yield the hypotheses of a search; the network runs only if it is reached."""
        if guess is not None:
            yield guess
        with self._step("network"):
            found = self._from_network(image, vertical)
        yield from found

    @contextmanager
    def _step(self, name: str) -> Iterator[None]:
        """Add the time of a step; a step within another one counts for itself alone."""
        begin, inner = time.perf_counter(), sum(self.steps_s.values())
        try:
            yield
        finally:
            spent = time.perf_counter() - begin - (sum(self.steps_s.values()) - inner)
            self.steps_s[name] = self.steps_s.get(name, 0.0) + spent

    def _from_network(self, image: np.ndarray, vertical: KnownVertical | None) -> list[Hypothesis]:
        if not self.options.network:
            return []
        height = self._height
        if height is not None:
            height = replace(height, up_m=height.up_m + float(self._offset[2]))
        located = self.localizer.localize(image, self.camera, vertical=vertical, height=height)
        if located.reason:
            return []
        center = located.poses.centers[0] - self._offset
        return [Hypothesis("network", center, located.poses.rotations[0])]

    def _prediction(self, time_us: int) -> Hypothesis | None:
        """Return the last pose moved on at constant velocity, while the localization is not lost."""
        if not self._passed or self._agreement.state not in (FixState.TRACK, FixState.COAST):
            return None
        last_s, pose = self._passed[-1]
        since_s = time_us * 1e-6 - last_s
        radius = self.options.radius_px + self.options.radius_px_s * since_s
        if len(self._passed) > 1:
            pose = interpolate_pose(self._passed[0], self._passed[1], time_us * 1e-6)
        return Hypothesis("track", pose.centers[0], pose.rotations[0], radius)

    def _remember(self, time_us: int, pose: Poses) -> None:
        """Keep two poses for the prediction, unless too much time passed between them."""
        recent = [
            p for p in self._passed if 0 < time_us * 1e-6 - p[0] < self.options.motion.coast_s
        ]
        self._passed = [*recent[-1:], (time_us * 1e-6, pose)]
