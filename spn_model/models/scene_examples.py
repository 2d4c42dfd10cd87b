"""Training examples of a scene-coordinate network: augmented images and novel views with their targets."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.pose import Poses
from spn_model.examples.augment import (
    PhotometricOptions,
    WarpOptions,
    augment_photometrically,
    random_warp,
)
from spn_model.examples.held_out_views import HeldOutViews
from spn_model.examples.novel_view_fusion import fused_view
from spn_model.examples.novel_views import (
    NovelViewOptions,
    nearby_pose,
    overhead_pose,
    warp_to_pose,
)
from spn_model.examples.point_targets import (
    Surface,
    SurfaceOptions,
    cell_centers,
    cell_targets,
)
from spn_model.examples.source_images import SourceImages
from spn_model.examples.training_set import TrainingSet
from spn_model.examples.training_surfaces import TrainingSurfaces
from spn_model.networks.scene_coordinates import (
    FIRST_CELL_PX,
    STRIDE_PX,
    SceneCoordinates,
    grid_size,
)

FAR = 4.0  # in spreads from the scene's centre; points beyond are unreliable and no targets
LEVEL = 0.011  # largest height difference of a level triangle, in spreads
_VIEW_BYTES = 800_000_000  # memory for rendered views, which are kept: one takes 20 to 80 ms
_MOST_VIEWS = 1_000_000  # view numbers below it are for training, those above are held out
_IMAGES_A_VIEW = 120  # images drawn for each rendered view, which costs as much as ten of them
_FIRST_VIEWS = 32  # views available at a stage's start, so that it need not wait for all
_ALL_VIEWS_AT = 0.8  # progress from which all views are drawn
_GOLDEN = 0.6180339887498949  # multiples of it fill the unit interval evenly, however many
_LEAST_SHOWN = 0.3  # smallest fraction of a view that must show something
_ATTEMPTS = 4  # attempts to render such a view
_RAMP_FROM = 0.3  # fraction of rotations and log zooms at a stage's start


@dataclass(frozen=True, kw_only=True)
class SceneStageOptions:
    """Options of one training stage: augmentation, novel views and frozen layers."""

    freeze_layers: int = 5  # number of SqueezeNet's first layers that stay as published
    features_rate: float = 0.3  # learning rate of SqueezeNet's other layers relative to the head
    choice_weight: float = 1.0  # weight of the cross-entropy of scene parts in the loss
    surfaces: bool = True  # learn from surfaces between map points, not only from the points
    tilt_deg: float = 20.0  # largest rotation about each image axis
    roll_deg: float = 20.0  # largest rotation about the optical axis
    zoom_min: float = 0.65  # focal length relative to that of the network's input images
    zoom_max: float = 1.6
    size_min: float = 0.9  # image size relative to that of the network's input images;
    size_max: float = 1.2  # between these limits it follows the focal length
    ramp_share: float = 0.2  # first fraction of the stage, over which rotations and zooms grow
    look: bool = True  # augment exposure, colour, sharpness and noise, and occlude parts
    views_share: float = 0.0  # fraction of images rendered as novel views
    views: int = 1000  # number of novel views to render, as far as memory allows
    views_fused: bool = True  # fuse several images, instead of warping one training image
    views_rise: float = 0.6  # largest rise of a view, in spreads of the scene
    views_side: float = 0.2  # largest sideways shift, in spreads
    views_high: float = 0.4  # fraction of fused views that look down from above the scene
    views_height: float = 0.7  # largest height above the highest training image, in spreads

    def __post_init__(self) -> None:
        for name, low, high in (
            ("freeze_layers", 0, 13),
            ("features_rate", 0, 10),
            ("choice_weight", 0, 100),
            ("tilt_deg", 0, 60),
            ("roll_deg", 0, 180),
            ("zoom_min", 0.1, 10),
            ("zoom_max", self.zoom_min, 10),
            ("size_min", 0.1, 10),
            ("size_max", self.size_min, 10),
            ("ramp_share", 0, 1),
            ("views_share", 0, 1),
            ("views", 1, _MOST_VIEWS),
            ("views_rise", 0, 10),
            ("views_side", 0, 10),
            ("views_high", 0, 1),
            ("views_height", 0, 10),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"{name} is {value}, needs to be from {low} to {high}")
        if self.views_share and not self.surfaces:
            raise InputError("views_share needs surfaces: views are rendered from them")


class SceneExamples:
    """Examples of one data set with the augmentation of one stage; surfaces and views are cached.

    The cache depends on the data only, not on the order in which rows are drawn.

    Parameters
    ----------
    data : TrainingSet
        Training images.
    options : SceneStageOptions
        Augmentation and novel views.
    center : ndarray, shape (3,)
        Centre of the scene.
    spread : float
        Spread of the scene.
    shrink : int
        Factor by which the network's images are smaller than the data set's.
    images : int
        Approximate number of images that the stage draws.
    """

    def __init__(
        self,
        data: TrainingSet,
        options: SceneStageOptions,
        center: np.ndarray,
        spread: float,
        shrink: int,
        images: int,
    ):
        self._data, self._options, self._shrink = data, options, shrink
        self._center, self._spread = center, spread
        level = LEVEL * spread if data.up_is_known else 0.0
        self._surface_options = SurfaceOptions(level_m=level)
        self._view_options = NovelViewOptions(
            rise_m=options.views_rise * spread,
            side_m=options.views_side * spread,
            height_m=options.views_height * spread,
            up=(0.0, 0.0, 1.0) if data.up_is_known else _mean_up(data),
        )
        self._surfaces = TrainingSurfaces(data, self._surface_options)
        width, height = data.size
        step = self._surface_options.step_px
        fits = step % shrink == 0 and width % shrink == 0 and height % shrink == 0
        self._view_shrink = shrink if fits else 1
        surface_step = self._view_shrink if options.views_fused else step
        view_bytes = width * height * (3 / self._view_shrink**2 + 4 / surface_step**2)
        kept = max(1, int(_VIEW_BYTES / view_bytes))
        worth = max(_FIRST_VIEWS, images // _IMAGES_A_VIEW)
        self._view_count = min(options.views, kept, worth)
        self._views: dict[int, tuple[np.ndarray, Surface]] = {}
        self._sources: SourceImages | None = None
        self._looks_down = False
        if options.views_share and options.views_fused:
            self._sources = SourceImages(data, center, spread, FAR * spread)
            is_below = self._sources.samples[:, 2] < np.median(data.poses.centers[:, 2])
            self._looks_down = data.up_is_known and bool(is_below.any())

    def batch(
        self, rows: np.ndarray, generator: np.random.Generator, progress: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Make a batch of images (N, h, w, 3) uint8, targets (N, 3, r, c) float32 and known (N, r, c).

        All images have the same zoom and size. If the zoom makes them smaller, there are up to twice as
        many, from further rows.
        """
        data, options = self._data, self._options
        zoom, warp = self._variation(generator, progress)
        scale = min(max(zoom * 1.05, options.size_min), options.size_max) / self._shrink
        width, height = (
            max(round(side * scale), SceneCoordinates.min_side_px) for side in data.size
        )
        whole = data.size[0] * data.size[1] / self._shrink**2
        count = max(len(rows), round(len(rows) * min(2.0, whole / (width * height))))
        more = generator.integers(len(data), size=count - len(rows))
        made = [
            self._example(int(row), generator, progress, warp, zoom / self._shrink, (width, height))
            for row in np.concatenate([rows, more])
        ]
        images, targets, known = (np.stack(part) for part in zip(*made, strict=True))
        return images, targets, known

    def _variation(
        self, generator: np.random.Generator, progress: float
    ) -> tuple[float, WarpOptions]:
        options = self._options
        ramp = 1.0
        if progress < options.ramp_share:
            ramp = _RAMP_FROM + (1 - _RAMP_FROM) * progress / options.ramp_share
        low, high = np.log([options.zoom_min, options.zoom_max]) * ramp
        warp = WarpOptions(tilt_deg=options.tilt_deg * ramp, roll_deg=options.roll_deg * ramp)
        return float(np.exp(generator.uniform(low, high))), warp

    def _example(
        self,
        row: int,
        generator: np.random.Generator,
        progress: float,
        options: WarpOptions,
        zoom: float,
        size: tuple[int, int],
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        image, seen = self._source(row, generator, progress)
        matrix = self._data.intrinsics[row] if seen is None else seen.matrix
        # Rendered views are stored at the network's size, training images at full size.
        zoom *= self._data.size[0] / image.shape[1]
        warp = random_warp(
            generator, matrix, image.shape[1::-1], options, zoom=zoom, target_size=size
        )
        red, green, blue = (int(v) for v in generator.integers(0, 256, 3))
        image = warp.image(image, (red, green, blue))
        if self._options.look:
            image = augment_photometrically(image, generator, PhotometricOptions())
        grid = grid_size(*size)
        if seen is not None:
            cells = cell_centers(*grid, FIRST_CELL_PX, STRIDE_PX)
            xyz = seen.xyz(warp.source_pixels(cells))
            targets = xyz.astype(np.float32).T.reshape(3, grid[1], grid[0])
            known = np.ones(targets.shape[1:], bool)
        else:
            points = self._data.points(row)
            targets, known = cell_targets(
                warp.pixels(points.pixels),
                points.xyz,
                grid,
                first_px=FIRST_CELL_PX,
                stride_px=STRIDE_PX,
            )
        with np.errstate(invalid="ignore"):
            off = np.linalg.norm(targets - self._center[:, None, None], axis=0)
            known &= off < FAR * self._spread
        return image, np.where(known, targets, np.float32(0)), known

    def _source(
        self, row: int, generator: np.random.Generator, progress: float
    ) -> tuple[np.ndarray, Surface | None]:
        """Return a training image, or a rendered view of the scene, with the surface that it shows."""
        if generator.random() < self._options.views_share:
            number = int(generator.integers(self._views_at(progress)))
            if number not in self._views:
                self._views[number] = self._view(number) or self._training_image(number)
            return self._views[number]
        return self._image(row), self._surfaces.of(row) if self._options.surfaces else None

    def _image(self, row: int) -> np.ndarray:
        image, valid = self._data.image(row), self._data.valid(row)
        if valid is None:
            return image
        return np.where(
            valid[..., None], image, np.random.default_rng(row).integers(0, 256, 3, np.uint8)
        )

    def _views_at(self, progress: float) -> int:
        """Return how many views are drawn from; they are rendered gradually while training runs."""
        share = min(1.0, progress / _ALL_VIEWS_AT)
        return min(self._view_count, max(_FIRST_VIEWS, round(self._view_count * share)))

    def held_out_views(self, count: int) -> HeldOutViews | None:
        """Render up to `count` views that no batch contains; None if the stage renders none."""
        if not self._options.views_share:
            return None
        numbers = range(_MOST_VIEWS, _MOST_VIEWS + count)
        made = []
        for number in numbers:
            view = self._view(number)
            if view is not None:
                made.append(view)
        if not made:
            return None
        enlarged = self._view_shrink
        larger = np.diag([enlarged, enlarged, 1.0])
        return HeldOutViews(
            Poses.concatenate(seen.pose for _, seen in made),
            np.stack([larger @ seen.matrix for _, seen in made]),
            [image for image, _ in made],
            enlarged,
        )

    def _row_of_view(self, number: int) -> int:
        return int(number * _GOLDEN % 1 * len(self._data))

    def _training_image(self, number: int) -> tuple[np.ndarray, Surface]:
        """Return the fallback for a view that cannot be rendered."""
        row = self._row_of_view(number)
        return self._image(row), self._surfaces.of(row)

    def _view(self, number: int) -> tuple[np.ndarray, Surface] | None:
        """Render a view by its number; None if it shows too little."""
        row = self._row_of_view(number)
        seen = self._surfaces.of(row)
        if not np.isfinite(seen.inverse_depth).any():
            return None
        # A view depends on its number only, so that a batch depends on its arguments only.
        generator = np.random.default_rng(number)
        if self._sources is None:
            return self._moved(row, seen, generator)
        high = self._looks_down and generator.random() < self._options.views_high
        for _ in range(_ATTEMPTS):
            if high:
                centers, scene = self._data.poses.centers, self._sources.samples
                place = overhead_pose(generator, centers, scene, self._view_options)
            else:
                place = nearby_pose(generator, seen, self._view_options)
            red, green, blue = (int(v) for v in generator.integers(0, 256, 3))
            image, fused = fused_view(
                self._data,
                self._sources,
                self._surfaces.of,
                place,
                self._data.intrinsics[row],
                self._view_shrink,
                (red, green, blue),
                self._surface_options,
            )
            if np.isfinite(fused.inverse_depth).mean() > _LEAST_SHOWN:
                return image, fused
        return None

    def _moved(
        self, row: int, seen: Surface, generator: np.random.Generator
    ) -> tuple[np.ndarray, Surface]:
        place = nearby_pose(generator, seen, self._view_options)
        red, green, blue = (int(v) for v in generator.integers(0, 256, 3))
        image, moved = warp_to_pose(self._image(row), seen, place, (red, green, blue))
        if self._view_shrink == 1:
            return image, moved
        by = self._view_shrink
        image = cv2.resize(
            image, (image.shape[1] // by, image.shape[0] // by), interpolation=cv2.INTER_AREA
        )
        matrix = np.diag([1 / by, 1 / by, 1.0]) @ moved.matrix
        return image, replace(moved, step_px=moved.step_px // by, matrix=matrix)


def _mean_up(data: TrainingSet) -> tuple[float, float, float]:
    """Return the mean direction of the images' upper edges as a unit vector."""
    up = -data.poses.rotations[:, 1].mean(axis=0)
    x, y, z = up / max(float(np.linalg.norm(up)), 1e-9)
    return float(x), float(y), float(z)
