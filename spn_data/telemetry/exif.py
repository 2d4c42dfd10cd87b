"""EXIF and XMP metadata of photos: time, position, orientation and lens. Pixels are never decoded."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spn_data.errors import InputError
from spn_data.geometry.geodesy import HeightReference
from spn_data.media.photo_file import DAMAGE, is_raw, open_photo, raw_size
from spn_data.telemetry.accuracy import NAN_SIGMA, Sigma, sigma_from_dop
from spn_data.telemetry.drone_xmp import DroneXmp, describe_rtk, read_drone_xmp
from spn_data.telemetry.photo_tags import (
    NAN,
    exif_tags,
    number,
    positive,
    tags_of_raw,
    text,
    xmp_properties,
)
from spn_data.telemetry.photo_time import exposure_times, natural_order
from spn_data.telemetry.placeholders import without_placeholders
from spn_data.telemetry.track import Telemetry

_MAKE, _MODEL, _ORIENTATION = 271, 272, 274
_FOCAL_MM, _FOCAL_35MM, _LENS_MODEL = 37386, 41989, 42036
_ORIGINAL_WIDTH, _ORIGINAL_HEIGHT = 40962, 40963
_FOCAL_PLANE_X, _FOCAL_PLANE_UNIT = 41486, 41488
_UNITS_MM = {
    2.0: 25.4,
    3.0: 10.0,
    4.0: 1.0,
    5.0: 0.001,
}  # inch by default; 4 and 5 are common extensions
_MAX_SIDE_PX = 1_000_000
_GPS_LAT, _GPS_LON, _GPS_ALT_REF, _GPS_ALT = 2, 4, 5, 6
_GPS_MEASURE_MODE, _GPS_DOP, _GPS_H_ERROR = 10, 11, 31
_XMP = 700
_SAME_HEIGHT_M = 0.1


@dataclass(frozen=True)
class PhotoMetadata:
    """Metadata of one photo; NaN, "" or None if not stated.

    Attributes
    ----------
    path : Path
        The photo.
    width, height : int
        Size as stored, before `orientation` is applied.
    orientation : int
        EXIF: 1 as stored, 3 turned by 180 degrees, 6 and 8 by 90.
    make, model, lens : str
        Camera and lens.
    focal_mm, focal_35mm : float
        Focal length and its 35 mm equivalent.
    focal_plane_px_per_mm : float
        Pixels of the original image per millimetre of the sensor.
    original_size : (int, int) or None
        Width and height that the camera wrote, as stored.
    calibrated_focal_px : float
    calibrated_center_px : tuple of float
        Focal length and principal point (x, y) in pixels of the original image, by the drone's calibration.
    local_s, utc_s : float
        Time of exposure in seconds since 1970, on the camera's clock of unknown time zone, and in UTC
        (only if the photo states the zone).
    lat_deg, lon_deg : float
        WGS84 position.
    position_without_letters : bool
        Whether the EXIF has a position that does not say N or S, E or W, and nothing else states one.
    altitude_m : float
        EXIF altitude, or XMP's AbsoluteAltitude.
    altitude_reference : HeightReference
        What `altitude_m` is measured from.
    altitude_type : str
        XMP, such as "RtkAlt" or "GpsFusionAlt".
    relative_altitude_m : float
        Height above take-off.
    gimbal_deg : tuple of float
        Heading, pitch, roll.
    rtk_flag : int or None
        DJI: 50 fixed, 32 to 49 float, 16 single, 0 none.
    sigma_m : tuple of float
        Standard deviations east, north, up.
    notes : tuple of str
        What is damaged in the metadata.
    """

    path: Path
    width: int
    height: int
    orientation: int = 1
    make: str = ""
    model: str = ""
    lens: str = ""
    focal_mm: float = NAN
    focal_35mm: float = NAN
    focal_plane_px_per_mm: float = NAN
    original_size: tuple[int, int] | None = None
    calibrated_focal_px: float = NAN
    calibrated_center_px: tuple[float, float] = (NAN, NAN)
    local_s: float = NAN
    utc_s: float = NAN
    lat_deg: float = NAN
    lon_deg: float = NAN
    position_without_letters: bool = False
    altitude_m: float = NAN
    altitude_reference: HeightReference = HeightReference.UNKNOWN
    altitude_type: str = ""
    relative_altitude_m: float = NAN
    gimbal_deg: tuple[float, float, float] = (NAN, NAN, NAN)
    rtk_flag: int | None = None
    sigma_m: Sigma = NAN_SIGMA
    notes: tuple[str, ...] = ()


def read_photo(path: Path | str) -> PhotoMetadata:
    """Read the metadata of a JPEG, PNG, TIFF, BMP, WebP, HEIC or DNG.

    Parameters
    ----------
    path : Path or str
        The photo.

    Returns
    -------
    PhotoMetadata
        Its metadata. Damaged entries in a readable photo are left out and reported in `notes`.

    Raises
    ------
    InputError
        If the file cannot be read as such a photo.
    """
    path = Path(path)
    notes: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            width, height, main, exif, gps, data = _read_file(path, notes)
        except DAMAGE as error:
            reason = (
                getattr(error, "strerror", None)
                or "it is not a JPEG, PNG, TIFF, BMP, WebP or HEIC, or it is damaged"
            )
            raise InputError(f"cannot be read as a photo: {reason}", path=path) from error
    if caught:
        notes.append(f"damaged EXIF: {str(caught[0].message).splitlines()[0][:200]}")
    drone = read_drone_xmp(xmp_properties(data, notes))
    orientation = number(main.get(_ORIENTATION))
    local_s, utc_s = exposure_times(main, exif, gps, utc_at_exposure=drone.utc_at_exposure)
    lat, lon = _position(gps, drone, notes)
    altitude, reference = _altitude(gps, drone)
    if drone.invalid_fix and math.isfinite(lat):
        notes.append("GpsStatus is Invalid, so its position is left out")
        lat = lon = altitude = NAN
    if drone.unused_angles:
        notes.append(
            "Camera:Pitch is left out, as makers measure it from the horizon or from below"
        )
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
        focal_plane_px_per_mm=_focal_plane_px_per_mm(exif),
        original_size=_original_size(exif),
        calibrated_focal_px=drone.calibrated_focal_px,
        calibrated_center_px=drone.calibrated_center_px,
        local_s=local_s,
        utc_s=utc_s,
        lat_deg=lat,
        lon_deg=lon,
        position_without_letters=math.isnan(lat) and _lacks_letters(gps),
        altitude_m=altitude,
        altitude_reference=reference,
        altitude_type=drone.altitude_type,
        relative_altitude_m=drone.relative_altitude_m,
        gimbal_deg=drone.gimbal_deg,
        rtk_flag=drone.rtk_flag,
        sigma_m=_sigma(gps, drone),
        notes=tuple(notes),
    )


def _read_file(
    path: Path, notes: list[str]
) -> tuple[int, int, dict[int, Any], dict[int, Any], dict[int, Any], Any]:
    """Return stored width and height, main, EXIF and GPS tags, and XMP; HEIC, DNG are upright already."""
    if is_raw(path):
        width, height = raw_size(path)
        main, exif, gps = exif_tags(lambda: tags_of_raw(path), notes)
        return width, height, main | {_ORIENTATION: 1}, exif, gps, main.get(_XMP)
    with open_photo(path) as image:
        width, height = image.size
        main, exif, gps = exif_tags(image.getexif, notes)
        if image.format == "HEIF":
            main = main | {_ORIENTATION: 1}
        elif image.format == "TIFF" and number(main.get(_ORIENTATION)) in (5, 6, 7, 8):
            width, height = height, width  # Pillow reports the upright size of a TIFF
        return width, height, main, exif, gps, image.info.get("xmp")


def telemetry_from_photos(
    photos: Sequence[PhotoMetadata], names: Sequence[str] | None = None, *, source: str = ""
) -> Telemetry:
    """Build telemetry with one record per photo.

    Parameters
    ----------
    photos : sequence of PhotoMetadata
        In the order of the sequence.
    names : sequence of str, optional
        Names for the notes, by default those of the files.
    source : str
        Name of the source.

    Returns
    -------
    Telemetry
        time_s is in seconds after the first photo, in UTC or on the camera's clock. If a photo has no time,
        or the times decrease, photos are counted as one per second, and a note says so.

    Raises
    ------
    ValueError
        If the number of names differs from that of the photos.
    """
    names = [photo.path.name for photo in photos] if names is None else names
    if len(names) != len(photos):
        raise ValueError(f"{len(names)} names for {len(photos)} photos")
    damaged = [(name, p.notes[0]) for name, p in zip(names, photos, strict=True) if p.notes]
    notes = []
    unsigned = [n for n, p in zip(names, photos, strict=True) if p.position_without_letters]
    if unsigned:
        notes.append(
            f"photos whose position does not say N or S, E or W, and is left out: {len(unsigned)}, the first "
            f"is {unsigned[0]}; write the letters, for example with exiftool -GPSLatitudeRef=N "
            "-GPSLongitudeRef=E"
        )
    if damaged:
        notes.append(
            f"photos with damaged metadata: {len(damaged)}, the first is {': '.join(damaged[0])}"
        )
    utc_s = np.array([photo.utc_s for photo in photos])
    is_local = not np.isfinite(utc_s).all()
    if is_local:
        utc_s = np.array([photo.local_s for photo in photos])
    time_s = utc_s - utc_s[0] if len(photos) else utc_s
    if not np.isfinite(time_s).all():
        missing = [name for name, t in zip(names, utc_s, strict=True) if math.isnan(t)]
        notes.append(
            f"{len(missing)} photos have no time, the first is {missing[0]}; "
            "photos are counted as one per second"
        )
        time_s = np.arange(len(photos), dtype=np.float64)
    elif np.any(np.diff(time_s) < 0):
        later = names[int(np.flatnonzero(np.diff(time_s) < 0)[0]) + 1]
        notes.append(
            f"{later} is older than the photo before it; photos are counted as one per second"
        )
        time_s = np.arange(len(photos), dtype=np.float64)
    altitude = np.array([photo.altitude_m for photo in photos])
    references = {p.altitude_reference for p in photos if not math.isnan(p.altitude_m)}
    reference = references.pop() if len(references) == 1 else HeightReference.UNKNOWN
    if np.any(altitude < 0):
        notes.append(
            f"the EXIF altitude goes down to {np.nanmin(altitude):.1f} m, below sea level: "
            "trust only its differences, if at all"
        )
    ordered = sorted(names, key=natural_order)
    if list(names) != ordered:
        first = next(n for n, m in zip(names, ordered, strict=True) if n != m)
        notes.append(f"photos are in the order of their times, not of their names, from {first} on")
    rtk = describe_rtk([photo.rtk_flag for photo in photos])
    if rtk:
        notes.append(f"RTK: {rtk}")
    kinds = sorted({p.altitude_type for p in photos if p.altitude_type})
    if kinds and reference is HeightReference.UNKNOWN:
        notes.append(
            f"the altitudes are of type {', '.join(kinds)} (DJI), which states no height reference"
        )
    track = Telemetry.from_columns(
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
    return without_placeholders(track)


def _position(gps: Mapping[int, Any], drone: DroneXmp, notes: list[str]) -> tuple[float, float]:
    """Return (latitude, longitude) from EXIF, which post-processing rewrites, or from XMP; NaN if unknown."""
    lat, lon = _degrees(gps, _GPS_LAT, "N", "S"), _degrees(gps, _GPS_LON, "E", "W")
    if math.isnan(lat + lon):
        lat, lon = drone.lat_deg, drone.lon_deg
    # DJI writes 0, 0 if there is no fix.
    if math.isnan(lat + lon) or (lat == 0 and lon == 0):
        return NAN, NAN
    if abs(lat) > 90 or abs(lon) > 180:
        notes.append(f"{lat}, {lon} is not a position on Earth")
        return NAN, NAN
    return lat, lon


def _lacks_letters(gps: Mapping[int, Any]) -> bool:
    """Return whether there are three numbers for latitude and longitude, but not the letters of both."""
    numbers = (gps.get(_GPS_LAT), gps.get(_GPS_LON))
    letters = (text(gps.get(_GPS_LAT - 1)).upper(), text(gps.get(_GPS_LON - 1)).upper())
    full = all(isinstance(n, tuple) and len(n) == 3 and any(map(number, n)) for n in numbers)
    return full and not (letters[0] in ("N", "S") and letters[1] in ("E", "W"))


def _degrees(gps: Mapping[int, Any], tag: int, plus: str, minus: str) -> float:
    """Return signed degrees from (degrees, minutes, seconds) and the letter in the tag before it."""
    parts = gps.get(tag)
    letter = text(gps.get(tag - 1)).upper()
    if not isinstance(parts, tuple) or len(parts) != 3 or letter not in (plus, minus):
        return NAN
    degrees, minutes, seconds = (number(part) for part in parts)
    if not (0 <= minutes <= 60 and 0 <= seconds <= 60):
        return NAN
    size = degrees + minutes / 60 + seconds / 3600
    return -size if letter == minus else size


def _altitude(gps: Mapping[int, Any], drone: DroneXmp) -> tuple[float, HeightReference]:
    """Return the signed altitude and its reference.

    EXIF 2 calls references 0 and 1 sea level, EXIF 3 the ellipsoid, and drones write either of these or a
    pressure height: unknown, unless DJI says that it is of RTK, which is above the ellipsoid. References 2
    and 3 were added in EXIF 3 and mean sea level.
    """
    altitude = number(gps.get(_GPS_ALT))
    code = gps.get(_GPS_ALT_REF, b"\0")
    code = code[0] if isinstance(code, bytes) and code else code
    altitude = -altitude if code in (1, 3) else altitude
    # A program that rewrote the EXIF altitude may have changed its reference.
    same = math.isnan(altitude) or abs(altitude - drone.altitude_m) <= _SAME_HEIGHT_M
    if drone.altitude_type == "RtkAlt" and math.isfinite(drone.altitude_m) and same:
        return drone.altitude_m, HeightReference.ELLIPSOID
    if math.isnan(altitude):
        return drone.altitude_m, HeightReference.UNKNOWN
    return altitude, HeightReference.AMSL if code in (2, 3) else HeightReference.UNKNOWN


def _focal_plane_px_per_mm(exif: Mapping[int, Any]) -> float:
    unit = _UNITS_MM.get(number(exif.get(_FOCAL_PLANE_UNIT, 2)))
    return NAN if unit is None else positive(exif.get(_FOCAL_PLANE_X)) / unit


def _original_size(exif: Mapping[int, Any]) -> tuple[int, int] | None:
    size = positive(exif.get(_ORIGINAL_WIDTH)), positive(exif.get(_ORIGINAL_HEIGHT))
    if not all(1 <= side <= _MAX_SIDE_PX for side in size):
        return None
    return int(size[0]), int(size[1])


def _sigma(gps: Mapping[int, Any], drone: DroneXmp) -> Sigma:
    """Return standard deviations east, north, up in metres from the most direct statement available."""
    if not math.isnan(drone.sigma_m[0]):
        return drone.sigma_m
    horizontal = positive(gps.get(_GPS_H_ERROR))
    if not math.isnan(horizontal):
        return horizontal, horizontal, NAN
    dop = positive(gps.get(_GPS_DOP))
    # EXIF: dilution in three dimensions, or in two if only those were measured.
    return (
        sigma_from_dop(hdop=dop)
        if text(gps.get(_GPS_MEASURE_MODE)) == "2"
        else sigma_from_dop(pdop=dop)
    )
