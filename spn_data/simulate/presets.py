"""Options of the simulation and named presets."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.camera import MODELS, Camera
from spn_data.geometry.geodesy import GeoOrigin
from spn_data.simulate.gnss import GnssOptions
from spn_data.simulate.light import LightOptions
from spn_data.simulate.place import Place, SceneOptions


class MappingPaths(StrEnum):
    """Flight patterns of the mapping flights in the courtyard; other places have their own."""

    COURTYARD = "courtyard"  # two flights inside the courtyard, 1.5-9 m high
    NADIR = "nadir"  # one flight in parallel lines above the building, looking down
    STRAIGHT = "straight"  # one flight along a straight line parallel to the north facade


LOOK_ALIKE_SEED = 1_000_000  # added to the seed of the scene, not of the flights


@dataclass(frozen=True, kw_only=True)
class LensOptions:
    """Lens of one camera; the image size is given by the flight."""

    fov_deg: float  # horizontal, of the undistorted image
    distortion: tuple[float, ...] = ()  # none, (k1,), (k1, k2) or (k1, k2, p1, p2) as in COLMAP
    shift: tuple[float, float] = (0.0, 0.0)  # of the principal point, as shares of width and height

    def camera(self, width: int, height: int) -> Camera:
        """Return the camera for an image size."""
        camera = Camera.from_horizontal_fov(width, height, self.fov_deg, self.distortion)
        at = MODELS[camera.model].index("cx")
        camera.params[at : at + 2] += np.array(self.shift) * (width, height)
        return camera


@dataclass(frozen=True, kw_only=True)
class SimulateOptions:
    """Options that determine the simulated flights: equal options give equal files."""

    preset: str = "standard"
    seed: int = 1
    width: int = 1280
    height: int = 720
    fps: float = 10.0  # of the video; telemetry has one record per frame
    place: Place = Place.COURTYARD
    only: tuple[str, ...] = ()  # flights or roles (mapping, evaluation) to render; empty for all
    mapping_paths: MappingPaths = MappingPaths.COURTYARD
    area_factor: float = 1.0  # factor on the courtyard's ground area; flights grow with its side
    length_factor: float = 1.0  # factor on the duration of the flights, at the same speed
    mapping_lens: LensOptions = field(
        default_factory=lambda: LensOptions(fov_deg=72.0, distortion=(-0.05, 0.015))
    )
    evaluation_lens: LensOptions = field(
        default_factory=lambda: LensOptions(fov_deg=94.0, distortion=(-0.1, 0.02))
    )
    blur_share: float = 0.12  # share of frames that rotate during their exposure
    blur_deg: tuple[float, float] = (
        0.35,
        1.3,
    )  # minimum and maximum rotation during such an exposure
    exposure_sigma_ev: float = 0.2  # slow changes of exposure
    lens_blur_px: float = 0.45  # standard deviation of the lens's point spread function
    noise_sigma: float = 1.8  # of the sensor, in grey levels (of 255)
    readout_s: float = (
        0.0  # rolling shutter: time from the first row to the last; 0 for a global shutter
    )
    gnss: GnssOptions = field(default_factory=GnssOptions)
    gimbal_angles: bool = True  # whether telemetry contains them
    gimbal_sigma_deg: tuple[float, float, float] = (
        2.0,
        0.3,
        0.3,
    )  # constant bias per flight: heading, pitch, roll
    time_offset_s: float = 0.0  # added to telemetry times to get video times
    origin: GeoOrigin = field(default_factory=lambda: GeoOrigin(49.015422, 8.425117, 163.2))
    geoid_m: float = 48.3  # height of mean sea level, to which abs_alt refers, above the ellipsoid
    texels_per_m: float = 140.0  # resolution of the painted surfaces
    houses_per_hectare: float = 0.0  # on the courtyard's ground
    size_m: tuple[float, float] = (39.0, 36.0)  # of the ground, east-west and north-south
    people: int = 0  # that walk
    cars: int = 0  # that drive
    wind_m: float = 0.0  # how far crowns of trees 5 m high sway
    light: LightOptions = field(default_factory=LightOptions)
    look_alike: bool = False  # same grid of windows and same objects, all else is different
    crf: int = 18  # H.264 quality; lower is better

    def __post_init__(self) -> None:
        if self.width % 2 or self.height % 2 or min(self.width, self.height) < 16:
            raise InputError(
                f"image size {self.width} x {self.height}: H.264 needs even numbers of at least 16"
            )
        if self.fps <= 0 or self.area_factor <= 0 or self.length_factor <= 0:
            raise InputError("fps, area factor and length factor must be above zero")
        if not 0 <= self.blur_share <= 1:
            raise InputError(f"blur share {self.blur_share} is outside 0 to 1")
        if self.place != Place.COURTYARD and self.mapping_paths != MappingPaths.COURTYARD:
            raise InputError(
                f"paths {self.mapping_paths} are flown in the courtyard only, not over {self.place}"
            )
        if abs(self.time_offset_s) > 5:
            raise InputError(f"time offset {self.time_offset_s} s is outside -5 to 5 s")
        # The ground is one texture, which limits its number of texels.
        if self.area_factor > 16 and self.texels_per_m > 170 / self.area_factor**0.5:
            raise InputError(
                f"area factor {self.area_factor} exceeds 16 at {self.texels_per_m:g} texels per metre"
            )

    @property
    def scene(self) -> SceneOptions:
        """Options of the scene."""
        return SceneOptions(
            place=self.place,
            size_m=self.size_m,
            people=self.people,
            cars=self.cars,
            wind_m=self.wind_m,
            area_factor=self.area_factor,
            texels_per_m=self.texels_per_m,
            houses_per_hectare=self.houses_per_hectare,
            seed=self.seed + LOOK_ALIKE_SEED * self.look_alike,
        )


# What real flights have and `standard` does not: a principal point off the centre, the distortion of a wide
# lens, a GNSS error that lasts, brightness and shadows that change.
_REAL: dict[str, Any] = {
    "mapping_lens": LensOptions(
        fov_deg=72.0, distortion=(-0.09, 0.03, 0.0006, -0.0004), shift=(0.008, -0.006)
    ),
    "evaluation_lens": LensOptions(
        fov_deg=90.0, distortion=(-0.24, 0.07, -0.0005, 0.0007), shift=(-0.009, 0.007)
    ),
    "exposure_sigma_ev": 0.45,
    "gnss": GnssOptions(constant_sigma_m=(0.9, 0.9, 2.3)),
    "light": LightOptions(sun=1.0),
}

PRESETS: dict[str, SimulateOptions] = {
    "standard": SimulateOptions(),
    "demo": SimulateOptions(preset="demo", width=960, height=540, fps=5.0),
    "look-alike": SimulateOptions(preset="look-alike", look_alike=True),
    "modern": SimulateOptions(
        preset="modern", place=Place.MODERN, people=8, cars=1, wind_m=0.12, **_REAL
    ),
    "street": SimulateOptions(
        preset="street",
        place=Place.STREET,
        size_m=(96.0, 17.0),
        people=14,
        cars=10,
        wind_m=0.12,
        **_REAL,
    ),
    "village": SimulateOptions(
        preset="village",
        place=Place.VILLAGE,
        size_m=(110.0, 90.0),
        people=16,
        cars=6,
        wind_m=0.15,
        **_REAL,
    ),
}


def preset(name: str, *, seed: int = 1) -> SimulateOptions:
    """Return the options of a preset in `PRESETS` with a seed.

    Raises
    ------
    InputError
        If there is no preset of this name.
    """
    if name not in PRESETS:
        raise InputError(f"unknown preset {name!r}; choose from {', '.join(sorted(PRESETS))}")
    return replace(PRESETS[name], seed=seed)
