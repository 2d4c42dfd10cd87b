"""Self-test before take-off: a first fix, compared with where the drone stands and with its attitude."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.geodesy import GeoOrigin
from spn_data.geometry.rotations import rotations_from_quats
from spn_model.integrity.fix import Fix
from spn_model.integrity.height import HeightZero
from spn_model.landmarks.aids import KnownVertical, tilt_sigmas
from spn_model.onboard.flight_report import kind_of_reason
from spn_model.onboard.pilot import Pilot
from spn_model.onboard.replay import FlownImage

_IMAGES = 60  # tried
_SIGMAS = 3.0  # of a stated position or height
_MAX_TILT_SIGMAS = 5.0


@dataclass(frozen=True, kw_only=True)
class StatedPosition:
    """Where the drone stands, for example by its GNSS receiver; heights are not compared.

    Attributes
    ----------
    lat_deg, lon_deg : float
        WGS84.
    sigma_m : float
        Standard deviation along each horizontal axis.

    Raises
    ------
    InputError
        If a value is not finite or out of range.
    """

    lat_deg: float
    lon_deg: float
    sigma_m: float

    def __post_init__(self) -> None:
        if not (abs(self.lat_deg) <= 90 and abs(self.lon_deg) <= 180 and 0 < self.sigma_m <= 1000):
            raise InputError(
                f"the stated position {self.lat_deg:g}, {self.lon_deg:g} with {self.sigma_m:g} m is none: "
                "latitude up to 90, longitude up to 180, standard deviation up to 1000 m"
            )


def pre_arm(
    pilot: Pilot,
    images: Iterable[FlownImage],
    stated: StatedPosition | None = None,
) -> Iterator[str]:
    """Test a bundle on the first images, and yield a line for each test that passed.

    Parameters
    ----------
    pilot : Pilot
        Which has checked the hashes of its bundle.
    images : iterable of FlownImage
        Images with what is known at their times.
    stated : StatedPosition, optional

    Yields
    ------
    str

    Raises
    ------
    InputError
        With the number that missed its limit, if a test fails.
    """
    bundle = pilot.localizer.bundle
    yield "Bundle: graph and landmarks have the hashes that bundle.json states."
    origin = bundle.view.origin
    if stated is not None and origin is None:
        raise InputError(
            "not ready: the world of the bundle has no place on the Earth to compare with --at",
            path=bundle.folder,
        )
    reasons: Counter[str] = Counter()
    for count, (time_us, image, vertical, height_m) in enumerate(images, 1):
        if count == 1:
            height, width = image.shape[:2]
            seen = pilot.localizer.renderer(pilot.camera, width, height).valid.mean()
            yield f"Camera: {width}x{height}, fills {100 * seen:.0f} % of the network's view."
        item = pilot.fix(image, time_us)
        if isinstance(item, Fix) and item.usable:
            yield (
                f"First fix: image {count}, protected to {item.horizontal_protection_m:.2f} m horizontally "
                f"and {item.vertical_protection_m:.2f} m vertically."
            )
            yield _position(item, stated, origin)
            yield _attitude(item, vertical)
            yield _height(item, height_m, HeightZero(pilot.options.height))
            return
        reasons[item.reason] += 1
        if count == _IMAGES:
            break
    most = Counter({kind_of_reason(text): number for text, number in reasons.items()})
    why = f"; most often: {most.most_common(1)[0][0]}" if most else ""
    raise InputError(f"not ready: no usable fix in {sum(reasons.values())} images{why}")


def _position(fix: Fix, stated: StatedPosition | None, origin: GeoOrigin | None) -> str:
    if stated is None or origin is None:
        return "Position: not compared; state it with --at."
    there = origin.enu_from_wgs84(np.array([[stated.lat_deg, stated.lon_deg, origin.alt_m]]))[0]
    away_m = float(np.hypot(*(fix.center - there)[:2]))
    own_m = float(np.sqrt(np.linalg.eigvalsh(fix.covariance[:2, :2])[-1]))
    allowed_m = _SIGMAS * float(np.hypot(stated.sigma_m, own_m))
    if away_m > allowed_m:
        raise InputError(
            f"not ready: the first fix is {away_m:.1f} m from the stated position, {allowed_m:.1f} m is "
            "allowed"
        )
    return f"Position: {away_m:.1f} m from the stated one, {allowed_m:.1f} m is allowed."


def _attitude(fix: Fix, vertical: KnownVertical | None) -> str:
    if vertical is None:
        return "Attitude: not compared; state it with --attitude."
    rotation = rotations_from_quats(fix.quat_wxyz)
    sigmas = tilt_sigmas(vertical, rotation, fix.covariance)
    cosine = float(np.clip(rotation[:, 2] @ np.array(vertical.up), -1, 1))
    off = f"{np.rad2deg(np.arccos(cosine)):.1f} deg ({sigmas:.1f} standard deviations)"
    if sigmas > _MAX_TILT_SIGMAS:
        raise InputError(
            f"not ready: the first fix is {off} from the stated attitude, {_MAX_TILT_SIGMAS:g} standard "
            "deviations are allowed"
        )
    return f"Attitude: {off} from the stated one."


def _height(fix: Fix, height_m: float | None, zero: HeightZero) -> str:
    if height_m is None:
        return "Height: not compared; state it with --height."
    up_m, sigma_m = zero.expected(height_m, fix.time_us)
    off_m = float(fix.center[2]) - up_m
    allowed_m = _SIGMAS * float(np.hypot(sigma_m, np.sqrt(fix.covariance[2, 2])))
    if abs(off_m) > allowed_m:
        raise InputError(
            f"not ready: the first fix is {off_m:+.1f} m from the stated height, {allowed_m:.1f} m is allowed"
        )
    return f"Height: {off_m:+.1f} m from the stated one, {allowed_m:.1f} m is allowed."
