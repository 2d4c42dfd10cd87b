"""XMP that drones write into photos: position, heights, camera angles, RTK state and accuracy, by maker."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from spn_data.telemetry.accuracy import NAN_SIGMA, Sigma
from spn_data.telemetry.photo_tags import NAN, number, positive, text

# Files choose their own prefixes; the URI identifies the namespace. Autel writes that of DJI.
_DJI = "{http://www.dji.com/drone-dji/1.0/}"
_PARROT = "{http://www.parrot.com/drone-parrot/1.0/}"
_SKYDIO = "{https://www.skydio.com/drone-skydio/1.0/}"
_PIX4D = ("{http://pix4d.com/camera/1.0/}", "{http://pix4d.com/camera/1.0}")
_SKYDIO_CAMERA = f"{_SKYDIO}CameraOrientationNED/{_SKYDIO}"
_ANGLES = ("Yaw", "Pitch", "Roll")

RTK_FIXED, RTK_NONE = 50, 0
RTK_FLOAT = range(32, 50)


@dataclass(frozen=True)
class DroneXmp:
    """What the drone says in a photo's XMP; NaN, "" or None if not stated.

    `invalid_fix`: DJI says that the position is none. `unused_angles`: there are angles of a convention that
    differs among makers. The others are as in `PhotoMetadata`.
    """

    lat_deg: float = NAN
    lon_deg: float = NAN
    altitude_m: float = NAN
    altitude_type: str = ""
    relative_altitude_m: float = NAN
    gimbal_deg: tuple[float, float, float] = (NAN, NAN, NAN)
    rtk_flag: int | None = None
    sigma_m: Sigma = NAN_SIGMA
    utc_at_exposure: str = ""
    invalid_fix: bool = False
    unused_angles: bool = False
    calibrated_focal_px: float = NAN
    calibrated_center_px: tuple[float, float] = (NAN, NAN)


def read_drone_xmp(xmp: Mapping[str, str]) -> DroneXmp:
    """Read what DJI, Autel, Parrot and Skydio write.

    Parameters
    ----------
    xmp : mapping of str to str
        Properties by "{namespace}name".

    Returns
    -------
    DroneXmp
        Angles are those of the camera, with a pitch of -90 straight down: DJI's gimbal angles, Parrot's
        CameraYawDegree and so on, and Skydio's CameraOrientationNED. Pix4D's Camera:Yaw, Pitch and Roll are
        not used: a pitch of 0 is straight down for some makers and level for others.
    """
    rtk = number(xmp.get(_DJI + "RtkFlag"))
    flag = None if math.isnan(rtk) else int(rtk)
    angles = [
        [number(xmp.get(_DJI + f"Gimbal{axis}Degree")) for axis in _ANGLES],
        [number(xmp.get(_PARROT + f"Camera{axis}Degree")) for axis in _ANGLES],
        [number(xmp.get(_SKYDIO_CAMERA + axis)) for axis in _ANGLES],
    ]
    stated = [found for found in angles if not all(math.isnan(angle) for angle in found)]
    yaw, pitch, roll = stated[0] if stated else (NAN, NAN, NAN)
    lat = number(xmp.get(_DJI + "GpsLatitude", xmp.get(_SKYDIO + "Latitude")))
    lon = number(
        xmp.get(
            _DJI + "GpsLongitude", xmp.get(_DJI + "GpsLongtitude", xmp.get(_SKYDIO + "Longitude"))
        )
    )
    return DroneXmp(
        lat_deg=lat,
        lon_deg=lon,
        altitude_m=number(
            xmp.get(_DJI + "AbsoluteAltitude", xmp.get(_SKYDIO + "AbsoluteAltitude"))
        ),
        altitude_type=text(xmp.get(_DJI + "AltitudeType")),
        relative_altitude_m=number(xmp.get(_DJI + "RelativeAltitude")),
        gimbal_deg=(yaw % 360.0, pitch, roll),
        rtk_flag=flag,
        sigma_m=_sigma(xmp, flag),
        utc_at_exposure=xmp.get(_DJI + "UTCAtExposure", ""),
        invalid_fix=text(xmp.get(_DJI + "GpsStatus")).lower() == "invalid",
        unused_angles=not stated and any(space + "Pitch" in xmp for space in _PIX4D),
        calibrated_focal_px=positive(xmp.get(_DJI + "CalibratedFocalLength")),
        calibrated_center_px=(
            positive(xmp.get(_DJI + "CalibratedOpticalCenterX")),
            positive(xmp.get(_DJI + "CalibratedOpticalCenterY")),
        ),
    )


def describe_rtk(flags: list[int | None]) -> str:
    """Return counts of RTK states, such as "17 fixed, 1 float"; "" if none is of RTK."""
    known = [flag for flag in flags if flag is not None]
    if not any(flag == RTK_FIXED or flag in RTK_FLOAT for flag in known):
        return ""
    fixed, floating = known.count(RTK_FIXED), sum(flag in RTK_FLOAT for flag in known)
    counts = {
        "fixed": fixed,
        "float": floating,
        "single or none": len(known) - fixed - floating,
        "not stated": len(flags) - len(known),
    }
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count)


def _sigma(xmp: Mapping[str, str], rtk_flag: int | None) -> Sigma:
    """Return the standard deviations east, north, up that the drone states."""
    rtk = tuple(positive(xmp.get(_DJI + f"RtkStd{axis}")) for axis in ("Lon", "Lat", "Hgt"))
    if not any(math.isnan(value) for value in rtk) and rtk_flag != RTK_NONE:
        return rtk[0], rtk[1], rtk[2]
    for space in _PIX4D:
        horizontal = _rational(xmp.get(space + "GPSXYAccuracy"))
        if not math.isnan(horizontal):
            return horizontal, horizontal, _rational(xmp.get(space + "GPSZAccuracy"))
    return NAN_SIGMA


def _rational(value: str | None) -> float:
    """Return a positive number, which Pix4D's vocabulary writes as "5/2" too; NaN for anything else."""
    above, slash, below = (value or "").partition("/")
    return positive(number(above) / (positive(below) if slash else 1.0))
