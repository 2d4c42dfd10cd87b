"""Where a fix is to be expected: a bundle judges views that are rendered from the training images."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.camera import Camera
from spn_data.geometry.pose import Poses
from spn_model.evaluation.fixes import MISLEADING_DEG, MISLEADING_M, fix_error
from spn_model.examples.novel_view_fusion import fused_view
from spn_model.examples.point_targets import SurfaceOptions
from spn_model.examples.source_images import SourceImages
from spn_model.examples.training_set import TrainingSet
from spn_model.examples.training_surfaces import TrainingSurfaces
from spn_model.integrity.fix import NoFix
from spn_model.landmarks.matching import expected
from spn_model.models.scene_examples import FAR, LEVEL
from spn_model.onboard.pilot import Pilot, PilotOptions

_FILL = (128, 128, 128)  # what no training image shows
_GRID = (8, 5)  # parts of the image, as in the judgement of a fix
_MANY = 10  # times the landmarks that have to agree: about a seventh of those in view did, from far above
_LITTLE = 0.1  # share of a view; where less is shown, nothing else matters
_MOST_ASPECT = 8.0  # of the images of a camera, either way
_FIRST_US = 1


class Expectation(StrEnum):
    """Whether a fix is to be expected."""

    YES = "yes"  # the rendered view has one
    PERHAPS = "perhaps"  # it has none, but many landmarks are in view
    NO = "no"


@dataclass(frozen=True, kw_only=True)
class ExpectedFix:
    """What is to be expected at a planned pose.

    Attributes
    ----------
    name : str
    expectation : Expectation
    reason : str
        Why the rendered view has no usable fix at this pose; empty if it has.
    landmarks : int
        Landmarks of the bundle in the view, seen from a direction and distance known to the map. Some of
        them may be hidden.
    spread : float
        Share of the parts of the image (8 x 5) with one of them.
    shown : float
        Share of the view that training images show.
    error_m : float
        Error of the fix in the rendered view; NaN without one.
    protection_m : tuple of float
        Its protection levels, horizontal and vertical.
    """

    name: str
    expectation: Expectation
    reason: str
    landmarks: int
    spread: float
    shown: float
    error_m: float = math.nan
    protection_m: tuple[float, float] = (math.nan, math.nan)


class PlannedViews:
    """Views at any pose, rendered from the training images of a data set, and judged by a bundle.

    Parameters
    ----------
    data : TrainingSet
        With map points.
    bundle : Path
        Folder of a bundle with landmarks.

    Raises
    ------
    InputError
        If the data set has no map points for training, or the bundle has no landmarks.
    FormatError
        If the bundle is damaged.
    """

    def __init__(self, data: TrainingSet, bundle: Path):
        if not data.has_points:
            raise InputError("the data set has no map points, from which views could be rendered")
        self._data = data
        xyz = np.concatenate([data.points(row).xyz for row in range(len(data))])
        center = np.median(xyz, axis=0)
        spread = float(np.median(np.linalg.norm(xyz - center, axis=1)))
        self._sources = SourceImages(data, center, spread, FAR * spread)
        self._options = SurfaceOptions(level_m=LEVEL * spread if data.up_is_known else 0.0)
        self._surfaces = TrainingSurfaces(data, self._options)
        self._pilots: dict[tuple[int, int, float], Pilot] = {}
        self._bundle = bundle

    def expect(self, name: str, pose: Poses, camera: Camera) -> ExpectedFix:
        """Return whether a fix is to be expected at a pose.

        Parameters
        ----------
        name : str
        pose : Poses
            One pose, in the world.
        camera : Camera
            That will fly; its distortion is left out.

        Returns
        -------
        ExpectedFix

        Raises
        ------
        InputError
            If the aspect ratio of the camera is above 8.
        """
        pinhole = self._pinhole(camera)
        image, shown = self.render(pose, pinhole)
        pilot = self._pilot(pinhole)
        landmarks, spread = self._visible(pilot, pose, pinhole)
        item = pilot.fix(image, _FIRST_US)
        error_m, levels, reason = math.nan, (math.nan, math.nan), ""
        if isinstance(item, NoFix):
            unseen = f"the training images show {shown:.0%} of this view"
            reason = unseen if shown < _LITTLE else item.reason
        else:
            error = fix_error(item, pose)
            error_m = error.error_m
            levels = (item.horizontal_protection_m, item.vertical_protection_m)
            if error.error_m > MISLEADING_M or error.error_deg > MISLEADING_DEG:
                reason = f"the fix in the rendered view is {error_m:.2f} m beside the pose"
        expectation = Expectation.YES
        if reason:
            many = landmarks >= _MANY * pilot.options.limits.min_inliers
            expectation = Expectation.PERHAPS if many else Expectation.NO
        return ExpectedFix(
            name=name,
            expectation=expectation,
            reason=reason,
            landmarks=landmarks,
            spread=spread,
            shown=shown,
            error_m=error_m,
            protection_m=levels,
        )

    def render(self, pose: Poses, pinhole: Camera) -> tuple[np.ndarray, float]:
        """Return the image (H, W, 3), BGR, of a pinhole at a pose, and the share that is not unknown."""
        moved = pose.moved_by([-part for part in self._data.offset])
        image, seen = fused_view(
            self._data,
            self._sources,
            self._surfaces.of,
            moved,
            pinhole.matrix,
            1,
            _FILL,
            self._options,
            (pinhole.width, pinhole.height),
        )
        return np.ascontiguousarray(image[..., ::-1]), float(np.isfinite(seen.inverse_depth).mean())

    def _pinhole(self, camera: Camera) -> Camera:
        """Return a pinhole with the field of view of a camera, as wide as the images of the data set."""
        if not 1 / _MOST_ASPECT <= camera.width / camera.height <= _MOST_ASPECT:
            raise InputError(
                f"the camera has images of {camera.width} x {camera.height} px, too narrow to render"
            )
        width = max(self._data.size)
        by = width / max(camera.width, camera.height)
        size = (max(round(camera.width * by), 1), max(round(camera.height * by), 1))
        params = np.array([camera.focal_px[0] * by, size[0] / 2, size[1] / 2])
        return Camera("SIMPLE_PINHOLE", *size, params)

    def _pilot(self, pinhole: Camera) -> Pilot:
        key = (pinhole.width, pinhole.height, float(pinhole.focal_px[0]))
        if key not in self._pilots:
            self._pilots[key] = Pilot(self._bundle, pinhole, PilotOptions(sequence=False))
        return self._pilots[key]

    def _visible(self, pilot: Pilot, pose: Poses, pinhole: Camera) -> tuple[int, float]:
        """Return the number of landmarks in view, and the share of the parts of the image with one."""
        options = pilot.landmarks.facts.features
        focal_px = float(pinhole.focal_px[0]) * options.max_image_size_px / max(self._data.size)
        half = np.array([pinhole.width, pinhole.height]) / 2 / pinhole.focal_px[0]
        center = pose.centers[0] - np.array(pilot.localizer.bundle.view.offset)
        found = expected(pilot.landmarks, center, pose.rotations[0], focal_px, half)
        part = np.floor((found.at / focal_px / half + 1) / 2 * _GRID)
        part = np.clip(part, 0, np.array(_GRID) - 1)
        return len(found.landmarks), len(np.unique(part, axis=0)) / (_GRID[0] * _GRID[1])
