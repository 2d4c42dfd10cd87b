"""Focal lengths as a trial between witnesses: the images, metadata or the user, and GNSS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from spn_data.colmap.model import Scene
from spn_data.geometry.camera import Camera
from spn_data.geometry.initial_lens import Hold, InitialLens
from spn_data.reconstruction.correspondences import FramesToMap
from spn_data.reconstruction.view_variety import missing_views
from spn_data.uncertainty.map_covariance import MapCovariance
from spn_data.uncertainty.shared_errors import FocalLength

_DOUBTFUL = 0.01  # relative error of a focal length that deserves a note
_SIGMAS = 2.0  # beyond which two statements contradict each other
# Relative error if the measurements are too few to determine it.
_UNDETERMINED = 0.05
_TELLS_NOTHING = 0.1  # relative sigma above which a witness is not heard


@dataclass(frozen=True)
class Statement:
    """What a witness says about a focal length, in pixels."""

    witness: str
    focal_px: float
    sigma_px: float

    def contradicts(self, other: Statement) -> bool:
        """Whether two statements differ by more than both can be wrong by."""
        sigma = float(np.hypot(self.sigma_px, other.sigma_px))
        return abs(self.focal_px - other.focal_px) > _SIGMAS * sigma

    def __str__(self) -> str:
        digits = 0 if self.sigma_px >= 0.95 else 2
        return f"{self.witness} {self.focal_px:.0f} px (sigma {self.sigma_px:.{digits}f})"


@dataclass(frozen=True, eq=False)
class FocalTrial:
    """Statements on the focal length of one camera.

    Attributes
    ----------
    camera : str
        Its key.
    adjusted : Camera
        As it is in the model.
    images : FocalLength or None
        What the images say; None if they are too few, or the focal length was held.
    lens : InitialLens
        What metadata or the user say.
    gnss : Statement or None
        What the fixes of the flights say.
    missing : tuple of str
        Views that would determine it.
    distance_m : float
        Viewing distance; NaN if the model has no known scale.
    """

    camera: str
    adjusted: Camera
    images: FocalLength | None
    lens: InitialLens
    gnss: Statement | None = None
    missing: tuple[str, ...] = ()
    distance_m: float = float("nan")

    @property
    def adjusted_px(self) -> float:
        """Focal length in the model."""
        return self.adjusted.focal_px[0]

    @property
    def stated(self) -> Statement | None:
        """What metadata or the user say."""
        if not self.lens.focal_is_known:
            return None
        focal_px = self.lens.camera.focal_px[0]
        return Statement(self.lens.source, focal_px, self.lens.focal_sigma * focal_px)

    @property
    def _used(self) -> Statement | None:
        """The statement that the model follows: of the images, or what was held."""
        if self.lens.hold is not Hold.NOTHING:
            return self.stated
        if self.images is None:
            return Statement("adjustment", self.adjusted_px, _UNDETERMINED * self.adjusted_px)
        return Statement("images", self.adjusted_px + self.images.shift_px, self.images.sigma_px)

    @property
    def _others(self) -> list[Statement]:
        """Statements that the model does not follow, if they tell anything."""
        stated = self.stated if self.lens.hold is Hold.NOTHING else None
        heard = [one for one in (stated, self.gnss) if one is not None]
        return [one for one in heard if one.sigma_px < _TELLS_NOTHING * one.focal_px]

    @property
    def against(self) -> list[Statement]:
        """Statements that contradict the model, unless another one takes its side against them."""
        used = self._used
        if used is None:
            return []
        against = [one for one in self._others if one.contradicts(used)]
        sides = [one for one in self._others if one not in against]
        if any(one.contradicts(other) for one in sides for other in against):
            return []
        return against

    @property
    def doubt_px(self) -> float:
        """Difference between the model and the statements that contradict it; 0 if none does."""
        if not self.against:
            return 0.0
        return max(abs(one.focal_px - self.adjusted_px) for one in self.against)

    def notes(self) -> list[str]:
        """Return sentences for the user on what the witnesses say."""
        used = self._used
        if used is None or not self._others:
            return [self._weak()] if self._is_weak else []
        if self.against:
            return [self._contradicted(used)]
        if self._is_weak:
            return [self._weak()]
        if self.images is None and self.lens.hold is Hold.NOTHING:
            return []
        alone = [one for one in self._others if one.contradicts(used)]
        said = ", ".join(map(str, [used, *self._others]))
        verdict = f"{alone[0].witness} is outvoted" if alone else "they agree"
        return [f"camera {self.camera}: focal length {self.adjusted_px:.0f} px; {said}: {verdict}"]

    def counts(self) -> dict[str, float | None]:
        """Return the errors and statements for stage.json, in pixels."""
        said = {"focal_error_px": None if self.images is None else round(self.images.error_px, 2)}
        if self.gnss is not None:
            said |= {
                "focal_by_gnss_px": round(self.gnss.focal_px, 2),
                "focal_by_gnss_sigma_px": round(self.gnss.sigma_px, 2),
            }
        return said | {"focal_doubt_px": round(self.doubt_px, 2)}

    @property
    def _is_weak(self) -> bool:
        return self.images is not None and self.images.error_px >= _DOUBTFUL * self.adjusted_px

    def _contradicted(self, used: Statement) -> str:
        held = self.lens.hold is not Hold.NOTHING
        said = " and ".join(map(str, self.against))
        follows = "held" if held else "estimated"
        verb = "contradicts" if len(self.against) == 1 else "contradict"
        return (
            f"camera {self.camera}: the focal length was {follows} as {self.adjusted_px:.0f} px ({used}), "
            f"which {said} {verb}. {self._heights(self.doubt_px / self.adjusted_px)}, which stated "
            f"uncertainties contain; or the images are cropped. {self._remedy()}"
        )

    def _remedy(self) -> str:
        """Return which option makes the model follow those who contradict it."""
        if self.stated in self.against:
            agree = "which GNSS supports, " if self.gnss in self.against else ""
            return f"--fixed-lens holds the stated focal length, {agree}--camera a calibrated lens"
        assert self.gnss is not None
        scale = self.gnss.focal_px / self.adjusted_px
        params = self.adjusted.params.copy()
        params[:1] *= scale
        fov = replace(self.adjusted, params=params).horizontal_fov_deg
        return (
            "--camera with --fixed-lens holds a calibrated lens; GNSS would have it at --fov "
            f"{fov:.1f}, if the fixes are of these frames"
        )

    def _weak(self) -> str:
        assert self.images is not None
        share = self.images.error_px / self.adjusted_px
        heard = [one for one in (self._used, *self._others) if one is not None]
        together = ""
        if len(heard) > 1:
            weight = np.array([one.sigma_px**-2 for one in heard])
            mean = float(weight @ [one.focal_px for one in heard] / weight.sum())
            together = f"; together {mean:.0f} px (sigma {weight.sum() ** -0.5:.0f})"
        better = self.stated
        hold = (
            " --fixed-lens holds the stated one, which is known better."
            if better is not None and better.sigma_px < self.images.error_px
            else ""
        )
        lacking = (
            f" To determine it, add one of: {', '.join(self.missing)}." if self.missing else ""
        )
        said = ", ".join(map(str, heard)) + together
        return (
            f"camera {self.camera}: the images determine the focal length only to {share:.1%}: "
            f"{self.adjusted_px:.0f} px adjusted; {said}, if the lens differs from its model as the "
            f"residuals suggest. {self._heights(share)}, which their stated uncertainty contains."
            f"{hold}{lacking}"
        )

    def _heights(self, share: float) -> str:
        metres = f" ({share * self.distance_m:.1f} m)" if np.isfinite(self.distance_m) else ""
        return (
            f"Heights above the ground and positions of other flights may be wrong by {share:.1%}"
            f"{metres}"
        )


def focal_trials(
    scene: Scene,
    covariance: MapCovariance | None,
    frames: FramesToMap,
    gnss: Mapping[str, Statement],
    distance: float,
    metres: float,
) -> dict[int, FocalTrial]:
    """Return the statements on the focal length of each camera of a model, by its id.

    Parameters
    ----------
    scene : Scene
    covariance : MapCovariance or None
        Covariance of the model.
    frames : FramesToMap
        Provides what is known of the lenses.
    gnss : mapping of str to Statement
        What fixes say, by camera.
    distance : float
        Viewing distance, in units of the model.
    metres : float
        Length of such a unit; NaN if unknown.

    Returns
    -------
    dict of int to FocalTrial
    """
    images = {} if covariance is None else covariance.shared.focal_lengths
    missing = missing_views(scene, distance)
    return {
        i: FocalTrial(
            key,
            scene.cameras[i],
            images.get(i),
            frames.lenses[key],
            gnss.get(key),
            missing,
            distance * metres,
        )
        for key, i in sorted(frames.camera_ids(scene).items())
    }
