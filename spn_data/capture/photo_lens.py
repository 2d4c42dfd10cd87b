"""Focal length that the metadata of a photo state, with its standard deviation."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from spn_data.telemetry.exif import PhotoMetadata

_DIAGONAL_35MM = 43.267
# Relative standard deviations.
_CALIBRATED_SIGMA = 0.01
_NOMINAL_SIGMA = 0.02  # of a focal length in millimetres: samples differ, and so does the focus
_EQUIVALENT_SIGMA = 0.03
# Of rounding to 0.1 mm, and to whole 35 mm equivalents.
_ROUNDED_MM, _ROUNDED_35MM = 0.03, 0.29
_DISAGREE = 2.0  # standard deviations of the difference
# Aspect ratios up to which an image is taken to be 4:3 and 3:2; wider ones are crops of either.
_4_TO_3, _3_TO_2 = 1.42, 1.6
_SHORTEST, _LONGEST = 0.1, 1000.0  # believed, in units of the longer side
_SAME_ASPECT = 0.02
_SAME_CENTRE = 0.05
# Width and height in millimetres of the sensors of common drones, by the camera model in EXIF. Their makers
# publish the type: 1/2.3, 1/2, 1/1.3, 1 and 4/3 inches.
_2_3_INCH, _2_INCH, _1_3_INCH = (6.17, 4.63), (6.4, 4.8), (9.6, 7.2)
_1_INCH, _4_3_INCH, _FULL_FRAME = (13.2, 8.8), (17.3, 13.0), (35.9, 24.0)
SENSORS_MM: dict[str, tuple[float, float]] = {
    **dict.fromkeys(
        ("FC300S", "FC300X", "FC330", "FC220", "FC2103", "FC7203", "FC7303"), _2_3_INCH
    ),
    "FC3170": _2_INCH,
    "FC3582": _1_3_INCH,
    **dict.fromkeys(("FC6310", "FC6310R", "FC6310S", "FC6510", "L1D-20c"), _1_INCH),
    **dict.fromkeys(("L2D-20c", "M3E", "FC6520"), _4_3_INCH),
    "ZenmuseP1": _FULL_FRAME,
}


@dataclass(frozen=True)
class StatedFocal:
    """Focal length that something states.

    Attributes
    ----------
    focal_px : float
        In pixels of the photo.
    sigma : float
        Standard deviation divided by the focal length.
    source : str
        What states it, for the user.
    in_pixels : bool
        Whether it was stated for pixels, so that it is wrong if the photo was resized without a trace.
    """

    focal_px: float
    sigma: float
    source: str
    in_pixels: bool = False


def stated_focal(photo: PhotoMetadata) -> tuple[StatedFocal | None, str]:
    """Return the best statement of the focal length, and a note if another one disagrees.

    Parameters
    ----------
    photo : PhotoMetadata

    Returns
    -------
    stated : StatedFocal or None
        None if nothing states it. The standard deviation is the larger one of statements that disagree.
    note : str
        Empty if they agree.
    """
    candidates = (_focal_plane(photo), _calibrated(photo), _by_sensor(photo), _equivalent(photo))
    best, note, longer_px = None, "", max(photo.width, photo.height)
    for other in candidates:
        if other is None or not _SHORTEST < other.focal_px / longer_px < _LONGEST:
            continue
        if best is None:
            best = other
            continue
        difference = math.log(other.focal_px / best.focal_px)
        if abs(difference) <= _DISAGREE * math.hypot(best.sigma, other.sigma):
            continue
        # A statement without pixels holds for a resized photo too.
        kept = other if best.in_pixels and not other.in_pixels else best
        note = note or (
            f"the focal length is {best.focal_px:.0f} px by {best.source}, but {other.focal_px:.0f} px by "
            f"{other.source}; {kept.source} is used"
        )
        best = replace(kept, sigma=max(best.sigma, other.sigma))
    return best, note


def _focal_plane(photo: PhotoMetadata) -> StatedFocal | None:
    """Return the focal length by the number of sensor pixels per millimetre."""
    focal_px = photo.focal_mm * photo.focal_plane_px_per_mm * _scale(photo, photo.original_size)
    if not focal_px > 0:
        return None
    sigma = math.hypot(_NOMINAL_SIGMA, _ROUNDED_MM / photo.focal_mm)
    return StatedFocal(focal_px, sigma, "FocalPlaneXResolution", in_pixels=True)


def _calibrated(photo: PhotoMetadata) -> StatedFocal | None:
    """Return the calibrated focal length of the drone; it is stated in pixels of the full size."""
    if not photo.calibrated_focal_px > 0:
        return None
    width, height = photo.original_size or (photo.width, photo.height)
    centre_x, centre_y = photo.calibrated_center_px
    if centre_x > 0 and centre_y > 0 and abs(2 * centre_x / width - 1) > _SAME_CENTRE:
        width, height = round(2 * centre_x), round(2 * centre_y)
    focal_px = photo.calibrated_focal_px * _scale(photo, (width, height))
    return StatedFocal(focal_px, _CALIBRATED_SIGMA, "CalibratedFocalLength", in_pixels=True)


def _scale(photo: PhotoMetadata, original: tuple[int, int] | None) -> float:
    """Return the width of the photo over its original width; 1 if it was cropped or that is unknown."""
    if original is None:
        return 1.0
    width, height = original
    same_shape = abs(photo.width * height / (photo.height * width) - 1) <= _SAME_ASPECT
    return photo.width / width if same_shape else 1.0


def _by_sensor(photo: PhotoMetadata) -> StatedFocal | None:
    """Return the focal length by the size of the sensor of a common drone, whose crops keep one side."""
    sensor = SENSORS_MM.get(photo.model)
    if sensor is None or not photo.focal_mm > 0:
        return None
    long, short = max(photo.width, photo.height), min(photo.width, photo.height)
    px_per_mm = long / sensor[0] if long / short >= sensor[0] / sensor[1] else short / sensor[1]
    sigma = math.hypot(_NOMINAL_SIGMA, _ROUNDED_MM / photo.focal_mm)
    return StatedFocal(photo.focal_mm * px_per_mm, sigma, f"the sensor of {photo.model}")


def _equivalent(photo: PhotoMetadata) -> StatedFocal | None:
    """Return the focal length by the 35 mm equivalent.

    It compares diagonals (CIPA DCG-001), but some makers compare widths, and that of a crop may be of the
    whole sensor.
    """
    if not photo.focal_35mm > 0:
        return None
    long, short = max(photo.width, photo.height), min(photo.width, photo.height)
    own = math.hypot(long, short)
    whole_4_to_3, whole_3_to_2 = 5 / 4 * long, math.sqrt(13) / 3 * long
    if long / short < _4_TO_3:
        diagonal, crop = own, own / whole_3_to_2
    elif long / short < _3_TO_2:
        diagonal, crop = own, whole_4_to_3 / own
    else:  # between that of the crop and that of a sensor of 4:3
        diagonal, crop = math.sqrt(own * whole_4_to_3), math.sqrt(whole_4_to_3 / own)
    sigma = math.hypot(_EQUIVALENT_SIGMA, _ROUNDED_35MM / photo.focal_35mm)
    sigma = math.hypot(sigma, math.log(crop))
    return StatedFocal(photo.focal_35mm / _DIAGONAL_35MM * diagonal, sigma, "the 35 mm equivalent")
