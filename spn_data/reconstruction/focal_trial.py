"""Focal lengths as a trial between witnesses: the images, and metadata or the user."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spn_data.colmap.model import Scene
from spn_data.geometry.initial_lens import Hold, InitialLens
from spn_data.reconstruction.correspondences import FramesToMap
from spn_data.uncertainty.map_covariance import MapCovariance
from spn_data.uncertainty.shared_errors import FocalLength

_DOUBTFUL = 0.01  # relative error of a focal length that deserves a note
_SIGMAS = 2.0  # beyond which two statements contradict each other
# Relative error if the measurements are too few to determine it.
_UNDETERMINED = 0.05


@dataclass(frozen=True, eq=False)
class FocalTrial:
    """Statements on the focal length of one camera.

    Attributes
    ----------
    camera : str
        Its key.
    adjusted_px : float
        Focal length in the model.
    images : FocalLength or None
        What the images say; None if they are too few.
    lens : InitialLens
        What metadata or the user say.
    """

    camera: str
    adjusted_px: float
    images: FocalLength | None
    lens: InitialLens

    @property
    def error(self) -> float:
        """Relative error to be expected of the adjusted focal length, by the images."""
        return _UNDETERMINED if self.images is None else self.images.error_px / self.adjusted_px

    @property
    def stated_px(self) -> float:
        """Focal length that metadata or the user say."""
        return self.lens.camera.focal_px[0]

    @property
    def contradicted(self) -> bool:
        """Whether metadata or the user contradict the adjusted focal length."""
        change = np.log(self.adjusted_px / self.stated_px)
        known = self.lens.focal_is_known
        return known and abs(change) > _SIGMAS * float(np.hypot(self.error, self.lens.focal_sigma))

    def notes(self) -> list[str]:
        """Return sentences for the user; none if all agree and the images determine the focal length well."""
        if self.lens.hold is not Hold.NOTHING:
            return []
        if self.contradicted:
            return [
                f"camera {self.camera}: the focal length was estimated as {self.adjusted_px:.0f} px, "
                f"{self.adjusted_px / self.stated_px - 1:+.0%} from {self._statement()}: more than both can "
                f"be wrong by (the images determine it to {self.error:.1%}). Heights above the ground "
                "have the same relative error; or the images are cropped. --camera gives a calibrated lens "
                "to start from, and --fixed-lens holds what is stated"
            ]
        if self.images is None or self.error < _DOUBTFUL:
            return []
        expected = self.adjusted_px + self.images.shift_px
        stated = f"; stated: {self._statement()}" if self.lens.focal_is_known else ""
        hold = (
            " --fixed-lens holds the stated one, which is known better."
            if self.lens.focal_is_known and self.lens.focal_sigma < self.error
            else ""
        )
        return [
            f"camera {self.camera}: the images determine the focal length only to {self.error:.1%} "
            f"({self.adjusted_px:.0f} px adjusted, {expected:.0f} px, sigma {self.images.sigma_px:.0f} px, "
            f"if the lens differs from its model as the residuals suggest{stated}). Heights above the ground "
            "and positions of other flights may be wrong by the same share, which their stated uncertainty "
            f"contains.{hold} Cross lines, oblique views or a second height determine it"
        ]

    def _statement(self) -> str:
        return f"{self.stated_px:.0f} px, sigma {self.lens.focal_sigma:.1%} ({self.lens.source})"


def focal_trials(
    scene: Scene, covariance: MapCovariance | None, frames: FramesToMap
) -> list[FocalTrial]:
    """Return the statements on the focal length of each camera of a model.

    Parameters
    ----------
    scene : Scene
    covariance : MapCovariance or None
        Covariance of the model.
    frames : FramesToMap
        Provides what is known of the lenses.

    Returns
    -------
    list of FocalTrial
    """
    images = {} if covariance is None else covariance.shared.focal_lengths
    return [
        FocalTrial(key, scene.cameras[i].focal_px[0], images.get(i), frames.lenses[key])
        for key, i in sorted(frames.camera_ids(scene).items())
    ]
