"""What a photo's EXIF and XMP say: when, where, which way, through which lens. Never its pixels."""

from __future__ import annotations

import math
import struct
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.telemetry.accuracy import NAN_SIGMA, Sigma, sigma_from_dop
from spn_data.telemetry.photo_tags import NAN, exif_tags, number, positive, text, xmp_properties
from spn_data.telemetry.track import Telemetry

MAX_PHOTO_BYTES = 1_000_000_000

_MAKE, _MODEL, _ORIENTATION, _DATE_TIME = 271, 272, 274, 306
_DATE_TIME_ORIGINAL, _OFFSET_TIME_ORIGINAL, _SUB_SEC_ORIGINAL = 36867, 36881, 37521
_FOCAL_MM, _FOCAL_35MM, _LENS_MODEL = 37386, 41989, 42036
_GPS_LAT, _GPS_LON, _GPS_ALT_REF, _GPS_ALT = 2, 4, 5, 6
_GPS_MEASURE_MODE, _GPS_DOP, _GPS_H_ERROR = 10, 11, 31

# The prefix is the file's own choice; the address is what identifies the vocabulary.
_DJI = "{http://www.dji.com/drone-dji/1.0/}"
_PIX4D = "{http://pix4d.com/camera/1.0}"


@dataclass(frozen=True)
class PhotoMetadata:
    """What a photo says of itself; NaN, "" or None where it says nothing.

    local_s, utc_s : when it was taken, seconds since 1970, on the camera's clock of unknown zone
        and in UTC (only where the photo tells the zone).
    altitude_m, altitude_reference : EXIF altitude, else XMP's AbsoluteAltitude.
    sigma_m : east, north, up. gimbal_deg : heading, pitch, roll.
    """

    path: Path
    width: int  # as stored, before `orientation` is applied
    height: int
    orientation: int = 1  # EXIF: 1 as stored, 3 turned by 180 degrees, 6 and 8 by 90
    make: str = ""
    model: str = ""
    lens: str = ""
    focal_mm: float = NAN
    focal_35mm: float = NAN
    calibrated_focal_px: float = NAN  # XMP, of the full-size photo
    local_s: float = NAN
    utc_s: float = NAN
    lat_deg: float = NAN
    lon_deg: float = NAN
    altitude_m: float = NAN
    altitude_reference: HeightReference = HeightReference.UNKNOWN
    altitude_type: str = ""  # XMP, such as "RtkAlt" or "GpsFusionAlt"
    relative_altitude_m: float = NAN
    gimbal_deg: tuple[float, float, float] = (NAN, NAN, NAN)
    rtk_flag: int | None = None  # DJI: 50 fixed, 32 to 49 float, 16 single, 0 none
    sigma_m: Sigma = NAN_SIGMA
    notes: tuple[str, ...] = ()  # what is damaged in the metadata


def read_photo(path: Path | str) -> PhotoMetadata:
    """Metadata of a JPEG, PNG or TIFF. Raises InputError where it is no such photo.

    Damaged metadata in a readable photo does not stop it: it is left out and said in `notes`.
    """
    path = Path(path)
    notes: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            if path.stat().st_size > MAX_PHOTO_BYTES:
                raise InputError(
                    f"is larger than the {MAX_PHOTO_BYTES / 1e9:.0f} GB that a photo may have",
                    path=path,
                )
            with Image.open(path, formats=("JPEG", "PNG", "TIFF")) as image:
                width, height = image.size
                main, exif, gps = exif_tags(image, notes)
                if image.format == "TIFF" and number(main.get(_ORIENTATION)) in (5, 6, 7, 8):
                    width, height = height, width  # Pillow tells the size of a TIFF once turned
                xmp = xmp_properties(image, notes)
        except (
            OSError,
            SyntaxError,
            ValueError,
            struct.error,
            Image.DecompressionBombError,
        ) as error:
            reason = getattr(error, "strerror", None) or "it is no JPEG, PNG or TIFF, or is damaged"
            raise InputError(f"cannot be read as a photo: {reason}", path=path) from error
    damage = [
        str(warning.message).splitlines()[0][:200]
        for warning in caught
        if not issubclass(warning.category, Image.DecompressionBombWarning)
    ]
    if damage:
        notes.append(f"damaged EXIF: {damage[0]}")
    orientation = number(main.get(_ORIENTATION))
    local_s, utc_s = _times(main, exif, xmp)
    lat, lon = _position(gps, xmp, notes)
    altitude, reference = _altitude(gps, xmp)
    gimbal = [number(xmp.get(_DJI + f"Gimbal{axis}Degree")) for axis in ("Yaw", "Pitch", "Roll")]
    rtk = number(xmp.get(_DJI + "RtkFlag"))
    return PhotoMetadata(
        path=path,
        width=width,
        height=height,
        orientation=int(orientation) if orientation in range(1, 9) else 1,
        make=text(main.get(_MAKE)),
        model=text(main.get(_MODEL)),
        lens=text(exif.get(_LENS_MODEL)),
        focal_mm=positive(exif.get(_FOCAL_MM)),
        focal_35mm=positive(exif.get(_FOCAL_35MM)),
        calibrated_focal_px=positive(xmp.get(_DJI + "CalibratedFocalLength")),
        local_s=local_s,
        utc_s=utc_s,
        lat_deg=lat,
        lon_deg=lon,
        altitude_m=altitude,
        altitude_reference=reference,
        altitude_type=text(xmp.get(_DJI + "AltitudeType")),
        relative_altitude_m=number(xmp.get(_DJI + "RelativeAltitude")),
        gimbal_deg=(gimbal[0] % 360.0, gimbal[1], gimbal[2]),
        rtk_flag=None if math.isnan(rtk) else int(rtk),
        sigma_m=_sigma(gps, xmp, rtk),
        notes=tuple(notes),
    )


def telemetry_of_photos(
    photos: Sequence[PhotoMetadata], names: Sequence[str] | None = None, *, source: str = ""
) -> Telemetry:
    """One record a photo, in the order given; `names` (by default the files') serve the notes.

    time_s is seconds after the first photo, in UTC or on the camera's clock; where a photo has no
    time, or the times decrease, it is the photo's place in the order, and a note says so.
    """
    names = [photo.path.name for photo in photos] if names is None else names
    if len(names) != len(photos):
        raise ValueError(f"{len(names)} names for {len(photos)} photos")
    damaged = [(name, p.notes[0]) for name, p in zip(names, photos, strict=True) if p.notes]
    notes = []
    if damaged:
        notes.append(
            f"photos with damaged metadata: {len(damaged)}, the first {': '.join(damaged[0])}"
        )
    utc_s = np.array([photo.utc_s for photo in photos])
    is_local = not np.isfinite(utc_s).all()
    if is_local:
        utc_s = np.array([photo.local_s for photo in photos])
    time_s = utc_s - utc_s[0] if len(photos) else utc_s
    if not np.isfinite(time_s).all():
        missing = [name for name, t in zip(names, utc_s, strict=True) if math.isnan(t)]
        notes.append(
            f"{len(missing)} photos have no time, the first {missing[0]}: counted as one a second"
        )
        time_s = np.arange(len(photos), dtype=np.float64)
    elif np.any(np.diff(time_s) < 0):
        later = names[int(np.flatnonzero(np.diff(time_s) < 0)[0]) + 1]
        notes.append(f"{later} was taken before the photo ahead of it: counted as one a second")
        time_s = np.arange(len(photos), dtype=np.float64)
    altitude = np.array([photo.altitude_m for photo in photos])
    references = {p.altitude_reference for p in photos if not math.isnan(p.altitude_m)}
    reference = references.pop() if len(references) == 1 else HeightReference.UNKNOWN
    if np.any(altitude < 0):
        notes.append(
            f"the EXIF altitude falls to {np.nanmin(altitude):.1f} m, below sea level: "
            "trust it for differences at most"
        )
    kinds = sorted({p.altitude_type for p in photos if p.altitude_type})
    if kinds and reference is HeightReference.UNKNOWN:
        notes.append(
            f"the altitudes are of type {', '.join(kinds)} (DJI), which states no height reference"
        )
    return Telemetry.from_columns(
        time_s,
        lat_lon_deg=np.array([(p.lat_deg, p.lon_deg) for p in photos]).reshape(-1, 2),
        rel_alt_m=np.array([p.relative_altitude_m for p in photos]),
        abs_alt_m=altitude,
        sigma_m=np.array([p.sigma_m for p in photos]).reshape(-1, 3),
        gimbal_deg=np.array([p.gimbal_deg for p in photos]).reshape(-1, 3),
        utc_s=utc_s,
        abs_reference=reference,
        utc_is_local=is_local,
        kind="exif",
        source=source,
        notes=tuple(notes),
    )


def _times(
    main: Mapping[int, Any], exif: Mapping[int, Any], xmp: Mapping[str, str]
) -> tuple[float, float]:
    """(local_s, utc_s), seconds since 1970."""
    taken = text(exif.get(_DATE_TIME_ORIGINAL)) or text(main.get(_DATE_TIME))
    local_s = _seconds(taken, "%Y:%m:%d %H:%M:%S")
    fraction = text(exif.get(_SUB_SEC_ORIGINAL))
    if fraction.isdecimal():
        local_s += int(fraction) / 10 ** len(fraction)
    offset = text(exif.get(_OFFSET_TIME_ORIGINAL))
    utc_s = NAN
    try:
        zone = datetime.strptime(offset, "%z").utcoffset() if offset else None
    except ValueError:
        zone = None
    if zone is not None:
        utc_s = local_s - zone / timedelta(seconds=1)
    exposure = xmp.get(_DJI + "UTCAtExposure", "")
    if exposure:
        whole, _, part = exposure.replace("T", " ").partition(".")
        exposure_s = _seconds(whole, "%Y-%m-%d %H:%M:%S")
        digits = part.rstrip("Z")
        utc_s = exposure_s + (int(digits) / 10 ** len(digits) if digits.isdecimal() else 0.0)
    return local_s, utc_s


def _seconds(stamp: str, layout: str) -> float:
    try:
        return datetime.strptime(stamp, layout).replace(tzinfo=UTC).timestamp()
    except ValueError:  # "0000:00:00 00:00:00" is how a camera says that its clock was never set
        return NAN


def _position(
    gps: Mapping[int, Any], xmp: Mapping[str, str], notes: list[str]
) -> tuple[float, float]:
    """(latitude, longitude): EXIF's, which post-processing rewrites, else XMP's; or NaN."""
    lat, lon = _degrees(gps, _GPS_LAT, "S"), _degrees(gps, _GPS_LON, "W")
    if math.isnan(lat + lon):
        lat = number(xmp.get(_DJI + "GpsLatitude"))
        lon = number(xmp.get(_DJI + "GpsLongitude", xmp.get(_DJI + "GpsLongtitude")))
    if math.isnan(lat + lon) or (
        lat == 0 and lon == 0
    ):  # 0, 0 is how DJI says that there is no fix
        return NAN, NAN
    if abs(lat) > 90 or abs(lon) > 180:
        notes.append(f"{lat}, {lon} is no position on Earth")
        return NAN, NAN
    return lat, lon


def _degrees(gps: Mapping[int, Any], tag: int, negative: str) -> float:
    """Signed degrees of (degrees, minutes, seconds) and the letter in the tag before it."""
    parts = gps.get(tag)
    letter = text(gps.get(tag - 1)).upper()
    if not isinstance(parts, tuple) or len(parts) != 3 or letter not in ("N", "S", "E", "W"):
        return NAN
    degrees, minutes, seconds = (number(part) for part in parts)
    if not (0 <= minutes <= 60 and 0 <= seconds <= 60):
        return NAN
    size = degrees + minutes / 60 + seconds / 3600
    return -size if letter == negative else size


def _altitude(gps: Mapping[int, Any], xmp: Mapping[str, str]) -> tuple[float, HeightReference]:
    """The altitude with its sign, and what it is above.

    EXIF 2 calls references 0 and 1 sea level, EXIF 3 the ellipsoid, and drones write either of
    these or a pressure height under them: unknown. 2 and 3 came with EXIF 3 and say sea level.
    """
    altitude = number(gps.get(_GPS_ALT))
    if math.isnan(altitude):
        return number(xmp.get(_DJI + "AbsoluteAltitude")), HeightReference.UNKNOWN
    code = gps.get(_GPS_ALT_REF, b"\0")
    code = code[0] if isinstance(code, bytes) and code else code
    reference = HeightReference.AMSL if code in (2, 3) else HeightReference.UNKNOWN
    return (-altitude if code in (1, 3) else altitude), reference


def _sigma(gps: Mapping[int, Any], xmp: Mapping[str, str], rtk_flag: float) -> Sigma:
    """Sigma east, north, up in metres, from the most direct statement that there is."""
    rtk = tuple(positive(xmp.get(_DJI + f"RtkStd{axis}")) for axis in ("Lon", "Lat", "Hgt"))
    if not any(math.isnan(value) for value in rtk) and rtk_flag != 0:
        return rtk[0], rtk[1], rtk[2]
    horizontal = positive(xmp.get(_PIX4D + "GPSXYAccuracy"))
    if not math.isnan(horizontal):
        return horizontal, horizontal, positive(xmp.get(_PIX4D + "GPSZAccuracy"))
    horizontal = positive(gps.get(_GPS_H_ERROR))
    if not math.isnan(horizontal):
        return horizontal, horizontal, NAN
    dop = positive(gps.get(_GPS_DOP))
    # EXIF: dilution in three dimensions, or in two where only these were measured.
    return (
        sigma_from_dop(hdop=dop)
        if text(gps.get(_GPS_MEASURE_MODE)) == "2"
        else sigma_from_dop(pdop=dop)
    )
